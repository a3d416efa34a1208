"""Meaning of Scenic's nodes in JAX: a planar program becomes a function of arrays.

    tracer = Tracer(sampling)
    tracer.at(features)(node)                           # a number, `Vec`, `Yaw`, `Body` ...

A node without an entry here raises `Unsupported`, with its name.
"""

import operator
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.scenic.graph import field, is_constructed, is_random, kind_of, law
from verifai_jax.addons.scenic.leaves import OnPolyline
from verifai_jax.addons.scenic.sampling import Sampling
from verifai_jax.addons.scenic.values import (
    Body,
    Choice,
    Unsupported,
    Vec,
    Yaw,
    as_vec,
    as_yaw,
    attribute,
    from_euler,
    function,
    hypot,
    is_number,
    is_plain,
    normalize_angle,
    select,
)


def _reversed(op: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    return lambda one, other: op(other, one)


def _extreme(plain: Callable[..., Any], traced: Callable[..., Any]) -> Callable[..., Any]:
    def extreme(*values: Any, **options: Any) -> Any:
        if options:
            raise Unsupported("a key of min or max")
        values = values[0] if len(values) == 1 and isinstance(values[0], tuple) else values
        if is_plain(*values):
            return plain(values)
        result = values[0]
        for value in values[1:]:
            result = traced(result, value)
        return result

    return extreme


ARITHMETIC: dict[str, Callable[[Any, Any], Any]] = {
    f"__{prefix}{name}__": _reversed(op) if prefix else op
    for name, op in (
        ("add", operator.add),
        ("sub", operator.sub),
        ("mul", operator.mul),
        ("truediv", operator.truediv),
        ("floordiv", operator.floordiv),
        ("mod", operator.mod),
        ("pow", operator.pow),
    )
    for prefix in ("", "r")
}
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "normalizeAngle": normalize_angle,
    "Orientation.fromEuler": lambda _, *angles: from_euler(*angles),
    "Orientation.localAnglesFor": lambda one, other: as_yaw(one).localAnglesFor(other),
    "Orientation.globalToLocalAngles": lambda one, *angles: as_yaw(one).globalToLocalAngles(
        *angles
    ),
    "Orientation.__mul__": operator.mul,
    "Orientation.__add__": operator.mul,
    "Orientation.__radd__": _reversed(operator.mul),
    "directionalSpecHelper.<locals>.makeContactOffset": lambda dist, tolerance: (
        tolerance / 2 if dist is None else 0.0
    ),
    "max": _extreme(max, jnp.maximum),
    "min": _extreme(min, jnp.minimum),
    "hypot": hypot,
    **{name: function(name) for name in ("sin", "cos", "tan", "sqrt", "exp", "atan2", "floor")},
    "abs": abs,
}
"""Functions by their qualified names."""


class Tracer:
    """Values of a program's nodes at given features, as traced by JAX."""

    def __init__(self, sampling: Sampling) -> None:
        self.sampling = sampling

    def at(self, features: Mapping[str, Any]) -> "Values":
        """Return the values at these features."""
        return Values(self.sampling, features)


