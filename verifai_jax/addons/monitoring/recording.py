"""Recorded signals as a trace: from files and tables, of one clock or of several.

read("flight.csv")                                        # a column `time`
read(frame, dt=0.02)                                      # a pandas.DataFrame
read("drive.mcap", resample_to=0.1, method="hold")        # topics that arrive when they do
read(["imu.csv", "gps.csv"], missing={"speed": "hold"}, resample_to=0.1, method="linear")
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.addons.monitoring import containers, resampling
from verifai_jax.addons.monitoring.columns import LeftOut, numbers_of
from verifai_jax.addons.monitoring.containers import UNIT, Episode, Table
from verifai_jax.addons.monitoring.enumerations import word_columns
from verifai_jax.addons.monitoring.readers import Asked, Stamps, read_tables
from verifai_jax.addons.monitoring.stamps import (
    Repeated,
    apart,
    find_clock,
    in_order,
    last_of_each,
    seconds_of,
    sorted_rows,
)
from verifai_jax.addons.monitoring.topics import bag_files, read_bag_files
from verifai_jax.core.messages.errors import check_names, missing_name
from verifai_jax.core.values.trace import Trace

if TYPE_CHECKING:
    import pandas as pd


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
    time_unit: str | None = None,
    dt: float | None = None,
    columns: Sequence[str] | None = None,
    resample_to: float | None = None,
    method: resampling.Method | None = None,
    missing: resampling.Treatment = None,
    max_gap: float | None = None,
    episode: int | None = None,
    stamps: Stamps = "log",
    sort_times: bool = False,
    repeated: Repeated = "both",
    dbc: str | Path | Sequence[str | Path] = (),
) -> Trace:
    """Read a trace from a file or a table: its columns, topics or variables are signals.

    Columns `p[0]`, `p[1]`, ... become one vector signal `p`, and so does a column of lists of equal
    length. A column `mode` of at most 64 different words becomes truth values, `"mode=AUTO"` and so
    on, which `judge` takes for `mode == "AUTO"`. Other columns without numbers are left out, with a
    note, unless named in `columns`. An empty cell, `-` or `n/a` is a gap (NaN), and words such as
    `true` or `ON` are truth values. In a CSV
    file commas, semicolons or tabs separate the columns, as the first line shows; numbers may have
    a decimal comma if all of them do. Comment lines (`#`) before the names are skipped, and a row
    of units may follow the names. Left out, with a note, are a last line that was cut, rows with
    another number of cells, less than a tenth of the rows if their times are missing or go back,
    messages that cannot be decoded, topics of an unknown kind, and columns of another length.

    Data with several clocks, such as the topics of an MCAP file, the groups of an HDF5 file or
    several files, become one trace with the instants of all clocks; a signal has a gap where only
    others have a sample. Resampling with `"hold"` then repeats each signal's own last value. Times
    that differ by rounding alone are one instant. Samples that repeat the time of the one before
    both count, and a time without a value that is far longer than the period is a note.

    **Arguments:**
    - `source`: the path of a `.csv` or `.tsv` (first line: names, also with `.gz`), `.parquet`,
      `.feather`, `.jsonl`, `.npz` (each array is a column), `.mat`, `.mcap`, `.db3` (ROS 2), `.bag`
      (ROS 1), `.ulg`, `.mf4`, `.nc`, `.h5` or `.hdf5` file, of a `.zarr` store, of the folder of a
      LeRobot data set, or of a bag in several files; a `pandas.DataFrame`, whose index is a column
      if it has a name; or several paths.
    - `time`: the column of sample times: numbers, dates (ISO 8601 as text) or durations. Their unit
      may follow its name (`time [ms]`, `time_ms`), or stand in a row of units or an attribute.
      Dates and durations become seconds since the first one, and so do numbers that can only be
      milli-, micro- or nanoseconds since 1970, with a note. For several clocks in one table, a
      dictionary from each clock to its columns, `{"t_imu": ["gyro"], "t_gps": ["speed"]}`.
    - `time_unit`: the unit of the sample times, whatever the recording says: `"ms"`, `"us"`,
      `"ns"`, `"s"`, `"min"`, `"h"` or `"d"`. Without any, they are in seconds.
    - `dt`: the sampling period, if there is no column of times.
    - `columns`: the signals to read; all when left out.
    - `resample_to`, `method`: a period to resample to, and the method (`"hold"` or `"linear"`).
    - `missing`: how to fill gaps, for all signals or by name: `"hold"`, with the signal's own last
      value; `"interpolate"`, linearly between its neighbours; `"drop"` removes the instants. By
      default gaps remain. A number stands for a gap, `missing=-9999`, also in a list:
      `missing=[-9999, "hold"]`.
    - `max_gap`: the longest time in seconds that a signal may be without a value.
    - `episode`: number of an episode of a LeRobot data set.
    - `stamps`: `"header"` for the times in the headers of a bag's messages, instead of the log's.
    - `sort_times`: whether rows whose times go back are put in order, instead of left out.
    - `repeated`: `"last"` if of samples at one time the last counts, instead of both.
    - `dbc`: `.dbc` files that describe the CAN frames of an MDF file.
    **Raises:** `FileNotFoundError`; `MissingExtra` for a kind of file whose package is not
    installed; `ValueError` for another kind of file, no rows, a column that does not exist or
    contains no numbers, a text among numbers, times that do not increase or are hardly in seconds
    without a unit, a gap above `max_gap`, or `resample_to` without `method`.
    """
    if (resample_to is None) != (method is None):
        raise ValueError('resampling needs both: resample_to=PERIOD, method="hold" or "linear"')
    check_names("kind of stamps", [stamps], ("log", "header"))
    check_names("choice of repeated samples", [repeated], ("both", "last"))
    notes: dict[str, int] = {}
    databases = tuple(map(Path, [dbc] if isinstance(dbc, str | Path) else dbc))
    clock = "time" if isinstance(time, Mapping) else time
    name, tables = _tables(source, Asked(clock, stamps, episode, databases, notes))
    wanted = [time] * len(tables) if isinstance(time, str) else list(time)
    if isinstance(time, Mapping):
        tables = [_of_clock(name, tables, clock, own) for clock, own in time.items()]
    units = _units(tables)
    parts, clocks, unclocked = [], [], []
    for (table, said), each in zip(tables, wanted, strict=True):
        clock = find_clock(table, each)
        if clock is None and dt is None:
            fault = TimeColumnError(f"{name} has no column {each!r} of sample times", list(table))
            if isinstance(source, str | Path | Episode) and len(tables) > 1:
                unclocked.append(fault)
                continue
            raise fault
        column = None if clock is None else table.pop(clock)
        values = _values(name, table, columns, notes)
        if clock is not None and dt is None:
            unit = said.get(clock, "")
            seconds, origin, note = seconds_of(name, clock, column, unit, time_unit)
            notes |= {note: 1} if note else {}
            rows = sorted_rows(seconds, notes) if sort_times else in_order(seconds, notes)
            if repeated == "last":
                rows = last_of_each(seconds, rows, notes)
            values = {each: cells[rows] for each, cells in values.items()}
            clocks.append((apart(seconds[rows], notes), origin))
        parts.append(values)
    for fault in unclocked:
        if not parts:
            raise fault
        for column in fault.columns:
            notes[LeftOut(f"column {column!r} has no sample times: it is left out", column)] = 1
    if columns is None and not any(parts):
        said = "".join(f"; {note}" for note in notes if isinstance(note, LeftOut))
        raise ValueError(f"{name} has no column of numbers{said}")
    if dt is not None and len(parts) > 1:
        raise ValueError(f"{name} has {len(parts)} clocks, so one period dt is not enough")
    try:
        for seconds, _ in clocks:
            resampling.check_increasing(seconds)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    times = clocks[0][0] if clocks else None
    times, values = resampling.joined(clocks, parts) if len(parts) > 1 else (times, parts[0])
    signals = _signals(name, values, columns)
    units = {each: unit for each in signals if (unit := units.get(each) or units.get(f"{each}[0]"))}
    trace = Trace(signals, dt=dt, times=times, notes=notes, units=units)
    trace = resampling.treated(trace, max_gap, missing)
    if resample_to is not None and method is not None:
        return resampling.resample(trace, resample_to, method)
    return trace


Columns = dict[str, Any]


def _tables(
    source: "str | Path | Episode | pd.DataFrame | Sequence[str | Path]", asked: Asked
) -> tuple[str, list[tuple[Columns, dict[str, str]]]]:
    """Return how a recording is called, and the columns of each of its clocks with their units."""
    if isinstance(source, Episode):
        source, asked = source.path, replace(asked, episode=source.number)
    if isinstance(source, str | Path):
        path = Path(source)
        if not path.exists():
            raise FileNotFoundError(f"there is no recording {path}")
        if files := containers.lerobot_files(path):
            path = _file_of_episode(path, files, asked.episode)
        bag = bag_files(path)
        tables = read_bag_files(bag, asked) if bag else read_tables(path, asked)
        return str(path), [_columns(path, table) for table in tables]
    if isinstance(source, Sequence) and all(isinstance(each, str | Path) for each in source):
        found = [_tables(each, asked) for each in source]
        if not found:
            raise ValueError("there is no recording: the list of files is empty")
        tables = [table for _, several in found for table in several]
        names = [name for own, _ in tables for name in own if name != find_clock(own, asked.time)]
        _refuse_repeated("the files", names)
        return " and ".join(name for name, _ in found), tables
    return "the data frame", [(_frame_columns(source), {})]  # pyright: ignore[reportArgumentType]


def _file_of_episode(folder: Path, files: Sequence[Path], episode: int | None) -> Path:
    known = list(containers.episodes_of(files))
    for each in known:
        if each.number == episode or (episode is None and len(known) == 1):
            return each.path
    last = known[-1].number if known else -1
    wanted = "name one of its episodes" if episode is None else f"it has no episode {episode}"
    raise ValueError(f"{folder} is a LeRobot data set: {wanted}, episode=0 to {last}")


def _columns(path: Path, table: Table) -> tuple[Columns, dict[str, str]]:
    names = table.column_names
    if table.num_rows == 0:
        raise ValueError(f"{path} has no rows")
    _refuse_repeated(str(path), names)
    about = [(field.name, field.metadata or {}) for field in table.schema]
    said = {name: (each.get(UNIT) or each.get(b"units") or b"").decode() for name, each in about}
    return {name: table.column(name) for name in names}, {n: u for n, u in said.items() if u}


def _of_clock(
    source: str, tables: list[tuple[Columns, dict[str, str]]], clock: str, names: Sequence[str]
) -> tuple[Columns, dict[str, str]]:
    """Return the columns of one of several clocks of a table."""
    columns = {name: column for table, _ in tables for name, column in table.items()}
    for name in (clock, *names):
        if name not in columns:
            raise missing_name(source, "column", name, columns)
    given = columns[clock].is_valid()
    return {name: columns[name].filter(given) for name in (clock, *names)}, _units(tables)


def _units(tables: list[tuple[Columns, dict[str, str]]]) -> dict[str, str]:
    return {name: unit for _, said in tables for name, unit in said.items()}


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
    for name, (_, column) in zip(names, frame.items(), strict=True):
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


def _values(
    source: str, table: Columns, columns: Sequence[str] | None, notes: dict[str, int]
) -> dict[str, np.ndarray]:
    """Return columns as numbers, and put a note on each that is left out."""
    values: dict[str, np.ndarray] = {}
    for name, column in table.items():
        try:
            values[name] = numbers_of(source, name, column)
        except ValueError as error:
            if words := _words(name, column):
                values |= words
                continue
            if columns is not None and name in columns:
                raise
            why = str(error).replace(f" of {source}", "", 1)
            notes[LeftOut(f"{why}: it is left out", name)] = 1
    return values


def _words(name: str, column: Any) -> dict[str, np.ndarray]:
    """Return a column of words as truth values; nothing for other columns."""
    from pyarrow import types

    kind = column.type.value_type if types.is_dictionary(column.type) else column.type
    if not (types.is_string(kind) or types.is_large_string(kind)):
        return {}
    try:
        return word_columns(name, column.to_pylist())
    except ValueError:
        return {}


def _signals(
    source: str, values: dict[str, np.ndarray], columns: Sequence[str] | None
) -> dict[str, np.ndarray]:
    """Return the signals of columns by name: scalars, and vectors of several columns."""
    vectors = vector_columns([name for name in values if values[name].ndim == 1])
    in_vectors = {name for parts in vectors.values() for name in parts}
    scalars = [name for name in values if name not in in_vectors]
    of_words = {n: [each for each in scalars if each.startswith(f"{n}=")] for n in columns or ()}
    wanted = [*scalars, *vectors]
    if columns is not None:
        wanted = [n for each in columns for n in of_words[each] or [each]]
    signals = {}
    for name in wanted:
        if name in vectors:
            signals[name] = np.ma.stack([values[part] for part in vectors[name]], axis=1)
        elif name in values:
            signals[name] = values[name]
        else:
            raise missing_name(source, "column", name, [*scalars, *vectors])
    return signals


def vector_columns(names: Collection[str]) -> dict[str, list[str]]:
    """Return the vector signals among columns, `{"p": ["p[0]", "p[1]"]}`, in order."""
    vectors: dict[str, dict[int, str]] = {}
    for name in names:
        if found := re.fullmatch(r"([^\[]*)\[(\d+)\]", name, re.DOTALL):
            vectors.setdefault(found[1], {})[int(found[2])] = name
    return {
        stem: [parts[i] for i in range(len(parts))]
        for stem, parts in vectors.items()
        if sorted(parts) == list(range(len(parts))) and stem not in names
    }
