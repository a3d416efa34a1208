"""Choices to try at an instant: few pieces, changes of the best so far, and cross-entropy.

The best responses of many systems are extreme and change seldom (bang-bang), so half of the numbers
are ends of their range, and a third of the choices have few pieces.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.addons.avoidability.means import Means

ELITES = 24
"""Best choices that are kept for an instant."""
PIECES = 6
"""Pieces of a drawn choice, at most."""
SPREAD = 0.03
"""Least standard deviation of a number that cross-entropy draws."""
Numbers = Float[np.ndarray, "n steps entries"]
Stops = Int[np.ndarray, " n"]


class Proposals:
    """The choices of one instant: the best first, and those that wait to be tried."""

    def __init__(self, means: Means, start: int, rng: np.random.Generator) -> None:
        self.means, self.start, self.rng = means, start, rng
        self.first = min(start, means.shape[0] - 1)
        self.waiting: list[tuple[Numbers, Stops]] = []
        self.numbers, self.stops = np.zeros((0, *means.shape)), np.zeros(0, int)
        self.rho = np.zeros(0)

    def learn(self, numbers: Numbers, stops: Stops, rho: Float[np.ndarray, " n"]) -> None:
        """Keep the best of the known and these."""
        rho = np.concatenate([self.rho, rho])
        best = np.argsort(-rho, kind="stable")[:ELITES]
        self.rho, self.stops = rho[best], np.concatenate([self.stops, stops])[best]
        self.numbers = np.concatenate([self.numbers, numbers])[best]

    def next(self, count: int) -> tuple[Numbers, Stops]:
        """Return choices to try: those that wait, and new ones."""
        parts, self.waiting = self.waiting, []
        left = max(count - sum(len(stops) for _, stops in parts), 0)
        third = left // 3 if len(self.rho) else 0
        parts.append(self._few_pieces(left - 2 * third))
        parts += [self._with_segment(third), self._cross_entropy(third)] if third else []
        numbers, stops = (np.concatenate(both)[:count] for both in zip(*parts, strict=True))
        return numbers, stops

    def _levels(self, *shape: int) -> Any:
        extreme = self.rng.random(shape) < 0.5
        return np.where(extreme, self.rng.integers(0, 2, shape), self.rng.random(shape))

    def _stops(self, count: int) -> Stops:
        """Return where choices stop: half of them at the end."""
        early = self.means.ends & (self.rng.random(count) < 0.5)
        steps = self.means.shape[0]
        return np.where(early, self.rng.integers(self.first + 1, steps + 1, count), steps)

    def _few_pieces(self, count: int) -> tuple[Numbers, Stops]:
        (steps, entries), rng = self.means.shape, self.rng
        # Changes are more likely soon after the start, where they matter most.
        changes = self.first + (steps - self.first) * rng.random((count, PIECES - 1)) ** 2
        few = rng.integers(0, PIECES, (count, 1)) <= np.arange(PIECES - 1)
        pieces = np.arange(steps)[:, None] >= np.where(few, steps, changes)[:, None]
        levels = self._levels(count, PIECES, entries)
        return np.take_along_axis(levels, pieces.sum(2)[:, :, None], axis=1), self._stops(count)

    def _with_segment(self, count: int) -> tuple[Numbers, Stops]:
        """Return good choices with another value of some entries over a segment."""
        (steps, entries), rng = self.means.shape, self.rng
        parents = (len(self.rho) * rng.random(count) ** 2).astype(int)
        length = np.maximum(1, ((steps - self.first) * rng.random(count) ** 3).astype(int))
        begin = rng.integers(self.first, np.maximum(steps - length, self.first) + 1)
        since = np.arange(steps) - begin[:, None]
        chosen = rng.random((count, entries)) < max(0.5, 1.5 / max(entries, 1))
        replaced = ((since >= 0) & (since < length[:, None]))[:, :, None] & chosen[:, None]
        made = np.where(replaced, self._levels(count, 1, entries), self.numbers[parents])
        kept = rng.random(count) < 0.8
        return made, np.where(kept, self.stops[parents], self._stops(count))

    def _cross_entropy(self, count: int) -> tuple[Numbers, Stops]:
        """Return draws around the best choices, whose deviations hold for a while."""
        (steps, entries), rng, size = self.means.shape, self.rng, len(self.rho)
        blocks = np.arange(steps) // np.maximum(1, steps * rng.random((count, 1)) ** 3).astype(int)
        noise = rng.standard_normal((count, steps, entries))
        noise = np.take_along_axis(noise, blocks[:, :, None], axis=1)
        parents, about_mean = rng.integers(0, size, count), rng.random((count, 1, 1)) < 0.5
        centre = np.where(about_mean, self.numbers.mean(0), self.numbers[parents])
        made = np.clip(centre + (self.numbers.std(0) + SPREAD) * noise, 0, 1)
        # Whole numbers have no mean: each step is that of some good choice.
        lent = self.numbers[rng.integers(0, size, (count, steps)), np.arange(steps)]
        return np.where(np.array(self.means.levels, bool), lent, made), self.stops[parents]
