"""Random leaves of a Scenic program, each with the inverse of its cumulative distribution.

    leaf = leaf_of(node, "ego.position")                # None for a leaf without an inverse
    leaf.domains                                        # {"ego.position.x": Box(-2, 2), ...}
    leaf.draw(parts, given, numpy)                      # the value at these features
    leaf.invert(value, given)                           # and back

Every formula is written once, and computes in NumPy for Scenic and in JAX for compiled scenes.
"""

import abc
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from verifai_jax.addons.scenic.graph import field, is_random, kind_of, law
from verifai_jax.features.domain import Domain

Given: TypeAlias = Callable[[Any], Any]
"""What a node that a leaf depends on is worth in this scene; constants are worth themselves."""
Parts: TypeAlias = Mapping[str, Any]
"""The features of one leaf, by name."""
LABEL = 24
"""Letters of the text of an option that has no name."""


class NothingToDrawError(ValueError):
    """An error for a leaf without a value in this scene, such as a choice from an empty list."""


@dataclass(frozen=True, eq=False)
class Leaf(abc.ABC):
    """A random value that a program draws.

    - `node`: its node in Scenic's graph.
    - `name`: a name that a user recognises.
    - `domains`: its features by name, one for each unit coordinate.
    """

    node: Any
    name: str
    domains: Mapping[str, Domain]
    is_point = False
    is_series = False

    @abc.abstractmethod
    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        """Return the value at these features: a number, or the coordinates of a point.

        **Arguments:**
        - `parts`: features of this leaf, by name.
        - `given`: values of the nodes on which it depends.
        - `xp`: the array module, `numpy` or `jax.numpy`.
        """

    @abc.abstractmethod
    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        """Return the features at which the leaf has this value."""

    @property
    def feature(self) -> str:
        """Name of its first feature."""
        return next(iter(self.domains))


class Number(Leaf):
    """A number that is a feature itself."""

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        return parts[self.feature]

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        return {self.feature: value}


class Share(Leaf):
    """A number between random ends; its feature is the relative position between them."""

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        low, high = (given(field(law(self.node), end)) for end in ("low", "high"))
        return low + parts[self.feature] * (high - low)

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        low, high = (given(field(law(self.node), end)) for end in ("low", "high"))
        return {self.feature: (value - low) / (high - low) if high != low else 0.5}


class Deviation(Leaf):
    """A normal number with a random mean or width; its feature counts standard deviations."""

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        mean, std = (given(field(law(self.node), part)) for part in ("mean", "stddev"))
        return mean + std * parts[self.feature]

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        mean, std = (given(field(law(self.node), part)) for part in ("mean", "stddev"))
        return {self.feature: (value - mean) / std}


class TruncatedShare(Leaf):
    """A truncated normal number: its feature is the cumulative probability between the ends."""

    def _limits(self, given: Given, ndtr: Callable[[Any], Any]) -> tuple[Any, Any, Any, Any]:
        node = law(self.node)
        mean, std = given(field(node, "mean")), given(field(node, "stddev"))
        below, above = (ndtr((field(node, end) - mean) / std) for end in ("low", "high"))
        return mean, std, below, above

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        special = scipy.special if xp is np else jax.scipy.special
        mean, std, below, above = self._limits(given, special.ndtr)
        return mean + std * special.ndtri(below + parts[self.feature] * (above - below))

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        mean, std, below, above = self._limits(given, scipy.special.ndtr)
        return {self.feature: (scipy.special.ndtr((value - mean) / std) - below) / (above - below)}


class Histogram(Leaf):
    """A number that is uniform within each of several cells of equal width."""

    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        node = law(self.node)
        ((low, high),) = field(node, "domain").intervals
        cumulative = np.concatenate([[0.0], np.cumsum(field(node, "probs"))])
        return cumulative / cumulative[-1], np.linspace(low, high, len(cumulative))

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        return xp.interp(parts[self.feature], *self._edges())

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        cumulative, edges = self._edges()
        return {self.feature: float(np.interp(value, edges, cumulative))}


@dataclass(frozen=True, eq=False)
class Series(Leaf):
    """A value for each step, `TimeSeries(VerifaiRange(0, 1))`: an array of draws of one leaf.

    - `one`: the leaf of one step.
    """

    one: Leaf
    is_series = True

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        length = len(parts[self.feature])
        steps = [
            self.one.draw({name: part[i] for name, part in parts.items()}, given, xp)
            for i in range(length)
        ]
        return SeriesValue(tuple(steps)) if xp is np else jnp.stack(steps)

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        steps = [self.one.invert(step, given) for step in value.steps]
        return {name: np.array([step[name] for step in steps]) for name in self.domains}


