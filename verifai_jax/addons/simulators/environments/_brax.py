"""A Brax environment with a policy in the loop as a system.

    brax("inverted_pendulum", policy, steps=100, features={"pole": "link.inertia.mass[pole]"})
    brax("hopper", policy, backend="positional", duration=2.0, initial={"height": "q[1]"})
    brax(MyEnvironment(), policy, steps=50, signals=["x", "v"], dt=0.1)

The result is a pure function `(features, key) -> Trace` of one episode, which is never reset.
"""

import contextlib
import copy
import io
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax
from jaxtyping import Array, Int, Key, PyTree

from verifai_jax.addons.simulators.delay_options import DelayOption
from verifai_jax.addons.simulators.environments import brax_model
from verifai_jax.addons.simulators.environments.episode import Moment, step_count, vector_action
from verifai_jax.addons.simulators.environments.policy_loop import (
    PolicyLoop,
    check_version,
    loop_options,
)
from verifai_jax.core.compute.compilation import XlaOptimization
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.messages.errors import require, suggests_options, unknown_name
from verifai_jax.systems.base import Features
from verifai_jax.systems.ode.integrators import check_factor
from verifai_jax.systems.pytree_checks import outline

OLDEST = (0, 14)
BACKENDS = ("generalized", "spring", "positional", "mjx")


