"""An environment of MuJoCo Playground with a policy in the loop as a system.

    playground("CartpoleBalance", policy, steps=200, bind={"mass": "body/pole_1/mass"})
    playground(MyEnvironment(), policy, duration=2.0, bind={"angle": "joint/hinge_1/qpos"})

The result is a pure function `(features, key) -> Trace` of one episode, which is never reset.
"""

import contextlib
import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key, PyTree

from verifai_jax.addons.simulators.delay_options import DelayOption
from verifai_jax.addons.simulators.environments._brax import Brax, import_quietly
from verifai_jax.addons.simulators.environments.brax_model import Env, explain_errors
from verifai_jax.addons.simulators.environments.episode import Moment, step_count
from verifai_jax.addons.simulators.environments.policy_loop import check_version, loop_options
from verifai_jax.addons.simulators.mujoco.bindings import Bindings, Bound, resolve_bindings
from verifai_jax.addons.simulators.mujoco.mjx_rollout import with_leaves
from verifai_jax.addons.simulators.mujoco.model import load
from verifai_jax.core.messages.errors import suggests_options, unknown_name
from verifai_jax.systems.base import Features
from verifai_jax.systems.pytree_checks import outline

OLDEST = (0, 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Playground(Brax):
    """A closed loop `(features, key) -> Trace`; made by `playground`."""

    binding: ClassVar[str] = "bind={feature: 'body/NAME/mass'}, as in vj.mujoco"
    bindings: Bindings

    @property
    def reverse_hint(self) -> str:
        return f"{self.name}: MJX's constraint solver loops until it converges"

    def _configured(self, features: Features) -> Any:
        env = copy.copy(self.env)
        model = env.mjx_model
        if jax.config.read("jax_enable_x64"):
            model = jax.tree.map(_in_double, model)
        env._mjx_model = with_leaves(model, self.bindings, features)
        if self.configure is not None:
            env = self.configure(env, features)
            if not hasattr(env, "step"):
                raise ValueError(
                    f"configure must return the environment {self.name}; got {outline(env)}"
                )
        return env

    def _start(self, configured: Env, features: Features, key: Key[Array, ""]) -> Moment:
        if callable(self.initial):
            state = self.initial(configured, features, key)
        else:
            with explain_errors(self.env, self.name, "reset"), self._placed(features):
                state = configured.reset(key)
        return Moment(state, state.obs, state.reward, state.done)

    @contextlib.contextmanager
    def _placed(self, features: Features) -> Iterator[None]:
        """Let a reset that is traced begin where features say; the rest is as it draws it."""
        if not self.bindings.state:
            yield
            return
        module = import_quietly("mujoco_playground._src.mjx_env", "playground")
        make = module.make_data

        def make_data(*arguments: Any, **options: Any) -> Any:
            data = make(*arguments, **options)
            begin = {name: getattr(data, name) for name in ("qpos", "qvel")}
            start = self.bindings.start(features, begin)
            placed = {n: v.astype(begin[n].dtype) for n, v in start.items() if n in begin}
            return data.replace(**placed)

        module.make_data = make_data
        try:
            yield
        finally:
            module.make_data = make

    def _parts(self, state: Env) -> dict[str, Any]:
        return {"qpos": state.data.qpos, "qvel": state.data.qvel, **state.metrics}


def _in_double(leaf: Any) -> Any:
    real = hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating)
    return leaf.astype(jnp.float64) if real else leaf


