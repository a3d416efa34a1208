"""Recorded signals as a trace: from files and tables, of one clock or of several.

    read("flight.csv")                                        # a column `time`
    read(frame, dt=0.02)                                      # a pandas.DataFrame
    read("drive.mcap", resample_to=0.1, method="hold")        # topics that arrive when they do
    read(["imu.csv", "gps.csv"], missing={"speed": "hold"}, resample_to=0.1, method="linear")

CSV files may have comments, a row of units, and decimal commas.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.addons.monitoring import containers
from verifai_jax.addons.monitoring.columns import (
    LeftOut,
    epoch_unit,
    is_numeric,
    numbers_of,
    seconds_of,
)
from verifai_jax.addons.monitoring.containers import UNIT, Episode, Table
from verifai_jax.addons.monitoring.resampling import (
    Method,
    Missing,
    check_increasing,
    joined,
    resample,
    without_gaps,
)
from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.values.trace import Trace

if TYPE_CHECKING:
    import pandas as pd
ENDINGS = (".csv", ".parquet", ".npz", ".mcap", ".nc", ".zarr", ".h5", ".hdf5")
"""Endings of files that are recordings."""


class TimeColumnError(ValueError):
    """An error for a recording without the column of its sample times.

    `fact` is the message without its advice; `columns` are the existing columns.
    """

    def __init__(self, fact: str, columns: Sequence[str]) -> None:
        self.fact, self.columns = fact, tuple(columns)
        super().__init__(
            f"{fact}: give the sampling period dt, or the name of the column. "
            f"It has: {', '.join(columns)}"
        )


def read(
    source: "str | Path | Episode | pd.DataFrame | Sequence[str | Path]",
    *,
    time: str | Mapping[str, Sequence[str]] = "time",
    dt: float | None = None,
    columns: Sequence[str] | None = None,
    resample_to: float | None = None,
    method: Method | None = None,
    missing: Missing | Mapping[str, Missing] | None = None,
    episode: int | None = None,
) -> Trace:
    """Read a trace from a file or a table: its columns, topics or variables are signals.

    Columns `p[0]`, `p[1]`, ... become one vector signal `p`, and so does a column of lists of equal
    length. Columns without numbers are left out, with a note, unless named in `columns`. An empty
    cell is a gap (NaN). In a CSV file commas, semicolons or tabs separate the columns, as the first
    line shows; numbers may have a decimal comma if all of them do. Comment lines (`#`) before the
    names are skipped, and a row of units may follow the names.

    Data with several clocks, such as the topics of an MCAP file, the groups of an HDF5 file or
    several files, become one trace with the instants of all clocks; a signal has a gap where only
    others have a sample. Resampling with `"hold"` then repeats each signal's own last value.

    **Arguments:**
    - `source`: the path of a `.csv` (first line: names), `.parquet`, `.npz` (each array is a
      column), `.mcap`, `.nc`, `.h5` or `.hdf5` file, of a `.zarr` store, or of the folder of a
      LeRobot data set; a `pandas.DataFrame`, whose index is a column if it has a name; or several
      paths.
    - `time`: the column of sample times in seconds, of dates (ISO 8601 as text) or of durations.
      Dates and durations become seconds since the first one, and so do numbers that can only be
      milli-, micro- or nanoseconds since 1970, with a note. For several clocks in one table, a
      dictionary from each clock to its columns, `{"t_imu": ["gyro"], "t_gps": ["speed"]}`.
    - `dt`: the sampling period, if there is no column of times.
    - `columns`: the signals to read; all when left out.
    - `resample_to`, `method`: a period to resample to, and the method (`"hold"` or `"linear"`).
    - `missing`: how to fill gaps, for all signals or by name: `"hold"`, with the signal's own last
      value; `"interpolate"`, linearly between its neighbours; `"drop"` removes the instants. By
      default gaps remain.
    - `episode`: number of an episode of a LeRobot data set.
    **Raises:** `FileNotFoundError`; `MissingExtra` for a kind of file whose package is not
    installed; `ValueError` for another kind of file, no rows, a column that does not exist or
    contains no numbers, a text among numbers, times that do not increase, or `resample_to` without
    `method`.
    """
    if (resample_to is None) != (method is None):
        raise ValueError('resampling needs both: resample_to=PERIOD, method="hold" or "linear"')
    name, tables = _tables(source, "time" if isinstance(time, Mapping) else time, episode)
    if isinstance(time, Mapping):
        tables = [_of_clock(name, tables, clock, own) for clock, own in time.items()]
        time = "time"
    units = {name: unit for _, said in tables for name, unit in said.items()}
    notes: dict[str, int] = {}
    parts, clocks = [], []
    for table, _ in tables:
        if time not in table and dt is None:
            raise TimeColumnError(f"{name} has no column {time!r} of sample times", list(table))
        clocks.append(table.pop(time, None))
        parts.append(_values(name, table, columns, notes))
    if columns is None and not any(parts):
        raise ValueError(f"{name} has no column of numbers")
    if dt is not None:
        if len(parts) > 1:
            raise ValueError(f"{name} has {len(parts)} clocks, so one period dt is not enough")
        times, values = None, parts[0]
    else:
        stamps = [seconds_of(name, time, clock) for clock in clocks]
        for clock in clocks:
            if is_numeric(clock) and (unit := epoch_unit(numbers_of(name, time, clock))) != "s":
                notes[
                    f"column {time!r} is read as {unit} since 1970, in seconds from the first"
                ] = 1
        for seconds, _ in stamps:
            check_increasing(seconds)
        times, values = (stamps[0][0], parts[0]) if len(parts) == 1 else joined(stamps, parts)
    signals = _signals(name, values, columns)
    units = {each: unit for each in signals if (unit := units.get(each) or units.get(f"{each}[0]"))}
    trace = Trace(signals, dt=dt, times=times, notes=notes, units=units)
    if missing is not None:
        trace = without_gaps(trace, missing)
    if resample_to is not None and method is not None:
        return resample(trace, resample_to, method)
    return trace


Columns = dict[str, Any]


def _tables(
    source: "str | Path | Episode | pd.DataFrame | Sequence[str | Path]",
    time: str,
    episode: int | None,
) -> tuple[str, list[tuple[Columns, dict[str, str]]]]:
    """Return how a recording is called, and the columns of each of its clocks with their units."""
    if isinstance(source, Episode):
        source, episode = source.path, source.number
    if isinstance(source, str | Path):
        path = Path(source)
        if not path.exists():
            raise FileNotFoundError(f"there is no recording {path}")
        if files := containers.lerobot_files(path):
            path = _file_of_episode(path, files, episode)
        return str(path), [_columns(path, table) for table in _file_tables(path, time, episode)]
    if isinstance(source, Sequence) and all(isinstance(each, str | Path) for each in source):
        found = [_tables(each, time, episode) for each in source]
        if not found:
            raise ValueError("there is no recording: the list of files is empty")
        tables = [table for _, several in found for table in several]
        _refuse_repeated("the files", [name for own, _ in tables for name in own if name != time])
        return " and ".join(name for name, _ in found), tables
    return "the data frame", [(_frame_columns(source), {})]  # pyright: ignore[reportArgumentType]


def _file_of_episode(folder: Path, files: Sequence[Path], episode: int | None) -> Path:
    known = list(containers.episodes_of(files))
    if episode is None and len(known) == 1:
        return known[0].path
    named = [each.path for each in known if each.number == episode]
    if not named:
        last = known[-1].number if known else -1
        wanted = "name one of its episodes" if episode is None else f"it has no episode {episode}"
        raise ValueError(f"{folder} is a LeRobot data set: {wanted}, episode=0 to {last}")
    return named[0]


def _columns(path: Path, table: Table) -> tuple[Columns, dict[str, str]]:
    names = table.column_names
    if table.num_rows == 0:
        raise ValueError(f"{path} has no rows")
    _refuse_repeated(str(path), names)
    said = {field.name: (field.metadata or {}).get(UNIT, b"").decode() for field in table.schema}
    return {name: table.column(name) for name in names}, {n: u for n, u in said.items() if u}


def _of_clock(
    source: str, tables: list[tuple[Columns, dict[str, str]]], clock: str, names: Sequence[str]
) -> tuple[Columns, dict[str, str]]:
    """Return the columns of one of several clocks of a table, its times as `time`."""
    columns = {name: column for table, _ in tables for name, column in table.items()}
    for name in (clock, *names):
        if name not in columns:
            raise missing_name(source, "column", name, columns)
    given = columns[clock].is_valid()
    units = {name: unit for _, said in tables for name, unit in said.items()}
    found = {"time": clock} | {name: name for name in names}
    return {name: columns[column].filter(given) for name, column in found.items()}, units


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


def _file_tables(path: Path, time: str, episode: int | None) -> list[Table]:
    """Read the Arrow tables of a file, one for each of its clocks."""
    import pyarrow

    readers = {
        ".csv": lambda: [read_csv(path)],
        ".parquet": lambda: containers.read_parquet(path, time, episode),
        ".npz": lambda: [_read_arrays(path)],
        ".mcap": lambda: containers.read_mcap(path, time),
        ".nc": lambda: containers.read_dataset(path, time),
        ".zarr": lambda: containers.read_dataset(path, time),
        ".h5": lambda: containers.read_hdf5(path, time),
        ".hdf5": lambda: containers.read_hdf5(path, time),
    }
    ending = path.suffix.lower()
    if ending not in readers:
        known = f"{', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}"
        raise ValueError(f"a recording is a {known} file; got {path.name}")
    if episode is not None and ending != ".parquet":
        raise ValueError(f"episodes are those of a LeRobot data set; {path.name} has none")
    try:
        return readers[ending]()
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} cannot be read: the names of its columns are not UTF-8 ({error}); save it as "
            "UTF-8"
        ) from None
    except (pyarrow.ArrowInvalid, OSError) as error:
        # A row with more cells than the first line has names is often one of decimal commas.
        advice = ". Decimal commas need semicolons between the columns"
        advice = advice if "Expected" in str(error) else ""
        raise ValueError(f"{path} cannot be read: {error}{advice}") from None


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
            columns[name] = containers.matrix_column(array)
    return pyarrow.table(columns)


def _values(
    source: str, table: Columns, columns: Sequence[str] | None, notes: dict[str, int]
) -> dict[str, np.ndarray]:
    """Return columns as numbers, and put a note on each that is left out."""
    values: dict[str, np.ndarray] = {}
    for name, column in table.items():
        try:
            values[name] = numbers_of(source, name, column)
        except ValueError as error:
            if columns is not None and name in columns:
                raise
            why = str(error).replace(f" of {source}", "", 1)
            notes[LeftOut(f"{why}: it is left out", name)] = 1
    return values


def _signals(
    source: str, values: dict[str, np.ndarray], columns: Sequence[str] | None
) -> dict[str, np.ndarray]:
    """Return the signals of columns by name: scalars, and vectors of several columns."""
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
    return signals


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


NUMBER = re.compile(r'^\s*"?[-+]?[.,]?\d')
"""The beginning of a number, or of a date."""
DECIMAL_COMMAS = r"^\s*[-+]?\d*(,\d*)?([eE][-+]?\d+)?\s*$"
"""Numbers with a decimal comma, `1,5`, and those without decimals."""
THOUSANDS = r"^\s*[-+]?(\d{1,3}|[1-9]\d{0,2},\d{3})\s*$"
"""Numbers in which a comma, where there is one, may stand between thousands, `1,500`."""


def read_csv(path: Path) -> Table:
    """Read a CSV file as an Arrow table with any separator of columns and decimals."""
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
            f"{path} has {cell.strip()!r} in column {unclear[0]!r}, whose comma may be a decimal "
            "comma or separate thousands: write it without a comma, or separate the columns by "
            "semicolons"
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
                f"{name!r}: use the same for all numbers"
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
