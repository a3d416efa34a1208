"""`verifai-jax monitor "always[0, 4] abs(x) <= 2.4" trace.csv`: a formula on a recording.

`verifai-jax monitor requirements.toml logs/`: many requirements on many recordings.

`tail -f log.csv | verifai-jax monitor FORMULA -`: a formula on samples as they come in.
"""

import csv
import datetime
import functools
import itertools
import math
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import click

import verifai_jax as vj
from verifai_jax.addons.monitoring.commands.formula import NAMES, read_names
from verifai_jax.addons.monitoring.commands.monitor_fleet import (
    fleet_options,
    is_fleet,
    monitor_fleet,
    read_missing,
    reading_options,
)
from verifai_jax.cli.arguments import PATH, PLOT, option
from verifai_jax.cli.exit_codes import BROKEN, CommandError
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, give_result, say
from verifai_jax.core.messages.errors import missing_name, nearest_names
from verifai_jax.core.messages.text import format_time
from verifai_jax.core.store.atomic_files import replacing

if TYPE_CHECKING:
    from verifai_jax.addons.monitoring.judging import Reading


@command()
@click.argument("formula")
@click.argument("recording", nargs=-1, type=PATH)
@option("--dt", type=float, help="Sampling period in seconds, instead of a column of times.")
@option("--time", default="time", help="Column of sample times.")
@option("--time-unit", help="Unit of the sample times (ns, us, ms, s, min, h, d), if none is said.")
@option("--max-gap", type=float, help="Longest time in seconds without a value of a signal.")
@option("--resample", "resample_to", type=float, help="Period in seconds to resample to.")
@option("--method", type=click.Choice(["hold", "linear"]), help="Interpolation to resample.")
@option(
    "--missing", multiple=True, callback=read_missing,
    help="Treatment of gaps (hold, drop, interpolate), and numbers that stand for one "
    "[default: no verdict where they matter]",
)  # fmt: skip
@reading_options
@option(
    "--end", type=click.Choice(["hold", "truncate", "strict"]), default="hold",
    help="How a trace continues after the last sample.",
)  # fmt: skip
@option(
    "--error-bar", "bars", multiple=True, metavar="NAME=WIDTH",
    help="Half the width of a signal's error bar: a number, or an expression of signals.",
)  # fmt: skip
@option("--compat", type=click.Choice(["pymtl"]), help="Right-open windows, as in py-mtl.")
@NAMES
@option(
    "--export-c", "header", type=PATH, metavar="FILE.h",
    help="Write FORMULA as a monitor in C (or FILE.fmu) instead, for samples --dt seconds apart.",
)  # fmt: skip
@option("--explain", is_flag=True, help="Say which predicate decides, and when.")
@PLOT
@fleet_options
@fail_on(violation="if a formula fails", incomplete="if one fails or has no verdict on a recording")
def monitor(
    formula: str, recording: tuple[Path, ...], bars: tuple[str, ...],
    compat: Literal["pymtl"] | None, constants: tuple[str, ...], definitions: tuple[str, ...],
    header: Path | None, explain: bool, plot: Path | None, report: Path | None, junit: Path | None,
    jobs: int, fail_on: Gate | None,
    **given: Any,
) -> None:  # fmt: skip
    """Compute the robustness of FORMULA on a recorded trace, RECORDING.csv or .parquet.

    FORMULA may also be a file of requirements (.toml, .yaml, .csv or .reqif), and RECORDING a
    folder, or several: every requirement is judged on every recording.

    With - as RECORDING, lines of CSV are read from the standard input as they come, until the
    verdict is certain whatever follows: tail -f log.csv | verifai-jax monitor FORMULA -

    With --export-c FILE.h, FORMULA becomes a monitor in C, and with FILE.fmu an FMU.
    """
    import jax

    from verifai_jax.addons.monitoring.columns import LeftOut
    from verifai_jax.addons.monitoring.enumerations import with_words
    from verifai_jax.addons.monitoring.judging import Reading, finder
    from verifai_jax.mtl.setting import check_signals

    if (explain or plot is not None) and compat is not None:
        raise click.UsageError("--explain and --plot do not go with --compat")
    given["error_bars"] = _error_bars(bars)
    reading = Reading(**given, explain=explain)
    dt, end = reading.dt, reading.end
    numbers, named = read_names(constants, definitions)
    if header is not None:
        if recording or dt is None:
            raise click.UsageError("--export-c goes with --dt SECONDS, and with no RECORDING")
        parsed = vj.parse(formula, numbers, named)
        if header.suffix == ".fmu":
            if bars:
                raise click.UsageError("--error-bar goes with FILE.h, and with no FILE.fmu")
            vj.mtl.export_fmu(parsed, dt, header)
        else:
            name = re.sub(r"\W", "_", header.stem)
            text = vj.mtl.export_c(parsed, dt, name, error_bars=reading.error_bars)
            with replacing(header) as partial:
                partial.write_text(text, encoding="utf-8")
        say(f"monitor {header}")
        give_result(formula=formula, header=str(header))
        return
    if not recording:
        raise click.UsageError("give a RECORDING to judge, or --export-c FILE.h")
    if is_fleet(formula, recording, report, junit) or bars:
        if plot is not None or compat is not None:
            raise click.UsageError("--plot and --compat go with one formula on one recording")
        found = monitor_fleet(formula, recording, numbers, named, report, junit, jobs, given)
        check_gate(fail_on, {"violation": bool(found.failing), "incomplete": not found.all_hold})
        return
    (file,) = recording
    parsed = vj.parse(formula, numbers, named)
    if str(file) == "-":
        whole = (plot, compat, reading.resample_to, reading.max_gap)
        if explain or end != "hold" or any(option is not None for option in whole):
            raise click.UsageError(
                "a stream goes with --dt, --time, --time-unit, --missing hold, --const, --define "
                "and --fail-on; other options need the whole recording"
            )
        why = {
            "drop": "leaves instants out, and samples of a stream are evenly spaced",
            "interpolate": "needs the value after a gap, which a stream has not had yet",
        }
        ways = given["missing"] or ["hold"]
        for way in [] if ways == ["hold"] else ways:
            said = why.get(way, "goes with a whole recording")
            raise click.UsageError(f"--missing {way} {said}: use --missing hold")
        held, unit = reading.missing is not None, reading.time_unit
        holds = monitor_stream(parsed, sys.stdin, reading.time, dt, hold=held, time_unit=unit)
        give_result(formula=str(parsed), holds=holds)
        check_gate(fail_on, {"violation": not holds, "incomplete": not holds})
        return
    (parsed,), trace = with_words([parsed], _read(file, reading))
    check_signals(parsed, trace, str(file))
    period, method = reading.resample_to, reading.method
    even = vj.mtl.resample(trace, period, method) if period and method else trace
    with jax.enable_x64(True):
        try:
            if compat is None:
                (rho, holds, *_, because), off = finder(trace, reading)(parsed)
            else:
                rho, off = float(vj.mtl.robustness(parsed, even, end=end, compat=compat)), ""
                holds, because = bool(vj.mtl.satisfied(parsed, even, end, compat)), ""
        except vj.mtl.HorizonError as error:
            advice = "Use --end hold or --end truncate, or a longer recording"
            raise ValueError(f"{error.fact}. {advice}") from None
        except vj.mtl.SamplingError as error:
            advice = f"Resample it: --resample {error.dt:zg} --method hold (or linear)"
            raise ValueError(f"{error.fact}. {advice}") from None
        except ValueError as error:
            if str(error).startswith("no verdict"):
                raise CommandError(str(error), BROKEN) from None
            raise
        say(f"{'holds' if holds else 'fails'} with robustness {rho:z.10g}")
        for note in filter(None, (*trace.notes, off)):
            if not isinstance(note, LeftOut) or note.column in parsed.signals():
                say(f"note: {note}")
        try:
            why = vj.mtl.explain(parsed, even, end=end) if explain or plot is not None else None
        except vj.mtl.SamplingError as error:
            if plot is not None:
                raise ValueError(f"{error.fact}. A picture needs --resample and --method") from None
            why = None
        if explain:
            # Recorded times decide where there is a method, and a picture is of an even clock.
            say(str(why) if why is not None and method is None else because)
        if plot is not None and why is not None:
            vj.mtl.draw(why, plot)
            say(f"picture {plot}")
    give_result(formula=str(parsed), holds=holds, robustness=rho)
    check_gate(fail_on, {"violation": not holds, "incomplete": not holds})


