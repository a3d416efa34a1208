"""A gymnax environment with a policy in the loop as a system.

    gymnax("CartPole-v1", policy, features={"masspole": "masspole"}, initial={"theta0": "theta"})
    gymnax("Pendulum-v1", lambda observation: -observation[2:], steps=100)
    gymnax(MyEnvironment(), policy, signals=["x", "x_dot"], dt=0.1, steps=50)

The result is a pure function `(features, key) -> Trace` of one episode, which is never reset.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from verifai_jax.addons.simulators.delay_options import DelayOption
from verifai_jax.addons.simulators.environments.episode import (
    Moment,
    step_count,
    used_inputs,
    vector_action,
)
from verifai_jax.addons.simulators.environments.policy_loop import (
    PolicyLoop,
    check_version,
    loop_options,
)
from verifai_jax.core.messages.errors import check_names, require, suggests_options, unknown_name
from verifai_jax.systems.base import Features
from verifai_jax.systems.pytree_checks import check_like, outline

OLDEST = (1, 0, 1)
Env: TypeAlias = Any
"""A `gymnax` Environment; gymnax is an optional package, so its types cannot be imported here."""
Params: TypeAlias = Any
"""The parameters of an environment, a dataclass of its own."""
Space: TypeAlias = Any
"""A space of `gymnax.environments.spaces`."""
# Parameters that gymnax stores but that follow from others; it does not recompute them.
DERIVED: dict[str, dict[str, Callable[[Any], Any]]] = {
    "CartPole-v1": {
        "total_mass": lambda p: p.masscart + p.masspole,
        "polemass_length": lambda p: p.masspole * p.length,
    }
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Gymnax(PolicyLoop):
    """A closed loop `(features, key) -> Trace`; made by `gymnax`, which documents its parts."""

    binding: ClassVar[str] = "features={feature: parameter} or initial={feature: part of the state}"
    # An environment is the difference equation that its `step` computes.
    exact_step: ClassVar[bool] = True
    params: Any
    truncate: bool

    def _start(self, configured: Params, features: Features, key: Key[Array, ""]) -> Moment:
        observation, state = self.env.reset_env(key, configured)
        if self.initial is not None:
            state = self._initial_state(state, features, key)
            observation = self.env.observe(key, state, None, configured)
        return Moment(state, observation, 0.0, False)

    def _step(
        self, configured: Params, state: PyTree, action: PyTree, key: Key[Array, ""]
    ) -> Moment:
        state, params = _differentiable(self.env, state, action, key, configured)
        observation, state, reward, over, _ = self.env.step_env(key, state, action, params)
        if self.truncate:
            over = over | self.env.is_truncated(state, params)
        return Moment(state, observation, reward, over)

    def _parts(self, state: PyTree) -> dict[str, Any]:
        return {name: value for name, value in _fields(state).items() if name != "time"}

    def _action(self, action: PyTree) -> Array:
        return _as_action(action, self.env.action_space(self.params), self.name)

    def _action_bounds(self) -> tuple[PyTree, PyTree] | None:
        space = self.env.action_space(self.params)
        if hasattr(space, "n"):
            return 0, space.n - 1
        return (space.low, space.high) if hasattr(space, "low") else super()._action_bounds()

    def _configured(self, features: Features) -> Params:
        params = self.params
        if self.features:
            fields = {field: features[name] for name, field in self.features.items()}
            params = params.replace(**fields)
            derived = DERIVED.get(self.name, {})
            params = params.replace(
                **{name: rule(params) for name, rule in derived.items() if name not in fields}
            )
        if self.configure is not None:
            params = self.configure(params, features)
            if not isinstance(params, type(self.params)):
                raise ValueError(
                    f"configure must return the parameters of {self.name}, a "
                    f"{type(self.params).__name__}; got {outline(params)}"
                )
        return params

    def _initial_state(self, state: PyTree, features: Features, key: Key[Array, ""]) -> Any:
        """Return the state to start from."""
        if not isinstance(self.initial, Mapping):
            assert self.initial is not None
            placed = self.initial(state, features, key)
            role = f"a state of {self.name}"
            if jax.tree.structure(placed) != jax.tree.structure(state):
                check_like(placed, state, "initial", role)
            return jax.tree.map(jnp.asarray, placed)
        known = _fields(state)
        check_names(f"part of {self.name}'s state", self.initial.values(), known)
        return state.replace(**{part: features[name] for name, part in self.initial.items()})


@suggests_options
def gymnax(
    env: Env,
    policy: object,
    *,
    steps: int | None = None,
    duration: float | None = None,
    features: Mapping[str, str] | Iterable[str] = (),
    configure: Callable[..., Any] | None = None,
    initial: Mapping[str, str] | Callable[..., Any] | None = None,
    signals: Mapping[str, Any] | Sequence[str] | Callable[..., Mapping[str, Any]] | None = None,
    dt: float | None = None,
    params: Params | None = None,
    policy_memory: PyTree = None,
    truncate: bool = False,
    observation_delay: DelayOption = 0,
    action_delay: DelayOption = 0,
) -> Gymnax:
    """Make a system `(features, key) -> Trace` from an environment of gymnax and a policy.

    **Arguments:**
    - `env`: the id of a registered environment, or an `Environment` of your own.
    - `policy`: `observation -> action`, or `(observation, key) -> action` for a random one; a
      function, or an object with a method `act`, such as an `rl.Policy`. If it has an argument
      `features`, it receives the features at that instant.
    - `steps`: the maximum number of steps of the episode; alternatively `duration` in seconds; by
      default the environment's `max_steps_in_episode`. The trace has a sample after the reset and
      after each step, and its last valid sample is the one at which the environment is over.
    - `features`: which feature sets which parameter of the environment, `{"mass": "masspole"}`, or
      a list of names that are equal in both. Values that `CartPole-v1` derives from its parameters
      are updated.
    - `configure(params, features) -> params`: for other changes.
    - `initial`: which feature sets which part of the initial state, `{"theta0": "theta"}`, or a
      function `(state, features, key) -> state`. The other parts come from the environment's reset.
    - `signals`: names of all entries of the observation, or `{name: index or key}` of some;
      `action` and `reward` are added. Or a function `(state, observation, action, reward, features)
      -> dict`. By default: the parts of the state (except `time`), `observation`, `action` and
      `reward`, if they are scalars or vectors. An action of one number is a scalar signal.
    - `dt`: seconds of a step; by default the environment's parameter `dt` or `tau`, or 1.
    - `params`: the parameters to which features are applied; by default the environment's own.
    - `policy_memory`: the initial memory of a policy with memory. It is then called as
      `(observation, memory)` or `(observation, memory, key)` and returns `(action, memory)`.
    - `truncate`: whether the environment's time limit ends the episode, too.
    - `observation_delay`, `action_delay`: number of steps after which an observation reaches the
      policy, and an action takes effect: a number, or `{feature: maximum}` for a number given by a
      feature. Until then the policy sees the first observation, and the action is zero.

    A `Signal` feature is passed to parameters and functions as its value at the start of the step.
    Environments that support gradients are differentiated; others raise an error.

    **Returns:** a `Gymnax` system; one episode is one simulation.
    **Raises:** `MissingExtra` without gymnax, or with an outdated one; `UnknownNameError` for an
    unknown environment or parameter; `ValueError` for invalid numbers, and, when the system is
    traced, for an unsuitable policy, state or signals.
    """
    package = require("gymnax", extra="gymnax")
    check_version("gymnax", OLDEST)
    if isinstance(env, str):
        if env not in package.registered_envs:
            raise unknown_name("environment of gymnax", env, package.registered_envs)
        env, own = package.make(env)
        params = own if params is None else params
    parts = ("reset_env", "step_env", "default_params")
    if missing := [part for part in parts if not hasattr(env, part)]:
        raise ValueError(
            f"env must be the id of an environment or a gymnax Environment; got {env!r}, "
            f"which has no {missing[0]}"
        )
    if not hasattr(type(env), "step_env"):
        # What it passes on is the inner environment's step, without what the wrapper adds.
        raise ValueError(
            f"{type(env).__name__} is a wrapper, whose step resets the environment when an episode "
            "ends: give the environment itself, and move the wrapper's work into the policy"
        )
    if env.supports_transition_gradients and not env.transition_gradients_enabled:
        env = env.with_transition_gradients()
    params = env.default_params if params is None else params
    fields = _fields(params)
    clocks = [name for name in ("dt", "tau") if name in fields]
    delays, period = (observation_delay, action_delay), dt
    if period is None:
        period = fields[clocks[0]] if clocks else 1.0
    options = loop_options(
        period, policy, policy_memory, features, configure, initial, signals, delays, "params",
        "state",
    )  # fmt: skip
    check_names(f"parameter of {env.name}", options["features"].values(), fields)
    for name, parameter in options["features"].items():
        if parameter in clocks and dt is None:
            raise ValueError(
                f"feature {name!r} cannot set {parameter!r}: all samples of a trace are one fixed "
                "period apart; give dt=... if it is not the environment's time step"
            )
    _check_choices(policy, env.action_space(params), env.name)
    if isinstance(initial, Mapping):
        state = jax.eval_shape(env.reset_env, jax.eval_shape(lambda: jax.random.key(0)), params)[1]
        check_names(f"part of {env.name}'s state", initial.values(), _fields(state))
    return Gymnax(
        **options,
        env=env,
        name=env.name,
        params=params,
        steps=step_count(steps, duration, options["dt"], fields.get("max_steps_in_episode")),
        truncate=truncate,
    )


def _fields(value: object) -> dict[str, Any]:
    return {name: getattr(value, name) for name in getattr(value, "__dataclass_fields__", ())}


def _check_choices(policy: object, space: Space, name: str) -> None:
    """Refuse a policy that states itself that it chooses among another number of actions."""
    chosen, offered = getattr(getattr(policy, "action", None), "n", None), getattr(space, "n", None)
    if chosen is not None and chosen != offered:
        raise ValueError(f"policy chooses one of {chosen} actions; {name} takes {space!r}")


def _as_action(action: PyTree, space: Space, name: str) -> Array:
    """Return a policy's output as an action of the space."""
    if not hasattr(space, "n"):
        if hasattr(space, "low") and len(space.shape) == 1:
            return vector_action(action, space.shape[0], name)
        return jnp.asarray(action)
    shape, dtype = getattr(action, "shape", ()), getattr(action, "dtype", jnp.result_type(action))
    whole = jnp.issubdtype(dtype, jnp.integer) or dtype == jnp.bool_
    if shape not in ((), (1,)) or not whole:
        raise ValueError(
            f"policy must return one of the {space.n} actions of {name}, an integer; "
            f"got {outline(action)}"
        )
    return jnp.reshape(jnp.asarray(action, space.dtype), ())


