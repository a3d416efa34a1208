"""Calls, branches and loops, on sets."""

import numpy as np

from verifai_jax.addons.verification.sets.arrays import together
from verifai_jax.addons.verification.sets.elementwise import of_rank, select
from verifai_jax.addons.verification.sets.form import Form
from verifai_jax.addons.verification.sets.frames import framed
from verifai_jax.addons.verification.sets.interpreter import Equation, Interpreter, Program, rule
from verifai_jax.addons.verification.sets.values import Value, as_whole, constant
from verifai_jax.addons.verification.sets.whole import Whole
from verifai_jax.core.compute.fingerprint import operands_of_scan

LONG = 4
"""Steps from which a loop's own symbols are worth their cost."""
PASSES = 4096
"""Passes of a `while` after which boxes that may go on are taken to give anything."""


@rule("scan")
def _scan(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    params = step.params
    (consts, count), length = operands_of_scan(params), params["length"]
    shared, carry = inputs[:consts], inputs[consts : consts + count]
    rest = inputs[consts + count :]
    stacked = [value.unframed() if isinstance(value, Form) else value for value in rest]
    # A loop within a step leaves the symbols of that step as they are.
    inner = any(isinstance(v, Form) and v.frame is not None for v in shared)
    frames = length >= LONG and not inner and t.features > 0
    outputs: list[list[Value]] = []
    order = range(length)[::-1] if params["reverse"] else range(length)
    for i in order:
        if frames:
            carry = framed(carry, t.boxes, t.features)
        now = [v.moved(lambda a, lead, i=i: a[(slice(None),) * lead + (i,)]) for v in stacked]
        results = t.closed(params["jaxpr"], [*shared, *carry, *now])
        carry = results[:count]
        outputs.append([v.unframed() if isinstance(v, Form) else v for v in results[count:]])
    if params["reverse"]:
        outputs = outputs[::-1]
    if not outputs:
        forms = [variable.aval for variable in step.outvars[count:]]
        return [*carry, *(constant(np.zeros(form.shape), form.dtype) for form in forms)]
    stack = lambda arrays, lead: np.stack(arrays, lead)  # noqa: E731
    return [*carry, *(together(rows, stack) for rows in zip(*outputs, strict=True))]


@rule("cond")
def _cond(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    branches, (which, *operands) = step.params["branches"], inputs
    index = as_whole(which)
    if index.dtype != bool:
        low, high = (np.clip(end, 0, len(branches) - 1) for end in (index.low, index.high))
        index = Whole(low, high, index.dtype)
    first, last = int(index.low.min()), int(index.high.max())
    results = [t.closed(branches[number], operands) for number in range(first, last + 1)]
    if len(results) == 1:
        return results[0]
    shifted = Whole(index.low - first, index.high - first, index.dtype)
    return [select(of_rank(shifted, cases[0]), list(cases)) for cases in zip(*results, strict=True)]


@rule("while")
def _while(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    params = step.params
    before, inside = params["cond_nconsts"], params["body_nconsts"]
    asked, shared = inputs[:before], inputs[before : before + inside]
    reached = state = inputs[before + inside :]
    certain = started = np.zeros(1, bool)
    condition: Program = params["cond_jaxpr"]
    for _ in range(PASSES):
        (goes_on,) = t.closed(condition, [*asked, *state])
        on = as_whole(goes_on)
        # Boxes that may end here, and have not ended for certain before.
        ends, old = ~on.true & ~certain, reached
        reached = state
        if started.any():
            which = Whole((ends & ~started).astype(np.int64), ends.astype(np.int64),
                          np.dtype(bool))  # fmt: skip
            pairs = zip(old, state, strict=True)
            reached = [select(of_rank(which, a), [a, b]) for a, b in pairs]
        started, certain = started | ends, certain | on.false
        if np.all(certain):
            return reached
        state = t.closed(params["body_jaxpr"], [*shared, *state])
    raise NotImplementedError(f"a loop that may take more than {PASSES} passes")