def _read(recording: Path, reading: "Reading") -> "vj.Trace":
    """Read the recording; errors name the missing option of this command."""
    from verifai_jax.addons.monitoring.judging import read_recording

    if reading.resample_to is not None and reading.method is None:
        raise click.UsageError("--resample PERIOD goes with --method hold or --method linear")
    try:
        return read_recording(recording, reading)
    except vj.mtl.TimeColumnError as error:
        near = nearest_names(reading.time, error.columns)
        raise ValueError(
            f"{error.fact}{near or '.'} Give the sampling period, --dt SECONDS, or the name of "
            f"the column, --time NAME. It has: {', '.join(error.columns)}"
        ) from None


def _error_bars(given: tuple[str, ...]) -> dict[str, float | str] | None:
    """Return error bars, each `NAME=WIDTH`, by the name of the signal."""
    bars: dict[str, float | str] = {}
    for each in given:
        name, equals, width = (part.strip() for part in each.partition("="))
        if not (name and equals and width):
            raise click.UsageError(f"--error-bar is NAME=WIDTH, as in x=0.1; got {each}")
        try:
            bars[name] = float(width)
        except ValueError:
            bars[name] = width
    return bars or None


SOURCE = "the standard input"
EVEN = 1e-3
"""Share of the sampling period by which the time of a sample may be off."""


