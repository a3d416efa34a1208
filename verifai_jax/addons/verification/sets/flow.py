"""Solutions of a differential equation over one step, on sets: `flow`.

    end, during = flow(derivative, time, state, seconds)    # within a program for `Interpreter`

First a box is found that no solution leaves during the step: it contains all states that the
initial states can reach with the rates inside the box (Picard and Lindeloef). Then each solution is
its Taylor polynomial of order `ORDER` at the initial state, a sum of forms, and a remainder, the
next coefficient on that box. So results hold for the differential equation itself, in real
arithmetic.

Source: N. Nedialkov, K. Jackson, G. Corliss, Validated solutions of initial value problems for
ordinary differential equations, Applied Mathematics and Computation 105 (1999), sections 5 and 6.
"""

import contextlib
import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental.jet import jet
from jax.extend.core import Primitive
from jaxtyping import Array, PyTree

from verifai_jax.addons.verification.sets.form import SLACK, Form, Reals, add, joined, scaled
from verifai_jax.addons.verification.sets.interpreter import (
    Equation,
    Interpreter,
    MissingRule,
    Program,
    Value,
    as_form,
    rule,
)
from verifai_jax.core.compute.fingerprint import without_unused
from verifai_jax.core.compute.jaxprs import called, run_through
from verifai_jax.core.user_code.user_errors import source_line

ORDER = 4
"""Order of the polynomials: that of the Runge-Kutta method whose step they take."""
PARTS = (1, 2, 4, 8)
"""Numbers of parts of a step, tried until no solution leaves its box."""
TRIES = 12
"""Boxes that are tried for a part of a step, each wider than the one before it by `WIDER`."""
WIDER = 0.1
SMOOTH = frozenset({
    "acosh", "add", "add_any", "asinh", "atan2", "atanh", "broadcast_in_dim", "concatenate", "copy",
    "convert_element_type", "cos", "cosh", "cumsum", "div", "dot_general", "erf", "erfc", "exp",
    "expm1", "integer_pow", "log", "log1p", "logistic", "mul", "neg", "pow", "reduce_sum",
    "reshape", "rev", "rsqrt", "sin", "sinh", "slice", "split", "sqrt", "square", "squeeze",
    "stack", "sub", "tanh", "transpose", "unstack",
})  # fmt: skip
"""Operations with derivatives of all orders that jax.experimental.jet knows."""
CHOOSING = {"select_n": (1, None), "dynamic_slice": (0, 1), "gather": (0, 1)}
"""Operations that are smooth in these operands alone; the others choose among them."""
_solution = Primitive("flow")
_solution.multiple_results = True


def flow(
    derivative: Callable[[Any, PyTree], PyTree], time: Any, state: PyTree, seconds: Any
) -> tuple[PyTree, PyTree]:
    """Return enclosures of solutions after some seconds, and at all times until then.

    **Raises:** `MissingRule` for dynamics that are not smooth, with the operation and its line.
    """
    leaves, tree = jax.tree.flatten(state)

    def rates(time: Array, *leaves: Array) -> list[Array]:
        return jax.tree.leaves(derivative(time, tree.unflatten(leaves)))

    def derivatives(time: Array, *leaves: Array) -> list[list[Array]]:
        found = [rates(time, *leaves)]
        for order in range(1, ORDER + 1):
            clock = [jnp.ones_like(time), *[jnp.zeros_like(time)] * (order - 1)]
            series = [clock, *(list(each) for each in zip(*found, strict=True))]
            found.append([last[-1] for last in jet(rates, (time, *leaves), series)[1]])
        return found

    time = jnp.asarray(time, leaves[0].dtype)
    plain = jax.make_jaxpr(rates)(time, *leaves)
    _varying(plain.jaxpr, [True] * (1 + len(leaves)))
    closed = jax.make_jaxpr(derivatives)(time, *leaves)
    closed = jax.make_jaxpr(partial(_evaluated_once, closed.jaxpr, closed.consts))(time, *leaves)
    results = _solution.bind(
        *closed.consts, time, jnp.asarray(seconds, time.dtype), *leaves, program=closed.jaxpr,
        text=str(closed.jaxpr), shared=len(closed.consts),
    )  # fmt: skip
    return tree.unflatten(results[: len(leaves)]), tree.unflatten(results[len(leaves) :])


@_solution.def_abstract_eval
def _forms(*operands: Any, shared: int, **params: Any) -> list[Any]:
    return [*operands[shared + 2 :]] * 2


