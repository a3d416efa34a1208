"""CSV files with comments, a row of units, any separator and decimal commas as Arrow tables.

table = read_csv(Path("drive.csv"), notes)          # notes receives what was left out
"""

import io
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from verifai_jax.addons.monitoring.columns import GAPS, TRUTHS, is_numeric
from verifai_jax.addons.monitoring.containers import UNIT, Table
from verifai_jax.addons.monitoring.readers import Asked
from verifai_jax.addons.monitoring.units import NONE
from verifai_jax.core.messages.text import counted, shorten
from verifai_jax.core.store.foreign_files import MAX_BYTES, ForeignFileError, decoded, read_bytes

NUMBER = re.compile(r'^\s*"?[-+]?[.,]?\d')
"""The beginning of a number, or of a date."""
DECIMAL_COMMAS = r"^\s*[-+]?\d*(,\d*)?([eE][-+]?\d+)?\s*$"
"""Numbers with a decimal comma, `1,5`, and those without decimals."""
THOUSANDS = r"^\s*[-+]?(\d{1,3}|[1-9]\d{0,2},\d{3})\s*$"
"""Numbers in which a comma, where there is one, may stand between thousands, `1,500`."""


def read_delimited(path: Path, asked: Asked) -> list[Table]:
    """Read a CSV file, which may be compressed by gzip."""
    return [read_csv(path, asked.notes)]


def _unzipped(path: Path, data: bytes, notes: dict[str, int]) -> bytes:
    """Return the content of a gzip file; of one that is cut or damaged, what is before."""
    whole, rest, damage = [], data, ""
    while rest and not damage:
        unpacking = zlib.decompressobj(31)  # One member after the other, as gzip appends them.
        while not unpacking.eof and not damage:
            try:
                part = unpacking.decompress(rest, 1 << 24)
            except zlib.error as error:
                damage = str(error)
                break
            whole.append(part)
            if sum(map(len, whole)) > MAX_BYTES:
                raise ForeignFileError(f"{path} unpacks to more than {MAX_BYTES:,} bytes")
            rest = unpacking.unconsumed_tail
            damage = "it ends too early" if not (rest or part or unpacking.eof) else ""
        rest = unpacking.unused_data.lstrip(b"\0")
    if damage and not any(whole):
        raise ValueError(f"{path} is no gzip file, or is damaged: {damage}")
    if damage:
        notes[f"{path} is damaged or was cut ({damage}): what is before is read"] = 1
    return b"".join(whole)


def read_csv(path: Path, notes: dict[str, int]) -> Table:
    """Read a CSV file as an Arrow table with any separator of columns and decimals."""
    from pyarrow import csv

    data = read_bytes(path)
    if path.suffix.lower() == ".gz":
        data = _unzipped(path, data, notes)
    if not data.isascii() or b"\0" in data[:2]:
        text, note = decoded(path, data, cut=True)
        data = text.encode()
        notes |= {note: 1} if note else {}
    with io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig", errors="replace") as file:
        comments, first = 0, file.readline()
        while first.startswith("#"):
            comments, first = comments + 1, file.readline()
        second, third = file.readline(), file.readline()
    separator = max((",", ";", "\t"), key=first.count)
    below = [line.rstrip("\n").split(separator) for line in (second, third)]
    units = _are_units(*below)
    data = _without_cut_line(data, first.count(separator), separator, notes)
    odd: list[Any] = []
    parsed = csv.ParseOptions(
        delimiter=separator, invalid_row_handler=lambda row: odd.append(row) or "skip"
    )
    skipped = csv.ReadOptions(skip_rows=comments, skip_rows_after_names=int(units))
    words: dict[str, Any] = {
        "null_values": GAPS,
        "true_values": [word for word, truth in TRUTHS.items() if truth],
        "false_values": [word for word, truth in TRUTHS.items() if not truth],
    }

    def table_with(point: str) -> Table:
        converted = csv.ConvertOptions(decimal_point=point, **words)
        odd.clear()
        table = csv.read_csv(io.BytesIO(data), skipped, parsed, converted)
        if len(odd) > table.num_rows:
            raise ValueError(
                f"{path} cannot be read: {_said_of(odd)}. Decimal commas need semicolons between "
                "the columns"
            )
        return table

    table = table_with(".")
    if odd:
        notes[f"{_said_of(odd)}, and left out"] = len(odd)
    named = list(zip(table.column_names, table.columns, strict=True))
    commas = [name for name, column in named if _all_match(column, DECIMAL_COMMAS)]
    if not commas:
        return _with_units(table, below[0]) if units else table
    # Semicolons between the columns are there because commas are those of decimals.
    unclear = [name for name in commas if _all_match(table.column(name), THOUSANDS)]
    if unclear and separator != ";":
        cell = next(cell for cell in table.column(unclear[0]).to_pylist() if cell and "," in cell)
        raise ValueError(
            f"{path} has {cell.strip()!r} in column {unclear[0]!r}, whose comma may be a decimal "
            "comma or separate thousands: write it without a comma, or separate the columns by "
            "semicolons"
        )
    again = table_with(",")
    for (name, before), after in zip(named, again.columns, strict=True):
        if is_numeric(before) and not is_numeric(after):
            raise ValueError(
                f"{path} has decimal commas in column {commas[0]!r} and decimal points in column "
                f"{name!r}: use the same for all numbers"
            )
    return _with_units(again, below[0]) if units else again


