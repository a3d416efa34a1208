"""Functions that sets do not go into: `jnp.interp`, `jnp.searchsorted` and `sin_cos`.

Those over tables are bisections whose passes have wide sets. As a whole they are monotone, or
linear by pieces. They are recognised by the text of their program, and only with constant tables.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.verification.sets.form import Form, Reals, is_point, rounding, unknown
from verifai_jax.addons.verification.sets.functions import FUNCTIONS, Function
from verifai_jax.addons.verification.sets.interpreter import SHORTCUTS, Interpreter, Program
from verifai_jax.addons.verification.sets.values import Value, as_form
from verifai_jax.addons.verification.sets.whole import Whole
from verifai_jax.core.compute.jaxprs import called
from verifai_jax.systems.ode import sin_cos

UNITS = 16.0
"""Error of an interpolation in units of rounding of its greatest value, which its formula with six
operations keeps below ten."""


def _table(value: Value) -> np.ndarray | None:
    """Return a vector of constants, increasing ones; None for anything else."""
    if not isinstance(value, Form) or not is_point(value) or len(value.shape) != 1:
        return None
    numbers = value.centre[0]
    if len(value.centre) > 1 or not len(numbers) or not np.isfinite(numbers).all():
        return None
    return numbers


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
    apart = len(edges) > 1 and (gaps > 1e-6 * (1 + np.abs(edges[1:]))).all()
    if not apart or len(edges) != len(heights) or not _is(program, jnp.interp):
        return None
    scale = np.abs(heights).max()

    def knots(slope: Reals, low: Reals, high: Reals) -> Sequence[Reals]:
        return [np.full(low.shape, knot) for knot in edges]

    # What is taken for zero moves the argument, and with it the value by the steepest slope.
    steepest = np.abs(np.diff(heights) / gaps).max()
    margin = UNITS * kind.unit * scale + (4 * steepest + 16) * kind.smallest
    function = Function(
        lambda at: np.interp(at, edges, heights), knots, units=1.0, tiny=margin / kind.smallest,
        range=(heights.min() - margin, heights.max() + margin),
    )  # fmt: skip
    return [function(x)]


def _search(t: Interpreter, program: Program, inputs: list[Value]) -> list[Value] | None:
    if len(inputs) != 2 or getattr(program, "consts", ()):
        return None
    table, x = inputs
    edges = _table(table)
    if not isinstance(x, Form) or edges is None or not (np.diff(edges) >= 0).all():
        return None
    word = next((word for word, search in _SEARCHES.items() if _is(program, search)), None)
    if word is None:
        return None
    low, high = x.bounds()
    tiny = 2 * rounding(x.dtype).smallest
    first = np.searchsorted(edges, low - tiny, side=word)
    last = np.searchsorted(edges, high + tiny, side=word)
    lost = unknown(low, high)
    dtype = np.dtype(program.out_avals[0].dtype)
    return [Whole(np.where(lost, 0, first), np.where(lost, len(edges), last), dtype)]


_SEARCHES: Any = {side: partial(jnp.searchsorted, side=side) for side in ("left", "right")}


def _sin_cos(t: Interpreter, program: Program, inputs: list[Value]) -> list[Value] | None:
    """Not inside: it reduces its argument by whole quarter turns, which boxes have several of."""
    if len(inputs) != 1 or program.consts or not _is(program, sin_cos):
        return None
    angle, results = as_form(inputs[0]), []
    low, high = angle.bounds()
    for name in ("sin", "cos"):
        form = FUNCTIONS[name](angle)
        # Its error is 1.2e-7, and beyond 1e5 it is NaN.
        form.radius, form.common = form.radius + 2.4e-7, None
        if form.low is not None and form.high is not None:
            form.low, form.high = form.low - 2.4e-7, form.high + 2.4e-7
        form.forget((low < -1e5) | (high > 1e5))
        results.append(form)
    return results


SHORTCUTS |= {"_interp": _interpolation, "searchsorted": _search, "custom_jvp_call": _sin_cos}


@cache
def _is(program: Program, function: Callable[..., Any]) -> bool:
    """Return whether a program is that of a function of JAX for such arguments."""
    forms = tuple((form.shape, form.dtype) for form in program.in_avals)
    return str(program) == _reference(function, forms)


@cache
def _reference(function: Callable[..., Any], forms: tuple[Any, ...]) -> str:
    steps = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(*form) for form in forms)).jaxpr.eqns
    return str(called(steps[0])) if len(steps) == 1 else ""
