"""A pinhole camera at any pose, and the rays through its pixels.

    Camera(24, 48, field_of_view=0.6, position=(0.0, 0.0, 1.3))                # looks along +x
    Camera(32, 32, position=(x, y, 10.0), pitch=-math.pi / 2, yaw=heading)     # looks down

World axes: x forward, y to the left, z up, in metres. All drawn boundaries (edges of boxes,
outlines of cones, markings on the ground) are planes or quadratic cones through the eye. So the
signed distance of a boundary from a pixel's centre, in pixels, consists of linear functions of the
pixel and their norms, each a sum of a column and a row. That makes images cheap.
"""

import dataclasses
from typing import NamedTuple, TypeAlias, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

Number: TypeAlias = PyTree
"""A number, or an array `[]`, which may be traced."""
Vector: TypeAlias = PyTree
"""Three numbers, or an array `[3]`, which may be traced."""
TINY = 1e-12
Tree = TypeVar("Tree")
Description = TypeVar("Description")


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def described(kind: type[Description]) -> type[Description]:
    """Make a class of descriptions: a frozen dataclass that is a pytree of its fields."""
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True)(kind))


STATIC = {"static": True}
"""Metadata of a field that is part of a description's structure, and no leaf."""


def vector(value: Vector) -> Float[Array, " n"]:
    """Return numbers as one array; some may be traced."""
    if isinstance(value, tuple | list):
        return jnp.stack([jnp.asarray(entry, float) for entry in value])
    return jnp.asarray(value, float)


def computed_once(arrays: Tree) -> Tree:
    """Return arrays that are stored before they are used.

    Otherwise XLA recomputes small or frequently used arrays for each pixel that needs them.
    """
    return jax.lax.optimization_barrier(arrays)


def dot(a: Array, b: Array) -> Array:
    """Return the scalar product along the last axis, in full precision on every device."""
    return jnp.sum(a * b, axis=-1)


