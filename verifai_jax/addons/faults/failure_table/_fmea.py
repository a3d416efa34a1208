"""Failure modes and effects of single faults, and of pairs whose faults cause no failure alone.

    print(fmea(problem, [vj.faults.Dropout("gyro", onset=vj.Box(0, 3), duration=vj.Box(0, 1))]))

All faults are features of one problem, so one program simulates every row. In a row all other
faults are off.
"""

import itertools
import math
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from verifai_jax.addons.faults.failure_table.detection import (
    Detector,
    as_detector,
    detection,
    false_alarms,
)
from verifai_jax.addons.faults.failure_table.effects import with_counterexample
from verifai_jax.addons.faults.failure_table.result import FailureTable
from verifai_jax.addons.faults.failure_table.rows import Points, Rows
from verifai_jax.addons.faults.fault import AtMost, Fault, FaultFeatures
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count, check_fraction, is_number, options_of
from verifai_jax.core.messages.errors import check_names, end_if_interrupted, suggests_options
from verifai_jax.core.store.cache import locked_cache
from verifai_jax.counterexamples import confirm
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.falsification import load, simulate
from verifai_jax.falsification.run import Run
from verifai_jax.problem.problem import Problem


@suggests_options
@shows_progress("tabling the faults of")
def fmea(
    problem: Problem,
    faults: Sequence[Fault] = (),
    *,
    rate: float | Mapping[str, float] | None = None,
    mission_time: float | None = None,
    samples: int = 512,
    budget: int = 2000,
    pairs: bool = True,
    confidence: float = 0.95,
    detector: Detector | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    run_on: RunOn | None = None,
    progress: bool | None = None,
) -> FailureTable:
    """Make the failure table of a system: the effect and the probability of each fault.

    **Arguments:**
    - `problem`: a problem, whose own features stay nominal.
    - `faults`: faults of `vj.faults`, which are added to those of the problem. Each fault needs a
      varying number that can switch it off, such as `duration=vj.Box(0, 2)`.
    - `rate`: occurrences per hour: one number for all faults, or a dictionary by name;
      `mission_time` in hours. A fault then happens with probability `1 - exp(-rate *
      mission_time)`, independently of other faults. Without a rate, probabilities are conditional
      on the fault.
    - `samples`: number of samples of each fault and of each pair, from the prior.
    - `budget`: number of simulations of the search that runs if no or few samples fail, of the
      search for failures below the lowest severity, and half the budget of the estimate that runs
      if few samples fail; 0 switches off all three.
    - `pairs`: whether to try pairs of the faults that cause no failure alone.
    - `confidence`: the confidence of each interval.
    - `detector`: a detector on board, whose false alarms, misses and delays are measured: a formula
      that is true while there is an alarm, or a function that returns a truth value for each
      sample of a trace. It sees the signals of the trace.
    - `folder`: the folder of the counterexamples (a run) and of finished simulations; the same call
      continues an interrupted table there.
    - `run_on`: the workers of the simulations.
    - all other arguments: as in `falsify`.
    **Returns:** the table, the most probable failure first. Ctrl-C ends the call; with `folder` it
    may be repeated.
    **Raises:** `ValueError` without faults, for a fault that cannot be switched off, for rates out
    of range or without a mission time; the errors of `Problem.with_faults`.
    """
    started = time.perf_counter()
    where = options_of("fmea", RunOn, run_on, "executor")
    faulty = problem.with_faults(*faults) if faults else problem
    if detector is not None:
        as_detector(detector)
    known = _faults_of(faulty)
    rates = _rates(rate, mission_time, known)
    check_fraction("confidence", confidence)
    check_count("samples", samples)
    for name, count in (("budget", budget), ("seed", seed)):
        check_count(name, count, 0)
    faulty = resolved(faulty, batch=samples, budget=samples * len(known)).problem
    faulty.check()
    work = {
        "problem": faulty.name,
        "features": {name: repr(domain) for name, domain in faulty.space.domains.items()},
        "formulas": {name: str(formula) for name, formula in faulty.formulas.items()},
        "samples": samples, "budget": budget, "seed": seed,
    }  # fmt: skip
    effects, alarms = [], None
    with locked_cache(folder, "fmea") as cache:
        cache.claim(work, faulty.sources())
        rows = Rows(faulty, known, cache, seed, where)
        healthy = not rows("healthy", rows.nominal.u[None])[0][0]
        found = [rows.try_out((name,), samples, budget) for name in known]
        if pairs:
            safe = [effect.name for effect, _ in found if not effect.fails]
            both = [rows.try_out(pair, samples, budget) for pair in itertools.combinations(safe, 2)]
            found += [each for each in both if each[0].fails]
        run, verdicts, last = _run_of(rows, [points for _, points in found], folder), {}, 0
        if run is not None:
            again = confirm(run, progress=False)
            verdicts = dict(zip(again.numbers.tolist(), again.verdict.tolist(), strict=True))
        for effect, points in found:
            first, last = last, last + len(points)
            known_rates = [] if rates is None else [rates[name] for name in effect.faults]
            chance = math.prod(-math.expm1(-one * (mission_time or 0.0)) for one in known_rates)
            given = rows.probability(effect, confidence, budget)
            low, high, probability = (chance * given).tolist()
            if run is not None:
                own = {row: verdicts[row] for row in range(first, last) if row in verdicts}
                effect = with_counterexample(effect, run, own, known)
            bounds = {"probability": probability, "low": low, "high": high}
            effect = replace(effect, occurrence=chance, **bounds)
            if detector is not None:
                seen = detection(rows, effect.faults, detector, samples, confidence)
                effect = replace(effect, detection=seen)
            effects.append(effect)
        if detector is not None:
            alarms = false_alarms(rows, detector, samples, confidence)
    effects.sort(key=lambda effect: (-effect.fails, -effect.probability, effect.faults))
    return FailureTable(
        faulty.name, tuple(effects), run, rates, mission_time, confidence, bool(healthy),
        time.perf_counter() - started, alarms,
    )  # fmt: skip