def _varying(program: Program, inputs: Sequence[bool]) -> list[bool]:
    """Return which results depend on time or state, and refuse what is not smooth in them."""

    def step(each: Equation, operands: list[bool]) -> list[bool]:
        inner, name = called(each), each.primitive.name
        if inner is not None:
            return _varying(getattr(inner, "jaxpr", inner), operands)
        first, last = CHOOSING.get(name, (0, None))
        choices = operands[:first] + ([] if last is None else operands[last:])
        real = all(jnp.issubdtype(out.aval.dtype, jnp.floating) for out in each.outvars)
        smooth = name in SMOOTH or (name in CHOOSING and not any(choices))
        if any(operands) and not (smooth and real):
            line = source_line(each.source_info.traceback)
            raise MissingRule(
                f"the dynamics apply {name} to the state or the time{f' ({line})' * bool(line)}, "
                "which is not smooth, or has no Taylor series here: continuous=True needs smooth "
                "dynamics; move switching and saturation into the controller"
            )
        return [any(operands)] * len(each.outvars)

    constants = [False] * len(program.constvars)
    return run_through(program, constants, inputs, lambda _: False, step)


def _evaluated_once(program: Program, constants: Sequence[Any], *inputs: Array) -> list[Any]:
    """Run a program, what is computed twice once, and factorials and other constants now."""
    known: dict[Any, Any] = {}

    def step(each: Equation, operands: list[Any]) -> Sequence[Any]:
        inner = called(each)
        if inner is not None:
            inner, consts = getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())
            return run_through(inner, consts, operands, lambda one: one.val, step)
        key = each.primitive, str(each.params), *(
            id(one) if isinstance(one, Tracer) or np.ndim(one)
            else (str(one), type(one), getattr(one, "dtype", None))
            for one in operands
        )  # fmt: skip
        if key not in known:
            with contextlib.ExitStack() as stack:
                if not any(isinstance(one, Tracer) for one in operands):
                    stack.enter_context(jax.ensure_compile_time_eval())
                found = each.primitive.bind(*operands, **each.params)
                found = found if each.primitive.multiple_results else [found]
                # As numbers of the program's text they are the same wherever it is traced.
                if not any(isinstance(one, Tracer) for one in found):
                    found = [np.asarray(one) for one in found]
            # The operands live on, so that no other number gets the same identity.
            known[key] = operands, found
        return known[key][1]

    return run_through(program, constants, inputs, lambda one: one.val, step)


