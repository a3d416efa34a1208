"""The effect of a fault, read from its counterexample and the same simulation without it."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from verifai_jax.addons.faults.failure_table.result import Effect
from verifai_jax.addons.faults.failure_table.rows import ABOVE
from verifai_jax.addons.faults.fault import Fault
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.replay import Replay
from verifai_jax.evaluation.replay import replay as simulate_again
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.run_folder import replay_command
from verifai_jax.mtl import robustness_signal

DIFFERS = 0.05
"""Share of a signal's range; a smaller difference does not show a fault."""


def with_counterexample(
    effect: Effect, run: Run, verdicts: Mapping[int, str], faults: Mapping[str, Fault]
) -> Effect:
    """Return an effect completed with its counterexample and the details that it shows.

    **Arguments:**
    - `run`: the run of the table; `verdicts`: verdicts of the confirmation by row, for the failures
      of this fault or pair, the least severe first.
    - `faults`: all faults by name.
    """
    # The first that is confirmed; without one, the first that fails at all.
    row = min(verdicts, key=lambda row: verdicts[row] != "confirmed", default=None)
    if row is None or run.problem is None:
        return effect
    again, own = run.replay(row), {name: faults[name] for name in effect.faults}
    columns, onset = again.columns(), onset_of(again, own)
    off = {f"{name}.{n}": fault.weakest(n) for name, fault in own.items() for n in fault.domains}
    key = run_keys(run.seed)[1]
    without = simulate_again(run.problem, {**columns, **off}, key, row, run.precision)
    command = replay_command(run, row)
    if run.folder is None:
        command = f"table.{command}"
    shown_by, shown = _first_difference(again.trace, without.trace)
    grades = [f"{name}.{fault.grade}" for name, fault in own.items()]
    # Only the first few points lie at the edge; others fail, and something less severe does, too.
    edge = effect.edge and row - min(verdicts) < len(ABOVE)
    return replace(
        effect, row=row, edge=edge, severity={number: float(columns[number]) for number in grades},
        verdict=verdicts[row], broken=again.worst,
        delay=first_violation(again, onset) - max(onset, 0.0), shown_by=shown_by,
        shown_after=shown - max(onset, 0.0), command=command,
    )  # fmt: skip


def onset_of(again: Replay, faults: Mapping[str, Fault]) -> float:
    """Return the time of the first onset of some faults in a simulation."""
    fixed = {f"{name}.onset": fault.numbers["onset"] for name, fault in faults.items()}
    return min(float({**fixed, **again.columns()}[name]) for name in fixed)


def first_violation(again: Replay, onset: float) -> float:
    """Return the time of the first violation of the deciding predicate after the onset."""
    why = again.explain()
    trace = why.trace.finely()
    clock = np.asarray(trace.clock())
    margin = np.asarray(robustness_signal(why.predicate, trace))
    decides = margin[int(np.argmin(np.abs(clock - why.time)))]
    broken = (np.sign(margin) == np.sign(decides)) & (clock >= onset - 1e-9) & (decides != 0)
    return float(clock[np.argmax(broken)]) if broken.any() else float(why.time)


def _first_difference(trace: Trace, without: Trace) -> tuple[str, float]:
    """Return the signal that differs first, and when; of several, the one that differs more."""
    clock, found = np.asarray(trace.clock()), []
    for name, signal in trace.signals.items():
        other = np.asarray(without.signals[name], float)
        one = np.asarray(signal, float)[: len(other)]
        other = other[: len(one)]
        spread = np.maximum(np.ptp(other, axis=0), 1e-3 * np.abs(other).max(axis=0) + 1e-9)
        apart = (np.abs(one - other) / spread).reshape(len(one), -1).max(axis=1)
        if (apart > DIFFERS).any():
            at = int(np.argmax(apart > DIFFERS))
            found.append((float(clock[at]), -float(apart[at]), name))
    when, _, name = min(found, default=(math.nan, 0.0, ""))
    return name, when
