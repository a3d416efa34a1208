"""Random expressions of JAX with boxes of all sizes, and their values in two arithmetics."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special

from verifai_jax.addons.verification.sets import Form, Interpreter

POINTS = 64
WIDE = np.longdouble
"""Real arithmetic, as far as tests need it: 64 bits of mantissa on x86, 113 on others."""

ONE: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "neg": (lambda x: -x, lambda x: -x),
    "abs": (jnp.abs, np.abs),
    "square": (jnp.square, np.square),
    "cube": (lambda x: x**3, lambda x: x**3),
    "inverse square": (lambda x: jax.lax.integer_pow(x, -2), lambda x: 1 / (x * x)),
    "sqrt": (jnp.sqrt, np.sqrt),
    "rsqrt": (jax.lax.rsqrt, lambda x: 1 / np.sqrt(x)),
    "cbrt": (jnp.cbrt, np.cbrt),
    "exp": (jnp.exp, np.exp),
    "exp2": (jnp.exp2, np.exp2),
    "expm1": (jnp.expm1, np.expm1),
    "log": (jnp.log, np.log),
    "log1p": (jnp.log1p, np.log1p),
    "tanh": (jnp.tanh, np.tanh),
    "logistic": (jax.nn.sigmoid, lambda x: 1 / (1 + np.exp(-x))),
    "relu": (jax.nn.relu, lambda x: np.maximum(x, 0)),
    "softplus": (jax.nn.softplus, lambda x: np.logaddexp(x, 0)),
    "sin": (jnp.sin, np.sin),
    "cos": (jnp.cos, np.cos),
    "tan": (jnp.tan, np.tan),
    "asin": (jnp.arcsin, np.arcsin),
    "acos": (jnp.arccos, np.arccos),
    "atan": (jnp.arctan, np.arctan),
    "sinh": (jnp.sinh, np.sinh),
    "cosh": (jnp.cosh, np.cosh),
    "asinh": (jnp.arcsinh, np.arcsinh),
    "acosh": (jnp.arccosh, np.arccosh),
    "atanh": (jnp.arctanh, np.arctanh),
    "erf": (jax.lax.erf, lambda x: special.erf(x.astype(float)).astype(WIDE)),
    "sign": (jnp.sign, np.sign),
    "floor": (jnp.floor, np.floor),
    "ceil": (jnp.ceil, np.ceil),
    "round": (jnp.round, np.round),
    "clip": (lambda x: jnp.clip(x, -0.75, 1.25), lambda x: np.clip(x, -0.75, 1.25)),
}  # fmt: skip
TWO: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "add": (jnp.add, np.add),
    "sub": (jnp.subtract, np.subtract),
    "mul": (jnp.multiply, np.multiply),
    "div": (jnp.divide, np.divide),
    "max": (jnp.maximum, np.maximum),
    "min": (jnp.minimum, np.minimum),
    "rem": (jax.lax.rem, np.fmod),
    "atan2": (jnp.arctan2, np.arctan2),
    "pow": (jnp.power, np.power),
    "where": (lambda x, y: jnp.where(x < y, x * 2, y), lambda x, y: np.where(x < y, x * 2, y)),
}
JUMPS = ("sign", "floor", "ceil", "round", "rem", "where", "atan2")
"""Functions that jump: rounding may take a number to the other side."""


class Expression(NamedTuple):
    """A tree: an operation with operands, or the number of an input, or a constant."""

    name: str
    parts: tuple[Any, ...]

    def __call__(self, inputs: Any, side: int) -> Any:
        """Evaluate in JAX (side 0) or NumPy (side 1)."""
        if self.name == "input":
            return inputs[self.parts[0]]
        if self.name == "constant":
            value = np.float32(self.parts[0])
            return jnp.full_like(inputs[0], value) if side == 0 else np.full_like(inputs[0], value)
        function = (ONE | TWO)[self.name][side]
        return function(*(part(inputs, side) for part in self.parts))

    def __str__(self) -> str:
        return f"{self.name}({', '.join(map(str, self.parts))})"

    def names(self) -> set[str]:
        """Return all operations in it."""
        return {self.name}.union(*(p.names() for p in self.parts if isinstance(p, Expression)))


def expression(random: np.random.Generator, depth: int) -> Expression:
    """Draw an expression."""
    if depth == 0 or random.random() < 0.15:
        if random.random() < 0.2:
            return Expression("constant", (float(_size(random)),))
        return Expression("input", (int(random.integers(3)),))
    names = [*ONE] if random.random() < 0.5 else [*TWO] * 2
    name = names[int(random.integers(len(names)))]
    count = 1 if name in ONE else 2
    return Expression(name, tuple(expression(random, depth - 1) for _ in range(count)))


def _size(random: np.random.Generator) -> float:
    sizes = [1.0] * 12 + [1e-3, 1e3, 1e-38, 1e-41, 1e38, 1e-20, 1e20, 0.0, 1e5]
    return float(random.normal() * sizes[int(random.integers(len(sizes)))])


def boxes(random: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw boxes of three numbers: narrow and wide, at zero, tiny and huge."""
    centre = np.array([[_size(random) for _ in range(3)] for _ in range(count)])
    width = np.array([[abs(_size(random)) * 10.0 ** -random.integers(0, 8) for _ in range(3)]
                      for _ in range(count)])  # fmt: skip
    ends = np.clip(np.stack([centre - width, centre + width]), -3e38, 3e38).astype(np.float32)
    # Ends at exactly zero, which wraps many functions.
    ends[0][random.random((count, 3)) < 0.1] = 0.0
    low, high = ends.min(0), ends.max(0)
    return low.astype(float), high.astype(float)


