"""`tail -f log.csv | verifai-jax monitor FORMULA -`: a formula on samples as they come in."""

import csv
import datetime
import functools
import itertools
import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from verifai_jax.cli.exit_codes import BROKEN, CommandError
from verifai_jax.core.errors import missing_name
from verifai_jax.core.text import format_time

if TYPE_CHECKING:
    from verifai_jax.mtl import Formula

SOURCE = "the standard input"
EVEN = 1e-3
"""Share of the sampling period by which the time of a sample may be off."""


class Sample(NamedTuple):
    """One row of the stream: its line, its time (None without a column of times), its signals."""

    line: int
    time: float | None
    signals: dict[str, Any]


def monitor_stream(
    formula: "Formula", lines: Iterable[str], time: str, dt: float | None, show: Any = click.echo,
    hold: bool = False,
) -> bool:  # fmt: skip
    """Monitor samples until the verdict is certain whatever follows, or until they end.

    **Arguments:**

    - `lines`: the lines of CSV; the first has the names.
    - `time`: the column of sample times in seconds, or of dates (ISO 8601).
    - `dt`: the sampling period in seconds, instead of a column of times.
    - `show`: what prints a line.
    - `hold`: whether a gap keeps the last value of its signal.

    **Returns:** whether the formula holds; with the last sample held, if the samples have ended.

    **Raises:** `ValueError` for lines that are no evenly spaced samples; `CommandError` for a NaN.
    """
    from verifai_jax import mtl

    vectors: dict[str, int] = {}
    samples = _samples(lines, formula, None if dt is not None else time, vectors)
    samples, period = _period(samples, dt)
    first = next(samples, None)  # After it the sizes of vectors are known.
    samples = samples if first is None else itertools.chain([first], samples)
    robustness, truth = (
        mtl.watch(formula, period, semantics=semantics, sizes=vectors)
        for semantics in (mtl.hard, mtl.boolean)
    )
    count, begin, last = 0, None, dict[str, Any]()
    for count, sample in enumerate(samples, 1):
        begin = sample.time if begin is None else begin
        due = (count - 1) * period + (begin or 0.0)
        now = due if sample.time is None else sample.time
        if not abs(now - due) <= EVEN * period + math.ulp(now):
            raise ValueError(
                f"line {sample.line} of {SOURCE} is at {format_time(now)} s, where "
                f"{format_time(due)} s is due: samples of a stream are evenly "
                "spaced; if its times are rounded, give the period, --dt SECONDS; otherwise "
                "record it, and use --resample"
            )
        if hold:
            last = {name: _held(last.get(name), value) for name, value in sample.signals.items()}
            sample = sample._replace(signals=last)
        _refuse_nan(sample, now)
        robustness.step(sample.signals)
        truth.step(sample.signals)
        lowest, highest = truth.interval()
        if lowest > 0 or highest < 0:
            low, high = robustness.interval()
            verdict = f"holds, with robustness at least {low:z.10g}"
            if highest < 0:
                verdict = f"fails, with robustness at most {high:z.10g}"
            show(f"whatever follows {format_time(now, 10)} s, it {verdict}")
            return lowest > 0
    rho, holds = robustness.finish(), truth.finish() > 0
    show(
        f"undecided at the end: with the last of {count} sample{'s' * (count != 1)} held, it "
        f"{'holds' if holds else 'fails'} with robustness {rho:z.10g}"
    )
    return holds


def _period(samples: Iterator[Sample], dt: float | None) -> tuple[Iterator[Sample], float]:
    """Return the samples and their period, which is the first step where it is not given."""
    from verifai_jax.mtl.setting import plain_period

    if dt is not None:
        return samples, dt
    first = list(itertools.islice(samples, 2))
    if len(first) < 2:
        raise ValueError(
            f"{SOURCE} has {len(first)} sample{'s' * (len(first) != 1)}, of which no sampling "
            "period follows: give it, --dt SECONDS"
        )
    before, after = (sample.time for sample in first)
    assert before is not None
    assert after is not None
    if not 0 < after - before < math.inf:
        raise ValueError(
            f"sample times must increase; line {first[0].line} of {SOURCE} has "
            f"{format_time(before)} s and line {first[1].line} {format_time(after)} s"
        )
    # Stamps of a clock that began long ago are rounded, and their difference is off by as much.
    return itertools.chain(first, samples), plain_period(after - before, math.ulp(after))


