"""Requirements that count: how long something held within the last seconds, as a signal.

trace = durations(trace, {"fast": ("speed > 30", 60.0)})      # "at most 3 s in any 60 s"
robustness("always fast <= 3", trace)
"""

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp

from verifai_jax.core.trace import Trace
from verifai_jax.mtl._robustness import robustness_signal
from verifai_jax.mtl.evaluate import samples
from verifai_jax.mtl.formula import Formula, Interval
from verifai_jax.mtl.semantics import boolean
from verifai_jax.mtl.setting import period


def durations(trace: Trace, counted: Mapping[str, tuple[Formula | str, float]]) -> Trace:
    """Return a trace with more signals: the seconds of the last ones in which a formula held.

    Each sample stands for one period, and those before the first count as none. A system made of a
    function can return such a trace, so that searches and `mine` judge what is counted.

    **Arguments:**

    - `counted`: a formula and the length of the window in seconds, by the name of the new signal.

    **Returns:** the trace; a new signal is NaN while the formula is unknown within the window.

    **Raises:** `IntervalError` for a window that is not a multiple of the period; `ValueError` for
    a name that the trace has, for a window without a sample, and for a resampled recording.
    """
    dt, signals = period(trace), dict(trace.signals)
    if trace.between is not None:
        raise ValueError("count before resampling: a sample must stand for one period")
    for name, (formula, window) in counted.items():
        n = samples(window, dt, Interval(0.0, window))
        if name in signals or not 1 <= n < float("inf"):
            raise ValueError(
                f"a new signal has a new name and a window of one sample or more; got {name!r} "
                f"over {window} s"
            )
        truth = robustness_signal(formula, trace, boolean)
        width = min(int(n), len(truth))

        def within(marks: jnp.ndarray, width: int = width) -> jnp.ndarray:
            total = jnp.cumsum(marks)
            return total - jnp.concatenate([jnp.zeros(width, total.dtype), total[:-width]])

        unknown = within(jnp.isnan(truth)) > 0
        signals[name] = jnp.where(unknown, jnp.nan, within(truth > 0) * dt)
    return dataclasses.replace(trace, signals=signals)