def points(random: np.random.Generator, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Draw float32 points `[3, boxes, POINTS]` of boxes, with their corners."""
    share = random.random((3, len(low), POINTS))
    share[:, :, : POINTS // 2] = np.round(share[:, :, : POINTS // 2])
    low, high = low.T[:, :, None], high.T[:, :, None]
    drawn = (low + share * (high - low)).astype(np.float32)
    return np.clip(drawn, low, high).astype(np.float32)


def enclosed(tree: Expression, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of an expression over boxes."""
    form = jax.ShapeDtypeStruct((), jnp.float32)
    program = jax.make_jaxpr(lambda *inputs: tree(inputs, 0))(form, form, form)
    leaves = [
        Form.leaf(low[:, j], high[:, j], np.eye(3)[:, j], np.dtype(np.float32)) for j in range(3)
    ]
    (value,) = Interpreter(len(low), 3)(program, leaves)
    ends = value.bounds()
    return tuple(np.broadcast_to(end, len(low)) for end in ends)


def _xla_fails(tree: Expression, drawn: np.ndarray) -> np.ndarray:
    """Return at which points XLA gives NaN for arcs of subnormal numbers, as JAX 0.12's does."""
    subnormal = (drawn != 0) & (np.abs(drawn) < np.finfo(np.float32).tiny)
    arcs = any(name in str(tree) for name in ("asin", "atan"))
    return subnormal.any(axis=0) & (arcs and bool(jnp.isnan(jnp.arctan(np.float32(1e-39)))))


def escapes(tree: Expression, low: np.ndarray, high: np.ndarray, drawn: np.ndarray) -> list[str]:
    """Return which values lie outside of their bounds, as sentences."""
    least, greatest = enclosed(tree, low, high)
    found = []
    with np.errstate(all="ignore"):
        single = np.asarray(tree(tuple(map(jnp.asarray, drawn)), 0)).astype(float)
        exact = np.asarray(tree(tuple(drawn.astype(WIDE)), 1)).astype(float)
    for kind, values in (("float32", single), ("real", exact)):
        known = (least > -np.inf) | (greatest < np.inf)
        wrong = (values < least[:, None]) | (values > greatest[:, None])
        if kind == "float32":
            wrong |= np.isnan(values) & known[:, None] & ~_xla_fails(tree, drawn)
            wrong |= np.isinf(values) & ~np.where(
                values > 0, np.isinf(greatest)[:, None], np.isinf(least)[:, None]
            )
        for box, point in zip(*np.nonzero(wrong), strict=True):
            found.append(
                f"{kind}: {tree} at {drawn[:, box, point].tolist()} in {low[box].tolist()}, "
                f"{high[box].tolist()} is {values[box, point]}, not in "
                f"[{least[box]}, {greatest[box]}]"
            )
            break
    return found