@dataclass(frozen=True)
class SeriesValue:
    """The value of a `TimeSeries` in a program; `getSample()` returns that of the present step."""

    steps: tuple[Any, ...]

    def getSample(self) -> Any:
        """Return the value at the simulation's current step.

        **Raises:** `RuntimeError` outside a simulation, and beyond the last step.
        """
        simulation = sys.modules["scenic.syntax.veneer"].currentSimulation
        if simulation is None:
            raise RuntimeError(
                "a TimeSeries has values in a simulation only: call it in a behavior"
            )
        if simulation.currentTime >= len(self.steps):
            raise RuntimeError(
                f"a TimeSeries of {len(self.steps)} values is asked at step "
                f"{simulation.currentTime}: make `param timeBound` the number of steps"
            )
        return self.steps[simulation.currentTime]


@dataclass(frozen=True, eq=False)
class Chosen(Leaf):
    """An integer, or the index of an option.

    - `values`: the values of the feature's choices; None if the feature is the integer.
    """

    values: tuple[int, ...] | None = None

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        part = parts[self.feature]
        if self.values is None:
            return int(part) if xp is np else part
        domain = self.domains[self.feature]
        # A single option is a constant: there is nothing to choose.
        index = 0 if domain.tuning is None else part
        if domain.tuning is not None and domain.numeric:
            choices = np.array(domain.tuning.choices, np.float64)
            index = xp.argmin(xp.abs(choices.astype(np.float32) - xp.float32(part)))
        return self.values[int(index)] if xp is np else jnp.asarray(self.values)[index]

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        if self.values is None:
            return {self.feature: int(value)}
        index = self.values.index(int(value))
        tuning = self.domains[self.feature].tuning
        return {self.feature: index if tuning is None else tuning.choices[index]}


class ChoiceIndex(Leaf):
    """An integer between random or distant ends; its feature is the relative position."""

    def _ends(self, given: Given, xp: Any) -> tuple[Any, Any]:
        node = law(self.node)
        return xp.ceil(given(field(node, "low"))), xp.floor(given(field(node, "high")))

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        low, high = self._ends(given, xp)
        if xp is np and high < low:
            raise NothingToDrawError(f"there is no integer from {low:zg} to {high:zg}")
        count = xp.maximum(high - low + 1, 1)
        index = low + xp.minimum(xp.floor(parts[self.feature] * count), count - 1)
        return int(index) if xp is np else index

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        low, high = self._ends(given, np)
        return {self.feature: (value - low + 0.5) / (high - low + 1)}


