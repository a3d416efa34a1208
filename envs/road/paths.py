"""Lanes and guideways: paths of lines and arcs, parametrised by arc length."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from envs.road.bodies import Pose
from verifai_jax.systems.ode import sin_cos

Scalar = Float[Array, ""] | float


class Piece(NamedTuple):
    """A part of constant `curvature` (1/m, positive to the left), with the pose at its `start`."""

    start: float
    length: float
    curvature: float
    x: float
    y: float
    heading: float

    def displacement(self, done: Any) -> tuple[Any, Any]:
        """Return how far in x and y one is after `done` metres of it."""
        if self.curvature == 0:
            return done * math.cos(self.heading), done * math.sin(self.heading)
        sin, cos = sin_cos(self.heading + self.curvature * jnp.asarray(done))
        x = (sin - math.sin(self.heading)) / self.curvature
        return x, (math.cos(self.heading) - cos) / self.curvature

    def end(self) -> tuple[float, float, float]:
        """Return the place and heading at its end."""
        turned = self.heading + self.curvature * self.length
        if self.curvature == 0:
            x, y = self.length * math.cos(turned), self.length * math.sin(turned)
        else:
            x = (math.sin(turned) - math.sin(self.heading)) / self.curvature
            y = (math.cos(self.heading) - math.cos(turned)) / self.curvature
        return self.x + x, self.y + y, turned


@dataclass(frozen=True)
class Path:
    """Lines and arcs in a row; in front of the first and behind the last it goes straight on.

    Made by `start`, `straight` and `turn`, or `through` points.
    """

    x: float
    y: float
    heading: float
    parts: tuple[tuple[float, float, float], ...] = ()
    """Length, curvature, and the kink (rad) at the start, of each piece."""

    @staticmethod
    def start(x: float, y: float, heading: float = 0.0) -> "Path":
        """Begin a path."""
        return Path(x, y, heading)

    @staticmethod
    def through(points: Iterable[tuple[float, float]]) -> "Path":
        """Make a path of lines between points, such as a map has.

        **Raises:** `ValueError` for fewer than two points, or two that are the same in a row.
        """
        positions = [(float(x), float(y)) for x, y in points]
        if len(positions) < 2:
            raise ValueError(f"a path goes through at least two points; got {positions}")
        lines = []
        for (x, y), (u, v) in pairwise(positions):
            if (x, y) == (u, v):
                raise ValueError(f"the path stands still at ({x:g}, {y:g}); leave one of them out")
            lines.append((math.hypot(u - x, v - y), math.atan2(v - y, u - x)))
        parts, heading = [], lines[0][1]
        for length, direction in lines:
            parts.append((length, 0.0, math.remainder(direction - heading, math.tau)))
            heading += parts[-1][2]
        return Path(*positions[0], lines[0][1], tuple(parts))

    def straight(self, length: float) -> "Path":
        """Go straight on for `length` metres."""
        return self._with(length, 0.0)

    def turn(self, radius: float, angle: float) -> "Path":
        """Turn by `angle` (rad, positive to the left) on an arc.

        **Raises:** `ValueError` for a radius that is not positive.
        """
        if not radius > 0:
            raise ValueError(f"the radius of a turn must be positive; got {radius!r}")
        return self._with(radius * abs(angle), math.copysign(1 / radius, angle))

    def _with(self, length: float, curvature: float) -> "Path":
        if not length > 0:
            raise ValueError(f"a piece of a path must be longer than 0 m; got {length!r}")
        parts = (*self.parts, (float(length), float(curvature), 0.0))
        return Path(self.x, self.y, self.heading, parts)

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """The pieces with where they begin."""
        pieces: list[Piece] = []
        x, y, heading, start = self.x, self.y, self.heading, 0.0
        for length, curvature, kink in self.parts:
            pieces.append(Piece(start, length, curvature, x, y, heading + kink))
            x, y, heading = pieces[-1].end()
            start += length
        return tuple(pieces)

    @property
    def length(self) -> float:
        """The length of all pieces, in m."""
        return sum(length for length, _, _ in self.parts)

    def curvature(self, distance: Scalar) -> Any:
        """Return the curvature at an arc length, 1/m; zero beyond the ends."""
        curvature: Any = 0.0
        for piece in self.pieces:
            if piece.curvature != 0:
                within = (distance >= piece.start) & (distance < piece.start + piece.length)
                curvature = jnp.where(within, piece.curvature, curvature)
        return curvature

    def pose(self, distance: Scalar, offset: Scalar = 0.0) -> Pose:
        """Return the pose at an arc length, `offset` metres to the left.

        A sum over the pieces of what lies behind: no search, and differentiable throughout.
        """
        x: Any = self.x
        y: Any = self.y
        heading: Any = self.heading
        for piece, (_, _, kink) in zip(self.pieces, self.parts, strict=True):
            done = jnp.clip(distance - piece.start, 0.0, piece.length)
            east, north = piece.displacement(done)
            x, y = x + east, y + north
            if piece.curvature != 0:
                heading = heading + piece.curvature * done
            if kink != 0:
                heading = heading + jnp.where(distance >= piece.start, kink, 0.0)
        before, behind = jnp.minimum(distance, 0.0), jnp.maximum(distance - self.length, 0.0)
        last = self.pieces[-1].end()[2] if self.parts else self.heading
        x = x + before * math.cos(self.heading) + behind * math.cos(last)
        y = y + before * math.sin(self.heading) + behind * math.sin(last)
        if not (isinstance(offset, float) and offset == 0.0):
            sin, cos = sin_cos(heading)
            x, y = x - offset * sin, y + offset * cos
        return Pose(x, y, heading)
