"""Boxes, cones, cylinders and spheres: descriptions, and their appearance in an image.

    Box(position=(20.0, 0.0, 0.0), size=(4.5, 1.8, 0.8), colour=(0.9, 0.4, 0.1), yaw=0.1)
    Cone(position=(15.0, 1.0, 0.0), radius=0.2, height=0.75, colour=(1.0, 0.35, 0.0))

All solids of a kind are computed together, as arrays with a leading axis.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from verifai_jax.addons.perception.camera import (
    TINY,
    Number,
    Rays,
    Vector,
    ball_edge,
    computed_once,
    coverage,
    described,
    dot,
    normalized,
    round_edge,
    vector,
)
from verifai_jax.addons.perception.light import Sun

FAR = 1e4
"""Pixels, or metres, beyond everything."""
GREY: Vector = (0.5, 0.5, 0.5)


@described
class Box:
    """A box that stands on `position`.

    - `position`: middle of the underside, in m.
    - `size`: length (along its heading), width and height in m.
    - `colour`: red, green and blue in [0, 1].
    - `yaw`: heading in rad.
    - `rotation`: instead of `yaw`, a matrix `[3, 3]` whose columns are the box's axes in the world.
    """

    position: Vector
    size: Vector
    colour: Vector = GREY
    yaw: Number = 0.0
    rotation: PyTree = None


@described
class Cone:
    """A cone on its base.

    - `position`: middle of the base in m.
    - `radius`, `height`: in m.
    - `colour`: red, green and blue in [0, 1].
    - `axis`: direction from the base to the tip; `(1, 0, 0)` for one that has fallen forwards.
    """

    position: Vector
    radius: Number
    height: Number
    colour: Vector = GREY
    axis: Vector = (0.0, 0.0, 1.0)


@described
class Cylinder:
    """A cylinder on its base; see `Cone`."""

    position: Vector
    radius: Number
    height: Number
    colour: Vector = GREY
    axis: Vector = (0.0, 0.0, 1.0)


@described
class Sphere:
    """A sphere, `position` its middle in m."""

    position: Vector
    radius: Number
    colour: Vector = GREY


Solid: TypeAlias = Box | Cone | Cylinder | Sphere


class Look(NamedTuple):
    """The appearance of solids of one kind.

    - `cover`: share of each pixel that each of them covers.
    - `depth`: distance along the optical axis in m of the surface; only meaningful where covered.
    - `light`: brightness of the surface.
    - `shadow`: share of each pixel of the ground in their shadow; None without shadows.
    - `centre`: a point inside each solid.
    """

    cover: Float[Array, "solids height width"]
    depth: Float[Array, "solids height width"]
    light: Float[Array, "solids height width"]
    shadow: Float[Array, "solids height width"] | None
    centre: Float[Array, "solids 3"]


def look(rays: Rays, solids: Sequence[Solid], sun: Sun, shadows: bool) -> Look:
    """Return the appearance of solids of one kind."""
    kind = type(solids[0])
    if kind is Box:
        return _boxes(rays, solids, sun, shadows)  # pyright: ignore[reportArgumentType]
    if kind is Sphere:
        return _spheres(rays, solids, sun, shadows)  # pyright: ignore[reportArgumentType]
    return _frusta(rays, solids, sun, shadows)  # pyright: ignore[reportArgumentType]


def _thin(cover: Array, rays: Rays, centre: Array, size: Array, reach: Array) -> Array:
    """Fade what is narrower than a pixel, whose two edges blur into one another, or behind the eye.

    The least of two ramps of one pixel about a bar of width w < 1 integrates to (1 + w)^2 / 4
    instead of w. `reach` is how far a solid extends from its centre.
    """
    forward = dot(centre - rays.eye, rays.forward)
    width = jnp.clip(size * rays.focal / jnp.maximum(forward, 1e-3), 0.0, 1.0)
    width = jnp.where(forward + reach > 0, width, 0.0)
    return cover * computed_once(4 * width / (1 + width) ** 2)[:, None, None]


def _oriented(normal: Float[Array, "*stack 3"], towards: Float[Array, "*#stack 3"]) -> Array:
    """Return normals that look to the side of the plane on which `towards` is."""
    return normal * jnp.where(dot(normal, towards) < 0, -1.0, 1.0)[..., None]


def _on_ground(rays: Rays, normal: Array, point: Array) -> Array:
    """Return the plane through the eye that cuts the ground where another plane does.

    The other plane goes through `point`; the ground is seen by rays that fall.
    """
    height = dot(normal, rays.eye - point) / rays.eye[2]
    return normal - height[..., None] * jnp.asarray([0.0, 0.0, 1.0])


# --- boxes ---------------------------------------------------------------------------------------

_EDGES = tuple(itertools.product(range(3), (-1, 1), (-1, 1)))
"""The axis of each edge, and its signs along the next axis and the one after that."""


def _boxes(rays: Rays, boxes: Sequence[Box], sun: Sun, shadows: bool) -> Look:
    half = jnp.stack([vector(box.size) for box in boxes]) / 2
    axes = jnp.stack([_box_axes(box) for box in boxes])  # [boxes, axis, 3]
    base = jnp.stack([vector(box.position) for box in boxes])
    centre = base + axes[:, 2] * half[:, 2, None]
    eye = jnp.sum(axes * (rays.eye - centre)[:, None], -1)  # in the box's frame
    seen = jnp.stack([eye < -half, eye > half])  # faces that the eye sees: [sign, boxes, axis]
    along = jnp.stack([axes[:, axis] for axis, _, _ in _EDGES])  # [edge, boxes, 3]
    middle = jnp.stack([_edge_middle(centre, axes, half, edge) for edge in _EDGES])
    normal = jnp.cross(middle - rays.eye, along)
    outline = _within(rays, _oriented(normal, centre - rays.eye), seen)
    narrow = 2 * (jnp.sum(half, -1) - jnp.max(half, -1) - jnp.min(half, -1))
    cover = _thin(coverage(outline), rays, centre, narrow, jnp.sqrt(dot(half, half)))
    shadow = None
    if shadows:
        facing_sun = axes @ sun.direction()
        normal = _oriented(jnp.cross(along, sun.direction()[None, None]), centre - middle)
        sunny = jnp.stack([facing_sun < 0, facing_sun > 0])
        shadow = coverage(_within(rays, _on_ground(rays, normal, middle), sunny))
    depth = _box_depth(rays, axes, eye, half)
    return Look(cover, depth, _box_light(rays, axes, eye, half, seen, sun), shadow, centre)


def _edge_middle(centre: Array, axes: Array, half: Array, edge: tuple[int, int, int]) -> Array:
    axis, *signs = edge
    b, c = (axis + 1) % 3, (axis + 2) % 3
    to_b, to_c = half[:, b, None] * axes[:, b], half[:, c, None] * axes[:, c]
    return centre + signs[0] * to_b + signs[1] * to_c


def _within(
    rays: Rays, normal: Float[Array, "edges boxes 3"], seen: Bool[Array, "2 boxes 3"]
) -> Float[Array, "boxes height width"]:
    """Return the distance in pixels within the edges between faces that are seen and others."""
    distances = rays.pixels(normal)
    within = jnp.full((), FAR)
    for distance, (axis, *signs) in zip(distances, _EDGES, strict=True):
        faces = [seen[int(sign > 0), :, (axis + 1 + k) % 3] for k, sign in enumerate(signs)]
        inner = jnp.where(faces[0] != faces[1], 0.0, FAR)
        within = jnp.minimum(within, distance + computed_once(inner)[:, None, None])
    return within


def _box_axes(box: Box) -> Float[Array, "3 3"]:
    if box.rotation is not None:
        return jnp.asarray(box.rotation, float).T
    yaw = jnp.asarray(box.yaw, float)
    zero, one = jnp.zeros_like(yaw), jnp.ones_like(yaw)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack(
        [jnp.stack([cos, sin, zero]), jnp.stack([-sin, cos, zero]), jnp.stack([zero, zero, one])]
    )


def _box_depth(rays: Rays, axes: Array, eye: Array, half: Array) -> Array:
    """Return the greatest of the distances to the planes of faces that the eye sees."""
    depth = jnp.full((), -FAR)
    for axis, slope in enumerate(rays.linear(jnp.moveaxis(axes, 1, 0))):
        slope = jnp.where(jnp.abs(slope) < 1e-9, 1e-9, slope)
        side = jnp.sign(eye[:, axis])
        gap = (side * half[:, axis] - eye[:, axis])[:, None, None] / slope
        outside = (jnp.abs(eye[:, axis]) > half[:, axis])[:, None, None]
        depth = jnp.maximum(depth, jnp.where(outside, gap, -FAR))
    return depth


def _box_light(
    rays: Rays, axes: Array, eye: Array, half: Array, seen: Bool[Array, "2 boxes 3"], sun: Sun
) -> Array:
    """Return the light of the faces, blended along the edges between those that are seen."""
    side = jnp.where(eye > 0, 1.0, -1.0)
    light = computed_once(sun.light(side[..., None] * axes))[..., None, None]
    visible = seen[0] | seen[1]

    def ahead(a: int, b: int) -> Array:
        """Return the distance in pixels from the edge of faces a and b, positive on a."""
        to_a = side[:, a, None] * half[:, a, None] * axes[:, a]
        to_b = side[:, b, None] * half[:, b, None] * axes[:, b]
        from_eye = -jnp.sum(eye[..., None] * axes, 1)  # the centre, seen from the eye
        normal = jnp.cross(from_eye + to_a + to_b, axes[:, 3 - a - b])
        only = jnp.where(visible[:, b], 0.0, FAR) - jnp.where(visible[:, a], 0.0, FAR)
        return rays.pixels(_oriented(normal, from_eye + to_a)) + computed_once(only)[:, None, None]

    sides = light[:, 1] + (light[:, 0] - light[:, 1]) * coverage(ahead(0, 1))
    top = coverage(jnp.minimum(ahead(2, 0), ahead(2, 1)))
    return sides + (light[:, 2] - sides) * top


# --- cones and cylinders -------------------------------------------------------------------------


class _Frusta(NamedTuple):
    """Cones or cylinders: the radius falls from `radius` by `taper` over `height`."""

    base: Float[Array, "n 3"]
    frame: Float[Array, "n 3 3"]
    radius: Float[Array, " n"]
    height: Float[Array, " n"]
    taper: Float[Array, " n"]
    pointed: bool


def _frusta(
    rays: Rays, solids: Sequence[Cone] | Sequence[Cylinder], sun: Sun, shadows: bool
) -> Look:
    pointed = isinstance(solids[0], Cone)
    base = jnp.stack([vector(solid.position) for solid in solids])
    axis = normalized(jnp.stack([vector(solid.axis) for solid in solids]))
    radius = jnp.stack([jnp.asarray(solid.radius, float) for solid in solids])
    height = jnp.stack([jnp.asarray(solid.height, float) for solid in solids])
    frame = _frame(axis)
    shape = _Frusta(base, frame, radius, height, radius if pointed else 0.0 * radius, pointed)
    eye = jnp.sum(frame * (rays.eye - base)[:, None], -1)  # in the solid's frame
    across = (height * radius - shape.taper * eye[:, 2]) / height
    cover = _between_ends(rays, shape, eye[:, :2], across, None)
    foot = jnp.asarray([0.0, 0.0, 1.0]) * height[:, None]
    for end in [eye] if pointed else [eye, eye - foot]:
        cover = jnp.maximum(cover, coverage(_disc(rays, end, radius, frame)))
    cover = _thin(cover, rays, base, 2 * radius, jnp.hypot(radius, height))
    shadow = None
    if shadows:
        to_sun = frame @ sun.direction()
        across = -shape.taper * to_sun[:, 2] / height
        shadow = _between_ends(rays, shape, to_sun[:, :2], across, sun)
    depth, light = _frustum_surface(rays, eye, shape, sun)
    return Look(cover, depth, light, shadow, base + axis * height[:, None] / 2)


def _frame(axis: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    """Return right-handed frames, as rows, whose third axis is given."""
    helper = jnp.where(jnp.abs(axis[:, 2:]) < 0.9, jnp.eye(3)[2], jnp.eye(3)[0])
    first = normalized(jnp.cross(helper, axis))
    return jnp.stack([first, jnp.cross(axis, first), axis], axis=1)


def _between_ends(
    rays: Rays, shape: _Frusta, towards: Array, across: Array, sun: Sun | None
) -> Float[Array, "n height width"]:
    """Return the share of each pixel in the part of the outline between both ends.

    A plane tangent to the mantle at the angle phi contains the eye where `towards . (cos phi, sin
    phi) = across`. Two such planes and the chords between their points of contact bound the part.
    With a `sun`, the same for planes parallel to its rays, and for the ground: the shadow.
    """
    norm = jnp.sqrt(dot(towards, towards) + TINY)
    cosine = across / norm
    # Where the points of contact nearly coincide, the ends are all that is seen.
    exists = (jnp.abs(cosine) < 0.998)[:, None, None]
    cosine = jnp.clip(cosine, -0.999, 0.999)
    sine = jnp.sqrt(1 - cosine**2)
    x, y = (towards / norm[:, None]).T

    def distance(normal: Array, point: Array) -> Array:
        return rays.pixels(normal if sun is None else _on_ground(rays, normal, point))

    within = jnp.full((), FAR)
    low, high = [], []
    for sign in (-1.0, 1.0):
        along = x * cosine - sign * y * sine
        sideways = y * cosine + sign * x * sine
        radial = along[:, None] * shape.frame[:, 0] + sideways[:, None] * shape.frame[:, 1]
        normal = -(shape.height[:, None] * radial + shape.taper[:, None] * shape.frame[:, 2])
        top = shape.base + shape.height[:, None] * shape.frame[:, 2]
        low.append(shape.base + shape.radius[:, None] * radial)
        high.append(top + (shape.radius - shape.taper)[:, None] * radial)
        within = jnp.minimum(within, distance(normal, low[-1]))
    chords = [(low, high)] if shape.pointed else [(low, high), (high, low)]
    for end, other in chords:
        ray = end[0] - rays.eye if sun is None else sun.direction()[None]
        normal = jnp.cross(end[1] - end[0], ray)
        normal = _oriented(normal, (other[0] + other[1]) / 2 - end[0])
        within = jnp.minimum(within, distance(normal, end[0]))
    return jnp.where(exists, coverage(within), 0.0)


def _disc(rays: Rays, eye: Array, radius: Array, frame: Array) -> Array:
    """Return the distance in pixels within discs, each the foot of a frame that sees the eye."""
    first = eye[:, :1] * frame[:, 2] - eye[:, 2:] * frame[:, 0]
    second = eye[:, 1:2] * frame[:, 2] - eye[:, 2:] * frame[:, 1]
    side = jnp.where(eye[:, 2] > 0, -1.0, 1.0)
    away = -jnp.sum(eye[..., None] * frame, axis=1)
    return round_edge(rays, (radius * side)[:, None] * frame[:, 2], first, second, (away, radius))


def _frustum_surface(rays: Rays, eye: Array, shape: _Frusta, sun: Sun) -> tuple[Array, Array]:
    """Return depth and light where rays meet cones or cylinders."""
    frame, radius, height, taper = shape.frame, shape.radius, shape.height, shape.taper
    dx, dy, dz = rays.linear(jnp.moveaxis(frame, 1, 0))
    slope = computed_once(-taper / height)
    x, y, z = (value[:, None, None] for value in computed_once(tuple(eye.T)))
    slope, radius, height = (value[:, None, None] for value in (slope, radius, height))
    here = radius + slope * z  # the solid's radius at the eye's height
    a = dx**2 + dy**2 - (slope * dz) ** 2
    a = jnp.where(jnp.abs(a) < 1e-9, 1e-9, a)
    b = x * dx + y * dy - slope * here * dz
    c = x**2 + y**2 - here**2
    root = jnp.sqrt(jnp.maximum(b**2 - a * c, 1e-9))
    # Two forms of one root, each where it does not cancel.
    mantle = jnp.where(b < 0, c / jnp.where(b < 0, root - b, 1.0), -(b + root) / a)
    dz = jnp.where(jnp.abs(dz) < 1e-9, 1e-9, dz)
    end = jnp.where(z > height, (height - z) / dz, jnp.where(z < 0, -z / dz, -FAR))
    depth = jnp.maximum(mantle, end)
    normal = (x + mantle * dx, y + mantle * dy, -slope * (here + slope * mantle * dz))
    to_sun = [part[:, None, None] for part in computed_once(tuple((frame @ sun.direction()).T))]
    length = jnp.sqrt(sum(part**2 for part in normal) + TINY)
    around = sun.lit(sum(n * s for n, s in zip(normal, to_sun, strict=True)) / length)
    ends = sun.lit(jnp.where(z > height, 1.0, -1.0) * to_sun[2])
    return depth, jnp.where(mantle >= end, around, ends)


# --- spheres -------------------------------------------------------------------------------------


def _spheres(rays: Rays, spheres: Sequence[Sphere], sun: Sun, shadows: bool) -> Look:
    centre = jnp.stack([vector(sphere.position) for sphere in spheres])
    radius = jnp.stack([jnp.asarray(sphere.radius, float) for sphere in spheres])
    away = centre - rays.eye
    cover = coverage(ball_edge(rays, away, radius))
    cover = _thin(cover, rays, centre, 2 * radius, radius)
    beyond = dot(away, away) - radius**2
    towards, length = rays.linear(away), rays.lengths()
    root = jnp.sqrt(jnp.maximum(towards**2 - length**2 * beyond[:, None, None], 1e-9))
    depth = beyond[:, None, None] / (towards + root)
    to_sun = rays.linear(sun.direction())
    cosine = depth * to_sun - dot(away, sun.direction())[:, None, None]
    light = sun.lit(cosine / radius[:, None, None])
    shadow = None
    if shadows:
        frame = _frame(jnp.broadcast_to(sun.direction(), centre.shape))
        up = jnp.asarray([0.0, 0.0, 1.0])
        radial = -(radius / rays.eye[2])[:, None] * up
        one, other = (_on_ground(rays, frame[:, k], centre) for k in range(2))
        sun_height = sun.direction()[2]
        middle = away - (centre[:, 2] / sun_height)[:, None] * sun.direction()
        shadow = coverage(round_edge(rays, radial, one, other, (middle, radius / sun_height)))
    return Look(cover, depth, light, shadow, centre)