class Values:
    """Values of nodes at one point, each computed once."""

    def __init__(self, sampling: Sampling, features: Mapping[str, Any]) -> None:
        self.sampling, self.features = sampling, features
        self._known: dict[int, Any] = {}

    def __call__(self, node: Any) -> Any:
        """Return the value of a node, or of a constant.

        **Raises:** `Unsupported` where it has none in JAX.
        """
        if not is_random(node):
            return self._constant(node)
        known = self._known.get(id(node))
        if known is None:
            try:
                known = self._computed(node)
            except Unsupported as error:
                known = error
            self._known[id(node)] = known
        if isinstance(known, Unsupported):
            raise known
        return known

    def body(self, node: Any) -> Body:
        """Return an object, whether or not it is random."""
        if id(node) in self.sampling.seeded:
            raise Unsupported(self.sampling.seeded[id(node)])
        source = law(node) if is_random(node) else node
        return Body(lambda name: self(field(source, name)), frozenset(source.properties))

    def _constant(self, value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()  # One of NumPy would decide the precision.
        if isinstance(value, bool | str | int | float) or value is None:
            return value
        if isinstance(value, tuple | list):
            return tuple(self(entry) for entry in value)
        match kind_of(value):
            case "Vector":
                return Vec(*value.coordinates)
            case "OrientedVector":
                return Vec(*value.coordinates, heading=value.heading)
            case "Orientation":
                return from_euler(*(float(angle) for angle in value.eulerAngles))
            case "ConstantSamplable":
                return self._constant(field(value, "value"))
        if is_constructed(value):
            return self.body(value)
        return value

    def _computed(self, node: Any) -> Any:
        if id(node) in self.sampling.seeded:
            raise Unsupported(self.sampling.seeded[id(node)])
        if is_constructed(node):
            return self.body(node)
        leaf = self.sampling.leaves.get(id(node))
        if leaf is not None:
            parts = {name: self.features[name] for name in leaf.domains}
            value = leaf.draw(parts, self, jnp)
            if not leaf.is_point:
                return value
            heading = None
            if isinstance(leaf, OnPolyline):
                region = field(law(node), "region")
                heading = leaf.heading(parts, jnp) if region._usingDefaultOrientation else None
            return Vec(value[0], value[1], _height(node), heading)
        drawn = law(node)
        compute: Any = getattr(self, f"_{kind_of(drawn)}", None)
        if compute is None:
            raise Unsupported(kind_of(drawn))
        return compute(drawn)

    def _Vector(self, node: Any) -> Any:
        return Vec(*(self(coordinate) for coordinate in field(node, "coordinates")))

    def _OrientedVector(self, node: Any) -> Any:
        vector = self._Vector(node)
        return Vec(vector.x, vector.y, vector.z, self(field(node, "heading")))

    def _TupleDistribution(self, node: Any) -> Any:
        return tuple(self(entry) for entry in field(node, "coordinates"))

    def _AttributeDistribution(self, node: Any) -> Any:
        return attribute(self(field(node, "object")), field(node, "attribute"))

    def _MultiplexerDistribution(self, node: Any) -> Any:
        options = [self(option) for option in field(node, "options")]
        return select(self(field(node, "index")), options)

    _Options = _VerifaiOptions = _MultiplexerDistribution

    def _TypecheckedDistribution(self, node: Any) -> Any:
        value, kind = self(field(node, "_dist")), field(node, "_valueType")
        name = getattr(kind, "__name__", str(kind))
        if name == "Orientation":
            return as_yaw(value)
        if name == "Vector":
            return as_vec(value)
        if name in ("float", "int") and is_number(value):
            return value
        if name == "Heading":
            return as_yaw(value).yaw if not is_number(value) else value
        raise Unsupported(f"a value of type {name}")

    def _OperatorDistribution(self, node: Any) -> Any:
        if field(node, "kwoperands"):
            raise Unsupported("an operator with keywords")
        first = self(field(node, "object"))
        return self._applied(field(node, "operator"), first, field(node, "operands"))

    def _VectorOperatorDistribution(self, node: Any) -> Any:
        first = as_vec(self(field(node, "object")))
        return self._applied(field(node, "operator"), first, field(node, "operands"))

    def _applied(self, name: str, first: Any, operands: Any) -> Any:
        rest = [self(operand) for operand in operands]
        if name == "__call__" and callable(first):
            return first(*rest)
        if name == "__getitem__" and isinstance(first, tuple | Vec) and is_plain(*rest):
            return first[int(rest[0])]
        if name in ("__neg__", "__abs__", "__pos__") and is_number(first):
            return getattr(operator, name)(first)
        if name in ARITHMETIC and len(rest) == 1:
            kinds = (first, rest[0])
            if all(is_number(value) or isinstance(value, Vec | Yaw) for value in kinds):
                return ARITHMETIC[name](*kinds)
        if isinstance(first, Vec | Yaw | Body) and not name.startswith("_"):
            return attribute(first, name)(*rest)
        raise Unsupported(f"the operator {name}")

    def _MethodDistribution(self, node: Any) -> Any:
        if field(node, "kwargs"):
            raise Unsupported("a method with keywords")
        method, owner = field(node, "method"), field(node, "object")
        if kind_of(owner) == "VectorField" and method.__name__ == "__getitem__":
            return self._at_field(owner, field(node, "arguments")[0])
        first = self(owner)
        if isinstance(first, Vec | Yaw | Body):
            return self._applied(method.__name__, first, field(node, "arguments"))
        raise Unsupported(f"the method {method.__name__} of {kind_of(owner)}")

    _VectorMethodDistribution = _MethodDistribution

    def _at_field(self, owner: Any, where: Any) -> Any:
        """Return the direction of a line at the point of it that is nearest."""
        line: Any = getattr(owner.value, "__self__", None)
        if kind_of(line) != "PolylineRegion":
            raise Unsupported(f"the vector field {owner.name}")
        position = as_vec(self(where))
        if position.heading is not None:
            return Yaw(position.heading)
        starts, ends = (
            np.array([segment[end][:2] for segment in line.segments], np.float32) for end in (0, 1)
        )
        ahead = ends - starts
        square = np.sum(ahead * ahead, axis=1)
        offset = jnp.stack([position.x - starts[:, 0], position.y - starts[:, 1]], axis=1)
        share = jnp.clip(jnp.sum(offset * ahead, axis=1) / square, 0, 1)
        gap = offset - share[:, None] * ahead
        nearest = jnp.argmin(jnp.sum(gap * gap, axis=1))
        headings = np.arctan2(ahead[:, 1], ahead[:, 0]) - np.pi / 2
        return Yaw(jnp.asarray(headings)[nearest])

    def _FunctionDistribution(self, node: Any) -> Any:
        made = field(node, "function")
        name = getattr(made, "__qualname__", repr(made))
        if name not in FUNCTIONS:
            raise Unsupported(f"the function {name}")
        arguments = [
            argument if isinstance(argument, type) else self(argument)
            for argument in field(node, "arguments")
        ]
        if any(kind_of(argument) == "StarredDistribution" for argument in arguments):
            raise Unsupported("an argument list of random length")
        options = {key: self(value) for key, value in (field(node, "kwargs") or {}).items()}
        return FUNCTIONS[name](*arguments, **options)


def _height(node: Any) -> float:
    height = getattr(field(law(node), "region"), "z", 0.0)
    if is_random(height) or not is_plain(height):
        return 0.0
    return float(height)


def as_output(value: Any) -> Any:
    """Return a value as one number for a system; for an option that is not a number, its index.

    **Raises:** `Unsupported` for anything else.
    """
    if isinstance(value, Choice):
        return value.index
    if isinstance(value, bool):
        return float(value)
    if is_number(value):
        return value
    raise Unsupported(f"a value that is not a number ({type(value).__name__})")
