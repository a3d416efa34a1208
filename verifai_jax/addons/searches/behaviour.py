"""Distances between the outcomes of simulations, and a memory of outcomes.

    seen = SeenBehaviour.nothing(capacity=256, batch=16)
    seen = seen.widened(outcomes).recorded(outcomes)
    seen.unlike(outcomes, others)                       # [n, m], from 0 to 1

Outcomes are those of `core.values.clauses`: the deciding predicate, its time, and the shape of the
trace.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from verifai_jax.core.values.clauses import OUTCOME, SEGMENTS, SIGNALS

MEMORY = 256
"""Outcomes that are remembered; the last ones. As many as `Diverse` archives failures by
default."""
NEIGHBOURS = 15
"""Remembered outcomes that say how well known one is: the k of novelty search, which Lehman and
Stanley set to 15."""
ALIKE = 1e-4
"""Spread of the robustness of safe points, over its size, up to which it says nothing: a thousand
roundings of float32, as a constant robustness may have from the arithmetic of a simulation."""


class SeenBehaviour(NamedTuple):
    """The outcomes seen so far, and the ranges of their signals.

    - `archive`: the archive of failures.
    - `best`: the best points, from which to restart.
    - `memory`: the latest outcomes, whatever their robustness; rows that are not finite are empty.
    - `index`: the row of the memory for the next outcome.
    - `low`, `high`: the range of each signal.
    - `lowest`, `highest`: the extreme robustness of safe points.
    """

    archive: Float[Array, "capacity outcome"]
    best: Float[Array, "batch outcome"]
    memory: Float[Array, "memory outcome"]
    index: Int[Array, ""]
    low: Float[Array, " signals"]
    high: Float[Array, " signals"]
    lowest: Float[Array, ""]
    highest: Float[Array, ""]

    @classmethod
    def nothing(cls, capacity: int, batch: int) -> "SeenBehaviour":
        """Return the memory before the first simulation."""
        unknown = np.float32(np.nan)
        return cls(
            archive=jnp.full((capacity, OUTCOME), unknown),
            best=jnp.full((batch, OUTCOME), unknown),
            memory=jnp.full((MEMORY, OUTCOME), unknown),
            index=jnp.int32(0),
            low=jnp.full(SIGNALS, np.float32(np.inf)),
            high=jnp.full(SIGNALS, np.float32(-np.inf)),
            lowest=jnp.float32(np.inf),
            highest=jnp.float32(-np.inf),
        )

    @property
    def level(self) -> Bool[Array, ""]:
        """True if all safe points have the same robustness, so that it gives no direction."""
        return self.highest - self.lowest <= ALIKE * jnp.abs(self.highest)

    def widened(
        self, outcomes: Float[Array, "n outcome"], safe: Float[Array, " n"]
    ) -> "SeenBehaviour":
        """Return the memory with ranges widened to these outcomes.

        **Arguments:**
        - `outcomes`: the outcomes of a round.
        - `safe`: the robustness of safe points, NaN for others.
        """
        known = is_known(outcomes)[:, None, None]
        shape = _shape(outcomes)
        low = jnp.min(jnp.where(known, shape, jnp.inf), axis=(0, 2), initial=jnp.inf)
        high = jnp.max(jnp.where(known, shape, -jnp.inf), axis=(0, 2), initial=-jnp.inf)
        lowest = jnp.min(jnp.where(jnp.isnan(safe), jnp.inf, safe), initial=jnp.inf)
        highest = jnp.max(jnp.where(jnp.isnan(safe), -jnp.inf, safe), initial=-jnp.inf)
        return self._replace(
            low=jnp.minimum(self.low, low),
            high=jnp.maximum(self.high, high),
            lowest=jnp.minimum(self.lowest, lowest).astype(jnp.float32),
            highest=jnp.maximum(self.highest, highest).astype(jnp.float32),
        )

    def recorded(self, outcomes: Float[Array, "n outcome"]) -> "SeenBehaviour":
        """Return the memory with these outcomes as the latest ones; unknown ones are left out."""
        known = is_known(outcomes)
        number = self.index + jnp.cumsum(known) - 1
        slot = jnp.where(known, number % MEMORY, MEMORY)
        return self._replace(
            memory=self.memory.at[slot].set(outcomes, mode="drop"),
            index=((self.index + jnp.sum(known)) % MEMORY).astype(jnp.int32),
        )

    def familiarity(
        self, outcomes: Float[Array, "n outcome"], radius: Float[Array, ""]
    ) -> Float[Array, " n"]:
        """Return 1 for outcomes seen often, falling to 0 at a given distance from all seen ones.

        It is a mean over the nearest outcomes, as in novelty search, so an outcome seen once is not
        familiar.
        """
        far = jnp.where(is_known(self.memory), self.unlike(outcomes, self.memory), jnp.inf)
        _, nearest = jax.lax.top_k(-far, NEIGHBOURS)
        near = jnp.take_along_axis(far, nearest, axis=1)
        return jnp.mean(jnp.clip(1 - near / radius, 0.0, 1.0), axis=1)

    def unlike(
        self, one: Float[Array, "n outcome"], other: Float[Array, "m outcome"]
    ) -> Float[Array, "n m"]:
        """Return the dissimilarity of outcomes, from 0 to 1; infinite if one is unknown.

        It is 1 if different predicates decide; otherwise the larger of the difference of the times
        and that of the shapes. The latter is the maximum over signals of the root mean square
        difference, as a share of the signal's observed range.
        """
        later = jnp.abs(one[:, None, 1] - other[None, :, 1])
        span = jnp.where(self.high > self.low, self.high - self.low, 1.0)[:, None]
        gap = (_shape(one)[:, None] - _shape(other)[None]) / span
        shape = jnp.max(jnp.sqrt(jnp.mean(gap**2, axis=-1)), axis=-1)
        same = one[:, None, 0] == other[None, :, 0]
        distance = jnp.where(same, jnp.maximum(later, jnp.minimum(shape, 1.0)), 1.0)
        known = is_known(one)[:, None] & is_known(other)[None]
        return jnp.where(known, distance, jnp.inf)


def is_known(outcomes: Float[Array, "n outcome"]) -> Bool[Array, " n"]:
    """Return which outcomes are known."""
    return jnp.all(jnp.isfinite(outcomes), axis=1)


def _shape(outcomes: Float[Array, "n outcome"]) -> Float[Array, "n signals parts"]:
    return outcomes[:, 2:].reshape(-1, SIGNALS, SEGMENTS)
