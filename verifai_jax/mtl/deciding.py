"""The predicate and the instant that decide the robustness of formulas, for `jit` and `vmap`.

    predicate, sample = deciding_instant([formula], trace)

The hard robustness is the value of one predicate at one instant. So its derivative is 1 or -1 by
that value and zero by all others, and one reverse sweep of the monitor finds it. `explain` gives
more details on one concrete trace.
"""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.evaluate import End, Evaluator
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.semantics import hard
from verifai_jax.mtl.setting import prepare


def leaves_of(formulas: Sequence[Formula]) -> tuple[Formula, ...]:
    """Return the different predicates of formulas, in their order."""
    every = (part for formula in formulas for part in formula.subformulas())
    return tuple(dict.fromkeys(p for p in every if p.is_predicate))


def deciding_instant(
    formulas: Sequence[Formula], trace: Trace, end: End = "hold"
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Find the predicate and the instant that decide the least robustness of formulas on one trace.

    **Arguments:**
    - `formulas`, `trace`, `end`: as in `robustness`; use `jax.vmap` for batches.
    **Returns:** the index of the predicate in `leaves_of(formulas)`, and of the sample; 0 and 0 if
    there is none, or if the robustness is not finite. If several decide equally, one of them.
    """
    leaves = leaves_of(formulas)
    # A search is guided by the samples of the clock; verdicts count all.
    trace = replace(trace.hold(), between=None)
    if not leaves:
        return jnp.int32(0), jnp.int32(0)

    def lowest(nudges: Float[Array, "leaves time"]) -> Float[Array, ""]:
        own = {leaf: nudges[i] for i, leaf in enumerate(leaves)}
        values = []
        for formula in formulas:
            setting, signals, _, valid = prepare(formula, trace, hard, end, None)
            signals = jax.lax.stop_gradient(signals)
            evaluator = Evaluator(
                signals, setting.length, setting.dt, end=end, valid=valid, nudges=own,
                truths=setting.truths,
            )  # fmt: skip
            values.append(evaluator.value(setting.formula, 0, 0)[0])
        return jnp.min(jnp.stack(values))

    dtype = jnp.result_type(float)
    influence = jnp.abs(jax.grad(lowest)(jnp.zeros((len(leaves), trace.length), dtype)))
    index = jnp.argmax(jnp.nan_to_num(influence)).astype(jnp.int32)
    return index // trace.length, index % trace.length
