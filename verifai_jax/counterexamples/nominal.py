"""The nominal point, and departures from it: their number and distance.

    nominal = Nominal.of(problem)
    nominal.count(points), nominal.distance(points)     # [n] each

A departure is measured in unit coordinates, in which 1 is the whole range of the prior. Every
coordinate counts separately, including each control point of a signal. A missing item, such as an
event of nominal that the point lacks, counts only in the number of items. An additional item counts
with all of its coordinates, for which there are no nominal values.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.core.compute.compilation import pad_rows
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.values.cube import Cube
from verifai_jax.features import FeatureSpace
from verifai_jax.features.improbability import Improbability
from verifai_jax.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Nominal:
    """The nominal features as a point of the unit cube.

    **Fields:**
    - `space`: the space of the features.
    - `u` `[d]`: the point.
    - `low` and `high` `[d]`: the range in which points may depart.
    """

    space: FeatureSpace
    u: Float[np.ndarray, " d"]
    low: Float[np.ndarray, " d"] | float = 0.0
    high: Float[np.ndarray, " d"] | float = 1.0

    @classmethod
    def of(cls, problem: Problem, nominal: Mapping[str, Any] | None = None) -> "Nominal":
        """Return the nominal point of a problem.

        **Arguments:**
        - `problem`: the problem with its nominal features.
        - `nominal`: nominal values that override those of the problem.
        **Raises:** `ValueError` if a feature has no nominal value, or one outside the space.
        """
        space = problem.space
        check_names("feature", nominal or {}, space.domains)
        ordinary = {n: d.nominal for n, d in space.root.fields if d.nominal is not None}
        whole = {**ordinary, **(problem.nominal or {}), **(nominal or {})}
        varied = [name for name, domain in space.root.fields if domain.size]
        missing = [name for name in varied if name not in whole]
        if missing:
            raise ValueError(
                f"problem {problem.name!r} does not say what is nominal for {', '.join(missing)}; "
                f"give it: nominal={{{missing[0]!r}: ..., ...}}, or Problem(..., nominal=...)"
            )
        # What a view of the space holds fixed is not said again.
        features = space.coerce({name: whole[name] for name in varied})
        for name in varied:
            space.domains[name].check_reachable(features[name], f"the nominal value of {name}")
        return cls(space, np.asarray(space.point_of(features), np.float32))

    def restrict_to_side(self, u: Float[np.ndarray, " d"]) -> "Nominal":
        """Return the same point with departures allowed only on the side of `u`.

        Discrete coordinates stay free.
        """
        free = (np.array(self.space.levels) > 0) | (u == self.u)
        low = np.where(free | (u < self.u), 0.0, self.u)
        high = np.where(free | (u > self.u), 1.0, self.u)
        return replace(self, low=low, high=high)

    @cached_property
    def cube(self) -> Cube:
        """The unit cube of the space."""
        return self.space.cube

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return self.space.coordinates

    @cached_property
    def groups(self) -> tuple[tuple[str, Int[np.ndarray, " k"]], ...]:
        """The features, each with the indices of its coordinates."""
        groups, first = [], 0
        for name, domain in self.space.root.fields:
            if domain.size:
                groups.append((name, np.arange(first, first + domain.size)))
            first += domain.size
        return tuple(groups)

    def settle(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Move points into the cube, and discrete coordinates to the middles of their cells.

        In the nominal cell a discrete coordinate gets exactly the nominal value.
        """
        u = np.clip(np.asarray(points, np.float64), self.low, self.high).astype(np.float32)
        discrete = self.cube.discrete
        if len(discrete):
            cells = self.cells(u)
            same = cells == self.cells(self.u)
            middles = self.centres(cells)
            u[:, discrete] = np.where(same, self.u[discrete], middles)
        if self.space.items and len(u):
            # Coordinates of items that do not exist mean nothing, and do not depart; an item that
            # comes back is nominal's.
            used = self._compiled(self.space.used, u)
            u = np.where(used, self._compiled(self.space.settle, u), self.u)
        return u

    @staticmethod
    def _compiled(function: Callable[..., Any], points: Float[np.ndarray, "n d"]) -> np.ndarray:
        """Return a compiled function of points, padded to powers of two to keep shapes few."""
        return np.asarray(function(pad_rows(points)))[: len(points)]

    @cached_property
    def lacks(self) -> Bool[np.ndarray, " d"]:
        """Return which coordinates belong to items that nominal does not have."""
        if not self.space.items:
            return np.zeros(len(self.u), bool)
        return ~self._compiled(self.space.used, self.u[None])[0]

    def cells(self, points: Float[np.ndarray, "*n d"]) -> Int[np.ndarray, "*n k"]:
        """Return the cell of each discrete coordinate of points `[*n, d]`."""
        return np.asarray(self.cube.cells(np.asarray(points, np.float32)))

    def centres(self, cells: Int[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n k"]:
        """Return the middles of cells as coordinates."""
        return np.asarray(self.cube.centres(np.asarray(cells, np.int32)))

    def moved(self, points: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, "n d"]:
        """Return which coordinates of settled points differ from nominal and can be moved back."""
        return points != self.u

    def departs(self, points: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, "n d"]:
        """Return which coordinates of settled points are not nominal: moved, or of new items."""
        moved = self.moved(points)
        if not self.lacks.any() or not len(points):
            return moved
        return moved | (self.lacks & self._compiled(self.space.used, np.asarray(points)))

    def gaps(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Return the departure of each coordinate, from 0 to 1.

        For integers and lengths it is a difference of indices, for choices 0 or 1.
        """
        gap = np.abs(np.asarray(points, np.float64) - self.u)
        discrete = self.cube.discrete
        if len(discrete):
            numbers = self.cells(points).astype(np.float64)
            apart = np.abs(numbers - self.cells(self.u))
            steps = np.array([max(self.cube.levels[i] - 1, 1) for i in discrete])
            ordered = np.array([self.cube.ordered[i] for i in discrete])
            gap[:, discrete] = np.where(ordered, apart / steps, apart > 0)
        return gap

    def departure(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Return the signed departures; their norm is the distance in continuous coordinates."""
        return np.asarray(points, np.float64) - self.u

    def point_at(self, departures: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Return the points with these signed departures."""
        return self.u.astype(np.float64) + departures

    def slope(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Return the derivative of the signed departures with respect to the coordinates."""
        return np.ones(np.shape(points))

    @cached_property
    def scale(self) -> Float[np.ndarray, " d"]:
        """Step sizes to try in each coordinate, as departures."""
        return np.ones(len(self.u))

    def count(self, points: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
        """Count the coordinates that depart."""
        return self.departs(points).sum(axis=1)

    def items(self, points: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
        """Count the items of arrays, such as events, added to nominal or removed from it."""
        own, home = self.lengths(points), self.lengths(self.u[None])
        return np.abs(own - home).sum(axis=1)

    def lengths(self, points: Float[np.ndarray, "n d"]) -> Int[np.ndarray, "n k"]:
        """Return the number of items of each array of variable length above its minimum."""
        lengths = list(self.cube.lengths)
        levels = np.array([self.cube.levels[i] for i in lengths], np.float32)
        numbers = np.asarray(points, np.float32)[:, lengths] * levels
        return np.clip(numbers.astype(int), 0, np.maximum(levels - 1, 0).astype(int))

    def restored(self, u: Float[np.ndarray, " d"]) -> Float[np.ndarray, "n d"]:
        """Return a point with some or all of nominal's items that it lacks put back."""
        own, home = self.lengths(u[None])[0], self.lengths(self.u[None])[0]
        points = []
        for k, i in enumerate(self.cube.lengths):
            for length in range(own[k] + 1, home[k] + 1):
                point = u.copy()
                point[i] = (length + 0.5) / self.cube.levels[i]
                points.append(point)
        if points:
            whole = u.copy()
            short = np.array(self.cube.lengths)[own < home]
            whole[short] = self.u[short]
            points.append(whole)
        return self.settle(np.array(points, np.float32).reshape(-1, len(u)))

    def distance(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Return the Euclidean norm of the departure."""
        return np.sqrt((self.gaps(points) ** 2).sum(axis=1))


@dataclass(frozen=True, eq=False)
class Likeliest(Nominal):
    """The likeliest features in the role of nominal ones: departures from them are improbable.

    The distance of a point is the number of standard deviations at which a normal distribution is
    as improbable: half its square is the loss of log density.
    """

    improbability: Improbability = field(kw_only=True)

    @classmethod
    def in_space(cls, space: FeatureSpace) -> "Likeliest":
        """Return the likeliest features of a space.

        **Raises:** `NoDensityError` for a space whose features have no density.
        """
        improbability = Improbability(space)
        u = improbability.likeliest.astype(np.float32)
        return cls(space, u, improbability=improbability)

    def departure(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        return self.improbability.departure(points)

    def point_at(self, departures: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        return self.improbability.point_at(departures)

    def slope(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        return self.improbability.slope(points)

    @cached_property
    def scale(self) -> Float[np.ndarray, " d"]:
        return self.improbability.scale

    def gaps(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        return np.sqrt(self.improbability.square(points))