class Sample(NamedTuple):
    """One row of the stream: its line, its time (None without a time column), its signals."""

    line: int
    time: float | None
    signals: dict[str, Any]


def monitor_stream(
    formula: "vj.Formula", lines: Iterable[str], time: str, dt: float | None,
    show: Any = click.echo, hold: bool = False, time_unit: str | None = None,
) -> bool:  # fmt: skip
    """Monitor samples until the verdict is certain, or until they end.

    **Arguments:**
    - `lines`: the lines of CSV; the first contains the names.
    - `time`: the column of sample times, or of dates (ISO 8601).
    - `time_unit`: their unit; by default the one at the end of the column's name, or seconds.
    - `dt`: the sampling period in seconds, if there is no column of times.
    - `show`: a function that prints a line.
    - `hold`: whether a gap keeps the last value of its signal.
    **Returns:** whether the formula holds; if the samples have ended, with the last one held.
    **Raises:** `ValueError` for lines that are not evenly spaced samples; `CommandError` if a NaN
    leaves the verdict open.
    """
    vectors: dict[str, int] = {}
    samples = _samples(lines, formula, None if dt is not None else time, vectors, time_unit)
    samples, period = _period(samples, dt)
    first = next(samples, None)  # After it the sizes of vectors are known.
    samples = samples if first is None else itertools.chain([first], samples)
    robustness, truth = (
        vj.mtl.watch(formula, period, semantics=semantics, sizes=vectors)
        for semantics in (vj.mtl.hard, vj.mtl.boolean)
    )
    count, begin, last, gap = 0, None, dict[str, Any](), ""
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
        gap = gap or _gap(sample, now)
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
    if math.isnan(rho) and gap:
        raise CommandError(gap, BROKEN)
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
            f"{SOURCE} has {len(first)} sample{'s' * (len(first) != 1)}, too few to show the "
            "sampling period: give it, --dt SECONDS"
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
    lines: Iterable[str], formula: "vj.Formula", time: str | None, vectors: dict[str, int],
    time_unit: str | None,
) -> Iterator[Sample]:  # fmt: skip
    """Read samples one by one, no line before it is needed, and note the sizes of `vectors`."""
    import numpy as np

    from verifai_jax.addons.monitoring.stamps import find_clock, scale_of_times

    lines = iter(lines)
    header = next(lines, "")
    if not header.strip():
        raise ValueError(f"{SOURCE} is empty; its first line has the names of the columns")
    separator = max((",", ";", "\t"), key=header.count)
    names = [name.strip() for name in next(csv.reader([header], delimiter=separator))]
    clock = None if time is None else find_clock(names, time)
    if time is not None and clock is None:
        raise ValueError(
            f"{SOURCE} has no column {time!r} of sample times. Give the sampling period, --dt "
            f"SECONDS, or the name of the column, --time NAME. It has: {', '.join(names)}"
        )
    columns = _columns(names, formula)
    vectors |= {name: len(parts) for name, parts in columns.items() if isinstance(parts, list)}
    rows = csv.reader(lines, delimiter=separator)
    raw: list[float] = []
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
        if clock is not None:
            stamp = _seconds_since(first, cell := row[names.index(clock)])
            if stamp is None:
                stamp, whole = number(clock), cell.strip().isdecimal()
                raw = [*raw, stamp] if len(raw) < 2 else raw
                chosen = np.array(raw, int if whole else float)
                scale, _ = scale_of_times(f"column {clock!r} of {SOURCE}", clock, chosen, time_unit)
                many, parts = scale.seconds.as_integer_ratio()
                stamp = stamp * many / parts
        yield Sample(line, stamp, signals)


