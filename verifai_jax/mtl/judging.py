"""Many requirements on many recordings, each recording read once.

    found = judge({"gap": "always dist > 1", "speed": "always speed < 30"}, "logs/")
    print(found)                                      # which fail, and where
    found.table, found.quantiles(), found.outliers()

All requirements on a recording are one compiled program, so that they share sub-formulas. A
recording is lengthened by repeating its last sample, which changes no verdict, to one of few
lengths, so that a fleet shares programs.
"""

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.core.errors import missing_name
from verifai_jax.core.executors import Executor, check_executor, gather
from verifai_jax.core.text import format_time, one_line
from verifai_jax.core.trace import Trace
from verifai_jax.mtl._robustness import first_nan
from verifai_jax.mtl.evaluate import End, Evaluator
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.judgement import Judgement, Row
from verifai_jax.mtl.recording import ENDINGS, read
from verifai_jax.mtl.requirements import Requirement, Requirements, requirements_of
from verifai_jax.mtl.resampling import Method
from verifai_jax.mtl.setting import check_horizon, numbers_of_signals, period

if TYPE_CHECKING:
    import pandas as pd

Source: TypeAlias = "str | Path | Trace | pd.DataFrame"
SHORTEST = 64
"""Samples that every recording is lengthened to at least."""


class Reading(NamedTuple):
    """The way in which recordings are read and judged."""

    time: str
    dt: float | None
    resample_to: float | None
    method: Method | None
    end: End
    explain: bool


def judge(
    formulas: Requirements,
    recordings: "Source | Iterable[Source] | Mapping[str, Source]",
    *,
    time: str = "time",
    dt: float | None = None,
    resample_to: float | None = None,
    method: Method | None = None,
    end: End = "hold",
    explain: bool = True,
    executor: Executor | None = None,
    ended: Callable[[int, Sequence[Row]], None] | None = None,
) -> Judgement:
    """Judge every requirement on every recording, in double precision.

    Recordings are read one after another, each once, and none is kept. What cannot be read or
    judged is a row without a verdict that says why.

    **Arguments:**

    - `formulas`: one, a sequence, or a dictionary by identifier; `read_requirements` reads a file.
    - `recordings`: paths of files, of folders (all recordings in and below them), traces or data
      frames: one, a sequence, or a dictionary by name.
    - `time`, `dt`, `resample_to`, `method`: as `read` takes them; a trace is resampled too.
    - `end`: as for `robustness`.
    - `explain`: whether to find the predicate and the instant that decide, which takes a few times
      as long as the verdict.
    - `executor`: anything with `concurrent.futures`' `submit` to read and judge in parallel; the
      process pool must not fork.
    - `ended`: called with the index and the rows of each recording as it ends.

    **Raises:** `ValueError` for no requirement, no recording, `resample_to` without `method`;
    `FileNotFoundError` for a folder or a file that does not exist.
    """
    requirements = requirements_of(formulas)
    if (resample_to is None) != (method is None):
        raise ValueError('resampling needs both: resample_to=PERIOD, method="hold" or "linear"')
    if end not in ("hold", "truncate", "strict"):
        raise ValueError(f"end is 'hold', 'truncate' or 'strict'; got {end!r}")
    reading = Reading(time, dt, resample_to, method, end, explain)
    rows: dict[int, Sequence[Row]] = {}

    def keep(index: int, found: Sequence[Row]) -> None:
        rows[index] = found
        if ended is not None:
            ended(index, found)

    named = _named(recordings)
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


def _named(recordings: Any) -> Iterator[tuple[str, Any]]:
    """Yield recordings with their names; files of a folder in the order of their paths."""
    if isinstance(recordings, Mapping):
        yield from ((str(name), source) for name, source in recordings.items())
        return
    alone = isinstance(recordings, str | Path | Trace) or hasattr(recordings, "columns")
    several: Any = [recordings] if alone else recordings
    for index, source in enumerate(several, 1):
        if not isinstance(source, str | Path):
            yield f"recording {index}", source
            continue
        path = Path(source)
        if not path.exists():
            raise FileNotFoundError(f"there is no recording {path}")
        if not path.is_dir():
            yield str(path), path
            continue
        files = [each for each in sorted(path.rglob("*")) if each.suffix.lower() in ENDINGS]
        if not files:
            raise ValueError(f"there is no recording ({', '.join(ENDINGS)}) in {path}")
        yield from ((str(file), file) for file in files)


def judge_recording(
    requirements: Sequence[Requirement], name: str, source: Any, reading: Reading
) -> list[Row]:
    """Return a row for each requirement on one recording; workers call it, too."""
    try:
        with jax.enable_x64(True):
            return _judged(requirements, name, _trace(source, reading), reading)
    except (ValueError, TypeError, OSError) as error:
        return [Row(name, each.id, error=one_line(str(error))) for each in requirements]


def _trace(source: Any, reading: Reading) -> Trace:
    wanted = {"resample_to": reading.resample_to, "method": reading.method}
    if not isinstance(source, Trace):
        return read(source, time=reading.time, dt=reading.dt, **wanted)
    if reading.resample_to is not None and reading.method is not None:
        from verifai_jax.mtl.resampling import resample

        return resample(source, reading.resample_to, reading.method)
    return source


