"""One temperature for signals of different units: predicates in units of their own scale.

normalize(f, {"x": 2.4, "theta": 0.2095})        # abs(x) / 2.4 <= 1 & abs(theta) / 0.2095 <= 1
normalize(f, trace)                              # scales from how far each margin spreads
anneal(step, steps=100)                           # temperatures of 0.3 down to 0.02
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import Expression, Number, expression
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.rewriting import rebuild
from verifai_jax.mtl.semantics import hard
from verifai_jax.mtl.setting import evaluator_of, prepare


def normalize(formula: Formula, scales: Mapping[str, float] | Trace) -> Formula:
    """Divide each predicate of a formula by its scale; its truth stays, its robustness is relative.

    **Arguments:**
    - `scales`: a typical magnitude for each signal by name: the scale of a predicate is the largest
      one among its signals. Or a trace: the scale of a predicate is the range of its margin (1 if
      that is constant).
    **Raises:** `UnknownNameError` for a scale that belongs to no signal of the formula,
    `ValueError` for a signal without a scale, or a scale that is not positive and finite.
    """
    if isinstance(scales, Trace):
        return _mapped(formula, _spreads(formula, scales))
    names = formula.signals()
    check_names("signal", scales, names)
    missing = [name for name in names if name not in scales]
    if missing:
        raise ValueError(f"these signals need a scale: {', '.join(missing)}")
    for name, scale in scales.items():
        if not (scale > 0 and np.isfinite(scale)):
            raise ValueError(f"the scale of {name!r} must be positive and finite; got {scale}")
    leaves: dict[Formula, float] = {
        leaf: max(float(scales[name]) for name in leaf.signals())
        for leaf in formula.subformulas()
        if leaf.is_predicate
    }
    return _mapped(formula, leaves)


def anneal(
    step: Real[Array, ""] | float, steps: int, start: float = 0.3, end: float = 0.02
) -> Float[Array, ""]:
    """Return the temperature at a step of an optimisation, geometric from `start` to `end`.

    It is in units of the predicates' scale (see `normalize`). `step` may be traced.

    **Raises:** `ValueError` for fewer than one step, or temperatures that are not positive.
    """
    if steps < 1:
        raise ValueError(f"an annealing needs at least one step; got {steps}")
    if not (start > 0 and end > 0):
        raise ValueError(f"temperatures must be positive; got {start} to {end}")
    share = jnp.clip(jnp.asarray(step) / max(1, steps - 1), 0.0, 1.0)
    return jnp.asarray(start * (end / start) ** share)


def _spreads(formula: Formula, trace: Trace) -> dict[Formula, float]:
    setting, arrays, _, _ = prepare(formula, trace.trim(), hard, "hold", None)
    evaluator = evaluator_of(setting, arrays, None, None, 0)
    spreads = {}
    for leaf in formula.subformulas():
        if leaf.is_predicate:
            margin = np.asarray(evaluator.value(leaf, 0, setting.length - 1))
            spread = float(np.ptp(margin[np.isfinite(margin)])) if np.isfinite(margin).any() else 0
            # Three digits are plenty for a scale, and the formula stays readable.
            spreads[leaf] = float(f"{spread:z.3g}") or 1.0
    return spreads


def _mapped(f: Formula, scales: Mapping[Formula, float]) -> Formula:
    match f:
        case ast.Predicate(comparison, left, right):
            return ast.Predicate(comparison, _over(left, scales[f]), _over(right, scales[f]))
        case ast.Atom(e):
            return ast.Atom(_over(e, scales[f]))
    return rebuild(f, tuple(_mapped(part, scales) for part in f.operands()))


def _over(e: Term, scale: float) -> Expression:
    plain = isinstance(e, Number) and not e.opened
    return Number(e.value / scale) if plain else expression(e) / scale  # pyright: ignore
