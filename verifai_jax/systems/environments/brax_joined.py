"""The start and the steps of a Brax episode as one piece of program, which is half as large.

    joined = join(env)                                      # None where they cannot be joined
    joined.moment(fresh, env, begin, state, action, finish) # a start where `fresh`, else a step

On Brax's generalized backend, half of a step of the physics is what a start computes, too: where
the links are, how heavy they seem to each joint, which constraints act. An environment's `reset`
and `step` therefore hold the most of the physics twice, and XLA compiles it twice. Here both are
split where they call the physics, which is there once: it moves a state, or takes the start's, and
goes on the same way.
"""

import copy
import importlib.metadata
import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from verifai_jax.core.errors import require
from verifai_jax.systems.environments.brax_model import BraxSystem, Env, steps_plainly

KNOWN = ("0.14.2",)
"""Versions of Brax whose pipeline is the one that is split here."""

_PARTS = (
    *("actuator", "kinematics", "math", "io.mjcf", "generalized.base", "generalized.constraint"),
    *("generalized.dynamics", "generalized.integrator", "generalized.mass"),
)


class NotJoined(Exception):
    """An environment calls the physics in another way than once a start, and once a step."""


class _Reached(BaseException):
    """The physics was called; `arguments` are those of the call."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__()
        self.arguments = arguments


def join(env: Env) -> "Joined | None":
    """Return the environment's start and step as one; None where its physics is another."""
    inner = env.unwrapped
    if importlib.metadata.version("brax") not in KNOWN or not steps_plainly(env):
        return None
    if getattr(inner, "_backend", None) != "generalized" or getattr(inner, "_debug", True):
        return None
    pipeline = require("brax.envs.base", extra="brax").PipelineEnv
    if getattr(type(inner), "pipeline_init", None) is not pipeline.pipeline_init:
        return None
    return None if "pipeline_init" in vars(inner) else Joined(inner.sys)


class Joined:
    """The physics of an environment, whose parts JAX traces once for all programs that have them.

    **Arguments:**

    - `sys`: of the environment, some of whose arrays features may change.
    """

    def __init__(self, sys: BraxSystem) -> None:
        with warnings.catch_warnings():
            # Brax says of itself that it is no longer maintained.
            warnings.simplefilter("ignore", DeprecationWarning)
            modules = {part.split(".")[-1]: import_module(f"brax.{part}") for part in _PARTS}
        self._brax = modules
        if sys.mj_model is not None:
            modules["mjcf"].validate_model(sys.mj_model)
        self._leaves, self._structure = jax.tree.flatten(sys)
        self._sys = sys
        self._moved = jax.jit(self._moved_of)
        self._derived = jax.jit(self._derived_of)

    def __reduce__(self) -> Any:
        return Joined, (self._sys,)

    def moment(
        self,
        fresh: Bool[Array, ""] | bool,
        env: Env,
        begin: Callable[[Env], Any],
        state: PyTree,
        action: PyTree,
        finish: Callable[[Any], Any],
    ) -> Any:
        """Return what `finish` makes of the start's state where `fresh`, else of the next one's.

        **Arguments:**

        - `env`: the environment under the features of the instant.
        - `begin`: the start's state in an environment, which may be a copy of `env`.
        - `state`, `action`: of the step; at a start any of the same form, or None where `fresh` is
          known to be True.
        - `finish`: of the environment's state.

        **Raises:** `NotJoined`, or anything, for an environment that cannot be split.
        """
        changed = self._changed(env.unwrapped.sys)

        def starting(state: PyTree, action: PyTree) -> Any:
            q, qd = _arguments(begin, env, "init")[:2]
            physics = self._form(changed, q, qd)
            nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), physics)
            return nothing, jnp.zeros(env.action_size, float), _real((q, qd))

        def stepping(state: PyTree, action: PyTree) -> Any:
            before, action = _arguments(lambda env: env.step(_copied(state), action), env, "step")
            return _real(before), _real(action), _real((before.q, before.qd))

        physics, control, begun = _either(fresh, starting, stepping, state, action)
        now = _array(fresh) if isinstance(fresh, bool) else fresh

        # A start is repeated at each frame, which changes nothing.
        def frame(_: Any, physics: Any) -> Any:
            moved = self._moved(changed, now, begun, physics, control)
            return self._derived(changed, now, moved)

        frames = env.unwrapped._n_frames
        if isinstance(frames, jax.Array):
            physics = jax.lax.fori_loop(0, frames, frame, physics)
        else:
            physics = jax.lax.scan(lambda p, _: (frame(_, p), None), physics, None, frames)[0]

        def started(state: PyTree, action: PyTree, physics: Any) -> Any:
            return finish(_finished(begin, env, "init", physics))

        def stepped(state: PyTree, action: PyTree, physics: Any) -> Any:
            step = lambda env: env.step(_copied(state), action)  # noqa: E731
            return finish(_finished(step, env, "step", physics))

        return _either(fresh, started, stepped, state, action, physics)

    def _changed(self, sys: BraxSystem) -> dict[int, Any]:
        """Return the arrays of a system that are not those of the environment's own."""
        leaves, structure = jax.tree.flatten(sys)
        if structure != self._structure:
            raise NotJoined
        pairs = enumerate(zip(leaves, self._leaves, strict=True))
        return {i: leaf for i, (leaf, own) in pairs if leaf is not own}

    def _system(self, changed: dict[int, Any]) -> Any:
        if not changed:
            return self._sys
        leaves = [changed.get(i, leaf) for i, leaf in enumerate(self._leaves)]
        return jax.tree.unflatten(self._structure, leaves)

    def _form(self, changed: dict[int, Any], q: Array, qd: Array) -> Any:
        """Return the form of the physics' state that starts here."""
        q, qd = _real((q, qd))

        def derived() -> Any:
            inverse = jnp.zeros((qd.shape[0], qd.shape[0]), float)
            return self._derived(changed, _array(True), (q, qd, qd, qd, qd, inverse))

        return jax.eval_shape(derived)

    def _moved_of(self, changed: Any, fresh: Any, begun: Any, physics: Any, control: Array) -> Any:
        """Return position, velocity, acceleration and forces, and the last inverse of the mass."""
        sys, brax = self._system(changed), self._brax

        def start() -> Any:
            nothing = jnp.zeros_like(physics.qd)
            return (*begun, nothing, nothing, nothing)

        def move() -> Any:
            state = physics
            tau = brax["actuator"].to_tau(sys, control, state.q, state.qd)
            state = state.replace(qf_smooth=brax["dynamics"].forward(sys, state, tau))
            state = state.replace(qf_constraint=brax["constraint"].force(sys, state))
            state = brax["integrator"].integrate(sys, state)
            return _real((state.q, state.qd, state.qdd, state.qf_smooth, state.qf_constraint))

        return (*jax.lax.cond(fresh, start, move), physics.mass_mx_inv)

    def _derived_of(self, changed: Any, fresh: Any, moved: Any) -> Any:
        """Return all that follows from where the joints are, and how fast."""
        sys, brax = self._system(changed), self._brax
        q, qd, qdd, smooth, constraint, inverse = moved
        state = brax["base"].State.init(q, qd, *brax["kinematics"].forward(sys, q, qd))
        state = state.replace(qdd=qdd, qf_smooth=smooth, qf_constraint=constraint)
        state = brax["dynamics"].transform_com(sys, state)
        mass = brax["mass"].matrix(sys, state)

        def invert() -> Array:
            return jax.scipy.linalg.solve(mass, jnp.eye(sys.qd_size()), assume_a="pos")

        def improve() -> Array:
            return brax["math"].inv_approximate(mass, inverse, sys.matrix_inv_iterations)

        again = jax.lax.cond(fresh, invert, improve) if sys.matrix_inv_iterations else invert()
        state = state.replace(mass_mx=mass, mass_mx_inv=again)
        return _real(brax["constraint"].jacobian(sys, state))


