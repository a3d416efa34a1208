"""A program's own `require`s in JAX, from the text of the program.

A compiled `require` is a closure of Python, which JAX cannot trace. Its text is parsed again, by
Scenic's parser, and evaluated on traced values: arithmetic, comparisons, logic, distances, angles,
relative headings and containment in polygons. Anything else raises `Unsupported`; Scenic's own
checker then decides in Python.
"""

import ast
import inspect
import math
import operator
import sys
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp

from verifai_jax.addons.scenic import geometry
from verifai_jax.addons.scenic.compilation import Compiled
from verifai_jax.addons.scenic.graph import is_random, kind_of
from verifai_jax.addons.scenic.meaning import FUNCTIONS, Values
from verifai_jax.addons.scenic.values import (
    Body,
    Choice,
    Unsupported,
    Vec,
    Yaw,
    as_vec,
    as_yaw,
    atan2,
    attribute,
    is_number,
    is_plain,
    normalize_angle,
)

OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.Mod: operator.mod,
    ast.USub: operator.neg,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
CALLS = ("abs", "min", "max", "sin", "cos", "tan", "sqrt", "hypot", "floor", "exp", "atan2")


def conditions(compiled: Compiled) -> dict[int, ast.AST]:
    """Return the conditions of the program's `require` statements by line, as parsed by Scenic."""
    parser: Any = sys.modules["scenic.syntax.parser"]
    tree = parser.parse_string(compiled.source, "exec", filename=compiled.filename)
    found: list[Any] = [node for node in ast.walk(tree) if type(node).__name__ == "Require"]
    return {node.lineno: node.cond for node in found}


class Condition:
    """The condition of one `require`, as a function of traced values.

    **Arguments:**
    - `requirement`: the requirement as compiled by Scenic.
    - `tree`: the parsed condition.
    - `compiled`: the program.
    **Raises:** `Unsupported` for a condition in another file, whose text is not available.
    """

    def __init__(self, requirement: Any, tree: ast.AST, compiled: Compiled) -> None:
        held = inspect.getclosurevars(requirement.closure).nonlocals
        code = held["condition"].atomics()[0].closure.__code__
        if code.co_filename != compiled.filename:
            raise Unsupported("a requirement of an imported module")
        self.tree, self.ego = tree, held["ego"]
        # Variables of a scenario's `setup` are kept by the scenario.
        scenario = held["scenario"]
        local = {name: getattr(scenario, name, None) for name in getattr(scenario, "_locals", ())}
        self.bindings: Mapping[str, Any] = {**local, **held["globalBindings"]}

    def __call__(self, values: Values) -> Any:
        """Return whether the condition holds.

        **Raises:** `Unsupported` for what has no meaning in JAX.
        """
        return _truth(_Evaluation(values, self.bindings, self.ego).of(self.tree))


