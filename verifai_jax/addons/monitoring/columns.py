"""Conversion of a recording's columns to numbers, with errors for invalid cells.

numbers_of("flight.csv", "x", column)               # [time], or [time, k] of a column of lists
"""

from typing import Any

import numpy as np

from verifai_jax.core.messages.text import one_line

GAPS = (
    "", "-", "--", "#N/A", "#N/A N/A", "#NA", "-1.#IND", "-1.#QNAN", "-NaN", "-nan", "1.#IND",
    "1.#QNAN", "N/A", "NA", "NULL", "NaN", "n/a", "nan", "null", "None", "none", "n.a.",
)  # fmt: skip
"""Words in a table for a missing number."""
TRUTHS = {
    word: truth
    for pair in (("true", "false"), ("on", "off"), ("yes", "no"))
    for truth, small in zip((True, False), pair, strict=True)
    for word in (small, small.upper(), small.capitalize())
}
"""Words in a table for truth values."""


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
        # Masked, so that a trace knows truth values with gaps for what they are.
        known = np.asarray(column.is_valid())
        return np.ma.array(np.asarray(column.fill_null(False)), mask=~known)
    if types.is_decimal(kind):
        column = column.cast("float64")
    return column.to_numpy() if hasattr(column, "chunks") else column.to_numpy(zero_copy_only=False)


def _fault(column: Any) -> str:
    """Say why a column holds no numbers; rows are counted from 1."""
    # A column with a text in it keeps the words for a missing number as texts, too.
    cells = column.to_pylist()
    given = [c for c in cells if not (c is None or (isinstance(c, str) and c in GAPS))]
    if not given:
        return "is empty"
    texts = [cell for cell in given if not reads_as_number(cell)]
    if texts and len(texts) < len(given):
        row = cells.index(texts[0]) + 1
        return f"holds {texts[0]!r} in row {row}, where other rows hold numbers"
    return f"holds no numbers; it starts with {given[0]!r}"


def reads_as_number(cell: object) -> bool:
    """Return whether a cell is a text of a number."""
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
    for row, entry in ((row, entry) for row, cell in enumerate(rows, 1) for entry in cell):
        if not isinstance(entry, bool | int | float | None):
            raise ValueError(
                f"column {name!r} of {source} holds lists that are not vectors of numbers; in "
                f"row {row} there is {one_line(repr(entry), 40)}"
            )
    entries = [entry for cell in rows for entry in cell if entry is not None]
    truths = bool(entries) and all(isinstance(entry, bool) for entry in entries)
    return np.array(rows, object if truths else float).reshape(len(rows), width)
