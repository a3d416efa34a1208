"""A gymnax environment with a policy in the loop as a system.

    gymnax("CartPole-v1", policy, features={"masspole": "masspole"}, initial={"theta0": "theta"})
    gymnax("Pendulum-v1", lambda observation: -observation[2:], steps=100)
    gymnax(MyEnvironment(), policy, signals=["x", "x_dot"], dt=0.1, steps=50)

The result is a pure function `(features, key) -> Trace` of one episode, which is never reset.
"""

import importlib.metadata
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key, PyTree

from verifai_jax.core.errors import (
    MissingExtra,
    check_names,
    require,
    suggests_options,
    unknown_name,
)
from verifai_jax.core.trace import Trace
from verifai_jax.core.user_errors import check_called_with
from verifai_jax.core.waveform import set_durations
from verifai_jax.systems.base import Carry, Features, Seed, System
from verifai_jax.systems.delays import (
    NO_DELAY,
    Delay,
    DelayOption,
    Delays,
    as_delay,
    first_refusal,
)
from verifai_jax.systems.environments.episode import (
    Episode,
    Moment,
    Time,
    check_features,
    check_signals_option,
    features_at,
    first_memory,
    fold,
    has_waveforms,
    policy_function,
    policy_that_sees,
    read_signals,
    rollout,
    sampling_period,
    step_count,
    used_inputs,
    vector_action,
)
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


