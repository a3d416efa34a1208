"""Functions of JAX over tables of constants, on sets: `jnp.interp` and `jnp.searchsorted`.

They are bisections whose passes, one by one, have wide sets. As a whole they are monotone, or
linear by pieces. They are recognised by the text of their program, and only with constant tables.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.verification.sets.form import Form, Reals, is_point, rounding, unknown
from verifai_jax.addons.verification.sets.functions import Function
from verifai_jax.addons.verification.sets.interpreter import (
    SHORTCUTS,
    Interpreter,
    Program,
    Value,
)
from verifai_jax.addons.verification.sets.whole import Whole

UNITS = 16.0
"""Error of an interpolation in units of rounding of its greatest value, which its formula with six
operations keeps below ten."""


def _shortcut(name: str) -> Callable[[Any], Any]:
    def register(function: Any) -> Any:
        SHORTCUTS[name] = function
        return function

    return register


def _table(value: Value) -> np.ndarray | None:
    """Return a vector of constants, increasing ones; None for anything else."""
    if not isinstance(value, Form) or not is_point(value) or len(value.shape) != 1:
        return None
    numbers = value.centre[0]
    if len(value.centre) > 1 or not len(numbers) or not np.isfinite(numbers).all():
        return None
    return numbers


@_shortcut("_interp")
def _interpolation(t: Interpreter, program: Program, inputs: list[Value]) -> list[Value] | None:
    if len(inputs) != 3 or getattr(program, "consts", ()):
        return None
    x, points, values = inputs
    edges, heights = _table(points), _table(values)
    if not isinstance(x, Form) or edges is None or heights is None:
        return None
    kind = rounding(x.dtype)
    gaps = np.diff(edges)
    # Closer points than these JAX takes for equal, with a jump between them.
    if len(edges) < 2 or len(edges) != len(heights) or not (gaps > 1e-6 * (1 + np.abs(
        edges[1:]
    ))).all() or not _is(program, jnp.interp, 0):  # fmt: skip
        return None
    scale = np.abs(heights).max()

    def knots(slope: Reals, low: Reals, high: Reals) -> Sequence[Reals]:
        return [np.full(low.shape, knot) for knot in edges]

    function = Function(
        lambda at: np.interp(at, edges, heights), knots, units=0.0,
        range=(heights.min() - UNITS * kind.unit * scale - kind.smallest,
               heights.max() + UNITS * kind.unit * scale + kind.smallest),
    )  # fmt: skip
    form = function(x)
    # What is taken for zero moves the argument, and with it the value by the steepest slope.
    steepest = np.abs(np.diff(heights) / gaps).max()
    margin = UNITS * kind.unit * scale + (4 * steepest + 16) * kind.smallest
    lost = unknown(*x.bounds())
    form.radius = form.radius + margin
    form.size = form.size + margin
    assert form.low is not None
    assert form.high is not None
    form.low = np.where(lost, -np.inf, form.low - margin)
    form.high = np.where(lost, np.inf, form.high + margin)
    form._bounds = form._spread = None
    return [form]


@_shortcut("searchsorted")
def _search(t: Interpreter, program: Program, inputs: list[Value]) -> list[Value] | None:
    if len(inputs) != 2 or getattr(program, "consts", ()):
        return None
    table, x = inputs
    edges = _table(table)
    if not isinstance(x, Form) or edges is None or not (np.diff(edges) >= 0).all():
        return None
    side = next((i for i in (0, 1) if _is(program, _SEARCHES[i], i)), None)
    if side is None:
        return None
    low, high = x.bounds()
    tiny = 2 * rounding(x.dtype).smallest
    word = "left" if side == 0 else "right"
    first = np.searchsorted(edges, low - tiny, side=word)
    last = np.searchsorted(edges, high + tiny, side=word)
    lost = unknown(low, high)
    dtype = np.dtype(program.out_avals[0].dtype)
    return [Whole(np.where(lost, 0, first), np.where(lost, len(edges), last), dtype)]


_SEARCHES = (partial(jnp.searchsorted, side="left"), partial(jnp.searchsorted, side="right"))


def _is(program: Program, function: Callable[..., Any], side: int) -> bool:
    """Return whether a program is that of a function of JAX for such arguments."""
    forms = tuple((form.shape, form.dtype) for form in program.in_avals)
    return _text(program) == _reference(function, forms)


@cache
def _text(program: Program) -> str:
    return str(program)


@cache
def _reference(function: Callable[..., Any], forms: tuple[Any, ...]) -> str:
    steps = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(*form) for form in forms)).jaxpr.eqns
    return str(steps[0].params.get("jaxpr")) if len(steps) == 1 else ""
