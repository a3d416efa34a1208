"""Recorded signals as a trace: from CSV and Parquet files, and from uneven sample times.

read("flight.csv")                                        # a column `time`
read(frame, dt=0.02)                                      # a pandas.DataFrame
read("flight.parquet", dt=0.02)                           # rows 0.02 s apart
read("flight.csv", resample_to=0.1, method="linear")
"""

import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.core.errors import missing_name
from verifai_jax.core.trace import Trace
from verifai_jax.mtl.columns import LeftOut, epoch_unit, is_numeric, numbers_of, seconds_of
from verifai_jax.mtl.resampling import Method, check_increasing, resample

if TYPE_CHECKING:
    import pandas as pd

NUMBER = re.compile(r'^\s*"?[-+]?[.,]?\d')
"""The beginning of a number, or of a date."""
DECIMAL_COMMAS = r"^\s*[-+]?\d*(,\d*)?([eE][-+]?\d+)?\s*$"
"""Numbers with a decimal comma, `1,5`, and those without decimals."""
THOUSANDS = r"^\s*[-+]?(\d{1,3}|[1-9]\d{0,2},\d{3})\s*$"
"""Numbers in which a comma, where there is one, may stand between thousands, `1,500`."""

ENDINGS = (".csv", ".parquet", ".npz")
"""Endings of files that are recordings."""


class TimeColumnError(ValueError):
    """A recording without the column of its sample times.

    `fact` says so, without the advice of the message; `columns` are those it has.
    """

    def __init__(self, fact: str, columns: Sequence[str]) -> None:
        self.fact, self.columns = fact, tuple(columns)
        super().__init__(
            f"{fact}: give the sampling period dt, or the name of the column. "
            f"It has: {', '.join(columns)}"
        )


def read(
    source: "str | Path | pd.DataFrame",
    *,
    time: str = "time",
    dt: float | None = None,
    columns: Sequence[str] | None = None,
    resample_to: float | None = None,
    method: Method | None = None,
) -> Trace:
    """Read a trace from a file of CSV, Parquet or NumPy, or a data frame: a column is a signal.

    Columns `p[0]`, `p[1]`, ... make one vector signal `p`, and so does a column of lists of one
    length. Columns that hold no numbers are left out, with a note, unless named in `columns`. An
    empty cell is a gap (NaN). In a CSV file commas, semicolons or tabs separate the columns,
    whichever the first line has; numbers may have a decimal comma, if all of them do. Lines of
    comments (`#`) before the names, and a row of units below them, are passed over.

    **Arguments:**

    - `source`: the path of a `.csv` (first line: names), `.parquet` or `.npz` file (an array of it
      is a column), or a `pandas.DataFrame`, whose index is read as a column if it has a name.
    - `time`: the column of sample times in seconds, or of dates (ISO 8601 where they are text) or
      durations, which become seconds since the first; so do numbers that can only be milli-, micro-
      or nanoseconds since 1970, with a note.
    - `dt`: the sampling period, instead of a column of times.
    - `columns`: the signals to read; all when left out.
    - `resample_to`, `method`: a period to resample to, and how (`"hold"` or `"linear"`).

    **Raises:** `FileNotFoundError`; `ValueError` for another kind of file, no rows, a column that
    does not exist or holds no numbers, a text among numbers, times that do not increase, or
    `resample_to` without `method`.
    """
    if (resample_to is None) != (method is None):
        raise ValueError('resampling needs both: resample_to=PERIOD, method="hold" or "linear"')
    if isinstance(source, str | Path):
        path = Path(source)
        if not path.exists():
            raise FileNotFoundError(f"there is no recording {path}")
        name, table = str(path), _file_columns(path)
    else:
        name, table = "the data frame", _frame_columns(source)
    if time not in table and dt is None:
        raise TimeColumnError(f"{name} has no column {time!r} of sample times", list(table))
    times = table.pop(time, None)
    signals, notes = _signals(name, table, columns)
    if dt is not None:
        trace = Trace(signals, dt=dt, notes=notes)
    else:
        stamps = seconds_of(name, time, times)
        if is_numeric(times) and (unit := epoch_unit(numbers_of(name, time, times))) != "s":
            notes[f"column {time!r} is read as {unit} since 1970, in seconds from the first"] = 1
        check_increasing(stamps)
        trace = Trace(signals, times=stamps, notes=notes)
    if resample_to is not None and method is not None:
        return resample(trace, resample_to, method)
    return trace


def _frame_columns(frame: "pd.DataFrame") -> dict[str, Any]:
    """Return the columns of a data frame by name, as Arrow arrays."""
    import pandas as pd
    import pyarrow

    if not isinstance(frame, pd.DataFrame):
        raise TypeError(
            f"a recording is the path of a file or a pandas.DataFrame; got a {type(frame).__name__}"
        )
    if frame.index.name is not None:
        frame = frame.reset_index()
    if not len(frame):
        raise ValueError("the data frame has no rows")
    names = [str(name) for name in frame.columns]
    _refuse_repeated("the data frame", names)
    table = {}
    for position, name in enumerate(names):
        column = frame.iloc[:, position]
        if column.dtype == object:
            column = list(column)  # Cells may be lists, or numbers with None among them.
        try:
            table[name] = pyarrow.array(column, from_pandas=True)
        except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError, pyarrow.ArrowNotImplementedError):
            texts = [None if _is_missing(cell) else str(cell) for cell in column]
            table[name] = pyarrow.array(texts, pyarrow.string())
    return table


def _is_missing(cell: object) -> bool:
    gap = isinstance(cell, float) and cell != cell
    return cell is None or gap or type(cell).__name__ in ("NAType", "NaTType")


