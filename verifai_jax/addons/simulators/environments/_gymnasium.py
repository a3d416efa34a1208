"""A Gymnasium environment with a policy in the loop as a black box.

    gymnasium("CartPole-v1", policy, steps=200, signals=("x", "x_dot", "theta", "theta_dot"),
              features=("masspole", "length"), reset=start)
    gymnasium(make_my_environment, policy, steps=500, configure=place_obstacles)

One trace is one episode: it is never reset within.
"""

import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, ClassVar, TypeAlias, cast

import jax
import numpy as np
from jaxtyping import UInt8

from verifai_jax.addons.simulators.delay_options import NO_DELAY, DelayOption, as_delay
from verifai_jax.addons.simulators.environments import episode_signals
from verifai_jax.addons.simulators.environments.episode import (
    Moment,
    check_features,
    features_at,
    first_memory,
    policy_that_sees,
    sampling_period,
)
from verifai_jax.addons.simulators.environments.spaces import (
    DERIVED,
    Fitted,
    Misfit,
    check_observation,
    check_space,
    describe,
    fit,
    kind_of,
    named_numbers,
    no_action,
)
from verifai_jax.core.compute.purity import why_differs
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import require, suggests_options, unknown_name
from verifai_jax.core.user_code.kept_state import changed, state_of
from verifai_jax.core.user_code.user_errors import check_called_with, defined_at
from verifai_jax.core.values.gaps import with_gaps
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.core.values.waveform import is_waveform, set_durations
from verifai_jax.systems.base import KnownSignals
from verifai_jax.systems.blackbox._blackbox import BlackBox, PooledBlackBox, blackbox
from verifai_jax.systems.channels import Channels, Link, Passing
from verifai_jax.systems.delays import Delay

Env: TypeAlias = Any
"""A `gymnasium.Env`; Gymnasium is an optional package, so its types cannot be imported here."""


REPEATED = 50
"""Decisions of the first episode that are taken again, to see whether the policy remembers."""


