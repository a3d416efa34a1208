"""The sample times of recordings: their unit, repetitions, and which of them are one instant.

seconds_of("flight.csv", "time_ms", column)     # in seconds, and when they began
find_clock(["Time [ms]", "x"], "time")          # "Time [ms]"
"""

import bisect
import contextlib
import datetime
import re
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from verifai_jax.addons.monitoring.columns import numbers_of, reads_as_number
from verifai_jax.addons.monitoring.units import NONE
from verifai_jax.core.messages.text import counted, format_seconds
from verifai_jax.mtl.setting import resolution_of

Repeated: TypeAlias = Literal["both", "last"]
WORDS = {
    word: seconds
    for seconds, spellings in (
        (Fraction(1, 10**9), "ns nsec nano nanosec nanosecond"),
        (Fraction(1, 10**6), "us µs μs usec micro microsec microsecond"),
        (Fraction(1, 1000), "ms msec milli millisec millisecond"),
        (Fraction(1), "s sec second"),
        (Fraction(60), "min minute"),
        (Fraction(3600), "h hr hour"),
        (Fraction(86400), "d day"),
    )
    for word in spellings.split()
}
"""Words for units of time, without the ending of several, and their seconds."""
CALENDARS = {"utc", "gmt", "unix", "epoch", "posix", "local", "boot", "start", "time", "since"}
"""Words beside the name of a clock that say when it began, and not how it counts."""
WRITTEN = re.compile(r"^([\d.]+(?:e[-+]?\d+)?)?\s*([a-zµμ]+)\.?(?:\s+since\s+(.+))?$")
BRACKETS = re.compile(r"[(\[]\s*([^()\[\]]*[^()\[\]\d\s][^()\[\]]*?)\s*[)\]]\s*$")
SUFFIX = re.compile(r"(?:[_\s./-]|(?<=[a-z])(?=[A-Z]))([A-Za-zµμ]+)$")
FEW = 0.1
"""Share of a recording's rows below which those that cannot be read are left out."""
CALENDAR = 10**8
"""Seconds, three years, beyond which sample times count from the first."""


class Scale(NamedTuple):
    """The seconds of one count, and the seconds from 1970 to the count 0."""

    seconds: Fraction
    origin: Fraction = Fraction(0)


def scale_of(text: str) -> Scale | None:
    """Return what a unit of time says, such as `ms` or `days since 2020-01-01`; None if nothing.

    **Raises:** `ValueError` for a date that does not exist.
    """
    found = WRITTEN.match(text.strip(" ()[]").lower())
    many, word, since = found.groups() if found else (None, "", None)
    seconds = WORDS.get(word) or WORDS.get(word.removesuffix("s"))
    if seconds is None:
        return None
    origin = Fraction(0)
    if since is not None and since[0].isdigit():
        parts = [int(part) for part in re.findall(r"\d+", since)[:6]]
        origin = _since_1970(datetime.datetime(*parts))  # pyright: ignore[reportArgumentType]
    return Scale(seconds * Fraction(many or 1), origin)


def unit_in_name(name: str) -> str:
    """Return the unit of time at the end of a column's name; empty if there is none."""
    said = BRACKETS.search(name)
    if said is not None:
        return said[1]
    said = SUFFIX.search(name)
    return said[1] if said is not None and scale_of(said[1]) else ""


def find_clock(names: Iterable[str], time: str) -> str | None:
    """Return the column of sample times: of this name, or of this name and a unit after it."""
    known = list(names)
    if time in known:
        return time
    stems: dict[str, list[str]] = {}
    for name in known:
        unit = unit_in_name(name)
        stem = name[: name.rindex(unit)] if unit else name
        stems.setdefault(stem.strip(" _([./-").lower(), []).append(name)
    alike = stems.get(time.lower(), [])
    return alike[0] if len(alike) == 1 else None


