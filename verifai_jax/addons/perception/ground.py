"""The ground, and its painted markings.

    Ground(colour=(0.3, 0.3, 0.32), markings=(
        Line(position=(0.0, 1.75), width=0.15),                             # along the x axis
        Line(position=(0.0, -1.75), width=0.15, dash=3.0, gap=6.0),
        Disc(position=(5.0, 0.0), radius=1.0), Ring(position=(5.0, 0.0), radius=2.0, width=0.2),
        Rectangle(position=(9.0, 0.0), size=(2.0, 1.0), yaw=0.3),
        Cross(position=(20.0, 0.0), size=1.2, width=0.3),
    ))

The ground is the plane z = 0. Later markings lie on earlier ones.
"""

from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from verifai_jax.addons.perception.camera import (
    Number,
    Rays,
    Vector,
    coverage,
    described,
    dot,
    round_edge,
    strip,
    vector,
)

Position: TypeAlias = PyTree
"""Two numbers, x and y in m, or an array `[2]`."""
WHITE: Vector = (0.9, 0.9, 0.9)
NEAREST_FALL = 1e-4
"""Rays that fall less than this meet the ground behind everything."""


@described
class Line:
    """An infinite line through `position`, along the heading `yaw`.

    - `width`: its width in m.
    - `dash`, `gap`: lengths in m of the painted and unpainted pieces; without a gap all is painted.
    """

    position: Position = (0.0, 0.0)
    yaw: Number = 0.0
    width: Number = 0.15
    colour: Vector = WHITE
    dash: Number = 1.0
    gap: Number = 0.0


@described
class Rectangle:
    """A rectangle about `position`; `size` is its length along the heading `yaw`, and width."""

    position: Position = (0.0, 0.0)
    size: PyTree = (1.0, 1.0)
    colour: Vector = WHITE
    yaw: Number = 0.0


@described
class Disc:
    """A disc centred at `position`."""

    position: Position = (0.0, 0.0)
    radius: Number = 1.0
    colour: Vector = WHITE


@described
class Ring:
    """A ring centred at `position`; `radius` is that of the middle of its `width`."""

    position: Position = (0.0, 0.0)
    radius: Number = 1.0
    width: Number = 0.15
    colour: Vector = WHITE


@described
class Cross:
    """A cross centred at `position`: two bars of length `size` and of `width`, one along `yaw`."""

    position: Position = (0.0, 0.0)
    size: Number = 1.0
    width: Number = 0.2
    colour: Vector = WHITE
    yaw: Number = 0.0


Marking: TypeAlias = Line | Rectangle | Disc | Ring | Cross


@described
class Ground:
    """The plane z = 0, of one `colour`, with `markings`."""

    colour: Vector = (0.33, 0.33, 0.35)
    markings: tuple[Marking, ...] = ()


def painted(rays: Rays, marking: Marking) -> Float[Array, "height width"]:
    """Return the share of each pixel of the ground that a marking covers."""
    if isinstance(marking, Line):
        cover = _bar(rays, marking.position, marking.yaw, marking.width)
        if isinstance(marking.gap, int | float) and marking.gap == 0:
            return cover
        return cover * _dashes(rays, marking)
    if isinstance(marking, Rectangle):
        length, width = vector(marking.size)
        return _rectangle(rays, marking.position, marking.yaw, length, width)
    if isinstance(marking, Cross):
        one = _rectangle(rays, marking.position, marking.yaw, marking.size, marking.width)
        other = _rectangle(rays, marking.position, marking.yaw, marking.width, marking.size)
        return jnp.maximum(one, other)
    if isinstance(marking, Disc):
        return coverage(_circle(rays, marking.position, marking.radius))
    half = jnp.asarray(marking.width, float) / 2
    outer = _circle(rays, marking.position, marking.radius + half)
    inner = _circle(rays, marking.position, marking.radius - half)
    return strip(outer, -inner)


def _vertical() -> Float[Array, "3"]:
    return jnp.asarray([0.0, 0.0, 1.0])


def _point(position: Position) -> Float[Array, "3"]:
    x, y = vector(position)
    return jnp.stack([x, y, jnp.zeros_like(x)])


def _heading(yaw: Number) -> tuple[Array, Array]:
    """Return the unit vectors along a heading and to its left."""
    yaw = jnp.asarray(yaw, float)
    cos, sin, zero = jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw)
    return jnp.stack([cos, sin, zero]), jnp.stack([-sin, cos, zero])


def _bar(rays: Rays, position: Position, yaw: Number, width: Number) -> Array:
    """Return the share of each pixel within half a width of a line along `yaw`."""
    _, left = _heading(yaw)
    offset = dot(left, rays.eye - _point(position))
    half = jnp.asarray(width, float) / 2
    # A ray d meets the ground where 1 / t = -d_z / z; see `_on_ground` in solids.py.
    near = left - (offset - half) / rays.eye[2] * _vertical()
    far = left - (offset + half) / rays.eye[2] * _vertical()
    return strip(rays.pixels(far), -rays.pixels(near))


def _rectangle(rays: Rays, position: Position, yaw: Number, length: Number, width: Number) -> Array:
    along = _bar(rays, position, yaw, width)
    return along * _bar(rays, position, yaw + jnp.pi / 2, length)


def _circle(rays: Rays, position: Position, radius: Number) -> Array:
    """Return the distance in pixels within a circle."""
    away = _point(position) - rays.eye
    x, y, z = -away
    up = _vertical()
    one = jnp.asarray([1.0, 0.0, 0.0]) - x / z * up
    other = jnp.asarray([0.0, 1.0, 0.0]) - y / z * up
    radius = jnp.asarray(radius, float)
    return round_edge(rays, -radius / z * up, one, other, (away, radius))


def _dashes(rays: Rays, line: Line) -> Array:
    """Return the share of each pixel's footprint, along the line, that is painted."""
    along, _ = _heading(line.yaw)
    fall = jnp.minimum(rays.rises(), -NEAREST_FALL)
    distance = -rays.eye[2] / fall
    direction = rays.linear(along)
    at = dot(along, rays.eye - _point(line.position)) + distance * direction
    _, turn = rays.slopes(along)
    _, rise = rays.slopes(_vertical())
    footprint = jnp.abs(distance * (turn - direction / fall * rise)) + 1e-6
    dash = jnp.asarray(line.dash, float)
    period = dash + jnp.asarray(line.gap, float)

    def paint(end: Array) -> Array:
        """Return the length painted from 0 to `end`."""
        whole = jnp.floor(end / period)
        return whole * dash + jnp.minimum(end - whole * period, dash)

    return (paint(at + footprint / 2) - paint(at - footprint / 2)) / footprint
