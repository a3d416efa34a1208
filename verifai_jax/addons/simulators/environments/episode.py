"""One trace of one episode: a policy in the loop with any environment.

    rollout(Episode(name, start, step, decide, memory, see, steps=200, dt=0.02), key).trace()

An episode that is over stays in its final state; it is never reset within a trace.
"""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.values.trace import Status
from verifai_jax.core.values.waveform import is_waveform
from verifai_jax.systems.base import Features, Seed
from verifai_jax.systems.channels import NOTHING_PASSED, Channels
from verifai_jax.systems.clock import count_periods
from verifai_jax.systems.forks import LoopState, Rollout
from verifai_jax.systems.pytree_checks import (
    as_precise_as,
    check_like,
    check_signals,
    in_working_precision,
    outline,
)

Time: TypeAlias = Float[Array, ""] | float
"""Seconds since the start of an episode."""
Decide: TypeAlias = Callable[[PyTree, PyTree, Key[Array, ""], Features], tuple[PyTree, PyTree]]
"""A function `(observation, memory, key, features) -> (action, memory)`."""


class Moment(NamedTuple):
    """The state after the reset or a step, with observation, reward, and whether it is over."""

    state: Any
    observation: Any
    reward: Any
    over: Any


@dataclass(frozen=True, eq=False)
class Episode:
    """An environment with its features applied: its start, its step and its signals.

    - `start(key) -> Moment`
    - `step(time, state, action, key) -> Moment`: goes from the sample at `time` to the next.
    - `decide(time, observation, memory, key) -> (action, memory)`: see `policy_function`.
    - `signals(time, moment, action) -> dict`: returns one sample of the signals.
    - `steps`, `dt`: maximum number of steps, and seconds between two samples.
    - `channels`: the links in the path of observations and actions.
    """

    name: str
    start: Callable[..., Moment]
    step: Callable[..., Moment]
    decide: Callable[..., tuple[PyTree, PyTree]]
    memory: Any
    signals: Callable[..., dict[str, Array]]
    steps: int
    dt: float
    channels: Channels = NOTHING_PASSED

    def next_moment(self, time: Time, state: PyTree, action: PyTree, key: Key[Array, ""]) -> Moment:
        """Return the moment after a step, with `over` as a truth value."""
        moment = self.step(time, state, action, key)
        return moment._replace(over=jnp.asarray(moment.over, bool))


class _Keys(NamedTuple):
    """Random keys of a simulation: for the start, and the roots of those of steps and decisions."""

    start: Key[Array, ""]
    step: Key[Array, ""]
    decide: Key[Array, ""]


def episode_keys(key: Seed) -> _Keys:
    """Split a simulation's key; step `k` has `fold_in(keys.step, k)`, decision `k` likewise."""
    return _Keys(*jax.random.split(jax.random.key(0) if key is None else key, 3))


def rollout(episode: Episode, key: Seed) -> Rollout:
    """Return one episode as a loop: a sample after the reset and after each step, with its action.

    The reward of a sample is that of the step that led to it. The first sample at which the episode
    is over is the last valid one. The status is `NONFINITE` if the episode ends in a state with a
    NaN, or in an observation that is not finite, and `ERROR` if a delay or a fault has an invalid
    number.

    **Raises:** `ValueError` when JAX traces it, for parts that do not fit together.
    """
    keys = episode_keys(key)
    first, memory, action = _first_moment(episode, episode.start(keys.start), keys)
    channels = episode.channels

    def sample(carry: LoopState, k: Int[Array, ""]) -> Any:
        moment, memory, states, age, _ = carry
        frozen = (k >= episode.steps) | moment.over
        # Time, and with it randomness, stops with the state: the samples after the end repeat.
        time = age.astype(float) * episode.dt
        decide_key, step_key = (jax.random.fold_in(k, age) for k in (keys.decide, keys.step))
        observed, states = channels.observation(states, moment.observation, time, frozen)
        action, after = episode.decide(time, observed, memory, decide_key)
        after = as_precise_as(after, memory)
        action, states = channels.action(states, action, time, frozen)
        signals = episode.signals(time, moment, action)
        # A state in which an episode has ended may have no finite derivative.
        state = _where(frozen, first.state, moment.state)
        following = _cast(episode.next_moment(time, state, action, step_key), moment)
        unchanged, onwards = (moment, memory, age), (following, after, age + 1)
        moment, memory, age = _where(frozen, unchanged, onwards)
        return LoopState(moment, memory, states, age), signals

    start = LoopState(first, memory, channels.begin(first.observation, action, key), jnp.int32(0))
    # One sample more than there are steps: the last one moves nothing.
    return Rollout(
        start, sample, episode.steps + 1, episode.dt,
        lambda last: _status(last.plant, channels.valid()),
    )  # fmt: skip


