"""Many requirements on many recordings, each recording read once.

    found = judge({"gap": "always dist > 1", "speed": "always speed < 30"}, "logs/")
    print(found)                                      # which fail, and where
    found.table, found.quantiles(), found.outliers()

Nothing is compiled, as a fleet has recordings of many lengths: `HostValues` evaluates requirements
on a recording with NumPy, and common parts only once.
"""

import functools
import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from verifai_jax.addons.clusters.executors import gather
from verifai_jax.addons.monitoring import resampling
from verifai_jax.addons.monitoring.columns import LeftOut
from verifai_jax.addons.monitoring.containers import Episode
from verifai_jax.addons.monitoring.dense import DenseValues, NotDense
from verifai_jax.addons.monitoring.enumerations import with_words
from verifai_jax.addons.monitoring.error_bars import ErrorBars, check_bars, with_bars
from verifai_jax.addons.monitoring.judgement import Judgement, Row
from verifai_jax.addons.monitoring.readers import Stamps
from verifai_jax.addons.monitoring.recorded import Recording, Recordings, named_recordings
from verifai_jax.addons.monitoring.recording import read
from verifai_jax.addons.monitoring.requirement_files import Requirements, requirements_of
from verifai_jax.addons.monitoring.resampling import Method, Treatment
from verifai_jax.addons.monitoring.stamps import Repeated
from verifai_jax.addons.monitoring.units import plain_unit, unit_of, units_of
from verifai_jax.core.display.progress import count_done, shows_progress
from verifai_jax.core.messages.checks import options_of
from verifai_jax.core.messages.text import format_time, listed, one_line
from verifai_jax.core.user_code.sources import Source, hashed_files
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.mtl._robustness import first_nan
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.fitting import assumptions, fitted, sizes_of
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.mtl.requirements import Requirement
from verifai_jax.mtl.rewriting import asked_at_once
from verifai_jax.mtl.setting import SamplingError, check_horizon, check_reach, check_signals, period
from verifai_jax.mtl.shortfalls import shortfalls_in

_text = functools.lru_cache(1024)(Formula.__str__)
"""A fleet asks the same of a few formulas again and again."""


class Reading(NamedTuple):
    """Options for reading and judging recordings."""

    time: str
    dt: float | None
    time_unit: str | None
    resample_to: float | None
    method: Method | None
    missing: Treatment
    max_gap: float | None
    end: End
    explain: bool
    stamps: Stamps = "log"
    sort_times: bool = False
    repeated: Repeated = "both"
    dbc: str | Path | Sequence[str | Path] = ()
    error_bars: ErrorBars | None = None


class Found(NamedTuple):
    """Result of one formula on one recording; see `Row`."""

    robustness: float
    holds: bool
    instant: float = math.nan
    explanation: str = ""