@dataclass(frozen=True, eq=False)
class Gymnax(System):
    """A closed loop `(features, key) -> Trace`; made by `gymnax`, which says what its parts are."""

    # An environment is the difference equation that its `step` computes.
    exact_step: ClassVar[bool] = True
    env: Any
    params: Any
    policy: Any
    policy_memory: Any
    steps: int
    dt: float = field()
    features: Mapping[str, str]
    configure: Callable[..., Any] | None
    initial: Mapping[str, str] | Callable[..., Any] | None
    signals: Any
    truncate: bool
    observation_delay: Delay = NO_DELAY
    action_delay: Delay = NO_DELAY

    @property
    def duration(self) -> float:
        """Simulated seconds."""
        return self.steps * self.dt

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        """Simulate one episode, not reset at its end."""
        return rollout(self._episode(features), key)

    def fold(
        self,
        features: Features,
        key: Seed,
        carry: Carry,
        update: Callable[[Carry, dict[str, Array]], Carry],
    ) -> tuple[Carry, Int[Array, ""]]:
        """Simulate, and let `carry = update(carry, sample)` take in each sample; none is stored.

        Behind an early end the last valid sample comes again, until the last step.

        **Returns:** the last carry, and the status.
        """
        return fold(self._episode(features), key, carry, update)

    def _episode(self, features: Features) -> Episode:
        """Return the environment under these features, with the policy in the loop."""
        features = set_durations(features, self.duration)
        self.check(features)
        fixed = None if has_waveforms(features) else self._configure(features, 0.0)

        def params_at(time: Time) -> Any:
            return self._configure(features, time) if fixed is None else fixed

        def start(key: Key[Array, ""]) -> Moment:
            params = params_at(0.0)
            observation, state = self.env.reset_env(key, params)
            if self.initial is not None:
                state = self._initial_state(state, features_at(features, 0.0), key)
                observation = self.env.observe(key, state, None, params)
            return Moment(state, observation, 0.0, False)

        def step(time: Time, state: PyTree, action: PyTree, key: Key[Array, ""]) -> Moment:
            params = params_at(time)
            state, params = _differentiable(self.env, state, action, key, params)
            observation, state, reward, over, _ = self.env.step_env(key, state, action, params)
            if self.truncate:
                over = over | self.env.is_truncated(state, params)
            return Moment(state, observation, reward, over)

        def sample(time: Time, moment: Moment, action: PyTree) -> Any:
            named = {n: v for n, v in _fields(moment.state).items() if n != "time"}
            now = features_at(features, time)
            return read_signals(self.signals, moment, action, now, named, self.env.name)

        decide = policy_function(self.policy, self.policy_memory)

        def decide_checked(
            time: Time, observation: PyTree, memory: PyTree, key: Key[Array, ""]
        ) -> Any:
            now = features_at(features, time)
            action, memory = decide(observation, memory, key, now)
            return _as_action(action, self.env.action_space(self.params), self.env.name), memory

        return Episode(
            self.env.name,
            start,
            step,
            decide_checked,
            self.policy_memory,
            sample,
            self.steps,
            self.dt,
            Delays.under(self.observation_delay, self.action_delay, features),
        )

    def _configure(self, features: Features, time: Time) -> Any:
        """Return the environment's parameters under the features of an instant."""
        now, params = features_at(features, time), self.params
        if self.features:
            fields = {field: now[name] for name, field in self.features.items()}
            params = params.replace(**fields)
            derived = DERIVED.get(self.env.name, {})
            params = params.replace(
                **{name: rule(params) for name, rule in derived.items() if name not in fields}
            )
        if self.configure is not None:
            params = self.configure(params, now)
            if not isinstance(params, type(self.params)):
                raise ValueError(
                    f"configure must return the parameters of {self.env.name}, a "
                    f"{type(self.params).__name__}; got {outline(params)}"
                )
        return params

    def _initial_state(self, state: PyTree, features: Features, key: Key[Array, ""]) -> Any:
        """Return the state to start from."""
        if not isinstance(self.initial, Mapping):
            assert self.initial is not None
            placed = self.initial(state, features, key)
            role = f"a state of {self.env.name}"
            if jax.tree.structure(placed) != jax.tree.structure(state):
                check_like(placed, state, "initial", role)
            return jax.tree.map(jnp.asarray, placed)
        known = _fields(state)
        check_names(f"part of {self.env.name}'s state", self.initial.values(), known)
        return state.replace(**{part: features[name] for name, part in self.initial.items()})

    def check(self, features: Features) -> None:
        """Refuse features that do not exist, or that nothing would read.

        **Raises:** `UnknownNameError`, `ValueError`.
        """
        starts = self.initial if isinstance(self.initial, Mapping) else {}
        delays = (*self.observation_delay.features, *self.action_delay.features)
        check_features(
            features,
            [*self.features, *starts, *delays],
            (self.configure, self.signals, self.initial, policy_that_sees(self.policy)),
            self.env.name,
            "features={feature: parameter} or initial={feature: part of the state}",
        )
        self.observation_delay.check(features)
        self.action_delay.check(features)

    def why_error(self, features: Features) -> str | None:
        """Say which delay is none that the environment was made for."""
        delays = (self.observation_delay, self.action_delay)
        return first_refusal(delays, features, self.env.name)


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
      function, or an object with a method `act`, such as an `rl.Policy`. An argument `features`
      gets the features of the instant.
    - `steps`: of the episode at most, or `duration` in seconds; the environment's own
      `max_steps_in_episode` when left out. The trace has a sample after the reset and after each
      step, and its last valid sample is the one at which the environment is over.
    - `features`: which feature sets which parameter of the environment, `{"mass": "masspole"}`, or
      names that are the same in both. What `CartPole-v1` derives from its parameters follows.
    - `configure(params, features) -> params`: for anything else.
    - `initial`: which feature sets which part of the initial state, `{"theta0": "theta"}`, or a
      function `(state, features, key) -> state`. The rest is as the environment's reset draws it.
    - `signals`: names of all entries of the observation, or `{name: index or key of it}`; `action`
      and `reward` come along. Or a function `(state, observation, action, reward, features) ->
      dict`. When left out: the parts of the state (but `time`), `observation`, `action` and
      `reward`, as far as they are scalars and vectors. An action of one number is a scalar signal.
    - `dt`: seconds of a step; the parameter `dt` or `tau` of the environment when left out, or 1.
    - `params`: the parameters that features change; the environment's own when left out.
    - `policy_memory`: what a policy with memory remembers at first. It is then called
      `(observation, memory)` or `(observation, memory, key)` and returns `(action, memory)`.
    - `truncate`: end also where the environment's time limit would cut the episode off.
    - `observation_delay`, `action_delay`: steps after which the policy sees an observation, and
      after which its action takes effect: a number, or `{feature: greatest number}` for one that a
      feature says. Before that it sees the first observation, and no action is zeros.

    A `Signal` feature reaches parameters and functions as its value at the beginning of the step.
    Environments that support gradients are asked for them; differentiating any other raises.

    **Returns:** a `Gymnax` system, one episode of which is one simulation.

    **Raises:** `MissingExtra` without gymnax, or with one that is too old; `UnknownNameError` for
    an unknown environment or parameter; `ValueError` for numbers that do not fit, and, once the
    system is traced, for a policy, a state or signals that do not.
    """
    package = require("gymnax", extra="gymnax")
    _check_version()
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
            f"{type(env).__name__} is a wrapper, whose step resets the environment at its end: "
            "give the environment itself, and do in the policy what the wrapper does"
        )
    if env.supports_transition_gradients and not env.transition_gradients_enabled:
        env = env.with_transition_gradients()
    params = env.default_params if params is None else params
    fields = _fields(params)
    bindings = features if isinstance(features, Mapping) else {name: name for name in features}
    check_names(f"parameter of {env.name}", bindings.values(), fields)
    clocks = [name for name in ("dt", "tau") if name in fields]
    for name, parameter in bindings.items():
        if parameter in clocks and dt is None:
            raise ValueError(
                f"feature {name!r} cannot set {parameter!r}: all samples of a trace are one fixed "
                "period apart; give dt=... if it is not the environment's time step"
            )
    if dt is None:
        dt = fields[clocks[0]] if clocks else 1.0
    seconds = sampling_period(dt)
    check_signals_option(signals)
    check_called_with("configure", configure, ("params", "features"))
    if not isinstance(initial, Mapping):
        check_called_with("initial", initial, ("state", "features", "key"))
    policy_memory = first_memory(policy, policy_memory)
    policy_function(policy, policy_memory)
    _check_choices(policy, env.action_space(params), env.name)
    if isinstance(initial, Mapping):
        state = jax.eval_shape(env.reset_env, jax.eval_shape(lambda: jax.random.key(0)), params)[1]
        check_names(f"part of {env.name}'s state", initial.values(), _fields(state))
    return Gymnax(
        env=env,
        params=params,
        policy=policy,
        policy_memory=policy_memory,
        steps=step_count(steps, duration, seconds, fields.get("max_steps_in_episode")),
        dt=seconds,
        features=bindings,
        configure=configure,
        initial=initial,
        signals=signals,
        truncate=truncate,
        observation_delay=as_delay(observation_delay, "observation_delay"),
        action_delay=as_delay(action_delay, "action_delay"),
    )


def _check_version() -> None:
    version = importlib.metadata.version("gymnax")
    numbers = tuple(int(n) for n in re.findall(r"\d+", version)[:3])
    if numbers < OLDEST:
        raise MissingExtra(
            f"gymnax {version} is installed, verifai_jax needs {'.'.join(map(str, OLDEST))} or "
            "later: pip install 'verifai_jax[gymnax]'"
        )


def _fields(value: object) -> dict[str, Any]:
    return {name: getattr(value, name) for name in getattr(value, "__dataclass_fields__", ())}


def _check_choices(policy: object, space: Space, name: str) -> None:
    """Refuse a policy that states itself that it chooses among another number of actions."""
    chosen, offered = getattr(getattr(policy, "action", None), "n", None), getattr(space, "n", None)
    if chosen is not None and chosen != offered:
        raise ValueError(f"policy chooses one of {chosen} actions; {name} takes {space!r}")


def _as_action(action: PyTree, space: Space, name: str) -> Array:
    """Return a policy's output as an action of the space.

    **Raises:** `ValueError` for another shape, or numbers of another kind.
    """
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
    "the environment stops gradients between its steps, so derivatives of a trace would be zero, "
    "not true; use a search without gradients, or an environment that gymnax can differentiate "
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
        values: Sequence[Array],
        directions: Sequence[Array],
        others: Sequence[Array],
        action: PyTree,
        key: Key[Array, ""],
    ) -> Any:
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