def _run_of(rows: Rows, points: list[Points], folder: str | Path | None) -> Run | None:
    """Simulate the failing points of all faults as one run; None without failing points."""
    failing = np.concatenate(points)
    if not len(failing):
        return None
    space = rows.problem.space
    frame = pd.DataFrame(space.rows(space.features_at(rows.nominal.settle(failing))))
    path = None if folder is None else Path(folder) / "counterexamples"
    if path is not None and rows.cache.note("counterexamples") is not None:
        return load(path, rows.problem)
    if path is not None:
        shutil.rmtree(path, ignore_errors=True)  # What an interrupt left.
    run = simulate(rows.problem, frame, seed=rows.seed, folder=path, progress=False)
    end_if_interrupted(run.stopped)
    if path is not None:
        rows.cache.note("counterexamples", len(frame))
    return run


def _faults_of(problem: Problem) -> dict[str, Fault]:
    """Return the faults of a problem by name; refuse those that cannot be switched off."""
    known: dict[str, Fault] = {}
    for name, domain in problem.space.domains.items():
        if not isinstance(domain, FaultFeatures):
            continue
        fault, weakest = domain.fault, domain.nominal
        if isinstance(fault, AtMost):
            raise ValueError(f"fmea takes faults one by one; {name!r} is AtMost")
        if weakest.get("duration") != 0 and weakest.get(fault.severity) != fault.off:
            at = ", ".join(f"{number} {value:zg}" for number, value in weakest.items())
            raise ValueError(
                f"fault {name!r} cannot be switched off, not even at its weakest ({at}): allow a "
                "duration of 0, with duration=vj.Box(0, ...)"
            )
        known[name] = fault
    if not known:
        raise ValueError(
            f"problem {problem.name!r} has no faults that vary: give fmea(problem, faults), each "
            "with a domain such as duration=vj.Box(0, 1)"
        )
    return known


def _rates(
    rate: float | Mapping[str, float] | None, mission_time: float | None, known: Mapping[str, Fault]
) -> Mapping[str, float] | None:
    if (rate is None) != (mission_time is None):
        got = f"({rate=}, {mission_time=})"
        raise ValueError(f"rate (in an hour) and mission_time (in hours) go together; got {got}")
    if rate is None:
        return None
    rates = dict(rate) if isinstance(rate, Mapping) else dict.fromkeys(known, rate)
    check_names("fault", rates, known)
    numbers = {f"rate of fault {n!r}": (rates.get(n), "occurrences in an hour") for n in known}
    numbers["mission_time"] = (mission_time, "hours")
    for name, (value, unit) in numbers.items():
        if not is_number(value) or not 0 <= value < np.inf:
            raise ValueError(f"{name} must be a number of {unit}, 0 or more; got {value!r}")
    return rates