@shows_progress("judging", "recordings")
def judge(
    formulas: Requirements,
    recordings: Recordings,
    *,
    time: str = "time",
    time_unit: str | None = None,
    dt: float | None = None,
    resample_to: float | None = None,
    method: Method | None = None,
    missing: Treatment = None,
    max_gap: float | None = None,
    stamps: Stamps = "log",
    sort_times: bool = False,
    repeated: Repeated = "both",
    dbc: str | Path | Sequence[str | Path] = (),
    end: End = "hold",
    explain: bool = True,
    error_bars: ErrorBars | None = None,
    run_on: RunOn | None = None,
    ended: Callable[[int, Sequence[Row]], None] | None = None,
    progress: bool | None = None,
) -> Judgement:
    """Judge every requirement on every recording, in double precision.

    Recordings are read one after another, each once, and none is kept in memory. One that cannot be
    read or judged gives a row without a verdict, with the reason.

    The samples of an even clock decide. On an uneven one the recorded times decide, as in
    `dense_robustness`: each signal keeps its value until its next sample (`method="linear"`: lines
    join its samples), and windows begin and end at any time. Formulas that count samples, those
    that are not straight between them, and `end="truncate"` need an even clock; where `resample_to`
    gives one, a note says by how much times may be off.

    **Arguments:**
    - `formulas`: a formula, a sequence of formulas, or a dictionary by identifier;
      `read_requirements` reads them from a file.
    - `recordings`: paths of files, of folders (all recordings in them and their subfolders), traces
      or data frames: one, a sequence, or a dictionary by name; or a problem, which is simulated.
    - `time`, `time_unit`, `dt`, `missing`, `max_gap`, `stamps`, `sort_times`, `repeated`, `dbc`: as
      in `read`; the gaps of given traces are treated as well.
    - `resample_to`, `method`: the even clock for formulas that need one, and what is between
      samples, `"hold"` or `"linear"`.
    - `end`: as in `robustness`.
    - `explain`: whether to find the deciding predicate and instant.
    - `error_bars`: by the name of a signal half the width of its error bar (a number, or an
      expression of signals such as `"x_error"` or `"0.02 * abs(x)"`), or a pair of its ends. A
      verdict is then `"holds"` or `"fails"` for all values within the bars, otherwise
      `"depends"`; `robustness` and `highest` are the bounds of the robustness.
    - `run_on`: the workers of an executor, to read and judge in parallel.
    - `ended`: a function called with the index and the rows of each recording when it is done.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Raises:** `ValueError` for no requirement, no recording, `resample_to` without `method`;
    `FileNotFoundError` for a folder or a file that does not exist.
    """
    executor = options_of("judge", RunOn, run_on, "executor").executor
    requirements = requirements_of(formulas)
    if resample_to is not None and method is None:
        raise ValueError('resampling needs both: resample_to=PERIOD, method="hold" or "linear"')
    if method not in (None, "hold", "linear"):
        raise ValueError(f"method is 'hold' or 'linear'; got {method!r}")
    if end not in ("hold", "truncate", "strict"):
        raise ValueError(f"end is 'hold', 'truncate' or 'strict'; got {end!r}")
    if error_bars is not None:
        check_bars([each.formalized for each in requirements], error_bars)
    reading = Reading(
        time, dt, time_unit, resample_to, method, missing, max_gap, end, explain, stamps,
        sort_times, repeated, dbc, error_bars,
    )  # fmt: skip
    rows: dict[int, Sequence[Row]] = {}

    def keep(index: int, found: Sequence[Row]) -> None:
        rows[index] = found
        count_done(1)
        if ended is not None:
            ended(index, found)

    files = dict.fromkeys(Path(each.file) for each in requirements if each.file)
    inputs = hashed_files(files, "requirements")

    def seen() -> Iterator[tuple[str, Recording]]:
        for name, source in named_recordings(recordings):
            inputs.extend(_hashed(name, source))
            yield name, source

    if executor is None:
        for index, (name, source) in enumerate(seen()):
            keep(index, judge_recording(requirements, name, source, reading))
    else:
        start = functools.partial(executor.submit, judge_recording, requirements)
        gather([start(name, source, reading) for name, source in seen()], keep)
    if not rows:
        raise ValueError("there is no recording to judge")
    ordered = tuple(row for index in sorted(rows) for row in rows[index])
    return Judgement(requirements, ordered, tuple(dict.fromkeys(inputs)))


def _hashed(name: str, source: Recording) -> list[Source]:
    """Return a recording with its hash: its files, or its samples if it is in memory."""
    if isinstance(source, str | Path | Episode):
        path = source.path if isinstance(source, Episode) else source
        return hashed_files([Path(path)], "a recording")
    is_trace = isinstance(source, Trace)
    columns = {**source.signals, "time": source.clock()} if is_trace else source.to_dict("list")
    whole = hashlib.sha256()
    for column, values in sorted(columns.items(), key=str):
        array = np.asarray(values)
        whole.update(f"{column} {array.dtype} {array.shape}\n".encode())
        whole.update(repr(values).encode() if array.dtype.hasobject else array.tobytes())
    return [Source(name, "a recording in memory, by name and samples", whole.hexdigest())]


def judge_recording(
    requirements: Sequence[Requirement], name: str, source: Recording, reading: Reading
) -> list[Row]:
    """Return a row for each requirement on one recording; also called by workers."""
    try:
        return _judged(requirements, name, read_recording(source, reading), reading)
    except (ValueError, TypeError, OSError) as error:
        return [Row(name, each.id, error=one_line(str(error))) for each in requirements]


def read_recording(source: Recording, reading: Reading) -> Trace:
    """Return a recording as a trace, not resampled."""
    if not isinstance(source, Trace):
        return read(
            source, time=reading.time, time_unit=reading.time_unit, dt=reading.dt,
            missing=reading.missing, max_gap=reading.max_gap, stamps=reading.stamps,
            sort_times=reading.sort_times, repeated=reading.repeated, dbc=reading.dbc,
        )  # fmt: skip
    return resampling.treated(source.trim(), reading.max_gap, reading.missing)


