"""Improbability of the coordinates of a point, in standard deviations.

    improbability = Improbability(space)
    improbability.square(points)                    # [n, d], twice the loss of log-density
    improbability.departure(points)                 # [n, d], signed, of the likeliest value
    improbability.point_at(departures)              # and back

The features are independent, so the logarithm of the prior's density is a sum over coordinates. A
coordinate whose log density lies `loss` below its maximum departs by `sqrt(2 loss)`: for a normal
distribution this is the number of standard deviations, for any other the number at which a normal
one is as improbable. All values of a box are equally likely, so they hardly depart.
"""

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.core.compute.compilation import pad_rows
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.features.arrays import Array, VariableArray
from verifai_jax.features.box import Box, DiscreteBox
from verifai_jax.features.choice import Categorical, Constant
from verifai_jax.features.compound import Struct
from verifai_jax.features.continuous import Continuous
from verifai_jax.features.density import NoDensityError
from verifai_jax.features.domain import Domain, dotted
from verifai_jax.features.fixed import Fixed
from verifai_jax.features.signal import Signal
from verifai_jax.features.space import FeatureSpace

Points = Float[np.ndarray, "n d"]
SLIGHT = 0.02
"""Departure of the ends of a box from its middle: what breaks ties between values as likely."""
REACH, NODES = 5.4, 2161
"""Normal scores between which distributions are tabulated, as far as float32 coordinates reach."""
STEEP = 1e-13
"""Least rise from node to node of a departure that can be inverted."""


class Improbability:
    """The departures of points from the likeliest point, for each coordinate.

    **Arguments:**
    - `space`: the space of the features.
    **Raises:** `NoDensityError` for a domain whose values have no density, such as an automaton.
    """

    def __init__(self, space: FeatureSpace) -> None:
        self.space = space
        leaves = [leaf for name, one in space.root.fields for leaf in _leaves(one, name)]
        self.tables: dict[Continuous, tuple[np.ndarray, np.ndarray]] = {}
        self.groups: list[tuple[Continuous | None, Int[np.ndarray, " k"]]] = []
        for domain in dict.fromkeys(leaves):
            if domain is not None:
                self.tables[domain] = _table(domain)
            self.groups.append((domain, np.array([i for i, x in enumerate(leaves) if x == domain])))
        cube = space.cube
        self.losses = [2 * np.log(np.max(p) / p) for p in cube.probabilities]

    @cached_property
    def scale(self) -> Float[np.ndarray, " d"]:
        """A typical departure of each continuous coordinate, neither small nor large."""
        return np.min(self.slope(np.full((1, self.space.dim), 0.5)), axis=0).clip(0, 1)

    @cached_property
    def likeliest(self) -> Float[np.ndarray, " d"]:
        """The point with the greatest density; the middle of boxes, and the shortest arrays."""
        u = self.point_at(np.zeros((1, self.space.dim)))[0]
        for index, losses in zip(self.space.cube.discrete, self.losses, strict=True):
            edges = np.append(0.0, np.cumsum(np.exp(-losses / 2)))
            cell = int(np.argmin(losses))
            u[index] = (edges[cell] + edges[cell + 1]) / 2 / edges[-1]
        return u

    def departure(self, points: Points) -> Points:
        """Return the signed departures; for discrete coordinates, the distance."""
        u, found = np.asarray(points, np.float64), np.zeros(np.shape(points))
        for domain, own in self.groups:
            if domain is None:
                found[:, own] = SLIGHT * (2 * u[:, own] - 1)
            else:
                found[:, own] = np.interp(_score(u[:, own]), NODE, self.tables[domain][0])
        discrete = self.space.cube.discrete
        found[:, discrete] = u[:, discrete] - self.likeliest[discrete]
        return found

    def point_at(self, departures: Points) -> Points:
        """Return the points with these departures; discrete coordinates are at the middle."""
        from scipy.special import ndtr

        u = np.full(np.shape(departures), 0.5)
        for domain, own in self.groups:
            if domain is None:
                u[:, own] = np.clip(0.5 + departures[:, own] / (2 * SLIGHT), 0, 1)
            else:
                u[:, own] = ndtr(np.interp(departures[:, own], self.tables[domain][0], NODE))
        return u

    def slope(self, points: Points) -> Points:
        """Return the derivative of the departures by the coordinates; 1 for discrete ones."""
        u, found = np.asarray(points, np.float64), np.ones(np.shape(points))
        for domain, own in self.groups:
            if domain is None:
                found[:, own] = 2 * SLIGHT
            else:
                z, rises = _score(u[:, own]), np.gradient(self.tables[domain][0], NODE)
                found[:, own] = np.interp(z, NODE, rises) * np.sqrt(2 * np.pi) * np.exp(z * z / 2)
        found[:, self.space.cube.discrete] = 1.0
        return found

    def square(self, points: Points) -> Points:
        """Return the squares of all departures, which are twice the loss of log density.

        For boxes they are `SLIGHT`, for items that do not exist zero.
        """
        found, cube = self.departure(points) ** 2, self.space.cube
        for domain, own in self.groups:
            if domain is not None:
                score = _score(np.asarray(points, np.float64)[:, own])
                found[:, own] = np.interp(score, NODE, self.tables[domain][1])
        if len(cube.discrete):
            cells = np.asarray(cube.cells(np.asarray(points, np.float32)))
            for k, (index, losses) in enumerate(zip(cube.discrete, self.losses, strict=True)):
                found[:, index] = losses[cells[:, k]]
        if self.space.items and len(points):
            used = self.space.used(pad_rows(np.asarray(points, np.float32)))
            found = np.where(np.asarray(used)[: len(points)], found, 0.0)
        return found


NODE = np.linspace(-REACH, REACH, NODES)


def _score(u: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    from scipy.special import ndtri

    return np.clip(ndtri(np.clip(u, 1e-12, 1 - 1e-12)), -REACH, REACH)


def _table(domain: Continuous) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed departure and the squared one at the nodes.

    Where the density has several peaks, or steps, the signed one says where a value is, and not how
    improbable it is.
    """
    import jax
    from scipy.special import ndtr

    with in_precision("float64"):
        values = np.asarray(jax.vmap(domain.from_unit)(ndtr(NODE)[:, None]), np.float64)
    density = np.asarray(domain.log_density(values), np.float64)
    density = np.where(np.isfinite(density), density, np.min(density[np.isfinite(density)]) - 1.0)
    square = 2 * np.maximum(density.max() - density, 0.0)
    peak = int(np.argmax(density))
    signed = np.sign(np.arange(NODES) - peak) * np.sqrt(square)
    if np.diff(signed).min() < STEEP:
        signed = SLIGHT * NODE
    return signed, square


def _leaves(domain: Domain, name: str) -> Iterator[Continuous | None]:
    """Yield the distribution of each coordinate; None for boxes and discrete ones."""
    match domain:
        case Constant() | Fixed():
            return
        case Continuous():
            yield domain
        case Box() | DiscreteBox() | Categorical():
            yield from [None] * domain.size
        case Signal():
            for _ in range(domain.knots):
                yield from _leaves(domain.domain, name)
        case Struct():
            for field, part in domain.fields:
                yield from _leaves(part, dotted(name, field))
        case Array():
            for _ in range(domain.length):
                yield from _leaves(domain.domain, name)
        case VariableArray():
            yield from [None] * (domain.longest > domain.shortest)
            for _ in range(domain.longest):
                yield from _leaves(domain.domain, name)
        case _:
            raise NoDensityError(f"the prior of {name} has no density: {domain!r}")