def _status(last: Moment, valid: Bool[Array, ""] | bool) -> Int[Array, ""]:
    sound = jnp.array(True)
    for leaf in _floats(last):
        sound &= ~jnp.any(jnp.isnan(leaf))
    for leaf in _floats((last.observation, last.reward)):
        sound &= jnp.all(jnp.isfinite(leaf))
    status = jnp.where(sound, jnp.int32(Status.OK), jnp.int32(Status.NONFINITE))
    return jnp.where(valid, status, jnp.int32(Status.ERROR))


def _first_moment(episode: Episode, first: Moment, keys: _Keys) -> tuple[Moment, Any, Any]:
    """Return the first moment and memory in the types that they keep, checked, and no action."""
    first = jax.tree.map(jnp.asarray, first._replace(over=jnp.asarray(first.over, bool)))
    memory = in_working_precision(episode.memory)
    now = jnp.zeros(())
    action, after = jax.eval_shape(episode.decide, now, first.observation, memory, keys.decide)
    role = "(action, memory), its memory in the form of policy_memory"
    check_like(after, memory, "policy", role, same_precision=False)
    following = jax.eval_shape(episode.next_moment, jnp.zeros(()), first.state, action, keys.step)
    if jax.tree.structure(first) != jax.tree.structure(following):
        raise ValueError(
            f"{episode.name}: a step must return a state in the form that the start has: "
            f"{outline(first)}; got {outline(following)}"
        )
    pairs = zip(jax.tree.leaves_with_path(first), jax.tree.leaves(following), strict=True)
    leaves = []
    for (path, have), then in pairs:
        if have.shape != then.shape:
            raise ValueError(
                f"{episode.name}: {jax.tree_util.keystr(path).lstrip('.')} has shape "
                f"{list(have.shape)} at the start and {list(then.shape)} after a step"
            )
        # Environments start with a plain 0 and step to something that is not an integer.
        mixed = have.dtype != then.dtype
        leaves.append(have.astype(jnp.promote_types(have.dtype, then.dtype)) if mixed else have)
    first = jax.tree.unflatten(jax.tree.structure(first), leaves)
    if first.reward.shape != ():
        raise ValueError(
            f"{episode.name}: the reward must be one number; got {outline(first.reward)}"
        )
    check_signals(jax.eval_shape(episode.signals, jnp.zeros(()), first, action))
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), action)
    return first, memory, nothing


def policy_function(policy: object, memory: PyTree = None) -> Decide:
    """Return a user's policy as `decide(observation, memory, key, features) -> (action, memory)`.

    **Arguments:**
    - `policy`: a function of the observation, or of `(observation, key)` for a random one; or an
      object with such a method `act`, such as `rl.Policy`. It receives a key if it has that many
      arguments without a default, and the features of the instant if it has an argument `features`.
    - `memory`: the initial memory of a policy with memory. It is then called with `(observation,
      memory)` or `(observation, memory, key)` and returns `(action, memory)`.
    **Raises:** `ValueError` for an object that cannot be called so.
    """
    act = getattr(policy, "act", None)
    function = act if callable(act) else policy
    given = ("observation",) if memory is None else ("observation", "memory")
    forms = f"({', '.join(given)}) or ({', '.join(given)}, key)"
    if not callable(function):
        raise ValueError(f"policy must be a function of {forms}; got {policy!r}")
    needed = count_required(function)
    if needed is not None and not len(given) <= needed <= len(given) + 1:
        raise ValueError(f"policy must be a function of {forms}; got one of {needed} arguments")
    random, sees = needed == len(given) + 1, sees_features(function)

    def decide(
        observation: PyTree, remembered: PyTree, key: Key[Array, ""], features: Features
    ) -> tuple[Any, Any]:
        last = (key,) if random else ()
        options = {"features": features} if sees else {}
        if memory is None:
            return without_extras(function(observation, *last, **options)), remembered
        decided = function(observation, remembered, *last, **options)
        if not (isinstance(decided, tuple) and len(decided) == 2):
            raise ValueError(f"policy must return (action, memory); got {outline(decided)}")
        return decided

    return decide


def without_extras(decided: Any) -> Any:
    """Return the action from `(action, extras)`, as policies of Brax return it; else the action."""
    pair = isinstance(decided, tuple) and len(decided) == 2
    return decided[0] if pair and isinstance(decided[1], Mapping) else decided


def first_memory(policy: object, memory: PyTree) -> PyTree:
    """Return the initial memory of a policy: the given one, or the policy's own."""
    return getattr(policy, "initial_memory", None) if memory is None else memory


