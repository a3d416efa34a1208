"""Many requirements on many recordings, each recording read once.

    found = judge({"gap": "always dist > 1", "speed": "always speed < 30"}, "logs/")
    print(found)                                      # which fail, and where
    found.table, found.quantiles(), found.outliers()

Nothing is compiled, as a fleet has recordings of many lengths: `HostValues` evaluates requirements
on a recording with NumPy, and common parts only once.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.monitoring.judgement import Judgement, Row
from verifai_jax.addons.monitoring.recorded import Recording, Recordings, named_recordings
from verifai_jax.addons.monitoring.recording import read
from verifai_jax.addons.monitoring.resampling import Method, Missing, resample, without_gaps
from verifai_jax.core.compute.executors import Executor, check_executor, gather
from verifai_jax.core.display.progress import count_done, shows_progress
from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.messages.text import format_time, one_line
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl._robustness import first_nan
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.mtl.requirements import Requirement, Requirements, requirements_of
from verifai_jax.mtl.setting import check_horizon

_signals = functools.lru_cache(1024)(Formula.signals)
_text = functools.lru_cache(1024)(Formula.__str__)
"""A fleet asks the same of a few formulas again and again."""


class Reading(NamedTuple):
    """Options for reading and judging recordings."""

    time: str
    dt: float | None
    resample_to: float | None
    method: Method | None
    missing: Missing | Mapping[str, Missing] | None
    end: End
    explain: bool


@shows_progress("judging", "recordings")
def judge(
    formulas: Requirements,
    recordings: Recordings,
    *,
    time: str = "time",
    dt: float | None = None,
    resample_to: float | None = None,
    method: Method | None = None,
    missing: Missing | Mapping[str, Missing] | None = None,
    end: End = "hold",
    explain: bool = True,
    executor: Executor | None = None,
    ended: Callable[[int, Sequence[Row]], None] | None = None,
    progress: bool | None = None,
) -> Judgement:
    """Judge every requirement on every recording, in double precision.

    Recordings are read one after another, each once, and none is kept in memory. One that cannot be
    read or judged gives a row without a verdict, with the reason.

    **Arguments:**
    - `formulas`: a formula, a sequence of formulas, or a dictionary by identifier;
      `read_requirements` reads them from a file.
    - `recordings`: paths of files, of folders (all recordings in them and their subfolders), traces
      or data frames: one, a sequence, or a dictionary by name; or a problem, which is simulated.
    - `time`, `dt`, `resample_to`, `method`, `missing`: as in `read`; given traces are resampled and
      their gaps treated as well.
    - `end`: as in `robustness`.
    - `explain`: whether to find the deciding predicate and instant.
    - `executor`: anything with the `submit` of `concurrent.futures`, to read and judge in parallel;
      a process pool must not fork.
    - `ended`: a function called with the index and the rows of each recording when it is done.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Raises:** `ValueError` for no requirement, no recording, `resample_to` without `method`;
    `FileNotFoundError` for a folder or a file that does not exist.
    """
    requirements = requirements_of(formulas)
    if (resample_to is None) != (method is None):
        raise ValueError('resampling needs both: resample_to=PERIOD, method="hold" or "linear"')
    if end not in ("hold", "truncate", "strict"):
        raise ValueError(f"end is 'hold', 'truncate' or 'strict'; got {end!r}")
    reading = Reading(time, dt, resample_to, method, missing, end, explain)
    rows: dict[int, Sequence[Row]] = {}

    def keep(index: int, found: Sequence[Row]) -> None:
        rows[index] = found
        count_done(1)
        if ended is not None:
            ended(index, found)

    named = named_recordings(recordings)
    if executor is None:
        for index, (name, source) in enumerate(named):
            keep(index, judge_recording(requirements, name, source, reading))
    else:
        check_executor(executor)
        calls = [
            executor.submit(judge_recording, requirements, name, source, reading)
            for name, source in named
        ]
        gather(calls, keep)
    if not rows:
        raise ValueError("there is no recording to judge")
    return Judgement(requirements, tuple(row for index in sorted(rows) for row in rows[index]))


def judge_recording(
    requirements: Sequence[Requirement], name: str, source: Recording, reading: Reading
) -> list[Row]:
    """Return a row for each requirement on one recording; also called by workers."""
    try:
        return _judged(requirements, name, _trace(source, reading), reading)
    except (ValueError, TypeError, OSError) as error:
        return [Row(name, each.id, error=one_line(str(error))) for each in requirements]


def _trace(source: Recording, reading: Reading) -> Trace:
    if not isinstance(source, Trace):
        return read(
            source, time=reading.time, dt=reading.dt, resample_to=reading.resample_to,
            method=reading.method, missing=reading.missing,
        )  # fmt: skip
    trace = source if reading.missing is None else without_gaps(source, reading.missing)
    if reading.resample_to is not None and reading.method is not None:
        return resample(trace, reading.resample_to, reading.method)
    return trace


def _judged(
    requirements: Sequence[Requirement], name: str, trace: Trace, reading: Reading
) -> list[Row]:
    trace = trace.trim()
    truncated = reading.end == "truncate"
    values = HostValues.of(trace, "truncate" if truncated else "hold")
    clock = np.asarray(trace.finely().clock())
    rows = []
    for each in requirements:
        try:
            rows.append(_row(each, name, trace, values, clock, reading))
        except (ValueError, TypeError) as error:
            rows.append(Row(name, each.id, error=one_line(str(error))))
    return rows


def _row(
    requirement: Requirement,
    name: str,
    trace: Trace,
    values: HostValues,
    clock: Float[np.ndarray, " time"],
    reading: Reading,
) -> Row:
    """Judge one requirement on one recording."""
    formula = requirement.formalized
    for signal in _signals(formula):
        if signal not in trace.signals:
            raise missing_name("the recording", "signal", signal, trace.signals)
    if reading.end == "strict":
        check_horizon(formula, trace, values.dt)
    robustness = float(values.first(formula))
    if math.isnan(robustness):
        missing = f"no verdict: {first_nan(formula, trace)}"
        return Row(name, requirement.id, error=missing)
    # At a robustness of zero the comparison decides.
    holds = robustness > 0 or (robustness == 0 and float(values.first(formula, boolean=True)) > 0)
    instant, why = _decision(values, formula, clock) if reading.explain else (math.nan, "")
    return Row(name, requirement.id, "holds" if holds else "fails", robustness, instant, why)


def _decision(
    values: HostValues, formula: Formula, clock: Float[np.ndarray, " time"]
) -> tuple[float, str]:
    """Return the deciding instant of a formula in seconds, and the deciding predicate as text."""
    walk = values.walk(formula)
    found = walk.decision(formula)
    if found is None:
        return math.nan, "no sample decides"
    predicate, sample = found
    # Beyond the end a recording repeats its last sample, so that is where to look.
    instant = float(clock[min(sample, len(clock) - 1)])
    margin = walk.at(predicate, sample)
    return instant, f"{_text(predicate)} has margin {margin:z.4g} at {format_time(instant)} s"