def _refuse_repeated(source: str, names: Sequence[str]) -> None:
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"{source} has more than one column {', '.join(map(repr, repeated))}")


def _file_columns(path: Path) -> dict[str, Any]:
    """Read columns by name, as Arrow arrays."""
    import pyarrow
    from pyarrow import parquet

    readers = {".csv": _read_csv, ".parquet": parquet.read_table, ".npz": _read_arrays}
    if path.suffix.lower() not in readers:
        raise ValueError(f"a recording is a .csv, .parquet or .npz file; got {path.name}")
    try:
        table = readers[path.suffix.lower()](path)
        names = table.column_names
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} cannot be read: the names of its columns are no UTF-8 ({error}); save it as "
            "UTF-8"
        ) from None
    except (pyarrow.ArrowInvalid, OSError) as error:
        # A row with more cells than the first line has names is often one of decimal commas.
        advice = ". Decimal commas need semicolons between the columns"
        advice = advice if "Expected" in str(error) else ""
        raise ValueError(f"{path} cannot be read: {error}{advice}") from None
    if table.num_rows == 0:
        raise ValueError(f"{path} has no rows")
    _refuse_repeated(str(path), names)
    return {name: table.column(name) for name in names}


def _read_csv(path: Path) -> Any:
    """Read a CSV file as an Arrow table, whatever separates its columns and its decimals."""
    from pyarrow import csv

    with open(path, encoding="utf-8", errors="replace") as file:
        comments, first = 0, file.readline()
        while first.startswith("#"):
            comments, first = comments + 1, file.readline()
        second, third = file.readline(), file.readline()
    separator = max((",", ";", "\t"), key=first.count)
    units = _are_units(*(line.rstrip("\n").split(separator) for line in (second, third)))
    parsed = csv.ParseOptions(delimiter=separator)
    skipped = csv.ReadOptions(skip_rows=comments, skip_rows_after_names=int(units))
    table = csv.read_csv(path, parse_options=parsed, read_options=skipped)
    named = list(zip(table.column_names, table.columns, strict=True))
    commas = [name for name, column in named if _all_match(column, DECIMAL_COMMAS)]
    if not commas:
        return table
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
    return again


def _are_units(second: list[str], third: list[str]) -> bool:
    """Return whether the row below the names has texts alone, and the next one numbers."""
    named = [cell.strip().strip('"') for cell in second]
    constants = {"nan", "null", "na", "true", "false"}
    values = any(NUMBER.match(cell) or cell.lower() in constants for cell in named)
    if values or len(named) != len(third):
        return False
    return any(cell and NUMBER.match(below) for cell, below in zip(named, third, strict=True))


def _read_arrays(path: Path) -> Any:
    """Read the arrays of an `.npz` file as an Arrow table; nothing in it is unpickled."""
    import pyarrow

    columns = {}
    with np.load(path, allow_pickle=False) as arrays:
        for name in arrays.files:
            array = arrays[name]
            if array.ndim not in (1, 2):
                raise ValueError(
                    f"array {name!r} of {path} must have shape [time] or [time, k]; "
                    f"got {list(array.shape)}"
                )
            flat = pyarrow.array(array.reshape(-1))
            wide = array.ndim == 2
            columns[name] = (
                pyarrow.FixedSizeListArray.from_arrays(flat, array.shape[1]) if wide else flat
            )
    return pyarrow.table(columns)


def _all_match(column: Any, number: str) -> bool:
    """Return whether a column of text holds numbers of a form, and nothing else."""
    from pyarrow import compute, types

    if not types.is_string(column.type) or column.null_count == len(column):
        return False
    fits = compute.match_substring_regex(column, number)  # pyright: ignore[reportAttributeAccessIssue]
    return bool(compute.all(fits, skip_nulls=True).as_py())  # pyright: ignore[reportAttributeAccessIssue]


def _signals(
    source: str, table: dict[str, Any], columns: Sequence[str] | None
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Return the signals by name, and notes on the columns that are left out."""
    notes: dict[str, int] = {}
    values: dict[str, np.ndarray] = {}
    for name, column in table.items():
        try:
            values[name] = numbers_of(source, name, column)
        except ValueError as error:
            if columns is not None and name in columns:
                raise
            why = str(error).replace(f" of {source}", "", 1)
            notes[LeftOut(f"{why}: it is left out", name)] = 1
    if columns is None and not values:
        raise ValueError(f"{source} has no column of numbers")
    vectors = vector_columns([name for name in values if values[name].ndim == 1])
    in_vectors = {name for parts in vectors.values() for name in parts}
    scalars = [name for name in values if name not in in_vectors]
    wanted = [*scalars, *vectors] if columns is None else list(columns)
    signals = {}
    for name in wanted:
        if name in vectors:
            signals[name] = np.stack([values[part] for part in vectors[name]], axis=1)
        elif name in values:
            signals[name] = values[name]
        else:
            raise missing_name(source, "column", name, [*scalars, *vectors])
    return signals, notes


def vector_columns(names: Collection[str]) -> dict[str, list[str]]:
    """Return the vector signals among columns, `{"p": ["p[0]", "p[1]"]}`, in order."""
    vectors: dict[str, dict[int, str]] = {}
    for name in names:
        stem, bracket, index = name.partition("[")
        if bracket and index.endswith("]") and index[:-1].isdecimal():
            vectors.setdefault(stem, {})[int(index[:-1])] = name
    return {
        stem: [parts[i] for i in range(len(parts))]
        for stem, parts in vectors.items()
        if sorted(parts) == list(range(len(parts))) and stem not in names
    }