@dataclass(frozen=True, eq=False, kw_only=True)
class Brax(PolicyLoop):
    """A closed loop `(features, key) -> Trace`; made by `brax`, which documents its parts.

    - `exact_step`: whether the step belongs to the environment, so that it has no finer one.
    """

    binding: ClassVar[str] = "features={feature: part of the system} or initial={feature: 'q[0]'}"
    exact_step: bool = True

    @property
    def effort(self) -> XlaOptimization:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Effort of XLA: with `little` the generalized backend compiles faster and runs as fast."""
        backend = getattr(self.env.unwrapped, "_backend", None)
        return "little" if backend == "generalized" else "most"

    @property
    def reverse_hint(self) -> str:
        """A sentence on why reverse-mode derivatives may not exist."""
        return (
            f"{self.name}: the constraint solver of Brax's mjx backend loops until it converges, "
            "unless the model asks for one iteration; the other backends have fixed loops"
        )

    @property
    def traced_factor(self) -> bool:
        """True if JAX may trace the factor of `refined`."""
        return not self.exact_step and brax_model.steps_plainly(self.env)

    def filmed(self, replay: Any) -> Any:
        return lazy_import("verifai_jax.addons.simulators.pictures.mujoco_film", "filmed")(
            self, replay
        )

    def refined(self, factor: int | Int[Array, ""]) -> "Brax":
        """Return the same episode with a step divided by `factor`; samples and decisions stay.

        If `traced_factor` is true the factor may be traced: one program then serves all steps.

        **Raises:** `ValueError` for a factor that is not a positive integer, for an environment
        whose step belongs to it, and for the backends spring and positional, whose model changes
        with the step.
        """
        if self.exact_step:
            raise ValueError(
                f"the step belongs to {self.name} (exact_step=True), so a finer one would simulate "
                "another environment; if its step is an approximation, give exact_step=False"
            )
        if not isinstance(factor, jax.Array):
            check_factor(factor)
        return replace(self, env=brax_model.with_finer_step(self.env, factor, self.name))

    def _start(self, configured: brax_model.Env, features: Features, key: Key[Array, ""]) -> Moment:
        env = configured
        if callable(self.initial):
            return _moment(self.initial(env, features, key), self.name)
        if self.initial:
            env = brax_model.with_start(
                env, {location: features[name] for name, location in self.initial.items()}
            )
        with brax_model.explain_errors(self.env, self.name, "reset"):
            return _moment(env.reset(key), self.name)

    def _step(
        self, configured: brax_model.Env, state: brax_model.Env, action: PyTree, key: Key[Array, ""]
    ) -> Moment:
        with brax_model.explain_errors(self.env, self.name, "step"):
            return _moment(configured.step(state, action), self.name)

    def _parts(self, state: brax_model.Env) -> dict[str, Any]:
        physics = getattr(state, "pipeline_state", None)
        parts = {part: getattr(physics, part, None) for part in ("q", "qd")} | dict(state.metrics)
        return {name: value for name, value in parts.items() if value is not None}

    def _action(self, action: PyTree) -> Array:
        return vector_action(action, self.env.action_size, self.name)

    def _configured(self, features: Features) -> Any:
        env = self.env
        if self.features:
            sys = env.unwrapped.sys
            for name, location in self.features.items():
                sys = brax_model.with_value(sys, location, features[name], name)
            env = brax_model.with_system(env, sys)
        if self.configure is None:
            return env
        if not hasattr(env.unwrapped, "sys"):
            configured = self.configure(copy.copy(env), features)
            if not hasattr(configured, "step"):
                raise ValueError(
                    f"configure must return the environment {self.name}, which has no sys of its "
                    f"own; got {outline(configured)}"
                )
            return configured
        sys = self.configure(env.unwrapped.sys, features)
        if not isinstance(sys, type(env.unwrapped.sys)):
            raise ValueError(
                f"configure must return the sys of {self.name}, a "
                f"{type(env.unwrapped.sys).__name__}; got {outline(sys)}"
            )
        return brax_model.with_system(env, sys)


@suggests_options
def brax(
    env: brax_model.Env,
    policy: object,
    *,
    steps: int | None = None,
    duration: float | None = None,
    backend: str | None = None,
    features: Mapping[str, str] | Iterable[str] = (),
    configure: Callable[..., Any] | None = None,
    initial: Mapping[str, str] | Callable[..., Any] | None = None,
    signals: Mapping[str, Any] | Sequence[str] | Callable[..., Mapping[str, Any]] | None = None,
    dt: float | None = None,
    policy_memory: PyTree = None,
    options: Mapping[str, object] | None = None,
    exact_step: bool = True,
    observation_delay: DelayOption = 0,
    action_delay: DelayOption = 0,
) -> Brax:
    """Make a system `(features, key) -> Trace` from an environment of Brax and a policy.

    **Arguments:**
    - `env`: the name of an environment, or an `Env` of your own without training wrappers.
    - `policy`: `observation -> action`, or `(observation, key) -> action` for a random one; a
      function, or an object with a method `act`, such as an `rl.Policy`. If it has an argument
      `features`, it receives the features at that instant.
    - `steps`: the maximum number of steps of the episode; alternatively `duration` in seconds. The
      trace has a sample after the reset and after each step, and its last valid sample is the one
      at which the environment is done.
    - `backend`: `"generalized"`, `"spring"`, `"positional"` or `"mjx"`, for an environment given by
      name; by default its own.
    - `features`: which feature sets which part of the environment's `sys`, as a dotted path:
      `{"gravity": "opt.gravity[2]", "mass": "link.inertia.mass[pole]"}`. An entry is given by its
      index. For links (`link...`) and MuJoCo's arrays (`body_...`, `geom_...`) it may be given by
      its name in the model, and a row of an array by two: `geom_friction[floor, 0]` is the sliding
      friction of the floor, `actuator_gear[knee, 0]` a gear (backend mjx). Values derived from it
      earlier are not recomputed.
    - `configure(sys, features) -> sys`: for other changes; for an environment without `sys`, `(env,
      features) -> env`, with a copy of it.
    - `initial`: which feature sets which entry of the initial position or velocity, by index or
      joint name: `{"angle": "q[hinge]", "speed": "qd[0]"}`; the other entries come from the
      environment's reset. Or a function `(env, features, key) -> brax State`.
    - `signals`: names of all entries of the observation, or `{name: index or key}` of some;
      `action` and `reward` are added. Or a function `(state, observation, action, reward, features)
      -> dict`, with Brax's state. By default: `q`, `qd`, the metrics, `observation`, `action` and
      `reward`, if they are scalars or vectors. An action of one number is a scalar.
    - `dt`: duration of a step in seconds; `env.dt` when left out.
    - `policy_memory`: the initial memory of a policy with memory. It is then called as
      `(observation, memory)` or `(observation, memory, key)` and returns `(action, memory)`.
    - `options`: keyword arguments of an environment by name.
    - `exact_step`: whether the environment is defined by its `step`; counterexamples are then
      confirmed in double precision and under rounding. False if the step approximates continuous
      motion: counterexamples are then also replayed at a third and a quarter of it (backends
      generalized and mjx).
    - `observation_delay`, `action_delay`: number of steps after which an observation reaches the
      policy, and an action takes effect: a number, or `{feature: maximum}` for a number given by a
      feature. Until then the policy sees the first observation, and the action is zero.

    A `Signal` feature is passed to `sys` and functions as its value at the start of the step.

    **Returns:** a `Brax` system; one episode is one simulation.
    **Raises:** `MissingExtra` without brax, or with an outdated one; `UnknownNameError` for an
    unknown environment, backend or part; `ValueError` for a part that the backend does not read,
    and invalid numbers. When the system is traced, errors for an unsuitable policy, state or
    signals, and for an environment that does not work with the installed versions.
    """
    import_quietly("brax.envs")
    check_version("brax", OLDEST)
    if isinstance(env, str):
        name = env
        # A problem may be made while JAX traces the weights of its policy, which a model lacks.
        with jax.ensure_compile_time_eval():
            env = _make(name, backend, dict(options or {}))
    else:
        name = type(getattr(env, "unwrapped", env)).__name__
        if backend is not None or options:
            raise ValueError(
                f"backend and options need the name of an environment; got the object {name}"
            )
    _check_env(env, name)
    if dt is None:
        try:
            with jax.ensure_compile_time_eval():
                dt = env.dt
        except AttributeError as error:
            raise ValueError(f"{name} has no dt: give dt=..., seconds of a step") from error
    delays = (observation_delay, action_delay)
    shared = loop_options(
        dt, policy, policy_memory, features, configure, initial, signals, delays, "sys", "env"
    )
    locations = {
        f: brax_model.system_location(env, path, name) for f, path in shared["features"].items()
    }
    if isinstance(initial, Mapping):
        if not hasattr(env, "pipeline_init"):
            raise ValueError(
                f"{name} has no pipeline_init: initial must be a function (env, features, key) -> "
                "State"
            )
        shared["initial"] = {
            f: brax_model.joint_location(env, path, name) for f, path in initial.items()
        }
    brax_model.check_parts_are_read(env, name, locations)
    return Brax(
        **{**shared, "features": locations}, env=env, name=name,
        steps=step_count(steps, duration, shared["dt"]), exact_step=exact_step,
    )  # fmt: skip


def import_quietly(module: str, extra: str = "brax") -> Any:
    """Import a module without the messages that it and its dependencies print."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore", DeprecationWarning)
        require(module.partition(".")[0], extra=extra)
        return require(module, extra=extra)


