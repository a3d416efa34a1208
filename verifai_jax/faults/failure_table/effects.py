"""The effect of a fault, read from its counterexample and the same simulation without it."""

import math
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.replay import Replay
from verifai_jax.evaluation.replay import replay as simulate_again
from verifai_jax.falsification.run import Run
from verifai_jax.faults.failure_table.result import Effect
from verifai_jax.faults.fault import Fault
from verifai_jax.mtl import robustness_signal

DIFFERS = 0.05
"""Share of the range of a signal by which it has to differ before it shows a fault."""


class Found(NamedTuple):
    """The findings on a fault or a pair.

    - `candidates`: failing points `[n, d]`, the least severe first.
    - `failures`, `without`, `simulations`: of the samples: failing, without a verdict, all.
    - `first`: the row of the first of the candidates in the run of the table.
    """

    faults: tuple[str, ...]
    candidates: Float[np.ndarray, "n d"]
    failures: int
    without: int
    simulations: int
    first: int = 0


def effect_of(
    run: Run | None, found: Found, faults: Mapping[str, Fault], verdicts: Mapping[int, str]
) -> Effect:
    """Return what is known of a fault or a pair, without probabilities.

    **Arguments:**
    - `run`: with the candidates as rows; `verdicts`: of the confirmation, by row.
    - `faults`: all of them by name.
    """
    effect = Effect(found.faults, len(found.candidates) > 0, found.failures, found.simulations)
    rows = range(found.first, found.first + len(found.candidates))
    # The first that is confirmed; without one, the first that fails at all.
    known = [row for row in rows if row in verdicts]
    tried = sorted(known, key=lambda row: verdicts[row] != "confirmed")
    if run is None or run.problem is None or not tried:
        return effect
    again, space = run.replay(tried[0]), run.problem.space
    columns = again.columns()
    onset = min(
        float(columns.get(f"{name}.onset", faults[name].numbers["onset"]))  # pyright: ignore[reportArgumentType]
        for name in found.faults
    )
    healthy = {**again.features, **{name: space.domains[name].nominal for name in found.faults}}
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], space.coerce(healthy))
    one = {name: np.asarray(column)[0] for name, column in space.rows(batch).items()}
    without = simulate_again(run.problem, one, run_keys(run.seed)[1], tried[0], run.precision)
    shown_by, shown = _first_difference(again.trace, without.trace)
    numbers = [f"{name}.{faults[name].grade}" for name in found.faults]
    return replace(
        effect, row=tried[0], severity={number: float(columns[number]) for number in numbers},
        verdict=verdicts[tried[0]], broken=again.worst,
        delay=_violation(again, onset) - max(onset, 0.0), shown_by=shown_by,
        shown_after=shown - max(onset, 0.0), command=_command(run, tried[0]),
    )  # fmt: skip


def _violation(again: Replay, onset: float) -> float:
    """Return when the predicate that decides is first broken after the onset, in seconds."""
    why = again.explain()
    trace = why.trace.finely()
    clock = np.asarray(trace.clock())
    margin = np.asarray(robustness_signal(why.predicate, trace))
    decides = margin[int(np.argmin(np.abs(clock - why.time)))]
    broken = (np.sign(margin) == np.sign(decides)) & (clock >= onset - 1e-9) & (decides != 0)
    return float(clock[np.argmax(broken)]) if broken.any() else float(why.time)


def _first_difference(trace: Trace, without: Trace) -> tuple[str, float]:
    """Return the signal that differs first, the most of several, and when, in seconds."""
    clock = np.asarray(trace.clock())
    best: tuple[float, float, str] | None = None
    for name, signal in trace.signals.items():
        one, other = np.asarray(signal, float), np.asarray(without.signals[name], float)
        count = min(len(one), len(other))
        one, other = one[:count].reshape(count, -1), other[:count].reshape(count, -1)
        spread = np.maximum(np.ptp(other, axis=0), 1e-3 * np.abs(other).max(axis=0) + 1e-9)
        apart = (np.abs(one - other) / spread).max(axis=1)
        if (apart > DIFFERS).any():
            at = int(np.argmax(apart > DIFFERS))
            entry = (float(clock[at]), -float(apart[at]), name)
            best = entry if best is None else min(best, entry)
    return ("", math.nan) if best is None else (best[2], best[0])


def _command(run: Run, row: int) -> str:
    if run.folder is None:
        return f"table.run.replay({row})"
    if run.target is None:
        return f"vj.load({str(run.folder)!r}, problem).replay({row})"
    return shlex.join(["verifai-jax", "replay", str(Path(run.folder)), str(row)])