class InRectangle(Leaf):
    """A point in a rectangle: its features are its coordinates in the rectangle's own axes."""

    is_point = True

    def _frame(self, given: Given, xp: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
        region = region_of(self.node)
        centre = given(field(region, "position"))
        heading = given(field(region, "heading"))
        width, length = field(region, "width"), field(region, "length")
        centre_and_axes = centre[0], centre[1], xp.cos(heading), xp.sin(heading)
        if is_random(width) or is_random(length):
            return (*centre_and_axes, given(width), given(length))
        return (*centre_and_axes, 1.0, 1.0)

    def _global(self) -> bool:
        return self.feature.endswith(".x")

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        one, two = parts.values()
        if self._global():
            return one, two
        x, y, cos, sin, width, length = self._frame(given, xp)
        one, two = one * width, two * length
        return x + cos * one - sin * two, y + sin * one + cos * two

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        if self._global():
            return dict(zip(self.domains, (value[0], value[1]), strict=True))
        x, y, cos, sin, width, length = self._frame(given, np)
        right = (cos * (value[0] - x) + sin * (value[1] - y)) / width
        forward = (-sin * (value[0] - x) + cos * (value[1] - y)) / length
        return dict(zip(self.domains, (right, forward), strict=True))


class InSector(Leaf):
    """A point in a disc or a sector; its features are the share of the area within, the angle.

    The angle is measured as a share of the sector, counterclockwise.
    """

    is_point = True

    def _frame(self, given: Given) -> tuple[Any, Any, Any, Any, Any]:
        region = region_of(self.node)
        centre, radius = given(field(region, "center")), given(field(region, "radius"))
        if kind_of(region) == "CircularRegion":
            return centre[0], centre[1], radius, -math.pi, 2 * math.pi
        angle = given(field(region, "angle"))
        first = given(field(region, "heading")) + math.pi / 2 - angle / 2
        return centre[0], centre[1], radius, first, angle

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        within, share = parts.values()
        x, y, radius, first, angle = self._frame(given)
        # The square root has no derivative at zero, the centre.
        distance = radius * xp.sqrt(xp.maximum(within, 1e-12))
        direction = first + share * angle
        return x + distance * xp.cos(direction), y + distance * xp.sin(direction)

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        x, y, radius, first, angle = self._frame(given)
        dx, dy = value[0] - x, value[1] - y
        turned = (math.atan2(dy, dx) - first) % (2 * math.pi)
        within = (dx * dx + dy * dy) / radius**2
        return dict(zip(self.domains, (within, min(turned / angle, 1.0)), strict=True))


@dataclass(frozen=True, eq=False)
class InPolygon(Leaf):
    """A point in polygons: the triangle, by its share of the area, and two coordinates in it.

    - `triangles`: `[n, 3, 2]`.
    - `cumulative`: shares of the area up to each triangle, `[n]`.
    """

    triangles: np.ndarray
    cumulative: np.ndarray
    is_point = True

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        piece, one, two = parts.values()
        index = xp.clip(
            xp.searchsorted(xp.asarray(self.cumulative), piece, side="right"),
            0,
            len(self.triangles) - 1,
        )
        a, b, c = (xp.asarray(self.triangles)[index, corner] for corner in range(3))
        over = one + two > 1
        one, two = xp.where(over, 1 - one, one), xp.where(over, 1 - two, two)
        point = a + one * (b - a) + two * (c - a)
        return point[0], point[1]

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        point = np.array([value[0], value[1]])
        starts = self.triangles[:, 0]
        sides = np.stack([self.triangles[:, 1] - starts, self.triangles[:, 2] - starts], axis=2)
        shares = np.linalg.solve(sides, (point - starts)[:, :, None])[:, :, 0]
        outside = np.maximum(-shares.min(axis=1), shares.sum(axis=1) - 1)
        index = int(np.argmin(outside))
        before = self.cumulative[index - 1] if index else 0.0
        one, two = np.clip(shares[index], 0, 1)
        return dict(
            zip(self.domains, ((before + self.cumulative[index]) / 2, one, two), strict=True)
        )


@dataclass(frozen=True, eq=False)
class OnPolyline(Leaf):
    """A point on a polyline; its feature is the length along the line in metres.

    - `starts`, `ends`: those of the segments, `[n, 2]`.
    - `cumulative`: length up to the end of each segment, `[n]`.
    """

    starts: np.ndarray
    ends: np.ndarray
    cumulative: np.ndarray
    is_point = True

    def segment(self, along: Any, xp: Any) -> Any:
        """Return the index of the segment on which a point lies."""
        index = xp.searchsorted(xp.asarray(self.cumulative), along, side="right")
        return xp.clip(index, 0, len(self.starts) - 1)

    def draw(self, parts: Parts, given: Given, xp: Any) -> Any:
        along = parts[self.feature]
        index = self.segment(along, xp)
        before = xp.asarray(np.concatenate([[0.0], self.cumulative[:-1]]))[index]
        length = xp.asarray(np.diff(self.cumulative, prepend=0.0))[index]
        share = (along - before) / length
        start, end = xp.asarray(self.starts)[index], xp.asarray(self.ends)[index]
        point = start + share * (end - start)
        return point[0], point[1]

    def heading(self, parts: Parts, xp: Any) -> Any:
        """Return the direction of the polyline there, in Scenic's convention (0 is north)."""
        index = self.segment(parts[self.feature], xp)
        ahead = xp.asarray(self.ends)[index] - xp.asarray(self.starts)[index]
        return xp.arctan2(ahead[1], ahead[0]) - math.pi / 2

    def invert(self, value: Any, given: Given) -> dict[str, Any]:
        point = np.array([value[0], value[1]])
        ahead = self.ends - self.starts
        square = np.sum(ahead * ahead, axis=1)
        shares = np.clip(np.sum((point - self.starts) * ahead, axis=1) / square, 0, 1)
        nearest = self.starts + shares[:, None] * ahead
        index = int(np.argmin(np.sum((nearest - point) ** 2, axis=1)))
        before = self.cumulative[index - 1] if index else 0.0
        return {self.feature: before + shares[index] * math.sqrt(square[index])}


def region_of(node: Any) -> Any:
    return field(law(node), "region")