def _make(name: str, backend: str | None, options: dict[str, object]) -> Any:
    """Make one of Brax's own environments, by its name."""
    envs = import_quietly("brax.envs")
    known = getattr(envs, "_envs", {})
    if known and name not in known:
        raise unknown_name("environment of brax", name, known)
    if backend is not None:
        if backend not in BACKENDS:
            raise unknown_name("backend", backend, BACKENDS)
        options["backend"] = backend
    with brax_model.explain_errors(None, name, "construction", backend):
        return envs.get_environment(name, **options)


def _check_env(env: brax_model.Env, name: str) -> None:
    """Refuse anything that is not an environment, or one that resets itself."""
    for part in ("reset", "step", "action_size"):
        if not hasattr(type(env), part) and not hasattr(env, part):
            raise ValueError(
                f"env must be the name of an environment or a brax Env; got {env!r}, "
                f"which has no {part}"
            )
    wrappers = import_quietly("brax.envs.wrappers.training")
    training = tuple(
        getattr(wrappers, wrapper)
        for wrapper in ("AutoResetWrapper", "EpisodeWrapper", "VmapWrapper")
        if hasattr(wrappers, wrapper)
    )
    inner = env
    while inner is not None:
        if isinstance(inner, training):
            raise ValueError(
                f"{type(inner).__name__} is for training: one episode that is not reset needs "
                f"{name} without it, brax.envs.get_environment or env.unwrapped"
            )
        inner = vars(inner).get("env") if hasattr(inner, "__dict__") else None


def _moment(state: brax_model.Env, name: str) -> Moment:
    missing = [part for part in ("obs", "reward", "done") if not hasattr(state, part)]
    if missing:
        raise ValueError(
            f"{name}: reset, step and initial must return a brax State; got {outline(state)}"
        )
    return Moment(state, state.obs, state.reward, state.done)
