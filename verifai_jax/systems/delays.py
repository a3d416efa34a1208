"""Delays between a system and its policy, in whole steps, fixed or by a feature.

    brax("hopper", policy, action_delay=2)
    brax("hopper", policy, observation_delay={"latency": 5})    # the feature `latency`, at most 5

With a delay of `n` steps a policy receives the observation of `n` steps ago, or before that the
first one. An action takes effect `n` steps after its decision; until then the system receives
zeros, or a discrete environment its first choice.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree

from verifai_jax.systems.channels import Instant, Link, Side

Features: TypeAlias = PyTree
Value: TypeAlias = Array | np.ndarray
FEW = 16
"""Values of a line up to which each is an array of its own."""


@dataclass(frozen=True)
class Delay(Link):
    """A delay of `max_steps` steps, or of the number given by a `feature`, at most `max_steps`."""

    max_steps: int = 0
    feature: str | None = None
    side: Side = "observation"

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the features that it reads."""
        return () if self.feature is None else (self.feature,)

    def steps(self, features: Features) -> Any:
        """Return the number of steps in one simulation; traced if the feature is."""
        return self.max_steps if self.feature is None else features[self.feature]

    def valid(self, features: Features) -> Any:
        """Return whether the feature's value is an integer from 0 to the maximum."""
        steps = self.steps(features)
        return (steps >= 0) & (steps <= self.max_steps) & (steps % 1 == 0)

    def begin(self, value: PyTree, now: Instant, key: Key[Array, ""] | int | None) -> PyTree:
        # Without a delay nothing is remembered, which costs nothing.
        leaves = jax.tree.leaves(value) if self.max_steps else []
        return [line_of(jnp.asarray(leaf), self.max_steps + 1) for leaf in leaves]

    def through(self, state: PyTree, value: PyTree, now: Instant) -> tuple[PyTree, PyTree]:
        if not self.max_steps:
            return value, state
        leaves, form = jax.tree.flatten(value)
        lines = [moved_up(line, leaf) for line, leaf in zip(state, leaves, strict=True)]
        steps: Any = self.max_steps
        if self.feature is not None:
            wanted = jnp.asarray(self.steps(now.features)).astype(jnp.int32)
            steps = jnp.clip(wanted, 0, self.max_steps)
        late = jax.tree.unflatten(form, [entry(line, steps) for line in lines])
        return late, now.kept(state, lines)

    def refusal(self, features: Features, owner: str) -> str | None:
        """Return the problem with the feature's value, for `owner`; None if it is valid."""
        steps = np.asarray(self.steps(features))
        if steps.shape == () and bool(self.valid(features)):
            return None
        return (
            f"feature {self.feature!r} of {owner} must be a whole number of steps from 0 to "
            f"{self.max_steps}; got {steps}"
        )

    def check(self, features: Features) -> None:
        """Refuse a feature that draws real numbers, before anything compiles.

        - `features`: `jax.ShapeDtypeStruct`s; concrete values are checked by `valid`.

        **Raises:** `ValueError`.
        """
        feature = None if self.feature is None else features[self.feature]
        if isinstance(feature, jax.ShapeDtypeStruct) and jnp.issubdtype(
            feature.dtype, jnp.floating
        ):
            raise ValueError(
                f"feature {self.feature!r} is a delay in whole steps: make it a DiscreteBox, as in "
                f"DiscreteBox(0, {self.max_steps}); it draws real numbers"
            )


def line_of(first: Value, count: int) -> Any:
    """Return a delay line: the last `count` values, newest first, initially all `first`.

    A short line consists of separate arrays, which are shifted without a copy; a single array would
    be rewritten at each step.
    """
    return (first,) * count if count <= FEW else first[None].repeat(count, axis=0)


def moved_up(line: Any, new: Value, xp: ModuleType = jnp) -> Any:
    """Return a line with a new value at the front, without the oldest one."""
    new = xp.asarray(new, line[0].dtype)
    if isinstance(line, tuple):
        return (new, *line[:-1])
    return xp.concatenate([new[None], line[:-1]])


def entry(line: Any, index: Any, xp: ModuleType = jnp) -> Any:
    """Return the value of a line at an index, 0 for the newest."""
    if isinstance(index, int) or not isinstance(line, tuple):
        return line[index]
    chosen = line[0]
    for i, earlier in enumerate(line[1:], 1):
        chosen = xp.where(index == i, earlier, chosen)
    return chosen


def joined(links: tuple[Link, ...], faults: tuple[Link, ...]) -> tuple[Link, ...]:
    """Return links with faults inserted.

    Faults of sensors come before the delay of the observation, faults of actuators after the delay
    of the action; faults keep their order. What stands in for the policy comes before all.
    """
    delays = [link for link in links if isinstance(link, Delay)]
    others = [link for link in (*links, *faults) if not isinstance(link, Delay)]
    observed = [link for link in others if link.side == "observation"]
    acted = [link for link in others if link.side == "action" and not link.decides]
    return (*(link for link in others if link.decides), *observed, *delays, *acted)
