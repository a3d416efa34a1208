"""The undecided part of a feature space, for sampling and searching."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from verifai_jax.addons.verification.boxes import BROKEN, OUTSIDE, Boxes
from verifai_jax.features.domain import Numbers
from verifai_jax.features.space import FeatureSpace

MARGIN = 2.0**-20
"""Distance from the faces of a box within which a point of float32 does not count as in it: the
rounding of a point, and of the edges of discrete features."""
Node: TypeAlias = tuple[int, float, list[int], np.ndarray, np.ndarray]
"""A cut: its coordinate, where it is, the nodes below and above it; the corners of what is decided
where there is no cut any more."""


class Rest:
    """The part of the unit cube in no box of these states, which are decided, or refused.

    `mass` is its probability with what the constraint refuses of its boxes, and `cut` whether it
    may refuse some. `decided` is the probability of the decided boxes, which it accepts, and
    `failing` that of the decided boxes in which every point fails.
    """

    def __init__(self, boxes: Boxes, states: Sequence[int]) -> None:
        decided = np.isin(boxes.state, states)
        left = ~decided & (boxes.state != OUTSIDE)
        self.mass, self.decided, self.failing = (
            float(boxes.mass[rows].sum())
            for rows in (left, decided, decided & (boxes.state == BROKEN))
        )
        self.cut = not boxes.inside[left].all()
        self._boxes = boxes[left]
        # The partition is one of cuts from face to face, which are found again: a node for each.
        nodes: list[Node] = []
        self._depth = _grow(nodes, boxes.low, boxes.high, decided)
        self._nodes = [np.array(column) for column in zip(*nodes, strict=True)]

    def draw(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "count dim"]:
        """Draw points from the prior, given that they lie in this part."""
        low, high, mass = self._boxes.low, self._boxes.high, self._boxes.mass
        rows = random.choice(len(mass), count, p=mass / mass.sum())
        return low[rows] + random.random((count, low.shape[1])) * (high - low)[rows]

    def is_decided(
        self, points: Float[Any, "*n dim"], margin: float = 0.0, xp: Any = np
    ) -> Bool[Any, "*n"]:
        """Return which points lie in decided boxes, at a margin from their faces in the cube.

        `xp` is NumPy, or `jax.numpy`, which may trace the points.
        """
        axis, cut, after, low, high = map(xp.asarray, self._nodes)
        node = xp.zeros(points.shape[:-1], int)
        for _ in range(self._depth):
            value = xp.take_along_axis(points, axis[node][..., None], -1)[..., 0]
            node = xp.where(value < cut[node], after[node, 0], after[node, 1])
        low, high = low[node], high[node]
        low, high = low + margin * (low > 0), high - margin * (high < 1)
        return xp.all((low <= points) & (points <= high), axis=-1)


def _grow(nodes: list[Node], low: np.ndarray, high: np.ndarray, decided: np.ndarray) -> int:
    """Add the nodes of some boxes, and return how many lie below one another."""
    node = len(nodes)
    alike = decided.all() or not decided.any()
    inside = low.min(0) if decided.all() else np.full(low.shape[1], np.inf)
    below, axis, cut = (decided, 0, 0.0) if alike else _even_cut(low, high)
    nodes.append((axis, cut, after := [node, node], inside, high.max(0)))
    if alike:
        return 0
    depths = []
    for i, side in enumerate((below, ~below)):
        after[i] = len(nodes)
        depths.append(_grow(nodes, low[side], high[side], decided[side]))
    return 1 + max(depths)


def _even_cut(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, int, float]:
    """Return which boxes lie below a cut that goes through none, its coordinate, and where it is.

    Of all such cuts it is the one with the most equal numbers of boxes on both sides.
    """
    found, rest = None, np.inf
    for j in range(low.shape[1]):
        order = np.argsort(low[:, j], kind="stable")
        begins, ends = low[order, j], np.maximum.accumulate(high[order, j])
        counts = np.flatnonzero(begins[1:] >= ends[:-1]) + 1
        if len(counts):
            count = counts[np.argmin(np.abs(2 * counts - len(low)))]
            if abs(2 * count - len(low)) < rest:
                found, rest = (j, float(begins[count])), abs(2 * count - len(low))
    assert found is not None, "boxes that halving made have a cut between them"
    return low[:, found[0]] < found[1], *found


class Undecided:
    """The constraint of a space combined with the condition that a point lies in no decided box."""

    def __init__(self, space: FeatureSpace, rest: Rest) -> None:
        self.space, self.rest = space, rest

    def __call__(self, features: dict[str, Any]) -> Bool[Array, ""]:
        decided = self.rest.is_decided(self.space.flatten(features), MARGIN, jnp)
        return self.space.accepts(features) & ~decided


class RestSpace(FeatureSpace):
    """A feature space whose constraint also refuses decided boxes.

    The constraint is a function of points, since features do not determine all coordinates, such as
    those of absent items.
    """

    def __init__(self, space: FeatureSpace, rest: Rest) -> None:
        super().__init__(space.domains, Undecided(space, rest))

    @cached_property
    def accepts_points(self) -> Callable[[Numbers], Bool[Any, " n"]]:
        asked: Any = self.where
        return lambda u: (
            np.asarray(asked.space.accepts_points(u))
            & ~asked.rest.is_decided(np.asarray(u, float), MARGIN)
        )
