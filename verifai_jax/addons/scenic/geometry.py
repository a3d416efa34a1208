"""Boxes, polygons and visibility in the plane, as Scenic's 2D mode decides them, in JAX.

boxes_apart(one, other)                             # truth value: not even touching
box_inside(box, edges)                              # a box within polygons, holes allowed
sees_all_around(x, y, radius, box)                  # Scenic's disc is a polygon of 128 corners
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from verifai_jax.addons.scenic.values import Body, as_vec

CORNERS = 128
"""Corners of the polygon that Scenic sees for a disc."""


class Rectangle(NamedTuple):
    """A rectangle: its centre, its heading with cosine and sine, and its half extents."""

    x: Any
    y: Any
    heading: Any
    cos: Any
    sin: Any
    half_width: Any
    half_length: Any

    @property
    def corners(self) -> Float[Array, "4 2"]:
        """The corners, counterclockwise."""
        points = []
        for across, along in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
            right, forward = across * self.half_width, along * self.half_length
            points.append(self.x + self.cos * right - self.sin * forward)
            points.append(self.y + self.sin * right + self.cos * forward)
        return jnp.stack(
            [jnp.asarray(corner, jnp.result_type(float)) for corner in points]
        ).reshape(4, 2)


def rectangle_of(body: Body) -> Rectangle:
    """Return the rectangle covered by an object."""
    position = as_vec(body.get("position"))
    yaw = jnp.asarray(body.get("orientation").angle, jnp.result_type(float))
    return Rectangle(
        position.x, position.y, yaw, jnp.cos(yaw), jnp.sin(yaw), body.get("width") / 2,
        body.get("length") / 2,
    )  # fmt: skip


def boxes_apart(one: Rectangle, other: Rectangle) -> Bool[Array, ""]:
    """Return whether two rectangles have no common point (separating axes)."""
    dx, dy = other.x - one.x, other.y - one.y
    cos = jnp.abs(one.cos * other.cos + one.sin * other.sin)
    sin = jnp.abs(one.cos * other.sin - one.sin * other.cos)
    gaps = []
    for box, else_ in ((one, other), (other, one)):
        right = jnp.abs(dx * box.cos + dy * box.sin)
        forward = jnp.abs(-dx * box.sin + dy * box.cos)
        gaps.append(right - box.half_width - else_.half_width * cos - else_.half_length * sin)
        gaps.append(forward - box.half_length - else_.half_width * sin - else_.half_length * cos)
    return jnp.max(jnp.stack(gaps)) > 0


def edges_of(polygons: Any) -> Float[np.ndarray, "n 2 2"]:
    """Return the edges of Shapely polygons, including those of holes."""
    edges = []
    for polygon in getattr(polygons, "geoms", [polygons]):
        for ring in (polygon.exterior, *polygon.interiors):
            points = np.array(ring.coords, float)[:, :2]
            edges.append(np.stack([points[:-1], points[1:]], axis=1))
    return np.concatenate(edges)


def is_convex(polygons: Any) -> bool:
    """Return whether Shapely polygons are a single convex one without holes."""
    parts = list(getattr(polygons, "geoms", [polygons]))
    if len(parts) != 1 or len(parts[0].interiors):
        return False
    return math.isclose(parts[0].convex_hull.area, parts[0].area, rel_tol=1e-12)


def point_inside(x: Any, y: Any, edges: Float[np.ndarray, "n 2 2"]) -> Bool[Array, ""]:
    """Return whether a point lies in polygons: an odd number of edges lies to its right."""
    (x1, y1), (x2, y2) = edges[:, 0].T, edges[:, 1].T
    spans = (y1 > y) != (y2 > y)
    level = np.where(y1 == y2, 1.0, y2 - y1)
    crossing = x1 + (y - y1) * (x2 - x1) / level
    return jnp.sum(spans & (x < crossing)) % 2 == 1


def box_inside(box: Rectangle, edges: Float[np.ndarray, "n 2 2"], convex: bool) -> Bool[Array, ""]:
    """Return whether a rectangle lies in polygons.

    **Arguments:**
    - `convex`: True for a single convex polygon, for which testing the corners suffices.
    """
    corners = box.corners
    if convex:
        start, ahead = edges[:, 0], edges[:, 1] - edges[:, 0]
        ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        around = np.sum(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 1, 0] * edges[:, 0, 1])
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) * np.sign(around)
        inward = corners @ left.T.astype(corners.dtype) - np.sum(start * left, axis=1)
        return jnp.all(inward >= 0)
    inside = point_inside(corners[0, 0], corners[0, 1], edges)
    return inside & ~jnp.any(_crosses(box, edges))


def _crosses(box: Rectangle, edges: Float[np.ndarray, "n 2 2"]) -> Bool[Array, " n"]:
    """Return which edges go through the inner of a rectangle (Liang and Barsky, 1984)."""
    dx, dy = edges[..., 0] - box.x, edges[..., 1] - box.y
    right, forward = dx * box.cos + dy * box.sin, -dx * box.sin + dy * box.cos
    enter = jnp.zeros(len(edges), right.dtype)
    leave = jnp.ones(len(edges), right.dtype)
    misses = jnp.zeros(len(edges), bool)
    for offset, half in ((right, box.half_width), (forward, box.half_length)):
        start, step = offset[:, 0], offset[:, 1] - offset[:, 0]
        still = step == 0
        safe = jnp.where(still, 1.0, step)
        one, two = (-half - start) / safe, (half - start) / safe
        enter = jnp.where(still, enter, jnp.maximum(enter, jnp.minimum(one, two)))
        leave = jnp.where(still, leave, jnp.minimum(leave, jnp.maximum(one, two)))
        misses = misses | (still & (jnp.abs(start) >= half))
    return (enter < leave) & ~misses


def sees_all_around(x: Any, y: Any, radius: Any, box: Rectangle) -> Bool[Array, ""]:
    """Return whether a rectangle meets the disc around a point, a polygon as in Scenic.

    It tests separating axes: those of the rectangle, and the normals of the polygon's edges. The
    distance of the rectangle along a direction is, where positive, concave in the direction, with
    its maximum towards the rectangle's nearest point. So the two normals next to that direction
    decide.
    """
    step = 2 * math.pi / CORNERS
    dx, dy = box.x - x, box.y - y
    right, forward = dx * box.cos + dy * box.sin, -dx * box.sin + dy * box.cos
    apart = jnp.asarray(False)
    for offset, half, direction in (
        (right, box.half_width, box.heading),
        (forward, box.half_length, box.heading + math.pi / 2),
    ):
        off = direction - step * jnp.round(direction / step)
        apart = apart | (jnp.abs(offset) - half > radius * jnp.cos(off))
    nearest_right = right - jnp.clip(right, -box.half_width, box.half_width)
    nearest_forward = forward - jnp.clip(forward, -box.half_length, box.half_length)
    towards = jnp.arctan2(nearest_forward, nearest_right) + box.heading
    below = jnp.floor(towards / step - 0.5) + 0.5
    for normal in (below * step, (below + 1) * step):
        local = normal - box.heading
        cos, sin = jnp.cos(local), jnp.sin(local)
        lowest = right * cos + forward * sin
        lowest = lowest - box.half_width * jnp.abs(cos) - box.half_length * jnp.abs(sin)
        apart = apart | (lowest > radius * math.cos(step / 2))
    return ~apart
