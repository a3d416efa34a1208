"""Formulas over training itself: the learning curve is a trace whose time is environment steps.

formula = "eventually[0, 200000] (return >= 90 & always return >= 50)"
curve_robustness(formula, steps, mean_return)
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.addons.monitoring.resampling import resample
from verifai_jax.core.compute.compilation import power_of_two
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import Formula, parse, robustness
from verifai_jax.mtl.formula import Interval
from verifai_jax.mtl.rewriting import rebuild

SIGNALS = ("return",)
"""Signals of a learning curve: the mean return of the episodes that ended in each update."""
_SHORTEST = 64
"""Minimum padded length of curves, so that few lengths compile."""


def check_curve(formula: Formula | str) -> Formula:
    """Parse a formula and check that its only signal is that of a learning curve.

    **Returns:** the formula.
    **Raises:** `FormulaSyntaxError` for text that does not parse; `UnknownNameError` for another
    signal, with the nearest name; `TypeError` for anything that is not a formula.
    """
    if isinstance(formula, str):
        formula = parse(formula)
    if not isinstance(formula, Formula):
        raise TypeError(f"a curve's formula is MTL text or a Formula; got {formula!r}")
    check_names("signal of a learning curve", formula.signals(), SIGNALS)
    return formula


def curve_trace(
    steps: Int[np.ndarray, " updates"], mean_return: Float[np.ndarray, " updates"]
) -> Trace:
    """Make a trace of a learning curve, with the signal `return` over environment steps from 0 on.

    An update in which no episode ended, of which the return is NaN, keeps the previous value.
    Before the first episode ends, its value is used, since that episode began with the training.

    **Raises:** `ValueError` if no episode ended at all, or for steps that do not increase.
    """
    steps, known = np.asarray(steps, np.float64), np.asarray(mean_return, np.float64)
    if steps.shape != known.shape or steps.ndim != 1:
        raise ValueError(
            "steps and mean_return must have one entry for each update; got shapes "
            f"{list(steps.shape)} and {list(known.shape)}"
        )
    present = np.isfinite(known)
    if not present.any():
        raise ValueError("no episode ended in this training: its learning curve is empty")
    if steps[0] <= 0 or (np.diff(steps) <= 0).any():
        raise ValueError(f"steps must be positive and increase; got {steps[:8].tolist()}")
    last = np.maximum.accumulate(np.where(present, np.arange(len(known)), -1))
    held = known[np.where(last >= 0, last, int(np.argmax(present)))]
    signals, times = {"return": np.concatenate([held[:1], held])}, np.concatenate([[0.0], steps])
    period = float(steps[0])
    even, unit = np.array_equal(times, period * np.arange(len(times))), "environment steps"
    dt, times = (period, None) if even else (None, times)
    return Trace(signals, dt=dt, times=times, units={"time": unit})


def curve_robustness(
    formula: Formula | str, steps: Int[np.ndarray, " updates"],
    mean_return: Float[np.ndarray, " updates"],
) -> float:  # fmt: skip
    """Return the robustness of a formula on a learning curve.

    **Arguments:**
    - `formula`: a formula over the signal `return`; its time bounds are environment steps from 0
      on, rounded down to whole updates. After the end of the curve its last value is held.
    - `steps`, `mean_return`: the curve, as in `curve_trace`.
    **Returns:** the robustness in units of the return; NaN if no episode ended.
    **Raises:** the errors of `check_curve`.
    """
    formula = check_curve(formula)
    if not np.isfinite(np.asarray(mean_return, np.float64)).any():
        return float("nan")
    trace = curve_trace(steps, mean_return)
    if trace.times is not None:
        # Updates of different lengths; a value holds until the next update has ended.
        trace = resample(trace, dt=float(np.diff(np.asarray(trace.times)).min()), method="hold")
    # Curves are padded to few lengths, each of which compiles once; the last value stays anyway.
    length = max(_SHORTEST, power_of_two(trace.length))
    values = np.asarray(trace["return"], np.float32)
    padded = np.concatenate([values, np.full(length - len(values), values[-1], np.float32)])
    assert trace.dt is not None
    return float(robustness(_in_updates(formula, trace.dt), Trace({"return": padded}, dt=1.0)))


def _in_updates(formula: Formula, period: float) -> Formula:
    """Rescale the bounds of a formula to updates, rounded down to whole ones."""
    changed = rebuild(formula, tuple(_in_updates(part, period) for part in formula.operands()))
    interval = getattr(changed, "interval", None)
    if interval is None:
        return changed
    # The value of an update counts from its end on: nothing changes before the next one ends.
    start, end = (
        float(np.floor(bound / period * (1 + 1e-9))) for bound in (interval.start, interval.end)
    )
    return replace(changed, interval=Interval(start, end))  # pyright: ignore
