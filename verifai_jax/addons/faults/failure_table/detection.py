"""False alarms, misses and delays of a detector on board, measured by simulation.

detector = as_detector("once[0, 0.1] abs(control - expected) > 0.4")
detector(trace)                             # at which samples it gives an alarm
"""

import math
import zlib
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from jaxtyping import Bool

from verifai_jax.addons.faults.failure_table.effects import first_violation, onset_of
from verifai_jax.addons.faults.failure_table.result import Detection
from verifai_jax.addons.faults.failure_table.rows import Points, Rows
from verifai_jax.addons.faults.fault import Fault
from verifai_jax.core.messages.errors import end_if_interrupted
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.falsification import simulate
from verifai_jax.falsification.run import Run
from verifai_jax.mtl import Formula, boolean, parse, robustness_signal
from verifai_jax.statistics.binomial import Rate, clopper_pearson

Detector: TypeAlias = str | Formula | Callable[[Trace], Any]
"""A formula that is true while there is an alarm, or a function that returns a truth value for each
sample of a trace."""
REPLAYED = 64
"""Simulations of a fault that are judged by the detector."""


def as_detector(given: Detector) -> Callable[[Trace], Bool[np.ndarray, " time"]]:
    """Return a function that says at which samples of a trace a detector gives an alarm.

    A formula that looks some seconds ahead gives its alarm that much later, when it is decided.

    **Raises:** `ValueError` for a formula that is never decided; `TypeError` for anything else.
    """
    if callable(given):
        return lambda trace: _checked(given(trace), trace)
    if not isinstance(given, str | Formula):
        raise TypeError(
            "detector must be a formula, its text, or a function of a trace; got "
            f"{type(given).__name__}"
        )
    formula = parse(given) if isinstance(given, str) else given
    if math.isinf(formula.horizon()):
        raise ValueError(
            f"the detector {formula} looks ahead without end, and so never gives an alarm: use "
            "once or historically, which look back, or a bounded window"
        )

    def alarms(trace: Trace) -> Bool[np.ndarray, " time"]:
        clock = np.asarray(trace.clock())
        steps = np.diff(clock)
        true = np.asarray(robustness_signal(formula, trace, boolean)) > 0
        ahead = formula.horizon(float(steps[0]) if len(steps) else 0.0)
        late = round(ahead / steps[0]) if ahead and len(steps) else 0
        return np.concatenate([np.zeros(late, bool), true])[: len(true)]

    return alarms


def _checked(found: Any, trace: Trace) -> Bool[np.ndarray, " time"]:
    alarms = np.asarray(found)
    if alarms.shape != (trace.length,) or alarms.dtype.kind not in "bu":
        raise ValueError(
            f"the detector must return {trace.length} truth values, one for each sample; got an "
            f"array of {alarms.dtype} with the shape {alarms.shape}"
        )
    return alarms.astype(bool)


def false_alarms(rows: Rows, detector: Detector, samples: int, confidence: float) -> Rate:
    """Measure the share of simulations without a fault in which a detector gives an alarm."""
    alarms = as_detector(detector)
    own = [name for name in rows.groups if name not in rows.faults]

    def counted() -> dict[str, np.ndarray]:
        run = _simulated(rows, _sampled(rows, own, "healthy", samples), "healthy")
        proper = _proper(run)
        found = [bool(alarms(run.replay(int(row)).trace).any()) for row in proper]
        total = len(run.table.all)
        return {"counts": np.array([sum(found), total, total - len(proper)])}

    counts = _kept(rows, f"alarms/{samples}", detector, counted)["counts"].tolist()
    return clopper_pearson(counts[0], counts[1], confidence, counts[2])


def detection(
    rows: Rows, names: tuple[str, ...], detector: Detector, samples: int, confidence: float
) -> Detection:
    """Measure how often and when a detector finds a fault, or a pair, in samples of its prior."""
    alarms, label = as_detector(detector), "+".join(names)
    faults = {name: rows.faults[name] for name in names}

    def measured() -> dict[str, np.ndarray]:
        run = _simulated(rows, _sampled(rows, names, label, samples), label)
        violated = run.table.all["violated"].to_numpy(bool)
        chosen = np.flatnonzero(violated) if violated.any() else _proper(run)
        delays = [_delay(run, int(row), faults, alarms) for row in chosen[:REPLAYED]]
        return {"delays": np.array(delays, float), "failing": np.array(violated.any())}

    known = _kept(rows, f"detected/{label}/{samples}", detector, measured)
    delays = known["delays"]
    found = delays[np.isfinite(delays)]
    count = max(len(delays), 1)
    missed = clopper_pearson(len(delays) - len(found), count, confidence, count - len(delays))
    delay = float(np.median(found)) if len(found) else math.nan
    return Detection(missed, bool(known["failing"]), delay)


def _delay(run: Run, row: int, faults: Mapping[str, Fault], alarms: Callable[..., Any]) -> float:
    """Return the seconds from the onset to the alarm; infinite if it is missed."""
    again = run.replay(row)
    onset = onset_of(again, faults)
    clock = np.asarray(again.trace.clock())
    end = first_violation(again, onset) if again.violated else math.inf
    found = alarms(again.trace) & (clock >= onset - 1e-9) & (clock < end)
    return max(float(clock[np.argmax(found)]) - max(onset, 0.0), 0.0) if found.any() else math.inf


def _sampled(rows: Rows, names: Any, label: str, samples: int) -> Points:
    """Return points at which some features are sampled and all others are nominal.

    Those that the constraint of the space refuses are left out.
    """
    rng = np.random.default_rng([rows.seed, zlib.crc32(label.encode())])
    points = np.repeat(rows.nominal.u[None], samples, axis=0)
    for name in names:
        points[:, rows.groups[name]] = rng.random((samples, len(rows.groups[name])))
    points, accepted = rows.nominal.settle(points), rows.problem.space.constraint
    return points if accepted is None else points[np.asarray(accepted(points))]


def _simulated(rows: Rows, points: Points, label: str) -> Run:
    space = rows.problem.space
    frame = pd.DataFrame(space.rows(space.features_at(points)))
    seed = rows.seed + zlib.crc32(label.encode())
    run = simulate(rows.problem, frame, seed=seed, progress=False, run_on=rows.run_on)
    end_if_interrupted(run.stopped)
    return run


def _kept(
    rows: Rows, label: str, detector: Detector, compute: Callable[[], dict[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """Compute, or read, what a detector finds; a function, which may change, is called again."""
    if callable(detector):
        return compute()
    return rows.cache.remember(f"{label}/{detector}", compute)


def _proper(run: Run) -> np.ndarray:
    return np.flatnonzero(run.table.all["status"].to_numpy() == Status.OK.name.lower())