def normalized(a: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Return vectors of length one."""
    return a / jnp.sqrt(dot(a, a) + TINY)[..., None]


class Rays(NamedTuple):
    """The rays of a camera: through pixel (i, j) goes `forward + down * v[i] + right * u[j]`.

    - `eye`: their origin.
    - `right`, `down`, `forward`: the axes of the image in the world.
    - `u`, `v`: coordinates of columns and rows at distance one.
    - `focal`: focal length in pixels.
    - `level`: True if the horizon is known to be a row of the image.
    """

    eye: Float[Array, "3"]
    right: Float[Array, "3"]
    down: Float[Array, "3"]
    forward: Float[Array, "3"]
    u: Float[Array, " width"]
    v: Float[Array, " height"]
    focal: Float[Array, ""]
    level: bool

    def linear(self, n: Float[Array, "*stack 3"]) -> Float[Array, "*stack height width"]:
        """Return `n . d` for the ray d of each pixel."""
        rows = dot(n, self.forward)[..., None] + dot(n, self.down)[..., None] * self.v
        columns = dot(n, self.right)[..., None] * self.u
        rows, columns = computed_once((rows, columns))
        return rows[..., :, None] + columns[..., None, :]

    def slopes(self, n: Float[Array, "*stack 3"]) -> tuple[Array, Array]:
        """Return the change of `linear(n)` from one pixel to the next, to the right and down."""
        return dot(n, self.right) / self.focal, dot(n, self.down) / self.focal

    def pixels(self, n: Float[Array, "*stack 3"]) -> Float[Array, "*stack height width"]:
        """Return the signed distance, in pixels, from the line of the image with `n . d = 0`."""
        along, down = self.slopes(n)
        return self.linear(n / jnp.sqrt(along**2 + down**2 + TINY)[..., None])

    def rises(self) -> Float[Array, "height columns"]:
        """Return the vertical component of the rays; `columns` is 1 for a level camera."""
        if self.level:
            return (self.forward[2] + self.down[2] * self.v)[:, None]
        return self.linear(jnp.asarray([0.0, 0.0, 1.0], self.eye.dtype))

    def lengths(self) -> Float[Array, "height width"]:
        """Return the lengths of the rays, which are 1 along the optical axis."""
        return jnp.sqrt(1.0 + self.v[:, None] ** 2 + self.u[None, :] ** 2)


def coverage(pixels: Array) -> Array:
    """Return the share of a pixel on the positive side of a line at this distance in pixels.

    It is exact for lines along rows or columns, and a ramp of one pixel for others. Its derivative
    gives geometry a gradient.
    """
    return jnp.clip(0.5 + pixels, 0.0, 1.0)


def strip(one: Array, other: Array) -> Array:
    """Return the share of a pixel between two parallel lines, also exact below one pixel."""
    return jnp.maximum(coverage(one) + coverage(other) - 1.0, 0.0)


def round_edge(
    rays: Rays,
    radius: Float[Array, "*stack 3"],
    one: Float[Array, "*stack 3"],
    other: Float[Array, "*stack 3"],
    within: tuple[Float[Array, "*stack 3"], Float[Array, "*stack"]],
) -> Float[Array, "*stack height width"]:
    """Return the distance in pixels inside a conic, `radius . d >= |(one . d, other . d)|`.

    `within` is a ball around the curve, given by its centre as seen from the eye, and its radius.
    It limits curves that are thinner than a pixel, whose first-order distance is small along the
    whole axis.

    The distance is of first order: the function's value divided by the norm of its gradient
    (Sampson, "Fitting conic sections to very scattered data", 1982).
    """
    first, second = rays.linear(one), rays.linear(other)
    norm = jnp.sqrt(first**2 + second**2 + TINY)
    value = rays.linear(radius) - norm

    def slope(of_radius: Array, of_one: Array, of_other: Array) -> Array:
        of_radius, of_one, of_other = (s[..., None, None] for s in (of_radius, of_one, of_other))
        return of_radius - (first * of_one + second * of_other) / norm

    slopes = zip(rays.slopes(radius), rays.slopes(one), rays.slopes(other), strict=True)
    along, down = (slope(*parts) for parts in slopes)
    distance = value / jnp.sqrt(along**2 + down**2 + TINY)
    return jnp.minimum(distance, ball_edge(rays, *within))


def ball_edge(
    rays: Rays, away: Float[Array, "*stack 3"], radius: Float[Array, "*stack"]
) -> Float[Array, "*stack height width"]:
    """Return the distance in pixels inside the outline of a ball at `away` from the eye."""
    beyond = dot(away, away) - radius**2
    tangent = jnp.sqrt(jnp.maximum(beyond, TINY))[..., None, None]
    length = rays.lengths()
    along, down = (slope[..., None, None] for slope in rays.slopes(away))
    along = along - tangent * (rays.u[None, :] / length / rays.focal)
    down = down - tangent * (rays.v[:, None] / length / rays.focal)
    edge = rays.linear(away) - tangent * length
    return edge / jnp.sqrt(along**2 + down**2 + TINY)


@described
class Camera:
    """A pinhole camera.

    **Arguments:**
    - `height`, `width`: size of the image in pixels.
    - `field_of_view`: horizontal angle of view in rad.
    - `position`: the position of the eye in m.
    - `yaw`: heading in rad, counterclockwise from the x axis.
    - `pitch`: elevation of the optical axis in rad; with -pi/2 the camera looks down, and the top
      of the image is ahead.
    - `roll`: rotation about the optical axis in rad, clockwise. If it is the number 0.0, the
      horizon is a row of the image, and quantities of a row are computed once for each row.
    - `rotation`: instead of the three angles, a matrix `[3, 3]` whose columns are the directions
      right, down and forward in the world.
    """

    height: int = dataclasses.field(default=24, metadata=STATIC)
    width: int = dataclasses.field(default=48, metadata=STATIC)
    field_of_view: Number = 0.61
    position: Vector = (0.0, 0.0, 1.3)
    yaw: Number = 0.0
    pitch: Number = 0.0
    roll: Number = 0.0
    rotation: PyTree = None

    def rays(self) -> Rays:
        """Return the rays through the pixels' centres."""
        level = self.rotation is None and isinstance(self.roll, int | float) and self.roll == 0
        if self.rotation is None:
            right, down, forward = _axes(self.yaw, self.pitch, self.roll)
        else:
            right, down, forward = jnp.asarray(self.rotation, float).T
        focal = self.width / 2 / jnp.tan(jnp.asarray(self.field_of_view, float) / 2)
        u = (jnp.arange(self.width) + 0.5 - self.width / 2) / focal
        v = (jnp.arange(self.height) + 0.5 - self.height / 2) / focal
        return Rays(vector(self.position), right, down, forward, u, v, focal, level)


def _axes(yaw: Number, pitch: Number, roll: Number) -> tuple[Array, Array, Array]:
    """Return the directions right, down and forward of a pose."""
    yaw, pitch, roll = (jnp.asarray(angle, float) for angle in (yaw, pitch, roll))
    zero = jnp.zeros_like(yaw)
    level = jnp.stack([jnp.sin(yaw), -jnp.cos(yaw), zero])
    forward = jnp.stack(
        [jnp.cos(pitch) * jnp.cos(yaw), jnp.cos(pitch) * jnp.sin(yaw), jnp.sin(pitch)]
    )
    below = jnp.cross(forward, level)
    right = jnp.cos(roll) * level + jnp.sin(roll) * below
    return right, jnp.cos(roll) * below - jnp.sin(roll) * level, forward


def facing(position: Vector, target: Vector) -> dict[str, Array]:
    """Return `yaw` and `pitch` of a camera at `position` that looks at `target`.

    Camera(position=eye, **facing(eye, pad))
    """
    x, y, z = vector(target) - vector(position)
    return {"yaw": jnp.arctan2(y, x), "pitch": jnp.arctan2(z, jnp.hypot(x, y))}