def policy_that_sees(policy: object) -> Callable[..., Any] | None:
    """Return the function of a policy that receives features; None for any other."""
    act = getattr(policy, "act", None)
    function = act if callable(act) else policy
    return function if callable(function) and sees_features(function) else None


def sees_features(function: Callable[..., Any]) -> bool:
    """Return whether a policy has an argument `features`."""
    try:
        return "features" in inspect.signature(function).parameters
    except (TypeError, ValueError):
        return False


def count_required(function: Callable[..., Any]) -> int | None:
    """Count the arguments without a default, except `features`; None if the number is unknown."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return None
    if any(p.kind is p.VAR_POSITIONAL for p in parameters):
        return None
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(
        p.kind in kinds and p.default is p.empty and p.name != "features" for p in parameters
    )


def vector_action(action: ArrayLike, size: int, name: str) -> Float[Array, " size"]:
    """Return a policy's output as an action vector; a number may stand for a single entry.

    **Raises:** `ValueError` for anything but `size` real numbers.
    """
    shape, dtype = getattr(action, "shape", None), getattr(action, "dtype", None)
    if shape is None and isinstance(action, int | float):
        action = jnp.asarray(action, float)
        shape, dtype = action.shape, action.dtype
    fits = shape == (size,) or (size == 1 and shape == ())
    if not fits or dtype is None or not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(
            f"policy must return the {size} real number{'s' * (size > 1)} that {name} takes as an "
            f"action, shape [{size}]; got {outline(action)}"
        )
    return jnp.reshape(action, (size,))


def check_features(
    features: Features, bound: Sequence[str], functions: Sequence[Any], name: str, how: str
) -> None:
    """Refuse names of features that do not exist, and features that are never used.

    - `bound`: features that set something; `functions`: functions given by the user, any of which
      would use all features; `how`: how to bind a feature, as text.

    **Raises:** `UnknownNameError`, `ValueError`.
    """
    if not isinstance(features, Mapping):
        if bound:
            raise ValueError(f"features must be a dictionary; got {outline(features)}")
        return
    check_names("feature", bound, features)
    if any(map(callable, functions)):
        return
    for feature in features:
        if feature not in bound:
            raise ValueError(f"feature {feature!r} changes nothing in {name}: bind it by {how}")


def features_at(features: Features, time: Time) -> Any:
    """Return the same features with each waveform replaced by its value at a time in seconds."""
    return jax.tree.map(lambda v: v(time) if is_waveform(v) else v, features, is_leaf=is_waveform)


def has_waveforms(features: Features) -> bool:
    """Return True if any of the features is a function of time."""
    return any(map(is_waveform, jax.tree.leaves(features, is_leaf=is_waveform)))


def step_count(
    steps: int | None, duration: float | None, dt: float, otherwise: float | None = None
) -> int:
    """Return the number of steps of an episode; refuse anything but a positive one."""
    if steps is not None and duration is not None:
        raise ValueError(f"give either duration or steps; got (duration={duration}, steps={steps})")
    if duration is not None:
        steps = count_periods(duration, dt, "duration")
    chosen = otherwise if steps is None else steps
    if chosen is None:
        raise ValueError("give steps or duration; got neither")
    return check_count("steps", chosen)


def sampling_period(seconds: object) -> float:
    """Check a sampling period; a float32 number becomes the decimal number that was meant."""
    value: Any = seconds
    number = isinstance(seconds, int | float | np.number) and not isinstance(seconds, bool)
    if isinstance(seconds, jax.Array | np.ndarray) and np.shape(seconds) == ():
        number, value = True, np.asarray(seconds)
    if not number or not (math.isfinite(value) and value > 0):
        raise ValueError(f"dt must be a positive number of seconds; got {seconds!r}")
    if getattr(seconds, "dtype", None) == np.float32:
        return float(str(np.float32(value)))
    return float(value)


def used_inputs(function: Callable[..., Any], *arguments: Any) -> list[bool]:
    """Return, for each leaf of the arguments, True if some result of the function depends on it.

    This is abstract: nothing is computed or compiled.
    """
    from jax.interpreters import partial_eval

    closed = jax.make_jaxpr(function)(*arguments)
    _, used = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    return list(used)


def _where(condition: Bool[Array, ""], yes: PyTree, no: PyTree) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _cast(tree: PyTree, like: PyTree) -> Any:
    def cast(leaf: ArrayLike, wanted: Array | jax.ShapeDtypeStruct) -> Any:
        leaf = jnp.asarray(leaf)
        return leaf if leaf.dtype == wanted.dtype else leaf.astype(wanted.dtype)

    return jax.tree.map(cast, tree, like)


def _floats(tree: PyTree) -> list[Any]:
    return [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