@rule("flow")
def _flow(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    shared, program, text = (step.params[name] for name in ("shared", "program", "text"))
    time, seconds, *state = map(as_form, inputs[shared:])
    length = float(seconds.centre.flat[0])
    # The signals of a step and its end are asked for one after the other.
    key = text, length, *map(id, inputs[:shared]), id(time), *map(id, state)
    if t.latest is None or t.latest[0] != key:
        step_of = _Step(t, program, inputs[:shared], len(state))
        t.latest = key, inputs, step_of(time, state, length)
    return list(t.latest[2])


@lru_cache(maxsize=64)
def _part(program: Program, count: int, orders: tuple[int, ...]) -> Program:
    """Return what computes the derivatives of some orders, of `count` arrays of a state."""
    wanted = [i // count + 1 in orders for i in range(len(program.outvars))]
    whole = program.replace(constvars=[], invars=[*program.constvars, *program.invars])
    return without_unused(whole, wanted)


class _Step:
    """One step of a differential equation on sets, by a program of all derivatives of a state.

    Its operands are the `shared` ones, which do not change, a time, and `count` arrays of a state.
    """

    def __init__(self, t: Interpreter, program: Program, shared: Sequence[Value], count: int):
        def some(*orders: int) -> Callable[..., list[Form]]:
            part = _part(program, count, orders)
            return lambda shared, time, state: [
                *map(as_form, t.closed(part, [*shared, time, *state]))
            ]

        self.rates, self.terms = some(1), some(*range(1, ORDER + 1))
        self.bounded = some(2, ORDER + 1)
        self.boxes, self.shared = t.boxes, shared
        self.apart = [_hull(v) if isinstance(v, Form) else v for v in shared]

    def __call__(self, time: Form, state: list[Form], seconds: float) -> list[Value]:
        """Return the state after some seconds, and that at all times until then."""
        if not seconds:
            return [*state, *state]
        lost = self.unbounded(state)
        for parts in PARTS:
            length, now, during, fine = seconds / parts, state, state, np.ones(self.boxes, bool)
            for i in range(parts):
                begin = add(time, Form.constant(np.array(i * length), time.dtype))
                span = _hull(add(begin, _between(np.zeros(1), np.full(1, length), time)))
                box, stays = self.box(span, now, length)
                fine &= stays
                if parts < PARTS[-1] and not (fine | lost).all():
                    break
                tube, now = self.moved(begin, span, now, box, length)
                during = [*map(joined, during, tube)] if i else tube
            if (fine | lost).all():
                break
        for form in (*now, *during):
            nothing = ~fine.reshape(-1, *(1,) * len(form.shape))
            shape = np.broadcast_shapes(nothing.shape, form.radius.shape)
            form.forget(np.broadcast_to(nothing, shape))
        return [*now, *during]

    def unbounded(self, state: list[Form]) -> np.ndarray:
        """Return for which boxes of the batch the state is unbounded."""
        lost = np.zeros(self.boxes, bool)
        for form in state:
            low, high = form.bounds()
            lost |= ~np.isfinite(high - low).reshape(len(low), -1).all(1)
        return lost

    def box(self, span: Form, state: list[Form], length: float) -> tuple[list[Form], np.ndarray]:
        """Return a box that no solution leaves, and for which boxes of the batch it is valid."""
        begins = [form.bounds() for form in state]
        ends, lost, stays = begins, self.unbounded(state), np.zeros(self.boxes, bool)
        for _ in range(TRIES):
            now = [_between(low, high, span) for low, high in ends]
            rates = self.rates(self.apart, span, now)
            reached, inside = [], np.ones(self.boxes, bool)
            for (low, high), end, rate in zip(begins, ends, rates, strict=True):
                slowest, fastest = rate.bounds()
                slack = 4 * SLACK * (np.abs(low) + np.abs(high) + length * np.maximum(
                    np.abs(slowest), np.abs(fastest)
                ))  # fmt: skip
                low = low + np.minimum(length * slowest, 0) - slack
                high = high + np.maximum(length * fastest, 0) + slack
                reached.append((low, high))
                within = (end[0] <= low) & (high <= end[1]) & np.isfinite(high - low)
                inside &= within.reshape(len(within), -1).all(1)
            stays |= inside
            wider = []
            for (low, high), (first, last) in zip(reached, ends, strict=True):
                margin = WIDER * (high - low) + 1e-12 * (np.abs(low) + np.abs(high))
                rank = (-1, *(1,) * (low.ndim - 1))
                ours, kept = inside.reshape(rank), stays.reshape(rank)
                # What is reached from within a box is one, too, and smaller.
                low = np.where(ours, low, np.where(kept, first, np.minimum(low - margin, first)))
                high = np.where(ours, high, np.where(kept, last, np.maximum(high + margin, last)))
                wider.append((low, high))
            ends = wider
            if (stays | lost).all():
                break
        return [_between(low, high, span) for low, high in ends], stays

    def moved(
        self, begin: Form, span: Form, state: list[Form], box: list[Form], length: float
    ) -> tuple[list[Form], list[Form]]:
        """Return the states during a part of the step, and after it."""
        terms, count = self.terms(self.shared, begin, state), len(state)
        during, after = list[Form](), list(state)
        for k in range(ORDER):
            share = np.array(length ** (k + 1) / math.factorial(k + 1))
            for i, term in enumerate(terms[k * count : (k + 1) * count]):
                after[i] = add(after[i], scaled(term, share))
        share = np.array(length ** (ORDER + 1) / math.factorial(ORDER + 1))
        bends = self.bounded(self.apart, span, box)
        for i, (bend, last) in enumerate(zip(bends[:count], bends[count:], strict=True)):
            after[i] = add(after[i], scaled(_hull(last), share))
            # Between its ends a solution is a chord and at most an eighth of its second derivative.
            low, high = scaled(_hull(bend), np.array(-(length**2) / 8)).bounds()
            arc = _between(np.minimum(low, 0), np.maximum(high, 0), span)
            during.append(add(joined(state[i], after[i]), arc))
        return during, after


def _between(low: Reals, high: Reals, like: Form) -> Form:
    return Form.between(low, high, like.dtype)


def _hull(form: Form) -> Form:
    """Return the interval of a form, without what it depends on."""
    return Form.between(*form.bounds(), form.dtype)