@dataclasses.dataclass(eq=False)
class EpisodeFunction:
    """A function `(features, seed) -> Trace` of one episode of an environment.

    The environment is made once in each process, and is not sent to workers.
    """

    # An environment is the difference equation that its `step` computes.
    exact_step: ClassVar[bool] = True
    make: str | Callable[[], Any]
    policy: Any
    steps: int
    signals: Any
    features: Mapping[str, str]
    configure: Callable[..., None] | None
    reset: Callable[..., Any] | None
    dt: float | None
    observation_delay: Delay = NO_DELAY
    action_delay: Delay = NO_DELAY
    clip: bool = True
    links: tuple[Link, ...] = ()

    def __post_init__(self) -> None:
        self._env: Any = None
        self._decide: Any = None
        # Pictures by sample, of the samples that are wanted; none is drawn without.
        self._drawn: dict[int, Any] | None = None
        self._wanted: Collection[int] = ()
        self._memory: Any = None
        # What the policy saw and did at first, until it has done the same again.
        self._first: list[tuple[Any, ...]] | None = []

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_env": None, "_decide": None}

    @property
    def draws(self) -> bool:
        """True if the environment says that it can draw pictures."""
        metadata = getattr(self.environment, "metadata", None) or {}
        return "rgb_array" in metadata.get("render_modes", ())

    def frames(
        self, features: Mapping[str, Any], seed: int, samples: Collection[int]
    ) -> dict[int, UInt8[np.ndarray, "height width 3"]]:
        """Simulate again, and return the pictures that the environment draws at these samples.

        **Raises:** `ValueError` for an environment that draws no pictures.
        """
        if not self.draws:
            raise ValueError(
                f"{self.name} draws no pictures: its metadata have no render mode 'rgb_array'"
            )
        drawing = self.renewed()
        drawing._drawn, drawing._wanted = {}, samples
        try:
            drawing(features, seed)
        finally:
            if callable(close := getattr(drawing._env, "close", None)):
                close()
        return {
            k: episode_signals.single_picture(image, self.name)
            for k, image in drawing._drawn.items()
        }

    def __repr__(self) -> str:
        return self.name

    def filmed(self, replay: Any) -> Any:
        """Return the film of a replay, as `System.filmed` does."""
        return lazy_import("verifai_jax.addons.simulators.pictures.gymnasium_film", "EpisodeFilm")(
            self, replay
        )

    def renewed(self) -> "EpisodeFunction":
        """Return the same function with a new environment."""
        return dataclasses.replace(self)

    @property
    def name(self) -> str:
        """The name of the environment in errors."""
        return self.make if isinstance(self.make, str) else getattr(self.make, "__name__", "env")

    def __call__(self, features: Mapping[str, Any], seed: int) -> Trace:
        env, dt = self.environment, self.period
        features = set_durations(features, self.steps * dt)
        self._set(features, 0.0)
        if self.configure is not None:
            self.configure(env, features)
        observation = self._start(env, features, seed)
        self._begin_policy()
        changes = any(is_waveform(features[name]) for name in self.features)
        reward, over, rows, overshoots = 0.0, False, [], 0
        for link in (self.observation_delay, self.action_delay, *self.links):
            if (refusal := link.refusal(features, self.name)) is not None:
                raise ValueError(refusal)
        delays = (self.observation_delay, self.action_delay)
        wait, lag = (int(delay.steps(features)) for delay in delays)
        observations, actions = [], [Fitted(no_action(env.action_space), False) for _ in range(lag)]
        channels = Channels(self.links, dt, features, np)
        states = channels.begin(observation, None, seed)
        for k in range(self.steps + 1):
            # Copied: an environment may write its next observation into the same array.
            seen, states = channels.observation(states, observation, k * dt)
            observations.append(copy.deepcopy(seen) if wait else seen)
            observed = observations[max(0, k - wait)]
            actions.append(self._act(env, observed, features, k * dt))
            action, states = channels.action(states, actions[k].action, k * dt)
            rows.append(self._sample(env, observation, action, reward, features))
            if self._drawn is not None and (k in self._wanted or not k):
                self._drawn[k] = env.render()
            if over or k == self.steps:
                break
            if changes:
                self._set(features, k * dt)
            overshoots += actions[k].outside
            observation, reward, terminated, truncated, _ = env.step(action)
            self._check_observation(env, observation, "step must return an", ValueError)
            over = bool(terminated or truncated)
        self._check_repeats()
        signals = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        finite = all(bool(np.all(np.isfinite(signal))) for signal in signals.values())
        index = np.minimum(np.arange(self.steps + 1), len(rows) - 1)
        return Trace(
            {name: signal[index] for name, signal in signals.items()},
            dt=dt,
            valid=len(rows),
            status=int(Status.OK if finite else Status.NONFINITE),
            held=True,
            notes={self._overshoot(env): overshoots} if overshoots else {},
        )

    def check(self, features: Mapping[str, Any]) -> None:
        """Refuse features that the environment does not have, or that are never used.

        **Raises:** `UnknownNameError`, `ValueError`.
        """
        links = (self.observation_delay, self.action_delay, *self.links)
        check_features(
            features,
            [*self.features, *(name for link in links for name in link.features)],
            (self.configure, self.reset, self.signals, policy_that_sees(self.policy)),
            self.name,
            "features={feature: attribute}",
        )
        for link in links:
            link.check(features)
        env = self.environment.unwrapped
        for attribute in self.features.values():
            # An attribute of the class is one of the environment's as well.
            if not hasattr(env, attribute):
                known = [name for name in vars(env) if not name.startswith("_")]
                raise unknown_name(f"attribute of {self.name}", attribute, known)
        delayed = self.action_delay.max_steps > 0
        check_space(getattr(self.environment, "action_space", None), self.name, delayed)
        # Also refuses entries that the observation does not have.
        _ = self.known_signals

    @property
    def known_signals(self) -> KnownSignals:
        """The signals of a trace with their numbers of components, if known without a simulation.

        **Raises:** `UnknownNameError`, `ValueError` for entries that the observation does not have.
        """
        env = self.environment
        draws: list[Any] = [getattr(env, f"{n}_space", None) for n in ("observation", "action")]
        if callable(self.signals) or not all(hasattr(space, "sample") for space in draws):
            return None
        observation, action = (space.sample() for space in draws)
        samples = self._sample(env, observation, action, 0.0, {})
        return {name: max(1, value.size) for name, value in samples.items()}

    @property
    def environment(self) -> Any:
        """The environment in this process."""
        if self._env is None:
            if isinstance(self.make, str):
                package = require("gymnasium", extra="gymnasium")
                mode = {} if self._drawn is None else {"render_mode": "rgb_array"}
                self._env = package.make(self.make, **mode)
            else:
                self._env = self.make()
            if hasattr(self._env, "num_envs"):
                raise TypeError(
                    f"{self.name} must make one environment; it made a vector of "
                    f"{self._env.num_envs}, whose simulations vj.blackbox(workers=...) would share"
                )
            missing = [n for n in ("reset", "step", "unwrapped") if not hasattr(self._env, n)]
            if missing:
                raise TypeError(
                    f"{self.name} must make a Gymnasium environment; it made {self._env!r}, which "
                    f"has no {missing[0]}"
                )
            inner = self._env.unwrapped
            if self._drawn is not None and getattr(inner, "render_mode", None) != "rgb_array":
                # Environments ask for it when they draw.
                inner.render_mode = "rgb_array"
        return self._env

    @property
    def period(self) -> float:
        """Seconds between two samples."""
        if self.dt is not None:
            return self.dt
        for name in ("dt", "tau"):
            value = getattr(self.environment.unwrapped, name, None)
            if isinstance(value, int | float | np.number) and 0 < value < math.inf:
                return sampling_period(value)
        return 1.0

    def _set(self, features: Mapping[str, Any], time: float) -> None:
        env = self.environment
        for name, attribute in self.features.items():
            if not hasattr(env.unwrapped, attribute):
                raise unknown_name(f"attribute of {self.name}", attribute, vars(env.unwrapped))
            value = features[name]
            value = np.asarray(value(time)) if is_waveform(value) else value
            value = value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
            setattr(env.unwrapped, attribute, value)
        for attribute, derived in DERIVED.get(type(env.unwrapped).__name__, {}).items():
            setattr(env.unwrapped, attribute, derived(env.unwrapped))

    def _start(self, env: Env, features: Mapping[str, Any], seed: int) -> Any:
        started = env.reset(seed=seed) if self.reset is None else self.reset(env, features, seed)
        if isinstance(started, tuple) and len(started) == 2 and isinstance(started[1], dict):
            started = started[0]
        self._check_observation(env, started, "reset must return the first", TypeError)
        return started

    def _check_observation(
        self, env: Env, observation: object, must: str, error: type[Exception]
    ) -> None:
        space = getattr(env, "observation_space", None)
        try:
            if observation is None:
                raise Misfit("got None")
            check_observation(space, observation)
        except Misfit as misfit:
            raise error(f"{must} observation of {self.name}, {describe(space)}; {misfit}") from None

    def _overshoot(self, env: Env) -> str:
        """Say that actions lay outside their space, and what became of them."""
        became = "was clipped to it, as in training" if self.clip else "was passed on (clip=False)"
        return (
            f"the policy's action lay outside the action space {describe(env.action_space)} of "
            f"{self.name} and {became}"
        )

    def passing(self, features: Mapping[str, Any]) -> Passing:
        """Return the forms of observations and actions; `signals` gives the names."""
        env = self.environment
        observation, action = (
            jax.tree.map(episode_signals.entry_form, getattr(env, f"{name}_space").sample())
            for name in ("observation", "action")
        )
        names = episode_signals.names_of_entries(self.signals)
        return Passing(observation, action, self.period, self.steps * self.period, names)

    def with_links(self, links: tuple[Link, ...]) -> "EpisodeFunction":
        """Return the same episode with these faults."""
        return dataclasses.replace(self, links=(*self.links, *links))

    def _act(
        self, env: Env, observation: object, features: Mapping[str, Any], time: float
    ) -> Fitted:
        if self._decide is None:
            self._decide = episode_signals.host_policy_function(self.policy)
        sees = policy_that_sees(self.policy) is not None
        options = {"features": features_at(features, time)} if sees else {}
        before = None if self._first is None or self._first else state_of(self.policy)
        action = self._decided(observation, options)
        if self._first is not None and len(self._first) < REPEATED:
            self._first.append((*copy.deepcopy((observation, options, action)), before))
        try:
            return fit(env.action_space, action, self.clip)
        except Misfit as misfit:
            space, kind = env.action_space, kind_of(env.action_space)
            what = f"one of the {space.n} actions" if kind == "Discrete" else "an action"
            of = f"{self.name}'s {describe(space)}" if kind in ("Dict", "Tuple") else self.name
            raise ValueError(f"policy must return {what} of {of}; {misfit}") from None

    def _begin_policy(self) -> None:
        if callable(getattr(self.policy, "reset", None)):
            self.policy.reset()
        self._memory = first_memory(self.policy, None)

    def _decided(self, observation: object, options: Mapping[str, Any]) -> Any:
        if self._memory is None:
            return self._decide(observation, **options)
        action, self._memory = self._decide(observation, self._memory, **options)
        return action

    def _check_repeats(self) -> None:
        """Refuse a policy that acts otherwise in a second episode of the same observations."""
        first, self._first = list(self._first or ()), []
        self._begin_policy()
        for observation, options, action, _ in first:
            again = self._decided(observation, options)
            if not all(map(np.array_equal, jax.tree.leaves(action), jax.tree.leaves(again))):
                kept = changed(first[0][-1], state_of(self.policy))
                resets = callable(getattr(self.policy, "reset", None))
                raise ValueError(
                    f"the policy of {self.name}{defined_at(self.policy)} {why_differs(kept)}: with "
                    "the observations of an episode again it acts otherwise. "
                    f"{'Its reset()' if resets else 'Give it a method reset(), which'} is called "
                    "before each episode and must restore all that it remembers, and seed what "
                    "it draws"
                )
        self._first = None

    def _sample(
        self, env: Env, observation: object, action: object, reward: float | np.number,
        features: Mapping[str, Any],
    ) -> dict[str, np.ndarray]:  # fmt: skip
        custom = callable(self.signals)
        seen = episode_signals.as_arrays(observation)
        if isinstance(seen, Mapping | tuple) and not custom:
            seen = episode_signals.named_entries(seen)
        taken = episode_signals.as_arrays(action) if custom else np.zeros(())
        moment = Moment(env, seen, np.asarray(reward, float), np.array(False))
        samples = episode_signals.read_signals(self.signals, moment, taken, features, {}, self.name)
        if not custom:
            read, samples = samples, {}
            for name, value in read.items():
                samples |= named_numbers(name, action if name == "action" else value)
        # Copied: an environment may write its next observation into the same array.
        return {name: np.array(with_gaps(name, value)) for name, value in samples.items()}