def _either(fresh: Bool[Array, ""] | bool, start: Any, step: Any, *operands: Any) -> Any:
    """Return the one or the other, of which a program has both unless it is known which."""
    if isinstance(fresh, bool):
        return (start if fresh else step)(*operands)
    return jax.lax.cond(fresh, start, step, *operands)


def _array(fresh: bool) -> Bool[Array, ""]:
    """Return an array as programs compute it, on their mesh: JAX traces no part of them twice."""
    return jnp.full(1, fresh)[0]


def _arguments(call: Callable[[Env], Any], env: Env, physics: str) -> Any:
    """Return what a call of an environment's method gives to its physics."""

    def reached(*arguments: Any, **options: Any) -> Any:
        if options or len(arguments) != 2:
            raise NotJoined
        raise _Reached(*arguments)

    try:
        call(_with_physics(env, physics, reached))
    except _Reached as call_of_physics:
        return call_of_physics.arguments
    raise NotJoined


def _finished(call: Callable[[Env], Any], env: Env, physics: str, result: Any) -> Any:
    """Return what a method of an environment returns if its physics returns `result`."""
    calls = []

    def answer(*arguments: Any, **options: Any) -> Any:
        calls.append(arguments)
        return result

    found = call(_with_physics(env, physics, answer))
    if len(calls) != 1:
        raise NotJoined
    return found


def _with_physics(env: Env, physics: str, function: Callable[..., Any]) -> Any:
    """Return a copy whose start, or step, of the physics is this function; the other one raises."""
    other = copy.copy(env)
    if "env" in vars(other) and "sys" not in vars(other):
        other.env = _with_physics(other.env, physics, function)
        return other

    def refused(*arguments: Any, **options: Any) -> Any:
        raise NotJoined

    other.pipeline_init = function if physics == "init" else refused
    other.pipeline_step = function if physics == "step" else refused
    return other


def _copied(tree: PyTree) -> Any:
    """Return the same in containers of its own, since environments change dictionaries in place."""
    return jax.tree.map(lambda leaf: leaf, tree)


def _real(tree: PyTree) -> Any:
    """Return the tree, its real numbers in the precision of the program."""

    def cast(leaf: Any) -> Any:
        leaf = jnp.asarray(leaf)
        return leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(cast, tree)