def _samples(
    lines: Iterable[str], formula: "Formula", time: str | None, vectors: dict[str, int]
) -> Iterator[Sample]:
    """Read samples one by one, no line before it is needed, and note the sizes of `vectors`."""
    lines = iter(lines)
    header = next(lines, "")
    if not header.strip():
        raise ValueError(f"{SOURCE} is empty; its first line has the names of the columns")
    separator = max((",", ";", "\t"), key=header.count)
    names = [name.strip() for name in next(csv.reader([header], delimiter=separator))]
    if time is not None and time not in names:
        raise ValueError(
            f"{SOURCE} has no column {time!r} of sample times. Give the sampling period, --dt "
            f"SECONDS, or the name of the column, --time NAME. It has: {', '.join(names)}"
        )
    columns = _columns(names, formula)
    vectors |= {name: len(parts) for name, parts in columns.items() if isinstance(parts, list)}
    rows = csv.reader(lines, delimiter=separator)
    first: list[datetime.datetime] = []
    for row in rows:
        if not row:
            continue
        line = rows.line_num + 1
        if len(row) != len(names):
            raise ValueError(
                f"line {line} of {SOURCE} has {len(row)} cells, and the first has {len(names)}"
            )
        number = functools.partial(_number, dict(zip(names, row, strict=True)), line, separator)
        signals = {
            name: [number(part) for part in parts] if isinstance(parts, list) else number(parts)
            for name, parts in columns.items()
        }
        stamp = None
        if time is not None:
            stamp = _seconds_since(first, row[names.index(time)])
            stamp = number(time) if stamp is None else stamp
        yield Sample(line, stamp, signals)


def _seconds_since(first: list[datetime.datetime], cell: str) -> float | None:
    """Return the seconds since the first date of the stream; None for a cell that is not a date."""
    from verifai_jax.mtl.columns import moment_of

    text = cell.strip()
    if not {"-", ":"} & set(text[1:]):
        return None  # A number; the sign of one may be its first character.
    try:
        first.append(moment_of(text))
        moment = first.pop() if len(first) > 1 else first[0]
        return (moment - first[0]).total_seconds()
    except (ValueError, TypeError):
        return None


def _columns(names: list[str], formula: "Formula") -> dict[str, str | list[str]]:
    """Return the column of each signal of the formula, or the columns of a vector."""
    from verifai_jax.mtl.recording import vector_columns

    vectors = vector_columns(names)
    columns: dict[str, str | list[str]] = {}
    for name in formula.signals():
        if name not in names and name not in vectors:
            raise missing_name(SOURCE, "column", name, [*names, *vectors])
        columns[name] = vectors.get(name, name)
    return columns


def _number(cells: dict[str, str], line: int, separator: str, name: str) -> float:
    text = cells[name].strip()
    truths = {"true": 1.0, "false": -1.0, "": math.nan}
    if text.lower() in truths:
        return truths[text.lower()]
    try:
        return float(text.replace(",", ".") if separator == ";" else text)
    except ValueError:
        raise ValueError(
            f"line {line} of {SOURCE} has {text!r} in column {name!r}, which is no number"
        ) from None


def _held(last: Any, value: Any) -> Any:
    """Return a number, or those of a vector, with the last ones where there are gaps."""
    if isinstance(value, list):
        return list(map(_held, last or value, value))
    return last if math.isnan(value) and last is not None else value


def _refuse_nan(sample: Sample, now: float) -> None:
    for name, value in sample.signals.items():
        values = value if isinstance(value, list) else [value]
        if any(math.isnan(v) for v in values):
            message = f"no verdict: signal {name!r} is NaN at {format_time(now)} s"
            raise CommandError(message, BROKEN)