@suggests_options
def gymnasium(
    env: str | Callable[[], Any],
    policy: object,
    *,
    steps: int,
    signals: Mapping[str, Any] | Sequence[str] | Callable[..., Mapping[str, Any]] | None = None,
    features: Mapping[str, str] | Iterable[str] = (),
    configure: Callable[..., None] | None = None,
    reset: Callable[..., Any] | None = None,
    dt: float | None = None,
    workers: int | None = None,
    timeout: float | None = None,
    retries: int = 1,
    observation_delay: DelayOption = 0,
    action_delay: DelayOption = 0,
    clip: bool = True,
) -> BlackBox | PooledBlackBox:
    """Make a black box from an environment of Gymnasium and a policy.

    **Arguments:**
    - `env`: the id of a registered environment, or a function that makes one, in each process.
    - `policy`: `observation -> action`, or an object with such a method `act`, such as an
      `rl.Policy`. If it has an argument `features`, it receives the features at that instant. A
      policy with memory must have a method `reset()`, called before each episode.
    - `steps`: the maximum number of steps of the episode. The trace has a sample after the reset
      and after each step; the last valid one is that at which the environment terminates or is
      truncated (also by its own time limit). Each sample has the action taken there, and the reward
      of the step that led to it.
    - `signals`: names of all entries of the observation, or `{name: index or key}` of some;
      `action` and `reward` are added. Or a function `(env, observation, action, reward, features)
      -> dict`. By default: `observation`, `action` and `reward`.
    - `features`: which feature sets which attribute of the unwrapped environment, `{"mass":
      "masspole"}`, or a list of names that are equal in both. Values that the cart-pole derives
      from its masses and length are updated; in other environments `configure` has to do this. A
      `Signal` is set before each step.
    - `configure(env, features)`: for other changes, called before the reset.
    - `reset(env, features, seed) -> observation`: starts the episode in the state given by the
      features; `env.reset(seed=seed)` when left out.
    - `dt`: seconds of a step; by default the environment's attribute `dt` or `tau`, or 1.
    - `workers`, `timeout`, `retries`: see `blackbox`.
    - `observation_delay`, `action_delay`: number of steps after which an observation reaches the
      policy, and an action takes effect: a number, or `{feature: maximum}` for a number given by a
      feature. Until then the policy sees the first observation, and the action is zero.
    - `clip`: whether an action outside the bounds of a Box is clipped before it reaches the
      environment, as libraries do in training; False passes it on. In both cases the run counts
      such actions in its notes. Any other invalid action is an error of its row.
    **Returns:** a black box, with processes if `workers` are given; an episode is a simulation.
    **Raises:** `MissingExtra` without Gymnasium; `ValueError` for invalid options; when the problem
    is checked, `UnknownNameError` for an attribute that the environment lacks.
    """
    if isinstance(env, str):
        package = require("gymnasium", extra="gymnasium")
        if env not in package.registry and ":" not in env and "/" not in env:
            raise unknown_name("environment of Gymnasium", env, package.registry)
    elif not callable(env):
        raise ValueError(f"env must be an id or a function that makes one; got {env!r}")
    decide = episode_signals.host_policy_function(policy, compiled=False)
    if policy_that_sees(policy) is not None:
        decide = functools.partial(decide, features=None)
    check_called_with("policy", decide, ("observation",))
    check_called_with("configure", configure, ("env", "features"))
    check_called_with("reset", reset, ("env", "features", "seed"))
    check_count("steps", steps)
    episode_signals.check_signals_option(signals, "env")
    if not isinstance(clip, bool):
        raise ValueError(f"clip is True or False; got {clip!r}")
    bindings = features if isinstance(features, Mapping) else {name: name for name in features}
    seconds = None if dt is None else sampling_period(dt)
    episode = EpisodeFunction(
        env,
        policy,
        steps,
        signals,
        dict(bindings),
        configure,
        reset,
        seconds,
        as_delay(observation_delay, "observation_delay"),
        as_delay(action_delay, "action_delay"),
        clip,
    )
    options: Any = {"workers": workers, "timeout": timeout, "retries": retries}
    return cast("BlackBox | PooledBlackBox", blackbox(episode, seeded=True, **options))