def seconds_of(
    source: str, name: str, column: Any, unit: str = "", chosen: str | None = None
) -> tuple[np.ndarray, Fraction, str]:
    """Return the sample times of an Arrow column in seconds; NaN for an empty cell.

    Dates, times of day and durations, also as ISO 8601 texts, become seconds since the first one,
    which is subtracted before rounding, and so do numbers since 1970.

    **Arguments:**
    - `unit`: the unit that the recording gives; one in the name counts, too.
    - `chosen`: the unit that the user gives, which counts alone.
    **Returns:** the times, their origin in seconds since 1970 (0 for numbers in seconds), and a
    note, or nothing.
    **Raises:** the errors of `numbers_of`; `ValueError` for lists of numbers, and for numbers whose
    unit is unknown or cannot be meant.
    """
    from pyarrow import types

    if types.is_date(column.type):
        column = column.cast("timestamp[ms]")
    kind = column.type
    is_text = types.is_string(kind) or types.is_large_string(kind)
    if is_text and (moments := _moments(column.to_pylist())) is not None:
        return *moments, ""
    if types.is_timestamp(kind) or types.is_duration(kind) or types.is_time(kind):
        wide = "int32" if getattr(kind, "bit_width", 64) == 32 else "int64"
        scale = WORDS[kind.unit]
        known = np.asarray(column.is_valid())
        whole = np.asarray(column.cast(wide).fill_null(0))
        first = int(whole[known][0]) if known.any() else 0
        seconds = np.where(known, (whole - first) / int(1 / scale), np.nan)
        return seconds, first * scale, ""
    if is_text and sum(map(reads_as_number, texts := column.to_pylist())) > (1 - FEW) * len(column):
        values = np.array([float(text) if reads_as_number(text) else np.nan for text in texts])
    else:
        values = numbers_of(source, name, column)
    if values.ndim > 1:
        raise ValueError(
            f"column {name!r} of {source} holds lists of {values.shape[1]} numbers, where each row "
            "must have one sample time"
        )
    scale, note = scale_of_times(f"column {name!r} of {source}", name, values, chosen, unit)
    if scale == Scale(Fraction(1)):
        return values, Fraction(0), note
    known = values[np.isfinite(values)]
    first = known[0].item() if len(known) else 0
    begin = Fraction(first) * scale.seconds + scale.origin
    if abs(begin) < CALENDAR:
        first, begin = 0, scale.origin
    many, parts = (float(number) for number in scale.seconds.as_integer_ratio())
    return (values - first) * many / parts, begin, note


def scale_of_times(
    column: str, name: str, values: np.ndarray, chosen: str | None, unit: str = ""
) -> tuple[Scale, str]:
    """Return the scale of sample times and a note on it.

    **Arguments:**
    - `column`: what to call the column, by its `name`; see `seconds_of`.
    **Raises:** `ValueError` that asks for the unit.
    """
    said = [text for text in (unit, unit_in_name(name)) if _counts(text)]
    said = said if chosen is None else [chosen]
    scales = [scale_of(text) for text in said]
    ask = f'{column}: say it, as in time_unit="ms" (ns, us, ms, s, min, h or d)'
    if None in scales:
        raise ValueError(f"{said[scales.index(None)]!r} is no unit of the sample times in {ask}")
    if len({scale.seconds for scale in scales if scale}) > 1:
        raise ValueError(f"{' and '.join(map(repr, said))} are both given as the unit of {ask}")
    if scales and (scale := scales[0]):
        if chosen is None and epoch_unit(values * float(scale.seconds)) != "s":
            raise ValueError(f"the sample times cannot be in {said[0]}, as it says, in {ask}")
        return scale, ""
    if (large := epoch_unit(values)) != "s":
        note = f"column {name!r} is read as {large} since 1970, in seconds from the first"
        return Scale(WORDS[large]), note
    known = values[np.isfinite(values)]
    forward = np.diff(known)
    forward = forward[forward > 0]
    step = float(forward.min()) if forward.size else 0.0
    whole = values.dtype.kind in "iu"
    # Seconds that a clock counts are by ones, by minutes, or by half hours.
    if (whole and step > 1 and step % 60) or (step >= 1000 and step % 1800):
        sight = ", ".join(f"{stamp:zg}" for stamp in known[:3].tolist())
        raise ValueError(
            f"the unit of the sample times {sight}, ... is not known, which in seconds would be "
            f"{format_seconds(step)} apart or more, in {ask}"
        )
    unknown = whole and len(known) > 1
    return Scale(Fraction(1)), f"column {name!r} says no unit and is read as s" if unknown else ""


def _counts(text: str) -> bool:
    """Return whether a text beside a clock is about its unit."""
    words = set(re.findall(r"[a-zµμ]+", text.lower()))
    return text.strip().lower() not in NONE and not (words and words <= CALENDARS)


def epoch_unit(values: np.ndarray) -> str:
    """Return the unit of sample times: `s`, or the unit of a calendar clock.

    A unit is chosen if the numbers in seconds would lie over three thousand years after 1970.
    """
    known = values[np.isfinite(values)]
    size = float(np.min(known)) if known.size and known.ndim == 1 else 0.0
    return "s" if size < 1e11 else "ms" if size < 1e14 else "us" if size < 1e17 else "ns"


def moment_of(text: str) -> datetime.datetime:
    """Return the time of an ISO 8601 text, which may be only a time of day.

    **Raises:** `ValueError` for any other text.
    """
    try:
        return datetime.datetime.fromisoformat(text)
    except ValueError:
        return datetime.datetime.fromisoformat(f"2000-01-01T{text}")


