"""The boxes of a branch and bound: a partition of the unit cube, with the state of each box.

Coordinates are halved, so that the ends and the probabilities of boxes are exact numbers; discrete
ones are split between their cells.
"""

import itertools
import math
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.verification.enclosure import Enclosure

OPEN, PROVED, BROKEN, OUTSIDE = 0, 1, 2, 3
"""What is known of a box: nothing for certain, no point fails, every point fails, and no point is
accepted by the constraint."""
NARROWEST = 2.0**-20
"""Width of a coordinate below which a box is not split: its points are too few in float32."""
CHOICES = 4096
"""Combinations of choices that are looked at one by one, at most."""


@dataclass
class Boxes:
    """A partition of the unit cube, with one row for each box.

    - `low`, `high`: `[n, dim]`, the corners.
    - `state`: `[n]`, `OPEN`, `PROVED`, `BROKEN` or `OUTSIDE`.
    - `lowest`, `highest`: `[n]`, bounds of the robustness; infinite if unknown, and `highest` until
      the box itself was evaluated with sets.
    - `witness`: `[n, dim]`, a point that fails when simulated; NaN without one.
    - `confirmed`: `[n]`, whether the witness certainly fails.
    - `inside`: `[n]`, whether the constraint is known to accept all points.
    - `drawn`, `accepted`: `[n]`, counts of independent draws of the box from the prior of the
      unconstrained features, and of those that the constraint accepts.
    - `failures`, `samples`: `[n]`, counts of independent samples of the box, which are accepted.
    """

    low: Float[np.ndarray, "n dim"]
    high: Float[np.ndarray, "n dim"]
    state: Int[np.ndarray, " n"]
    lowest: Float[np.ndarray, " n"]
    highest: Float[np.ndarray, " n"]
    witness: Float[np.ndarray, "n dim"]
    confirmed: Bool[np.ndarray, " n"]
    inside: Bool[np.ndarray, " n"]
    drawn: Int[np.ndarray, " n"]
    accepted: Int[np.ndarray, " n"]
    failures: Int[np.ndarray, " n"]
    samples: Int[np.ndarray, " n"]

    @classmethod
    def between(
        cls, low: Float[np.ndarray, "n dim"], high: Float[np.ndarray, "n dim"], inside: np.ndarray
    ) -> "Boxes":
        """Return open boxes, of which the constraint accepts all points or may not."""
        n, infinite = len(low), np.full(len(low), np.inf)
        return cls(
            low, high, np.zeros(n, int), -infinite, infinite, np.full(low.shape, np.nan),
            np.zeros(n, bool), np.resize(inside, n), *(np.zeros(n, int) for _ in range(4)),
        )  # fmt: skip

    @classmethod
    def whole(cls, enclosure: Enclosure) -> "Boxes":
        """Return the whole cube: one box for each combination of choices and of lengths.

        **Raises:** `ValueError` for too many combinations.
        """
        space, sides = enclosure.problem.space, list[list[tuple[float, float]]]()
        for j, edges in enumerate(enclosure.ranges.edges):
            apart = not space.ordered[j] or j in space.lengths
            cells = [] if edges is None or not apart else itertools.pairwise(edges.tolist())
            sides.append([*cells] or [(0.0, 1.0)])
        count = math.prod(map(len, sides))
        if count > CHOICES:
            raise ValueError(
                f"the choices of this feature space have {count:,} combinations, and verify "
                f"examines at most {CHOICES:,}; fix some with problem.only(...)"
            )
        ends = np.array(list(itertools.product(*sides))).reshape(count, space.dim, 2)
        inside = np.array([space.where is None])
        return cls.between(ends[..., 0].copy(), ends[..., 1].copy(), inside)

    def __len__(self) -> int:
        return len(self.low)

    def __getitem__(self, rows: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "Boxes":
        return Boxes(*(getattr(self, field.name)[rows] for field in fields(self)))

    def with_more(self, others: "Boxes") -> "Boxes":
        """Return these boxes followed by others."""
        pairs = ((getattr(self, f.name), getattr(others, f.name)) for f in fields(self))
        return Boxes(*map(np.concatenate, pairs))

    @property
    def mass(self) -> Float[np.ndarray, " n"]:
        """The probability of each box under the prior of the unconstrained features."""
        return np.prod(self.high - self.low, axis=1)

    @property
    def has_witness(self) -> Bool[np.ndarray, " n"]:
        """True if a point of the box fails when simulated."""
        return np.asarray(~np.isnan(self.witness).any(axis=1))

    def splittable(self, enclosure: Enclosure) -> Bool[np.ndarray, "n dim"]:
        """Return which coordinates of each box can be split."""
        wide = self.high - self.low > NARROWEST
        for j in range(wide.shape[1]):
            edges = enclosure.ranges.edges[j]
            if edges is not None:
                first, last = (np.searchsorted(edges, end[:, j]) for end in (self.low, self.high))
                wide[:, j] = last - first > 1
        return wide

    def halves(self, coordinate: Int[np.ndarray, " n"], enclosure: Enclosure) -> "Boxes":
        """Return the halves of each box along a coordinate, open; its witness stays in its half.

        Lower bounds of the robustness are inherited by both halves.
        """
        rows = np.arange(len(self))
        low, high = self.low[rows, coordinate], self.high[rows, coordinate]
        middle = low / 2 + high / 2
        for j in np.unique(coordinate):
            edges = enclosure.ranges.edges[int(j)]
            if edges is not None:
                own = coordinate == j
                first, last = (np.searchsorted(edges, end[own]) for end in (low, high))
                middle[own] = edges[(first + last) // 2]
        left = Boxes.between(self.low, self.high.copy(), self.inside)
        right = Boxes.between(self.low.copy(), self.high, self.inside)
        left.high[rows, coordinate] = right.low[rows, coordinate] = middle
        left.lowest[:] = right.lowest[:] = self.lowest
        known = self.has_witness
        below = self.witness[rows, coordinate] < middle
        left.witness[known & below] = self.witness[known & below]
        right.witness[known & ~below] = self.witness[known & ~below]
        return left.with_more(right)
