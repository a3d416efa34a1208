"""Environments of JAX with a policy in the loop, as systems: their common base.

A subclass binds features, and gives the environment for the features of an instant, its start,
step, parts and actions. Episodes, checks and delays are here.
"""

import importlib.metadata
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import jax
from jaxtyping import Array, Key, PyTree

from verifai_jax.addons.simulators.delay_options import DelayOption, as_delay, links_of
from verifai_jax.addons.simulators.environments.episode import (
    Episode,
    Moment,
    Time,
    check_features,
    features_at,
    first_memory,
    has_waveforms,
    policy_function,
    policy_that_sees,
    rollout,
    sampling_period,
)
from verifai_jax.addons.simulators.environments.episode_signals import (
    SignalsOption,
    check_signals_option,
    names_of_entries,
    read_signals,
)
from verifai_jax.core.messages.errors import MissingExtra
from verifai_jax.core.user_code.user_errors import check_called_with
from verifai_jax.core.values.waveform import set_durations
from verifai_jax.systems.actions import Continuous, Discrete
from verifai_jax.systems.base import Features, Seed, System
from verifai_jax.systems.channels import Channels, Link, Passing, first_refusal
from verifai_jax.systems.delays import joined
from verifai_jax.systems.forks import Rollout
from verifai_jax.systems.pytree_checks import in_working_precision


@dataclass(frozen=True, eq=False, kw_only=True)
class PolicyLoop(System):
    """A closed loop `(features, key) -> Trace`; the function that makes it documents its parts.

    - `binding`: how to bind a feature, for errors.
    """

    binding: ClassVar[str]
    env: Any
    name: str
    policy: Any
    policy_memory: Any
    steps: int
    dt: float = field()
    features: Mapping[str, Any]
    configure: Callable[..., Any] | None
    initial: Mapping[str, Any] | Callable[..., Any] | None
    signals: SignalsOption
    links: tuple[Link, ...] = ()

    @property
    def duration(self) -> float:
        """Duration of a simulation in seconds."""
        return self.steps * self.dt

    def rollout(self, features: Features, key: Seed = None) -> Rollout:
        """Return one episode, not reset at its end."""
        return rollout(self._episode(features), key)

    def _configured(self, features: Features) -> Any:
        """Return the environment under the features of an instant, in the form that it has."""
        raise NotImplementedError

    def _start(self, configured: Any, features: Features, key: Key[Array, ""]) -> Moment:
        """Return the first moment; `features` are those of the first instant."""
        raise NotImplementedError

    def _step(self, configured: Any, state: Any, action: PyTree, key: Key[Array, ""]) -> Moment:
        """Return the moment one step after a state."""
        raise NotImplementedError

    def _parts(self, state: Any) -> dict[str, Any]:
        """Return the parts of a state that are signals where the user names none."""
        raise NotImplementedError

    def _action(self, action: PyTree) -> Array:
        """Return what the policy returned as an action of the environment, checked."""
        raise NotImplementedError

    def _episode(self, features: Features) -> Episode:
        """Return the environment under these features, with the policy in the loop."""
        features = set_durations(features, self.duration)
        self.check(features)
        first = features_at(features, 0.0)
        fixed = None if has_waveforms(features) else self._configured(first)

        def configured(time: Time) -> Any:
            return self._configured(features_at(features, time)) if fixed is None else fixed

        def start(key: Key[Array, ""]) -> Moment:
            return self._start(configured(0.0), first, key)

        def step(time: Time, state: Any, action: PyTree, key: Key[Array, ""]) -> Moment:
            return self._step(configured(time), state, action, key)

        def sample(time: Time, moment: Moment, action: PyTree) -> Any:
            now, parts = features_at(features, time), self._parts(moment.state)
            return read_signals(self.signals, moment, action, now, parts, self.name)

        policy = policy_function(self.policy, self.policy_memory)

        def decide(time: Time, observation: PyTree, memory: PyTree, key: Key[Array, ""]) -> Any:
            action, memory = policy(observation, memory, key, features_at(features, time))
            return self._action(action), memory

        return Episode(
            self.name, start, step, decide, self.policy_memory, sample, self.steps, self.dt,
            Channels(self.links, self.dt, features),
        )  # fmt: skip

    def check(self, features: Features) -> None:
        starts = self.initial if isinstance(self.initial, Mapping) else {}
        read = [name for link in self.links for name in link.features]
        check_features(
            features,
            [*self.features, *starts, *read],
            (self.configure, self.signals, self.initial, policy_that_sees(self.policy)),
            self.name,
            self.binding,
        )
        for link in self.links:
            link.check(features)

    def why_error(self, features: Features) -> str | None:
        """Return a message that names a delay or fault with an invalid number."""
        return first_refusal(self.links, features, self.name)

    def passing(self, features: Features) -> Passing:
        """Return the forms of observations and actions; `signals` gives the names."""

        def first(features: Features, key: Key[Array, ""]) -> Any:
            episode = self._episode(features)
            moment = episode.start(key)
            memory = in_working_precision(episode.memory)
            return moment.observation, episode.decide(0.0, moment.observation, memory, key)[0]

        key = jax.eval_shape(lambda: jax.random.key(0))
        observation, action = jax.eval_shape(first, features, key)
        names = names_of_entries(self.signals)
        return Passing(
            observation, action, self.dt, self.duration, names, bounds=self._action_bounds()
        )

    def _action_bounds(self) -> tuple[PyTree, PyTree] | None:
        """Return the lowest and the highest action; None if neither policy nor environment says."""
        action = getattr(self.policy, "action", None)
        if isinstance(action, Discrete):
            return 0, action.n - 1
        return (action.low, action.high) if isinstance(action, Continuous) else None

    def with_links(self, links: tuple[Link, ...]) -> "PolicyLoop":
        return replace(self, links=joined(self.links, links))


