"""The ranges of features over boxes of the unit cube.

    ranges = FeatureRanges(space, "float32")
    for low, high, depends in ranges(first, last): ...    # corners of boxes, [n, dim] each

They contain every number that `space.unflatten` gives within a box, including rounding, if the
domain is `monotone`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from verifai_jax.core.compute.precision import in_precision
from verifai_jax.features.space import FeatureSpace

ROUNDINGS = 8
"""Roundings by which the map from coordinates to a feature may fail to rise."""
TOGETHER = 512
"""Points that are converted at once: one program serves any number."""
Corners = Float[np.ndarray, "n dim"]


class FeatureRanges:
    """The ranges of a space's features.

    - `edges`: the ends of the cells of each coordinate; None for a continuous one.

    **Arguments:**
    - `space`: the feature space.
    - `precision`: the precision of features, `"float32"` or `"float64"`.
    """

    def __init__(self, space: FeatureSpace, precision: str) -> None:
        self.space, self.precision, self.dim = space, precision, space.dim
        self.edges = [
            None if not count else np.cumsum([0.0, *(weights or (1 / count,) * count)])
            for count, weights in zip(space.levels, space.weights, strict=True)
        ]
        self._values = jax.jit(jax.vmap(space.unflatten))
        self._smooth = np.array([edges is None for edges in self.edges], bool)
        self._depends = self._dependence()

    def __call__(self, low: Corners, high: Corners) -> list[tuple[np.ndarray, ...]]:
        """Return the ends of each leaf of the features, and on which coordinates they depend.

        **Returns:** a triple for each leaf, in the order of `jax.tree.leaves`: the ends
        `[n, *shape]`, and `[dim, *shape]`, 1 for the coordinate of a number and 0 for the others.
        """
        first, last = self.ends(low, high)
        found = []
        for begin, end, (depends, scale, exact, real) in zip(
            self._features(first), self._features(last), self._depends, strict=True
        ):
            size = np.maximum(np.maximum(np.abs(begin), np.abs(end)), scale)
            roundings = ROUNDINGS * float(jnp.finfo(self.precision).eps) * real
            margin = roundings * size * depends[self._smooth].any(0)
            below = above = margin
            if exact:
                # The ends of the whole interval are values themselves, and nothing lies beyond.
                below, above = (
                    margin * (1 - np.tensordot(1.0 * at_end, depends, (1, 0)))
                    for at_end in (low == 0, high == 1)
                )
            found.append((begin - below, end + above, depends))
        return found

    def ends(self, low: Corners, high: Corners) -> tuple[Corners, Corners]:
        """Return the points of the cube with the minimum and the maximum of box features."""
        low, high = low.copy(), high.copy()
        for j, edges in enumerate(self.edges):
            if edges is not None:
                first = np.searchsorted(edges[:-1], low[:, j], side="right") - 1
                last = np.searchsorted(edges[1:], high[:, j], side="left")
                last = np.clip(last, first, len(edges) - 2)
                middles = (edges[1:] + edges[:-1]) / 2
                low[:, j], high[:, j] = middles[first], middles[last]
        return low, high

    def _features(self, points: Corners) -> list[np.ndarray]:
        with in_precision(self.precision):
            dtype = np.dtype(self.precision)
            count = max(TOGETHER, -(-len(points) // TOGETHER) * TOGETHER)
            padded = np.resize(points.astype(dtype), (count, self.dim))
            leaves = jax.tree.leaves(self._values(padded))
        return [np.asarray(leaf)[: len(points)].astype(np.float64) for leaf in leaves]

    def _dependence(self) -> list[tuple[np.ndarray, np.ndarray, bool, bool]]:
        """Return for each leaf on which coordinates its numbers depend, their size, and more.

        That is whether its domain's map to its ends is exact, and whether it is of real numbers.
        """
        levels = [np.full((1, self.dim), level) for level in (0.0, 0.25, 0.75)]
        probes = np.concatenate([levels[0], np.eye(self.dim), *levels[1:]])
        leaves = iter(self._features(self.ends(probes, probes)[0]))
        form, found = self.space.feature_form_in(self.precision), []
        for name in sorted(form):
            for part, leaf in zip(jax.tree.leaves(form[name]), leaves, strict=False):
                depends = (leaf[1:-2] != leaf[0]).astype(float)
                size = np.asarray(np.maximum(np.abs(leaf[-2]), np.abs(leaf[-1])))
                real = bool(jnp.issubdtype(part.dtype, jnp.floating))
                found.append((depends, size, self.space.domains[name].uniform, real))
        return found

    def scales(self) -> list[dict[str, list[Any]]]:
        """Return the values of the feature along each coordinate, as the columns of a table.

        **Returns:** for a continuous coordinate `values`, at 0 and 1; for a discrete one those of
        its cells, and their `edges`; nothing where a coordinate is no column's alone.
        """
        monotone = [d.monotone for d in self.space.domains.values() for _ in range(d.size)]
        cells = [np.arange(2.0) if e is None else (e[1:] + e[:-1]) / 2 for e in self.edges]
        stops = np.cumsum([len(each) for each in cells])
        # Items of arrays are there if the length is greatest.
        points = np.ones((stops[-1] if cells else 0, self.dim), np.float32)
        parts = [slice(stop - len(each), stop) for stop, each in zip(stops, cells, strict=True)]
        for j, part in enumerate(parts):
            points[part, j] = cells[j]
        rows = self.space.rows(self.space.features_at(points)) if cells else {}
        found = [
            {"values": np.asarray(rows[name])[part].tolist()} if own and name in rows else {}
            for name, part, own in zip(self.space.coordinates, parts, monotone, strict=True)
        ]
        for scale, edges in zip(found, self.edges, strict=True):
            if scale and edges is not None:
                scale["edges"] = edges.tolist()
        return found

    def shares(self, points: Corners) -> Corners:
        """Return the positions of features between their minimum and maximum, from 0 to 1."""
        shares = points.astype(float).copy()
        leaves = self._features(points)
        ends = self._features(np.array([[0.0] * self.dim, [1.0] * self.dim]))
        for leaf, end, (depends, _, exact, _) in zip(leaves, ends, self._depends, strict=True):
            flat = depends.reshape(self.dim, -1)
            for j in np.flatnonzero(flat.any(1) & (not exact)):
                if self.edges[j] is None:
                    at = int(np.argmax(flat[j]))
                    low, high = end.reshape(2, -1)[:, at]
                    shares[:, j] = (leaf.reshape(len(leaf), -1)[:, at] - low) / (high - low)
        return shares