def _seconds_since(first: list[datetime.datetime], cell: str) -> float | None:
    """Return the seconds since the first date of the stream; None for a cell that is not a date."""
    from verifai_jax.addons.monitoring.stamps import moment_of

    text = cell.strip()
    if not {"-", ":"} & set(text[1:]):
        return None  # A number; the sign of one may be its first character.
    try:
        first.append(moment_of(text))
        moment = first.pop() if len(first) > 1 else first[0]
        return (moment - first[0]).total_seconds()
    except (ValueError, TypeError):
        return None


def _columns(names: list[str], formula: "vj.Formula") -> dict[str, str | list[str]]:
    """Return the column of each signal of the formula, or the columns of a vector."""
    from verifai_jax.addons.monitoring.recording import vector_columns

    vectors = vector_columns(names)
    columns: dict[str, str | list[str]] = {}
    for name in formula.signals():
        if name not in names and name not in vectors:
            raise missing_name(SOURCE, "column", name, [*names, *vectors])
        columns[name] = vectors.get(name, name)
    return columns


def _number(cells: dict[str, str], line: int, separator: str, name: str) -> float:
    from verifai_jax.addons.monitoring.columns import GAPS, TRUTHS

    text = cells[name].strip()
    if text in TRUTHS or text in GAPS:
        return TRUTHS.get(text, math.nan)
    try:
        return float(text.replace(",", ".") if separator == ";" else text)
    except ValueError:
        raise ValueError(
            f"line {line} of {SOURCE} has {text!r} in column {name!r}, which is not a number"
        ) from None


def _held(last: Any, value: Any) -> Any:
    """Return a number, or those of a vector, with the last ones where there are gaps."""
    if isinstance(value, list):
        return list(map(_held, last or value, value))
    return last if math.isnan(value) and last is not None else value


def _gap(sample: Sample, now: float) -> str:
    """Return why a NaN leaves the verdict open, or nothing."""
    for name, value in sample.signals.items():
        values = value if isinstance(value, list) else [value]
        if any(math.isnan(v) for v in values):
            return f"no verdict: signal {name!r} is NaN at {format_time(now)} s"
    return ""
