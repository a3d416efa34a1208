"""Conversion of a recording's columns to numbers, with errors for invalid cells.

numbers_of("flight.csv", "x", column)               # [time], or [time, k] of a column of lists
seconds_of("flight.csv", "time", column)            # from the first, and when that was
"""

import datetime
from fractions import Fraction
from typing import Any

import numpy as np

FRACTIONS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""Units of Arrow's times, as fractions of a second."""


class LeftOut(str):
    """A note on a `column` of a recording that does not become a signal of its trace."""

    column: str

    def __new__(cls, text: str, column: str) -> "LeftOut":
        """Make a note of its text and the column that it is about."""
        note = super().__new__(cls, text)
        note.column = column
        return note


def is_numeric(column: Any) -> bool:
    """Return whether the cells of an Arrow column are numbers or truth values."""
    from pyarrow import types

    kind = column.type
    checks = (types.is_floating, types.is_integer, types.is_boolean, types.is_decimal)
    return any(check(kind) for check in checks)


def numbers_of(source: str, name: str, column: Any) -> np.ndarray:
    """Return the numbers of an Arrow column; an empty cell is NaN.

    **Returns:** `[time]`, or `[time, k]` if the cells are lists of `k` numbers.
    **Raises:** `ValueError` for a column without numbers, for a text among numbers (with its row),
    and for lists of different lengths.
    """
    from pyarrow import types

    kind = column.type
    if types.is_dictionary(kind):
        return numbers_of(source, name, column.cast(kind.value_type))
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        return _vectors(source, name, column)
    if not is_numeric(column):
        raise ValueError(f"column {name!r} of {source} {_fault(column)}")
    if types.is_boolean(kind) and column.null_count:
        # Truth values count as +1 and -1, and a gap is neither.
        truths = {True: 1.0, False: -1.0, None: np.nan}
        return np.array([truths[cell] for cell in column.to_pylist()])
    if types.is_decimal(kind):
        column = column.cast("float64")
    return column.to_numpy() if hasattr(column, "chunks") else column.to_numpy(zero_copy_only=False)


def _fault(column: Any) -> str:
    """Say why a column holds no numbers; rows are counted from 1."""
    from pyarrow import csv

    # A column with a text in it keeps the words for a missing number as texts, too.
    missing = {None, *csv.ConvertOptions().null_values}
    cells = column.to_pylist()
    given = [c for c in cells if not (isinstance(c, str | None) and c in missing)]
    if not given:
        return "is empty"
    texts = [cell for cell in given if not _reads_as_number(cell)]
    if texts and len(texts) < len(given):
        row = cells.index(texts[0]) + 1
        return f"holds {texts[0]!r} in row {row}, where other rows hold numbers"
    return f"holds no numbers; it starts with {given[0]!r}"


def _reads_as_number(cell: object) -> bool:
    if not isinstance(cell, str):
        return False
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _vectors(source: str, name: str, column: Any) -> np.ndarray:
    """Return a column of lists of numbers as `[time, k]`, a missing list as NaN."""
    cells = column.to_pylist()
    lengths = {len(cell) for cell in cells if cell is not None}
    if len(lengths) != 1:
        sizes = ", ".join(map(str, sorted(lengths))) or "none"
        raise ValueError(
            f"column {name!r} of {source} holds lists of different lengths ({sizes}), which make "
            "no signal"
        )
    (width,) = lengths
    rows = [[None] * width if cell is None else cell for cell in cells]
    for row, cell in enumerate(rows, 1):
        for entry in cell:
            if entry is not None and not isinstance(entry, bool | int | float):
                raise ValueError(
                    f"column {name!r} of {source} holds lists that are not vectors of numbers; in "
                    f"row {row} there is {_brief(entry)}"
                )
    truths = any(isinstance(entry, bool) for cell in rows for entry in cell)
    if truths:
        rows = [[None if e is None else 1.0 if e else -1.0 for e in cell] for cell in rows]
    return np.array(rows, float).reshape(len(rows), width)


def _brief(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def seconds_of(source: str, name: str, column: Any) -> tuple[np.ndarray, Fraction]:
    """Return the sample times of an Arrow column in seconds; NaN for an empty cell.

    Dates, times of day and durations, also as ISO 8601 texts, become seconds since the first one,
    which is subtracted before rounding.

    **Returns:** the times, and their origin in seconds since 1970; 0 for numbers in seconds.
    **Raises:** the errors of `numbers_of`; `ValueError` for lists of numbers.
    """
    from pyarrow import types

    kind = column.type
    if types.is_string(kind) or types.is_large_string(kind):
        moments = _moments(column.to_pylist())
        if moments is not None:
            return moments
    if types.is_date(kind):
        column, kind = column.cast("timestamp[ms]"), None
    if kind is None or types.is_timestamp(kind) or types.is_duration(kind) or types.is_time(kind):
        fraction = FRACTIONS[column.type.unit]
        wide = "int32" if getattr(column.type, "bit_width", 64) == 32 else "int64"
        counts = column.cast(wide).to_pylist()
        first = next((count for count in counts if count is not None), 0)
        seconds = [np.nan if c is None else (c - first) / fraction for c in counts]
        return np.array(seconds), Fraction(first, fraction)
    values = numbers_of(source, name, column)
    if values.ndim > 1:
        raise ValueError(
            f"column {name!r} of {source} holds lists of {values.shape[1]} numbers, where each row "
            "must have one sample time"
        )
    unit = epoch_unit(values)
    if unit == "s":
        return values, Fraction(0)
    first = values[0].item()
    seconds = [(stamp - first) / FRACTIONS[unit] for stamp in values.tolist()]
    return np.array(seconds), Fraction(first) / FRACTIONS[unit]


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


def _moments(texts: list[str | None]) -> tuple[np.ndarray, Fraction] | None:
    """Return the seconds from the first ISO 8601 text to each; None if a text is no moment."""
    moments: list[datetime.datetime | None] = []
    for text in texts:
        try:
            moments.append(moment_of(text.strip()) if text else None)
        except ValueError:
            return None
    first = next((moment for moment in moments if moment is not None), None)
    if first is None:
        return None
    try:
        seconds = [np.nan if m is None else (m - first).total_seconds() for m in moments]
        zone = first.tzinfo or datetime.UTC
        since = first.replace(tzinfo=zone) - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
        return np.array(seconds), Fraction(since // datetime.timedelta(microseconds=1), 10**6)
    except TypeError:  # Some have a time zone and others have none.
        return None
