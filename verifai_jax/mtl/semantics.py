"""The meaning of a formula's operators as numbers: hard, boolean, or smooth at a temperature.

    robustness(f, trace)                              # hard: min and max
    robustness(f, trace, smooth(0.1))                 # log-sum-exp at temperature 0.1
    robustness(f, trace, smooth(tau, bound="lower"))  # never above the hard value
    robustness(f, trace, smooth(error=0.05))          # tau chosen so that |smooth - hard| <= 0.05

A `Semantics` is a pytree whose only leaf is the temperature, so annealing does not recompile.
"""

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.mtl.expression import Component, Signal
from verifai_jax.mtl.formula import Term

Kind = Literal["hard", "boolean", "smooth"]
Bound = Literal["none", "lower", "upper"]


@partial(
    jax.tree_util.register_dataclass, data_fields=["tau"], meta_fields=["kind", "error", "bound"]
)
@dataclass(frozen=True)
class Semantics:
    """A definition of a formula's value; made by `hard`, `boolean` and `smooth`."""

    # JAX rebuilds the class with placeholders, which are no numbers.
    __no_type_check__ = True
    kind: Kind
    tau: Array | float | None = None
    error: float | None = None
    bound: Bound = "none"


#: Quantitative semantics by min and max: positive where the formula holds, negative where not.
hard = Semantics("hard")
#: +1 where the formula holds, -1 where not, NaN where a signal is NaN. At robustness 0 the
#: comparison decides: `>=` holds, `>` does not.
boolean = Semantics("boolean")


def smooth(
    tau: Float[Array, ""] | float | None = None, *, error: float | None = None,
    bound: Bound = "none",
) -> Semantics:  # fmt: skip
    """Return quantitative semantics with log-sum-exp, which is differentiable everywhere.

    **Arguments:**
    - `tau`: the temperature, positive, in the unit of the predicates; may be traced. As it tends to
      0 the value tends to the hard one. The temperature itself is not differentiated.
    - `error`: instead of `tau`, the largest acceptable difference from the hard value, from which
      the temperature is computed (see `smoothing_error`).
    - `bound`: `"lower"` shifts the value so that it never exceeds the hard one, `"upper"` so that
      it never falls below it; `"none"` does not shift. The gradient is the same.
    **Raises:** `ValueError` unless exactly one of `tau` and `error` is given and positive.
    """
    if (tau is None) == (error is None):
        raise ValueError("smooth needs a temperature tau or an error, one of the two")
    if bound not in ("none", "lower", "upper"):
        raise ValueError(f"bound is 'none', 'lower' or 'upper'; got {bound!r}")
    for name, value in (("tau", tau), ("error", error)):
        concrete = isinstance(value, (int, float, np.number, np.ndarray))
        if concrete and not bool(np.all(np.asarray(value) > 0)):
            raise ValueError(f"{name} must be positive; got {value}")
    return Semantics("smooth", tau=tau, error=error, bound=bound)


def compared(comparison: str, left: Any, right: Any, boolean: bool, xp: ModuleType) -> Any:
    """Compute the value of a comparison between arrays.

    **Arguments:**
    - `left`, `right`: arrays that broadcast, or numbers.
    - `boolean`: whether to return +1 where it holds and -1 where not, instead of the margin.
    - `xp`: `jax.numpy`, or `numpy` on the host.
    **Returns:** the value; NaN where the margin is NaN.
    """
    match comparison:
        case ">" | ">=":
            margin = left - right
        case "<" | "<=":
            margin = right - left
        case "==":
            margin = -xp.abs(left - right)
        case _:
            margin = xp.abs(left - right)
    margin = xp.asarray(margin)
    if not boolean:
        return margin
    holds = margin >= 0 if comparison in (">=", "<=", "==") else margin > 0
    verdict = xp.where(holds, 1.0, -1.0).astype(margin.dtype)
    return xp.where(xp.isnan(margin), margin, verdict)


def alone(value: Any, e: Term, truths: Collection[str]) -> Any:
    """Return the value of an expression as a formula: a truth value is 1 or -1 there, not 1 or 0.

    **Arguments:**
    - `truths`: names of the signals of truth values.
    """
    signal = e.vector if isinstance(e, Component) else e
    return 2 * value - 1 if isinstance(signal, Signal) and signal.name in truths else value
