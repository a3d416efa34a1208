"""How far a point is from the nominal one: how many features depart from it, and how much.

    nominal = Nominal.of(problem)
    nominal.count(points), nominal.distance(points)     # [n] each

A departure is measured in unit coordinates, in which 1 is the whole range of the prior. Every
coordinate counts for itself, a control point of a signal too.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.core.cube import Cube
from verifai_jax.core.errors import check_names
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Nominal:
    """The features of an ordinary day, as the point `u` `[d]` of the unit cube.

    `low` and `high` `[d]` are the ends of the coordinates that may be departed to.
    """

    space: FeatureSpace
    u: Float[np.ndarray, " d"]
    low: Float[np.ndarray, " d"] | float = 0.0
    high: Float[np.ndarray, " d"] | float = 1.0

    @classmethod
    def of(cls, problem: Problem, nominal: Mapping[str, Any] | None = None) -> "Nominal":
        """That of a problem, with the given features instead where there are some.

        **Raises:** `ValueError` where neither names all features, or one is outside the space.
        """
        space = problem.space
        check_names("feature", nominal or {}, space.domains)
        whole = {**(problem.nominal or {}), **(nominal or {})}
        varied = [name for name, domain in space.root.fields if domain.size]
        missing = [name for name in varied if name not in whole]
        if missing:
            raise ValueError(
                f"problem {problem.name!r} does not say what is nominal for {', '.join(missing)}; "
                f"give it: nominal={{{missing[0]!r}: ..., ...}}, or Problem(..., nominal=...)"
            )
        # What a view of the space holds fixed is not said again.
        features = space.coerce({name: whole[name] for name in varied})
        return cls(space, np.asarray(jax.jit(space.flatten)(features), np.float32))

    def on_the_side_of(self, u: Float[np.ndarray, " d"]) -> "Nominal":
        """The same, and continuous coordinates depart only to where those of `u` do."""
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
        """What the coordinates are called."""
        return self.space.coordinates

    @cached_property
    def groups(self) -> tuple[tuple[str, Int[np.ndarray, " k"]], ...]:
        """The features, each with the places of its coordinates."""
        found, first = [], 0
        for name, domain in self.space.root.fields:
            if domain.size:
                found.append((name, np.arange(first, first + domain.size)))
            first += domain.size
        return tuple(found)

    def settle(self, points: Any) -> Float[np.ndarray, "n d"]:
        """These points inside the cube, in the middles of cells, nominal where they mean it."""
        u = np.clip(np.asarray(points, np.float64), self.low, self.high).astype(np.float32)
        discrete = self.cube.discrete
        if len(discrete):
            cells = self.cells(u)
            same = cells == self.cells(self.u)
            middles = self.centres(cells)
            u[:, discrete] = np.where(same, self.u[discrete], middles)
        return u

    def cells(self, points: Any) -> Int[np.ndarray, "*n k"]:
        """Which cell holds each discrete coordinate."""
        return np.asarray(self.cube.cells(np.asarray(points, np.float32)))  # pyright: ignore[reportArgumentType]

    def centres(self, cells: Any) -> Float[np.ndarray, "*n k"]:
        """The middles of cells."""
        return np.asarray(self.cube.centres(np.asarray(cells, np.int32)))  # pyright: ignore[reportArgumentType]

    def departs(self, points: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, "n d"]:
        """Which coordinates of settled points are not nominal."""
        return points != self.u

    def gaps(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """How much each coordinate departs, 0 to 1.

        Integers and lengths by difference of places, choices 0 or 1.
        """
        gap = np.abs(np.asarray(points, np.float64) - self.u)
        discrete = self.cube.discrete
        if len(discrete):
            places = self.cells(points).astype(np.float64)
            apart = np.abs(places - self.cells(self.u))
            steps = np.array([max(self.cube.levels[i] - 1, 1) for i in discrete])
            ordered = np.array([self.cube.ordered[i] for i in discrete])
            gap[:, discrete] = np.where(ordered, apart / steps, apart > 0)
        return gap

    def count(self, points: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
        """How many coordinates depart."""
        return self.departs(points).sum(axis=1)

    def distance(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Euclidean length of the departure."""
        return np.sqrt((self.gaps(points) ** 2).sum(axis=1))