def _since_1970(moment: datetime.datetime) -> Fraction:
    begin = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    since = moment.replace(tzinfo=moment.tzinfo or datetime.UTC) - begin
    return Fraction(since // datetime.timedelta(microseconds=1), 10**6)


def _moments(texts: list[str | None]) -> tuple[np.ndarray, Fraction] | None:
    """Return the seconds from the first ISO 8601 text to each; None if several are no moments."""
    moments = [_moment_or_none(text) for text in texts]
    odd = sum(moment is None and bool(text) for moment, text in zip(moments, texts, strict=True))
    try:
        first = next(moment for moment in moments if moment is not None)
        seconds = [np.nan if m is None else (m - first).total_seconds() for m in moments]
    except (StopIteration, TypeError):  # Some may have a time zone and others none.
        return None
    return None if odd and odd >= FEW * len(texts) else (np.array(seconds), _since_1970(first))


def _moment_or_none(text: str | None) -> datetime.datetime | None:
    with contextlib.suppress(ValueError):
        return moment_of(text.strip()) if text else None
    return None


def in_order(times: np.ndarray, notes: dict[str, int]) -> np.ndarray:
    """Return the rows that have a sample time, without the fewest whose times go back.

    There is a note on the others. If they are not few, all rows are returned.
    """
    known = np.flatnonzero(np.isfinite(times))
    own = times[known]
    if not np.all(own[1:] >= own[:-1]):
        # The longest part that never goes back: of each length, the least last time.
        ends: list[float] = []
        rows: list[int] = []
        before: list[int] = []
        for row, time in enumerate(own.tolist()):
            length = bisect.bisect_right(ends, time)
            ends[length : length + 1], rows[length : length + 1] = [time], [row]
            before.append(rows[length - 1] if length else -1)
        kept, row = [], rows[-1]
        while row >= 0:
            kept.append(row)
            row = before[row]
        known = known[kept[::-1]]
    out = np.setdiff1d(np.arange(len(times)), known)
    if len(out) >= FEW * len(times):
        return np.arange(len(times))
    if len(out):
        which = ", ".join(map(str, out[:3] + 1)) + ", ..." * (len(out) > 3)
        said = "left out: their times are missing, or go back"
        notes[f"{counted(len(out), 'row')} (row {which}): {said}"] = len(out)
    return known


def sorted_rows(times: np.ndarray, notes: dict[str, int]) -> np.ndarray:
    """Return the rows that have a sample time in the order of their times, with a note."""
    known = np.flatnonzero(np.isfinite(times))
    rows = known[np.argsort(times[known], kind="stable")]
    moved = int(np.sum(rows != known))
    notes |= {"rows whose times went back are put in order": moved} if moved else {}
    gone = len(times) - len(known)
    notes |= {"rows without a sample time are left out": gone} if gone else {}
    return rows


def last_of_each(times: np.ndarray, rows: np.ndarray, notes: dict[str, int]) -> np.ndarray:
    """Return rows in order of time without those at whose time another one follows."""
    last = np.append(np.diff(times[rows]) != 0, True)[: len(rows)]
    gone = int(np.sum(~last))
    notes |= {"of samples at one time the last counts: others are left out": gone} if gone else {}
    return rows[last]


def apart(times: np.ndarray, notes: dict[str, int]) -> np.ndarray:
    """Return sample times of which those that repeat the one before follow it by next to nothing.

    Both samples count, in their order, with a note. Clocks that stand still in over half of the
    steps, or whose numbers are too coarse, are unchanged.
    """
    steps = np.diff(times)
    same = np.append(False, steps == 0)
    forward = steps[steps > 0]
    if not same.any() or same.sum() > len(forward) or times.dtype.itemsize < 8:
        return times
    rank = np.arange(len(times)) - np.maximum.accumulate(np.where(same, 0, np.arange(len(times))))
    little = max(1e-6 * float(np.median(forward)), 8 * resolution_of(times))
    notes["samples have the time of the one before: both count, in their order"] = int(same.sum())
    return times + rank * min(little, 0.1 * float(forward.min()) / (rank.max() + 1))


def merged(clocks: Sequence[np.ndarray], errors: Sequence[float]) -> list[np.ndarray]:
    """Return clocks of which stamps are equal where they differ by rounding alone.

    **Arguments:**
    - `errors`: by how much the times of each clock are rounded, in seconds.
    """
    every = np.concatenate(clocks)
    shortest = min((float(np.diff(c).min()) for c in clocks if len(c) > 1), default=np.inf)
    near = min(4 * max(*errors, resolution_of(every)), shortest / 4)
    order = np.sort(every)
    begins = order[np.append(True, np.diff(order) > near)]
    return [begins[np.searchsorted(begins, clock + near / 2, "right") - 1] for clock in clocks]