def _said_of(odd: Sequence[Any]) -> str:
    """Say which rows have more or fewer cells than the first line has names."""
    cells, names = odd[0].actual_columns, odd[0].expected_columns
    rows = f"{counted(len(odd), 'row')} such as {shorten(odd[0].text)!r}"
    return f"{rows}: {counted(cells, 'cell')} where there are {counted(names, 'name')}"


def _without_cut_line(data: bytes, separators: int, separator: str, notes: dict[str, int]) -> bytes:
    """Return a table without its last line where that was cut, as by a loss of power."""
    whole, end, last = data.rstrip(b"\0\r\n").rpartition(b"\n")
    before, cells = (
        line.decode("utf-8", "replace").strip().split(separator)
        for line in (whole.rpartition(b"\n")[2], last)
    )
    open_end = not data.endswith((b"\n", b"\r"))
    torn = len(cells) <= separators or (
        open_end and _is_cell(before[-1], separator) and not _is_cell(cells[-1], separator)
    )
    if torn and end and len(before) > separators:
        notes[f"the last line {separator.join(cells)!r} was cut, and is left out"] = 1
        return whole + end
    if open_end:
        notes["the last line has no end: its last number may have been cut"] = 1
    return data.rstrip(b"\0")


def _is_cell(cell: str, separator: str) -> bool:
    """Return whether a cell is a whole number or a truth value."""
    try:
        float(cell.replace(",", ".") if separator == ";" else cell)
    except ValueError:
        return cell in TRUTHS
    return True


def _are_units(second: list[str], third: list[str]) -> bool:
    """Return whether the row below the names has texts alone, and the next one numbers."""
    named = [cell.strip().strip('"') for cell in second]
    values = any(NUMBER.match(c) or c in TRUTHS or (c in GAPS and c not in NONE) for c in named)
    if values or len(named) != len(third):
        return False
    return any(cell and NUMBER.match(below) for cell, below in zip(named, third, strict=True))


def _with_units(table: Table, units: Sequence[str]) -> Table:
    """Return an Arrow table with the units of its columns."""
    import pyarrow

    if len(units) != table.num_columns:
        return table
    pairs = zip(table.schema, units, strict=True)
    fields = [field.with_metadata({UNIT: unit.strip(' "[]()')}) for field, unit in pairs]
    return pyarrow.Table.from_arrays(table.columns, schema=pyarrow.schema(fields))


def _all_match(column: Table, number: str) -> bool:
    """Return whether a column of text holds numbers of a form, and nothing else."""
    from pyarrow import compute, types

    if not types.is_string(column.type) or column.null_count == len(column):
        return False
    fits = compute.match_substring_regex(column, number)  # pyright: ignore[reportAttributeAccessIssue]
    return bool(compute.all(fits, skip_nulls=True).as_py())  # pyright: ignore[reportAttributeAccessIssue]