_STOPS = (
    "the environment stops gradients between its steps, so derivatives of a trace would wrongly "
    "be zero; use a search without gradients, or an environment that gymnax can differentiate "
    "(Pendulum-v1, MountainCarContinuous-v0, Reacher-misc, Swimmer-misc, PointRobot-misc)"
)


def _differentiable(
    env: Env, state: PyTree, action: PyTree, key: Key[Array, ""], params: Params
) -> tuple[Any, Any]:
    """Return state and parameters, not differentiable if the step stops gradients.

    A gradient that is silently zero would mislead a search worse than none.
    """
    if env.transition_gradients_enabled:
        return state, params
    tree = (state, params)
    leaves, structure = jax.tree.flatten(tree)
    leaves = [jnp.asarray(leaf) for leaf in leaves]
    moving = [i for i, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    shapes = jax.eval_shape(lambda: (leaves, action, key))

    def stepped(
        values: Sequence[Array], others: Sequence[Array], action: PyTree, key: Key[Array, ""]
    ) -> Any:
        whole = list(others)
        for i, value in zip(moving, values, strict=True):
            whole[i] = value
        state, params = jax.tree.unflatten(structure, whole)
        after = jax.tree.leaves(env.step_env(key, state, action, params)[1])
        return [leaf for leaf in after if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)]

    def tangents(
        values: Sequence[Array], directions: Sequence[Array], others: Sequence[Array],
        action: PyTree, key: Key[Array, ""],
    ) -> Any:  # fmt: skip
        return jax.jvp(lambda v: stepped(v, others, action, key), (values,), (directions,))[1]

    def stops() -> bool:
        abstract, action, key = shapes
        values = [abstract[i] for i in moving]
        used = used_inputs(tangents, values, values, abstract, action, key)
        return bool(values) and not any(used[len(values) : 2 * len(values)])

    @jax.custom_jvp
    def same(*values: Array) -> Any:
        return values

    @same.defjvp
    def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> Any:
        if stops():
            raise ValueError(f"{env.name}: {_STOPS}")
        return primals, tangents

    if moving:
        for i, value in zip(moving, same(*(leaves[i] for i in moving)), strict=True):
            leaves[i] = value
    return jax.tree.unflatten(structure, leaves)