class _Evaluation:
    def __init__(self, values: Values, bindings: Mapping[str, Any], ego: Any) -> None:
        self.values, self.bindings, self.ego = values, bindings, ego

    def of(self, tree: ast.AST | None) -> Any:
        """Return the value of an expression; the ego object for an absent one."""
        if tree is None:
            return self._ego()
        compute = getattr(self, f"_{type(tree).__name__}", None)
        if compute is None:
            raise Unsupported(f"{type(tree).__name__} in a requirement")
        return compute(tree)

    def _ego(self) -> Any:
        if self.ego is None:
            raise Unsupported("ego, which is not defined yet")
        return self.values.body(self.ego)

    def _Constant(self, tree: Any) -> Any:
        return tree.value

    def _Name(self, tree: Any) -> Any:
        if tree.id == "ego":
            return self._ego()
        if tree.id not in self.bindings:
            raise Unsupported(f"the name {tree.id} in a requirement")
        return self.values(self.bindings[tree.id])

    def _Attribute(self, tree: Any) -> Any:
        return attribute(self.of(tree.value), tree.attr)

    def _BinOp(self, tree: Any) -> Any:
        one, other = self.of(tree.left), self.of(tree.right)
        kinds = all(is_number(value) or isinstance(value, Vec) for value in (one, other))
        if type(tree.op) not in OPERATORS or not kinds:
            raise Unsupported(f"{type(tree.op).__name__} in a requirement")
        return OPERATORS[type(tree.op)](one, other)

    def _UnaryOp(self, tree: Any) -> Any:
        value = self.of(tree.operand)
        if isinstance(tree.op, ast.Not):
            return _not(_truth(value))
        if isinstance(tree.op, ast.USub) and is_number(value):
            return -value
        raise Unsupported(f"{type(tree.op).__name__} in a requirement")

    def _BoolOp(self, tree: Any) -> Any:
        parts = [_truth(self.of(part)) for part in tree.values]
        both = isinstance(tree.op, ast.And)
        result = parts[0]
        for part in parts[1:]:
            result = jnp.logical_and(result, part) if both else jnp.logical_or(result, part)
        return result

    def _ImpliesOp(self, tree: Any) -> Any:
        hypothesis = _truth(self.of(tree.hypothesis))
        return jnp.logical_or(_not(hypothesis), _truth(self.of(tree.conclusion)))

    def _IfExp(self, tree: Any) -> Any:
        test, one, other = (self.of(part) for part in (tree.test, tree.body, tree.orelse))
        if not (is_number(one) and is_number(other)):
            raise Unsupported("a conditional expression in a requirement")
        return jnp.where(_truth(test), one, other)

    def _Compare(self, tree: Any) -> Any:
        left, result = self.of(tree.left), True
        for op, right_tree in zip(tree.ops, tree.comparators, strict=True):
            if isinstance(op, ast.In | ast.NotIn):
                held = self._within(left, right_tree)
                held = held if isinstance(op, ast.In) else _not(held)
                right = None
            else:
                right = self.of(right_tree)
                held = _compared(op, left, right)
            result = held if result is True else jnp.logical_and(result, held)
            left = right
        return result

    def _within(self, thing: Any, region_tree: Any) -> Any:
        region: Any = self.bindings.get(getattr(region_tree, "id", ""))
        if kind_of(region) == "Workspace":
            region = region.region
        polygonal = hasattr(region, "polygons") and not is_random(region)
        if region is None or not polygonal:
            raise Unsupported("containment in a region that is not a fixed polygon")
        if isinstance(thing, Body) and "width" in thing.names:
            box = geometry.rectangle_of(thing)
            return geometry.box_inside(
                box, geometry.edges_of(region.polygons), geometry.is_convex(region.polygons)
            )
        position = as_vec(thing)
        if kind_of(region) == "CircularRegion":
            return position.distanceTo(as_vec(self.values(region.center))) <= region.radius
        if kind_of(region) == "SectorRegion":
            raise Unsupported("containment in a sector")
        return geometry.point_inside(position.x, position.y, geometry.edges_of(region.polygons))

    def _Call(self, tree: Any) -> Any:
        name = getattr(tree.func, "id", "")
        bound = self.bindings.get(name)
        own = getattr(bound, "__module__", "") or ""
        standard = bound is None or own.startswith(("scenic", "math", "builtins"))
        if self.bindings.get(getattr(getattr(tree.func, "value", None), "id", "")) is math:
            name, standard = tree.func.attr, True
        if name not in CALLS or tree.keywords or not standard:
            raise Unsupported(f"the function {name or 'call'} in a requirement")
        arguments = [self.of(argument) for argument in tree.args]
        if not all(is_number(argument) for argument in arguments):
            raise Unsupported(f"the arguments of {name} in a requirement")
        return FUNCTIONS[name](*arguments)

    def _DegOp(self, tree: Any) -> Any:
        return self.of(tree.operand) * (math.pi / 180)

    def _VectorOp(self, tree: Any) -> Any:
        return Vec(self.of(tree.left), self.of(tree.right))

    def _DistanceFromOp(self, tree: Any) -> Any:
        return as_vec(self.of(tree.target)).distanceTo(self.of(tree.base))

    def _DistancePastOp(self, tree: Any) -> Any:
        base = self.of(tree.base)
        past = as_vec(base) - as_vec(self.of(tree.target))
        return past.rotatedBy(-as_yaw(base).yaw).y

    def _AngleFromOp(self, tree: Any) -> Any:
        base, target = self.of(tree.base), self.of(tree.target)
        return as_vec(base).azimuthTo(target)

    def _RelativeHeadingOp(self, tree: Any) -> Any:
        target, base = as_yaw(self.of(tree.target)), as_yaw(self.of(tree.base))
        return normalize_angle(target.yaw - base.yaw)

    def _ApparentHeadingOp(self, tree: Any) -> Any:
        target, base = self.of(tree.target), as_vec(self.of(tree.base))
        ahead = as_vec(target) - base
        azimuth = normalize_angle(atan2(ahead.y, ahead.x) - math.pi / 2)
        return normalize_angle(as_yaw(target).yaw - azimuth)


def _compared(op: ast.AST, one: Any, other: Any) -> Any:
    if type(op) not in OPERATORS:
        raise Unsupported(f"{type(op).__name__} in a requirement")
    if isinstance(op, ast.Eq | ast.NotEq) and isinstance(one, Choice) and isinstance(other, str):
        indices = [i for i, option in enumerate(one.options) if option == other]
        held = (
            jnp.isin(one.index, jnp.asarray(indices, jnp.int32)) if indices else jnp.asarray(False)
        )
        return held if isinstance(op, ast.Eq) else _not(held)
    for value in (one, other):
        if isinstance(value, Yaw | Vec | Body | Choice | tuple | str) or value is None:
            raise Unsupported("a comparison of something other than numbers in a requirement")
    return OPERATORS[type(op)](one, other)


def _truth(value: Any) -> Any:
    """Return a truth value."""
    if isinstance(value, bool) or getattr(value, "dtype", None) == jnp.bool_:
        return value
    if is_plain(value):
        return bool(value)
    if is_number(value):
        return value != 0
    raise Unsupported("a truth value of another kind in a requirement")


def _not(value: Any) -> Any:
    return (not value) if isinstance(value, bool) else jnp.logical_not(value)
