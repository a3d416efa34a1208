"""Solutions of a differential equation over one step, on sets: `flow`.

    end, during = flow(derivative, time, state, seconds)    # within a program for `Interpreter`

First a box is found that no solution leaves during the step: it contains all states that the
initial states can reach with the rates inside the box (Picard and Lindeloef). Then each solution is
its Taylor polynomial of order `ORDER` at the initial state and the next coefficient on that box.

Source: N. Nedialkov, K. Jackson, G. Corliss, Validated solutions of initial value problems for
ordinary differential equations, Applied Mathematics and Computation 105 (1999), sections 5 and 6.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jaxtyping import Array, PyTree

from verifai_jax.addons.verification.sets.form import SLACK, Form, add, joined, scaled
from verifai_jax.addons.verification.sets.interpreter import Interpreter, rule
from verifai_jax.addons.verification.sets.series import Rates
from verifai_jax.addons.verification.sets.values import Value, as_form

ORDER = 4
"""Order of the polynomials: that of the Runge-Kutta method whose step they take."""
PARTS = (1, 2, 4, 8)
"""Numbers of parts of a step, tried until no solution leaves its box."""
TRIES = 12
"""Boxes that are tried for a part of a step, each wider than the one before it by `WIDER`."""
WIDER = 0.1
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

    time = jnp.asarray(time, leaves[0].dtype)
    closed = jax.make_jaxpr(rates)(time, *leaves)
    results = _solution.bind(
        *closed.consts, time, jnp.asarray(seconds, time.dtype), *leaves,
        rates=Rates(closed.jaxpr, ORDER), text=str(closed.jaxpr), shared=len(closed.consts),
    )  # fmt: skip
    return tree.unflatten(results[: len(leaves)]), tree.unflatten(results[len(leaves) :])


@_solution.def_abstract_eval
def _forms(*operands: Any, shared: int, **params: Any) -> list[Any]:
    return [*operands[shared + 2 :]] * 2


@rule("flow")
def _flow(t: Interpreter, step: Any, inputs: list[Value]) -> list[Value]:
    shared, rates, text = (step.params[name] for name in ("shared", "rates", "text"))
    time, seconds, *state = map(as_form, inputs[shared:])
    length = float(seconds.centre.flat[0])
    # The signals of a step and its end are asked for one after the other.
    key = text, length, *map(id, inputs[:shared]), id(time), *map(id, state)
    if t.latest is None or t.latest[0] != key:
        t.latest = key, inputs, _Step(t, rates, inputs[:shared])(time, state, length)
    return list(t.latest[2])


class _Step:
    """One step of a differential equation on sets, by its rates.

    Their operands are the `shared` ones, which do not change, a time, and the arrays of a state.
    """

    def __init__(self, t: Interpreter, rates: Rates, shared: Sequence[Value]):
        self.t, self.rates = t, rates
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
                span = _hull(add(begin, Form.between(np.zeros(1), np.full(1, length), time.dtype)))
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
            now = [Form.between(low, high, span.dtype) for low, high in ends]
            (rates,) = self.rates(self.t, self.apart, [span, *now], 0)
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
        return [Form.between(low, high, span.dtype) for low, high in ends], stays

    def moved(
        self, begin: Form, span: Form, state: list[Form], box: list[Form], length: float
    ) -> tuple[list[Form], list[Form]]:
        """Return the states during a part of the step, and after it."""
        during, after = list[Form](), list(state)
        for k, terms in enumerate(self.rates(self.t, self.shared, [begin, *state], ORDER - 1), 1):
            share = np.array(length**k / k)
            after = [add(a, scaled(each, share)) for a, each in zip(after, terms, strict=True)]
        bends = self.rates(self.t, self.apart, [span, *box], ORDER)
        share = np.array(length ** (ORDER + 1) / (ORDER + 1))
        for i, (bend, last) in enumerate(zip(bends[1], bends[ORDER], strict=True)):
            after[i] = add(after[i], scaled(_hull(last), share))
            # Between its ends a solution is a chord and at most an eighth of its second derivative.
            low, high = scaled(_hull(bend), np.array(-(length**2) / 8)).bounds()
            arc = Form.between(np.minimum(low, 0), np.maximum(high, 0), span.dtype)
            during.append(add(joined(state[i], after[i]), arc))
        return during, after


def _hull(form: Form) -> Form:
    """Return the interval of a form, without what it depends on."""
    return Form.between(*form.bounds(), form.dtype)