@suggests_options
def playground(
    env: Env,
    policy: object,
    *,
    steps: int | None = None,
    duration: float | None = None,
    bind: Bound | None = None,
    configure: Callable[..., Any] | None = None,
    initial: Callable[..., Any] | None = None,
    signals: Mapping[str, Any] | Sequence[str] | Callable[..., Mapping[str, Any]] | None = None,
    dt: float | None = None,
    policy_memory: PyTree = None,
    options: Mapping[str, object] | None = None,
    observation_delay: DelayOption = 0,
    action_delay: DelayOption = 0,
) -> Playground:
    """Make a system `(features, key) -> Trace` from an environment of MuJoCo Playground.

    **Arguments:**
    - `env`: the name of an environment, or an `MjxEnv` of your own without training wrappers.
    - `policy`: `observation -> action`, or `(observation, key) -> action` for a random one; a
      function, or an object with a method `act`, such as a policy from `vj.policy`.
    - `steps`: the maximum number of steps of the episode; alternatively `duration` in seconds. The
      trace has a sample after the reset and after each step, and its last valid sample is the one
      at which the environment is done.
    - `bind`: a dictionary from a feature to the path that it sets in the model or in the initial
      state, as in `mujoco`: `"body/torso/mass"`, `"geom/floor/friction[0]"`, `"joint/hinge/qpos"`.
    - `configure(env, features) -> env`: for other changes; it gets a copy of the environment.
    - `initial(env, features, key) -> State`: replaces the environment's own reset.
    - `signals`: names of all entries of the observation, or `{name: index or key}` of some;
      `action` and `reward` are added. Or a function `(state, observation, action, reward, features)
      -> dict`, with Playground's state. By default: `qpos`, `qvel`, the metrics, `observation`,
      `action` and `reward`, if they are scalars or vectors.
    - `dt`: duration of a step in seconds; `env.dt` when left out.
    - `policy_memory`: the initial memory of a policy with memory; by default its own.
    - `options`: overrides of an environment's configuration by name; `impl` is by default `"jax"`.
    - `observation_delay`, `action_delay`: number of steps after which an observation reaches the
      policy, and an action takes effect: a number, or `{feature: maximum}`.
    **Returns:** a `Playground` system; one episode is one simulation.
    **Raises:** `MissingExtra` without Playground; `UnknownNameError` for an unknown environment or
    path; `ValueError` for an environment whose assets are not installed, for forces and controls in
    `bind`, and for invalid numbers.
    """
    env, name = loaded(env, options)
    shared = loop_options(
        env.dt if dt is None else dt, policy, policy_memory, {f: f for f in bind or {}}, configure,
        initial, signals, (observation_delay, action_delay), "env", "env",
    )  # fmt: skip
    bindings = resolve_bindings(load(env.mj_model), bind)
    if bindings.applied:
        raise ValueError(
            f"{bindings.applied[0].location.path!r} is set by the environment {name} at each step: "
            "change it by configure=(env, features) -> env"
        )
    return Playground(
        **shared, env=env, name=name, bindings=bindings,
        steps=step_count(steps, duration, shared["dt"]),
    )  # fmt: skip


def loaded(env: Env, options: Mapping[str, object] | None = None) -> tuple[Any, str]:
    """Return an environment, given by name or as an object, and its name."""
    package = import_quietly("mujoco_playground", "playground")
    check_version("playground", OLDEST)
    if not isinstance(env, str):
        name = type(getattr(env, "unwrapped", env)).__name__
        if options:
            raise ValueError(f"options need the name of an environment; got the object {name}")
        if not isinstance(env, package.MjxEnv) or env.unwrapped is not env:
            raise ValueError(
                f"env must be the name of an environment or an MjxEnv without wrappers; got {name}"
            )
        return env, name
    if env not in package.registry.ALL_ENVS:
        raise unknown_name("environment of Playground", env, package.registry.ALL_ENVS)
    module = import_quietly("mujoco_playground._src.mjx_env", "playground")

    def refuse() -> None:
        if not module.MENAGERIE_PATH.exists():
            raise ValueError(
                f"{env} needs models that are not in the package: git clone "
                f"https://github.com/google-deepmind/mujoco_menagerie {module.MENAGERIE_PATH} && "
                f"git -C {module.MENAGERIE_PATH} checkout {module.MENAGERIE_COMMIT_SHA}"
            )

    fetch, module.ensure_menagerie_exists = module.ensure_menagerie_exists, refuse
    try:
        made = package.registry.load(env, config_overrides={"impl": "jax", **(options or {})})
    finally:
        module.ensure_menagerie_exists = fetch
    return made, env