def _judged(
    requirements: Sequence[Requirement], name: str, trace: Trace, reading: Reading
) -> list[Row]:
    formulas, trace = with_words([each.formalized for each in requirements], trace.trim())
    units = units_of(trace.signals, trace.units)
    said = [note for note in trace.notes if not isinstance(note, LeftOut)]
    find = finder(trace, reading)
    clock, dt = np.asarray(trace.clock()), _even_step(trace)
    signals = {name: np.asarray(value) for name, value in trace.signals.items()}
    rows = []
    for each, formula in zip(requirements, formulas, strict=True):
        try:
            asked, best = formula, None
            if reading.error_bars is not None:
                fit = fitted(formula, units, sizes_of(signals))
                asked, best = with_bars(fit, reading.error_bars)
            check_signals(asked, trace, "the recording")
            found, note = find(asked)
            highest = found if best is None else find(best)[0]
            unit, other = _unit(each, units)
            lasts = float(clock[-1] - clock[0])
            falls = shortfalls_in(signals, formula, dt, lasts, reading.end)
            notes = "; ".join(filter(None, [*map(str, falls), *said, note, other]))
            verdict = "holds" if found.holds else "depends" if highest.holds else "fails"
            decided = (found.robustness, found.instant, found.explanation)
            about = {"note": notes, "unit": unit, "highest": highest.robustness}
            rows.append(Row(name, each.id, verdict, *decided, **about))
        except (ValueError, TypeError) as error:
            rows.append(Row(name, each.id, error=one_line(str(error))))
    return rows


def _even_step(trace: Trace) -> float:
    """Return the period of a trace; 0 for one that is not evenly sampled."""
    try:
        return period(trace)
    except SamplingError:
        return 0.0


def finder(trace: Trace, reading: Reading) -> Callable[[Formula], tuple[Found, str]]:
    """Return a function that decides formulas on one trace, and notes how if that is not exact."""
    trace = replace(trace, units=units_of(trace.signals, trace.units))

    @functools.cache
    def sampled() -> tuple[HostValues, Trace]:
        own = trace
        if reading.resample_to is not None and reading.method is not None:
            own = resampling.resample(own, reading.resample_to, reading.method)
        return HostValues.for_verdict(own, reading.end), own

    even, dense = _even_step(trace) and reading.method is None, None
    if not even and reading.end != "truncate":
        dense = DenseValues(trace, reading.method or "hold")

    def find(formula: Formula) -> tuple[Found, str]:
        if dense is not None:
            if reading.end == "strict":
                check_reach(formula, float(dense.times[-1]), 0.0)
            try:
                notes = [*dense.held(formula), *assumptions(formula, trace.units)]
                return _found(formula, dense, trace, reading), "; ".join(notes)
            except NotDense:
                if reading.resample_to is None:
                    period(trace)  # Its error says what to do about an uneven clock.
        values, own = sampled()
        if reading.end == "strict":
            check_horizon(formula, own, values.dt)
        notes = [str(note) for note in own.notes if note not in trace.notes]
        notes += assumptions(formula, trace.units)
        if (values.truth(asked_at_once(formula))[0] < 0).any():
            notes.append("it is violated already at the first sample")
        return _found(formula, values, own, reading), "; ".join(notes)

    return find


def _found(
    formula: Formula, values: HostValues | DenseValues, trace: Trace, reading: Reading
) -> Found:
    robustness = float(values.first(formula))
    if math.isnan(robustness):
        raise ValueError(f"no verdict: {first_nan(formula, trace)}")
    # At a robustness of zero the comparison decides.
    holds = robustness > 0 or (robustness == 0 and float(values.first(formula, boolean=True)) > 0)
    if not reading.explain:
        return Found(robustness, holds)
    found = values.decision(formula) if isinstance(values, DenseValues) else None
    if isinstance(values, HostValues) and (decided := values.walk(formula).decision(formula)):
        # Beyond the end a recording repeats its last sample, so that is where to look.
        instant = np.asarray(trace.finely().clock())[min(decided[1], values.length - 1)]
        found = decided[0], values.walk(formula).at(*decided), float(instant)
    if found is None:
        return Found(robustness, holds, explanation="no sample decides")
    predicate, margin, instant = found
    why = f"{_text(predicate)} has margin {margin:z.4g} at {format_time(instant)} s"
    return Found(robustness, holds, instant, why)


def _unit(requirement: Requirement, units: Mapping[str, str]) -> tuple[str, str]:
    """Return the unit of a robustness as recorded, and a note if the requirement has another."""
    leaves = [part for part in requirement.formalized.subformulas() if part.is_predicate]
    terms = [term for leaf in leaves for term in leaf.terms()]
    known = list(dict.fromkeys(unit for term in terms if (unit := unit_of(term, units, []))))
    wanted = plain_unit(requirement.unit)
    if not known:
        return requirement.unit, ""
    note = f"its robustness is in {listed(known)} as recorded, and the requirement says {wanted}"
    return known[0] if len(known) == 1 else "", note if wanted and known != [wanted] else ""
