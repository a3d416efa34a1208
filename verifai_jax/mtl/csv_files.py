"""CSV files as Arrow tables, whatever separates their columns and their decimals.

read_csv(Path("flight.csv"))                    # comments, a row of units, decimal commas
"""

import re
from collections.abc import Sequence
from pathlib import Path

from verifai_jax.mtl.columns import is_numeric
from verifai_jax.mtl.containers import UNIT, Table

NUMBER = re.compile(r'^\s*"?[-+]?[.,]?\d')
"""The beginning of a number, or of a date."""
DECIMAL_COMMAS = r"^\s*[-+]?\d*(,\d*)?([eE][-+]?\d+)?\s*$"
"""Numbers with a decimal comma, `1,5`, and those without decimals."""
THOUSANDS = r"^\s*[-+]?(\d{1,3}|[1-9]\d{0,2},\d{3})\s*$"
"""Numbers in which a comma, where there is one, may stand between thousands, `1,500`."""


def read_csv(path: Path) -> Table:
    """Read a CSV file as an Arrow table, whatever separates its columns and its decimals."""
    from pyarrow import csv

    with open(path, encoding="utf-8", errors="replace") as file:
        comments, first = 0, file.readline()
        while first.startswith("#"):
            comments, first = comments + 1, file.readline()
        second, third = file.readline(), file.readline()
    separator = max((",", ";", "\t"), key=first.count)
    below = [line.rstrip("\n").split(separator) for line in (second, third)]
    units = _are_units(*below)
    parsed = csv.ParseOptions(delimiter=separator)
    skipped = csv.ReadOptions(skip_rows=comments, skip_rows_after_names=int(units))
    table = csv.read_csv(path, parse_options=parsed, read_options=skipped)
    named = list(zip(table.column_names, table.columns, strict=True))
    commas = [name for name, column in named if _all_match(column, DECIMAL_COMMAS)]
    if not commas:
        return _with_units(table, below[0]) if units else table
    # Semicolons between the columns are there because commas are those of decimals.
    unclear = [name for name in commas if _all_match(table.column(name), THOUSANDS)]
    if unclear and separator != ";":
        cell = next(cell for cell in table.column(unclear[0]).to_pylist() if cell and "," in cell)
        raise ValueError(
            f"{path} has {cell.strip()!r} in column {unclear[0]!r}, which may have a decimal comma "
            "or one between thousands: write it without, or put semicolons between the columns"
        )
    again = csv.read_csv(
        path,
        parse_options=parsed,
        read_options=skipped,
        convert_options=csv.ConvertOptions(decimal_point=","),
    )
    for (name, before), after in zip(named, again.columns, strict=True):
        if is_numeric(before) and not is_numeric(after):
            raise ValueError(
                f"{path} has decimal commas in column {commas[0]!r} and decimal points in column "
                f"{name!r}: write all numbers in one way"
            )
    return _with_units(again, below[0]) if units else again


def _are_units(second: list[str], third: list[str]) -> bool:
    """Return whether the row below the names has texts alone, and the next one numbers."""
    named = [cell.strip().strip('"') for cell in second]
    constants = {"nan", "null", "na", "true", "false"}
    values = any(NUMBER.match(cell) or cell.lower() in constants for cell in named)
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