def loop_options(
    dt: object,
    policy: object,
    policy_memory: PyTree,
    features: Mapping[str, str] | Iterable[str],
    configure: Callable[..., Any] | None,
    initial: Mapping[str, str] | Callable[..., Any] | None,
    signals: SignalsOption,
    delays: tuple[DelayOption, DelayOption],
    configured: str,
    started: str,
) -> dict[str, Any]:
    """Check the options common to all environments, and return the arguments of `PolicyLoop`.

    **Arguments:**
    - `delays`: the delays of observations and of actions.
    - `configured`, `started`: the first argument of `configure`, and of a function `initial`.
    **Raises:** `ValueError` for an invalid option.
    """
    seconds = sampling_period(dt)
    check_signals_option(signals)
    check_called_with("configure", configure, (configured, "features"))
    if not isinstance(initial, Mapping):
        check_called_with("initial", initial, (started, "features", "key"))
    policy_memory = first_memory(policy, policy_memory)
    policy_function(policy, policy_memory)
    bindings = features if isinstance(features, Mapping) else {name: name for name in features}
    return {
        "dt": seconds,
        "policy": policy,
        "policy_memory": policy_memory,
        "features": bindings,
        "configure": configure,
        "initial": initial,
        "signals": signals,
        "links": links_of(
            as_delay(delays[0], "observation_delay"), as_delay(delays[1], "action_delay")
        ),
    }


def check_version(package: str, oldest: tuple[int, ...]) -> None:
    """Refuse a version of an environment's package that is older than `oldest`.

    **Raises:** `MissingExtra`, one line with the pip command.
    """
    version = importlib.metadata.version(package)
    if tuple(int(number) for number in re.findall(r"\d+", version)[:3]) < oldest:
        raise MissingExtra(
            f"{package} {version} is installed, verifai_jax needs {'.'.join(map(str, oldest))} or "
            f"later: pip install 'verifai_jax[{package}]'"
        )