def _judged(
    requirements: Sequence[Requirement], name: str, trace: Trace, reading: Reading
) -> list[Row]:
    trace = trace.trim()
    dt, stride, fine = period(trace), trace.stride, trace.finely()
    wanted = dict.fromkeys(n for each in requirements for n in each.formula.signals())
    known: dict[str, Any] = {n: np.asarray(fine.signals[n]) for n in wanted if n in fine.signals}
    signals = {n: _lengthened(np.asarray(s)) for n, s in numbers_of_signals(known).items()}
    shapes = tuple((n, s.shape) for n, s in signals.items())
    truncated = reading.end == "truncate"
    make = functools.partial(_Group, shapes, dt, "truncate" if truncated else "hold", stride)
    faults = {
        each.id: _fault(each.formula, trace, dt, reading.end, make((each.formula,)))
        for each in requirements
    }
    sound = [each for each in requirements if not faults[each.id]]
    group = make(tuple(each.formula for each in sound))
    valid = jnp.asarray(fine.length) if truncated else None
    values = [float(v) for v in _values(group, "hard", signals, valid)] if sound else []
    truths = [value > 0 for value in values]
    if any(value == 0 for value in values):
        # At a robustness of zero the comparison decides.
        truths = [float(v) > 0 for v in _values(group, "boolean", signals, valid)]
    rows = {each.id: Row(name, each.id, error=faults[each.id]) for each in requirements}
    clock = np.asarray(fine.clock())
    for each, value, holds in zip(sound, values, truths, strict=True):
        if math.isnan(value):
            missing = f"no verdict: {first_nan(each.formula, trace)}"
            rows[each.id] = Row(name, each.id, error=missing)
            continue
        instant, why = math.nan, ""
        if reading.explain:
            instant, why = _decision(make((each.formula,)), signals, valid, clock)
        rows[each.id] = Row(name, each.id, "holds" if holds else "fails", value, instant, why)
    return [rows[each.id] for each in requirements]


def _lengthened(signal: np.ndarray) -> np.ndarray:
    """Return a signal with its last sample repeated, up to a power of two or one and a half."""
    length, count = len(signal), SHORTEST
    while count < length:
        count = count * 3 // 2 if count & (count - 1) == 0 else count // 3 * 4
    return np.concatenate([signal, np.repeat(signal[-1:], count - length, axis=0)])


class _Group(NamedTuple):
    """Everything static about formulas that one program judges."""

    shapes: tuple[tuple[str, tuple[int, ...]], ...]
    dt: float
    end: End
    stride: int
    formulas: tuple[Formula, ...]

    def evaluator(
        self, signals: Mapping[str, Array], kind: str, valid: Array | None, **options: Any
    ) -> Evaluator:
        length = next((shape[0] for _, shape in self.shapes), 1)
        return Evaluator(
            signals, length, self.dt, kind, end=self.end, valid=valid, stride=self.stride, **options
        )


def _fault(formula: Formula, trace: Trace, dt: float, end: End, group: _Group) -> str:
    """Return why a formula cannot be judged on a trace; nothing if it can."""
    try:
        for name in formula.signals():
            if name not in trace.signals:
                raise missing_name("the recording", "signal", name, trace.signals)
        if end == "strict":
            check_horizon(formula, trace, dt)
    except ValueError as error:
        return one_line(str(error))
    return _shape_fault(group)


@functools.lru_cache(512)
def _shape_fault(group: _Group) -> str:
    """Return why formulas do not fit the clock and the forms of signals; nothing if they do."""
    forms = {n: jax.ShapeDtypeStruct(shape, jnp.float64) for n, shape in group.shapes}
    try:
        jax.eval_shape(functools.partial(_values, group, "hard", valid=None), forms)
    except (ValueError, TypeError) as error:
        return one_line(str(error))
    return ""


@functools.partial(jax.jit, static_argnums=(0, 1))
def _values(
    group: _Group, kind: str, signals: dict[str, Array], valid: Array | None
) -> list[Float[Array, ""]]:
    """Compute the values of all formulas at time 0; what they share once."""
    evaluator = group.evaluator(signals, kind, valid)
    return [evaluator.value(f, 0, 0)[0] for f in group.formulas]


def _leaves(group: _Group) -> list[Formula]:
    (formula,) = group.formulas
    return list(dict.fromkeys(f for f in formula.subformulas(valued=True) if f.is_predicate))


@functools.partial(jax.jit, static_argnums=0)
def _weights(
    group: _Group, signals: dict[str, Array], valid: Array | None
) -> list[tuple[Array, Array, Array]]:
    """Compute of each leaf the instant that its value decides at, how much, and the value there."""
    leaves, length = _leaves(group), group.shapes[0][1][0]

    def value(nudges: list[Array]) -> tuple[Array, list[Array]]:
        moved = dict(zip(leaves, nudges, strict=True))
        evaluator = group.evaluator(signals, "hard", valid, nudges=moved)
        margins = [evaluator.value(leaf, 0, length - 1) for leaf in leaves]
        return evaluator.value(group.formulas[0], 0, 0)[0], margins

    zeros = [jnp.zeros(length) for _ in leaves]
    slopes, margins = jax.grad(value, has_aux=True)(zeros)
    found = []
    for slope, margin in zip(slopes, margins, strict=True):
        at = jnp.argmax(jnp.abs(slope))
        found.append((at, jnp.abs(slope[at]), margin[at]))
    return found


def _decision(
    group: _Group, signals: dict[str, np.ndarray], valid: Array | None, clock: np.ndarray
) -> tuple[float, str]:
    """Return the instant that decides a formula in seconds, and what is so at it, in words."""
    leaves = _leaves(group)
    if not leaves:
        return math.nan, "no sample decides"
    found = _weights(group, signals, valid)
    best = max(range(len(found)), key=lambda k: float(found[k][1]))
    if not float(found[best][1]) > 0:
        return math.nan, "no sample decides"
    # Beyond the end a recording repeats its last sample, so that is where to look.
    instant = float(clock[min(int(found[best][0]), len(clock) - 1)])
    margin = float(found[best][2])
    return instant, f"{leaves[best]} has margin {margin:z.4g} at {format_time(instant)} s"
