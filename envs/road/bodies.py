"""Bodies on a road: where they are, how far apart, and what they hide."""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from verifai_jax.systems.ode import sin_cos

Scalar = Float[Array, ""] | float

TINY = 1e-6
"""Added to squared distances, m^2, so that their roots have a derivative at zero."""


class Pose(NamedTuple):
    """A place in the plane and a direction."""

    x: Any
    y: Any
    heading: Any


@dataclass(frozen=True)
class Body:
    """A rectangle of `length` and `width`, its middle `ahead` metres ahead of its reference point.

    `disc_gap` sees it as `discs` of equal radius in a row that cover it.
    """

    length: float
    width: float
    ahead: float = 0.0
    discs: int = 4

    @property
    def radius(self) -> float:
        """The radius of the discs: each covers a cell of the length whole."""
        return ((self.length / self.discs) ** 2 + self.width**2) ** 0.5 / 2

    @property
    def bulge(self) -> float:
        """How far the discs reach beyond the rectangle at most, in m."""
        return self.radius - min(self.width, self.length / self.discs) / 2

    @property
    def front(self) -> float:
        """How far the body reaches ahead of its reference point, in m."""
        return self.ahead + self.length / 2

    @property
    def rear(self) -> float:
        """How far it reaches behind its reference point, in m."""
        return self.length / 2 - self.ahead

    def middles(self, pose: Pose) -> list[tuple[Scalar, Scalar]]:
        """Return the middles of the discs."""
        sin, cos = sin_cos(pose.heading)
        cell = self.length / self.discs
        positions = [self.ahead - self.length / 2 + (i + 0.5) * cell for i in range(self.discs)]
        return [(pose.x + position * cos, pose.y + position * sin) for position in positions]

    def corners(self, pose: Pose) -> list[tuple[Scalar, Scalar]]:
        """Return the corners, anticlockwise from the front on the right."""
        sin, cos = sin_cos(pose.heading)
        half = self.width / 2
        positions = [
            (self.front, -half),
            (self.front, half),
            (-self.rear, half),
            (-self.rear, -half),
        ]
        return [(pose.x + a * cos - b * sin, pose.y + a * sin + b * cos) for a, b in positions]


CAR = Body(4.7, 1.85)
VAN = Body(5.4, 2.0)
TRUCK = Body(12.0, 2.5, discs=6)
PERSON = Body(0.5, 0.5, discs=1)


def gap(a: Pose, body: Body, b: Pose, other: Body) -> Scalar:
    """Compute the distance in m between two rectangles; where they overlap, minus its depth.

    Disjoint rectangles are nearest at a corner of one of them. Overlapping ones have the depth of
    the separating axis theorem, the least shift along a side that parts them (Gottschalk, Lin and
    Manocha, OBBTree, SIGGRAPH 1996, section 5).
    """
    near, apart = _corner_distances(a, body, b, other)
    far, apart_too = _corner_distances(b, other, a, body)
    apart = jnp.maximum(apart, apart_too)
    return jnp.where(apart > 0, jnp.sqrt(jnp.minimum(near, far) + TINY), apart)


def _corner_distances(a: Pose, body: Body, b: Pose, other: Body) -> tuple[Scalar, Scalar]:
    """Return the least squared distance of `other`'s corners to `body`, and its separation.

    The separation is that of the better of the body's two axes.
    """
    sin, cos = sin_cos(a.heading)
    half_length, half_width = body.length / 2, body.width / 2
    along, across, squares = [], [], []
    for x, y in other.corners(b):
        x, y = x - a.x, y - a.y
        along.append(x * cos + y * sin - body.ahead)
        across.append(y * cos - x * sin)
        out = jnp.maximum(jnp.abs(along[-1]) - half_length, 0.0)
        lateral = jnp.maximum(jnp.abs(across[-1]) - half_width, 0.0)
        squares.append(out**2 + lateral**2)
    first = jnp.maximum(_lowest(along), -_greatest(along)) - half_length
    second = jnp.maximum(_lowest(across), -_greatest(across)) - half_width
    return _lowest(squares), jnp.maximum(first, second)


def _lowest(values: list[Any]) -> Any:
    return functools.reduce(jnp.minimum, values)


def _greatest(values: list[Any]) -> Any:
    return functools.reduce(jnp.maximum, values)


def disc_gap(a: Pose, body: Body, b: Pose, other: Body, temperature: float = 0.0) -> Scalar:
    """Compute the distance in m between the discs of two bodies; smoother than `gap`, and less.

    **Arguments:**

    - `a`, `body`: the first one's pose and form; `b`, `other`: the second's.
    - `temperature`: in m; above 0 the least of the distances between discs is the log-sum-exp one,
      smooth and smaller by at most `temperature * log(number of pairs)`.

    **Returns:** never more than the distance between the rectangles, and less by at most what the
    discs bulge out of them (`Body.bulge`).
    """
    squares = [(x - u) ** 2 + (y - v) ** 2 for x, y in body.middles(a) for u, v in other.middles(b)]
    radii = body.radius + other.radius
    if temperature <= 0:
        return jnp.sqrt(_lowest(squares) + TINY) - radii
    distances = jnp.sqrt(jnp.stack(squares) + TINY)
    return -temperature * jax.nn.logsumexp(-distances / temperature, axis=0) - radii


def sight(
    eye: tuple[Scalar, Scalar], target: tuple[Scalar, Scalar], pose: Pose, body: Body
) -> Scalar:
    """Compute by how many m the view from `eye` to `target` misses a body; negative where hidden.

    The separating axis theorem for a segment and a rectangle: they are apart if and only if they
    are on one of the rectangle's two axes or on the segment's normal. The sign is exact, and the
    size is that of the best axis.
    """
    sin, cos = sin_cos(pose.heading)

    def local(point: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        x, y = point[0] - pose.x, point[1] - pose.y
        return x * cos + y * sin - body.ahead, y * cos - x * sin

    (a, b), (c, d) = local(eye), local(target)
    half_length, half_width = body.length / 2, body.width / 2
    along = jnp.maximum(jnp.minimum(a, c), -jnp.maximum(a, c)) - half_length
    across = jnp.maximum(jnp.minimum(b, d), -jnp.maximum(b, d)) - half_width
    span = jnp.sqrt((c - a) ** 2 + (d - b) ** 2 + TINY)
    reach = half_length * jnp.abs(d - b) + half_width * jnp.abs(c - a)
    lateral = (jnp.abs(a * d - b * c) - reach) / span
    return jnp.maximum(jnp.maximum(along, across), lateral)
