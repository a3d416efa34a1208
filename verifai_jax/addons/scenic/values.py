"""Values of a planar scene in JAX: vectors, orientations, objects, choices.

An orientation in the plane is its yaw. Numbers that depend on no random value stay plain Python, so
that a certain zero (a pitch, a height) is known as zero.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np


class Unsupported(Exception):
    """An error for a value that JAX cannot compute, by its name."""


def is_plain(*values: Any) -> bool:
    """Return whether all values are plain numbers of Python or NumPy."""
    return all(isinstance(value, int | float | np.generic) for value in values)


def function(name: str) -> Callable[..., Any]:
    """Return a function of numbers: from `math` for plain numbers, from JAX for others."""
    plain, traced = getattr(math, name), getattr(jnp, ARRAY_NAMES.get(name, name))
    return lambda *values: plain(*values) if is_plain(*values) else traced(*values)


ARRAY_NAMES = {"atan2": "arctan2", "acos": "arccos", "asin": "arcsin", "atan": "arctan"}
sin, cos, sqrt, atan2 = map(function, ("sin", "cos", "sqrt", "atan2"))


def hypot(*values: Any) -> Any:
    """Return the length of a vector, with a derivative at zero."""
    used = [value for value in values if not (is_plain(value) and value == 0)]
    if is_plain(*used):
        return math.hypot(*used)
    square = sum(value * value for value in used)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def normalize_angle(angle: Any) -> Any:
    """Return an angle in [-pi, pi]."""
    turns = (angle - math.pi) / math.tau
    if is_plain(angle):
        return (
            angle - math.tau * max(math.ceil(turns), 0)
            if angle > 0
            else (angle + math.tau * max(math.ceil((-angle - math.pi) / math.tau), 0))
        )
    above = jnp.maximum(jnp.ceil(turns), 0.0)
    below = jnp.maximum(jnp.ceil((-angle - math.pi) / math.tau), 0.0)
    return angle - math.tau * above + math.tau * below


@dataclass(frozen=True)
class Yaw:
    """An orientation in the plane."""

    angle: Any

    @property
    def yaw(self) -> Any:
        return normalize_angle(self.angle)

    pitch = roll = 0.0

    @property
    def inverse(self) -> "Yaw":
        return Yaw(-self.angle)

    @property
    def eulerAngles(self) -> tuple[Any, float, float]:
        return (self.yaw, 0.0, 0.0)

    def localAnglesFor(self, orientation: Any) -> tuple[Any, float, float]:
        return (normalize_angle(as_yaw(orientation).angle - self.angle), 0.0, 0.0)

    def globalToLocalAngles(self, yaw: Any, pitch: Any, roll: Any) -> tuple[Any, float, float]:
        return self.localAnglesFor(from_euler(yaw, pitch, roll))

    def __mul__(self, other: Any) -> "Yaw":
        return Yaw(self.angle + as_yaw(other).angle)

    __add__ = __mul__
    __radd__ = __mul__
    __rmul__ = __mul__

    def toOrientation(self) -> "Yaw":
        return self


def from_euler(yaw: Any, pitch: Any, roll: Any) -> Yaw:
    """Return the orientation of Euler angles.

    **Raises:** `Unsupported` for an orientation outside the plane.
    """
    if not (is_plain(pitch, roll) and abs(pitch) + abs(roll) < 1e-12):
        raise Unsupported("an orientation out of the plane")
    return Yaw(yaw)


def as_yaw(value: Any) -> Yaw:
    """Return a heading, an orientation, or an oriented object as an orientation."""
    if isinstance(value, Yaw):
        return value
    if isinstance(value, Body):
        return value.get("orientation")
    if isinstance(value, Vec) and value.heading is not None:
        return Yaw(value.heading)
    if isinstance(value, tuple) and len(value) == 3:
        return from_euler(*value)
    if isinstance(value, Vec | tuple | Choice | str) or value is None:
        raise Unsupported("a heading of another kind")
    return Yaw(value)


@dataclass(frozen=True)
class Vec:
    """A vector; `heading` is that of an oriented position, such as a point on a line."""

    x: Any
    y: Any
    z: Any = 0.0
    heading: Any = None

    def __getitem__(self, index: int) -> Any:
        return (self.x, self.y, self.z)[index]

    def __iter__(self) -> Any:
        return iter((self.x, self.y, self.z))

    def toVector(self) -> "Vec":
        return self

    def applyRotation(self, rotation: Any) -> "Vec":
        return self.rotatedBy(rotation)

    def rotatedBy(self, rotation: Any) -> "Vec":
        angle = as_yaw(rotation).angle
        if is_plain(angle) and angle == 0:
            return self
        c, s = cos(angle), sin(angle)
        return Vec(c * self.x - s * self.y, s * self.x + c * self.y, self.z)

    def offsetRotated(self, rotation: Any, offset: Any) -> "Vec":
        return self + as_vec(offset).rotatedBy(rotation)

    offsetLocally = offsetRotated

    def offsetRadially(self, radius: Any, heading: Any) -> "Vec":
        return self.offsetRotated(heading, Vec(0.0, radius))

    def sphericalCoordinates(self) -> "Vec":
        altitude = 0.0 if is_plain(self.z) and self.z == 0 else atan2(self.z, hypot(self.x, self.y))
        return Vec(hypot(*self), atan2(self.y, self.x) - math.pi / 2, altitude)

    def distanceTo(self, other: Any) -> Any:
        return hypot(*(as_vec(other) - self))

    def azimuthTo(self, other: Any) -> Any:
        ahead = as_vec(other) - self
        return normalize_angle(atan2(ahead.y, ahead.x) - math.pi / 2)

    angleTo = azimuthTo

    def altitudeTo(self, other: Any) -> Any:
        ahead = as_vec(other) - self
        if is_plain(ahead.z) and ahead.z == 0:
            return 0.0
        return normalize_angle(atan2(ahead.z, hypot(ahead.x, ahead.y)))

    def angleWith(self, other: Any) -> Any:
        return normalize_angle(atan2(other.y, other.x) - atan2(self.y, self.x))

    def norm(self) -> Any:
        return hypot(*self)

    def dot(self, other: Any) -> Any:
        return self.x * other.x + self.y * other.y + self.z * other.z

    def normalized(self) -> "Vec":
        length = hypot(*self)
        if is_plain(length):
            return self if length == 0 else self * (1 / length)
        safe = jnp.where(length > 0, length, 1.0)
        return Vec(self.x / safe, self.y / safe, self.z / safe)

    def __add__(self, other: Any) -> "Vec":
        return Vec(*(a + b for a, b in zip(self, as_vec(other), strict=True)))

    __radd__ = __add__

    def __sub__(self, other: Any) -> "Vec":
        return Vec(*(a - b for a, b in zip(self, as_vec(other), strict=True)))

    def __rsub__(self, other: Any) -> "Vec":
        return as_vec(other) - self

    def __mul__(self, other: Any) -> "Vec":
        return Vec(*(a * other for a in self))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> "Vec":
        return Vec(*(a / other for a in self))


def as_vec(value: Any) -> Vec:
    """Return a vector, a tuple of coordinates, or the position of an object as a vector."""
    if isinstance(value, Vec):
        return value
    if isinstance(value, Body):
        return value.get("position")
    if isinstance(value, tuple) and len(value) in (2, 3):
        return Vec(*value)
    if isinstance(value, Choice):
        return select(value.index, [as_vec(option) for option in value.options])
    raise Unsupported("a vector of another kind")


SIDES = {
    **{"left": (-1, 0), "right": (1, 0), "front": (0, 1), "back": (0, -1)},
    **{"frontLeft": (-1, 1), "frontRight": (1, 1), "backLeft": (-1, -1), "backRight": (1, -1)},
}
"""Positions on an object, in halves of its width and length."""


@dataclass(frozen=True)
class Body:
    """An object or an oriented point, whose properties are computed when needed."""

    properties: Callable[[str], Any]
    names: frozenset[str]

    def get(self, name: str) -> Any:
        """Return a property, or a value that Scenic computes from several.

        **Raises:** `Unsupported` for any other name.
        """
        if name in self.names:
            return self.properties(name)
        match name:
            case "x" | "y" | "z":
                return getattr(self.get("position"), name)
            case "hw":
                return self.get("width") / 2
            case "hl":
                return self.get("length") / 2
        if name in SIDES:
            across, along = SIDES[name]
            offset = Vec(across * self.get("width") / 2, along * self.get("length") / 2)
            position = as_vec(self.get("position")).offsetLocally(self.get("orientation"), offset)
            made = {"position": position, "orientation": self.get("orientation")}
            made["heading"] = made["orientation"].yaw
            return Body(made.__getitem__, frozenset(made))
        raise Unsupported(f"the property {name}")

    def relativePosition(self, offset: Any) -> Vec:
        return as_vec(self.get("position")).offsetLocally(self.get("orientation"), offset)


@dataclass(frozen=True)
class Choice:
    """One of several values that are not numbers, given by its index."""

    index: Any
    options: tuple[Any, ...]


def select(index: Any, options: Sequence[Any]) -> Any:
    """Return the option at an index; a `Choice` if options are not numbers."""
    if is_plain(index):
        return options[int(index)]
    if all(isinstance(option, Vec) for option in options):
        x, y, z = (select(index, [option[i] for option in options]) for i in range(3))
        return Vec(x, y, z)
    if all(isinstance(option, Yaw) for option in options):
        return Yaw(select(index, [option.angle for option in options]))
    if all(isinstance(option, tuple) and len(option) == len(options[0]) for option in options):
        return tuple(select(index, entries) for entries in zip(*options, strict=True))
    if all(isinstance(option, Body) for option in options):
        shared = frozenset.intersection(*(option.names for option in options))
        return Body(lambda name: select(index, [o.get(name) for o in options]), shared)
    if all(is_number(option) for option in options):
        if is_plain(*options) and len(set(options)) == 1:
            return options[0]
        # A sum of masked values has the derivatives of the chosen one, and no gather.
        result = options[-1] + 0.0 * index
        for position, option in enumerate(options[:-1]):
            result = jnp.where(index == position, option, result)
        return result
    return Choice(index, tuple(options))


def is_number(value: Any) -> bool:
    """Return whether a value is a number, plain or traced."""
    return is_plain(value) or (hasattr(value, "dtype") and getattr(value, "ndim", None) == 0)


def attribute(value: Any, name: str) -> Any:
    """Return the attribute of a value, as Scenic defines it.

    **Raises:** `Unsupported` for an attribute that JAX cannot compute.
    """
    if isinstance(value, Body):
        return getattr(value, name) if name == "relativePosition" else value.get(name)
    if isinstance(value, Choice):
        return select(value.index, [attribute(option, name) for option in value.options])
    if isinstance(value, Vec | Yaw) and not name.startswith("_") and hasattr(value, name):
        return getattr(value, name)
    raise Unsupported(f"the attribute {name} of {type(value).__name__}")
