"""Recordings of several clocks: MCAP, NetCDF, Zarr and HDF5 as Arrow tables, LeRobot's episodes.

Each table has one clock: a topic of MCAP, the variables of one dimension, or a group with its own
times. The caller names its column of times. Nothing in a file is unpickled.
"""

import itertools
import json
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from verifai_jax.addons.monitoring.columns import LeftOut
from verifai_jax.addons.monitoring.stamps import find_clock, unit_in_name
from verifai_jax.core.messages.errors import MissingExtra, require
from verifai_jax.core.messages.text import counted, format_error, one_line
from verifai_jax.core.store.foreign_archives import check_values
from verifai_jax.core.store.foreign_archives import read_parquet as read_parquet_file
from verifai_jax.core.store.foreign_files import open_file

Table: TypeAlias = Any
"""An Arrow table, whose package has no types."""
Decoder: TypeAlias = Callable[[bytes], Any]
EXTRA = "recordings"
UNIT = b"unit"
"""Key of Arrow's metadata of a field under which its unit stands."""
MAX_ENTRIES = 64
"""Numbers of a list in a message that is a vector signal; longer ones are images and clouds."""
EPISODE, FRAME, STAMP = "episode_index", "frame_index", "timestamp"
"""Columns of a LeRobot data set."""


class Episode(NamedTuple):
    """An episode of a LeRobot data set: a file, and its number."""

    path: Path
    number: int


def table_of(columns: Mapping[str, Any], units: Mapping[str, str] | None = None) -> Table:
    """Return columns by name as an Arrow table with the units of some of them."""
    import pyarrow

    arrays = {name: pyarrow.array(column) for name, column in columns.items()}
    fields = [
        pyarrow.field(name, array.type, metadata={UNIT: (units or {}).get(name, "")})
        for name, array in arrays.items()
    ]
    return pyarrow.Table.from_arrays(list(arrays.values()), schema=pyarrow.schema(fields))


def matrix_column(array: np.ndarray) -> Any:
    """Return an array `[time]` or `[time, k]` as a column of numbers or of lists."""
    import pyarrow

    long = array.dtype.kind == "f" and array.dtype.itemsize > 8
    native = np.dtype(float) if long else array.dtype.newbyteorder("=")
    flat = pyarrow.array(np.ascontiguousarray(array, native).reshape(-1))
    wide = array.ndim == 2
    return pyarrow.FixedSizeListArray.from_arrays(flat, array.shape[1]) if wide else flat


def table_of_arrays(
    arrays: Mapping[str, np.ndarray], clock: str | None, notes: dict[str, int],
    units: Mapping[str, str] | None = None,
) -> Table:  # fmt: skip
    """Return arrays as a table, without those that are no signals, of which there is a note.

    **Arguments:**
    - `clock`: the array of the sample times, as long as all signals.
    """
    lengths = [len(array) for array in arrays.values() if array.ndim]
    usual = max(lengths, key=lengths.count, default=0)
    length = usual if clock is None else len(arrays[clock])
    columns = {}
    for name, array in arrays.items():
        if array.ndim not in (1, 2):
            why = f"must have shape [time] or [time, k]; got {list(array.shape)}"
        elif len(array) != length:
            why = f"has {len(array)} rows, where others have {length}"
        elif array.dtype.kind not in "biufSUMm":
            why = f"holds {array.dtype}, and no numbers"
        else:
            columns[name] = matrix_column(array)
            continue
        notes[LeftOut(f"column {name!r} {why}: it is left out", name)] = 1
    return table_of(columns, units)


def bag_files(folder: Path) -> list[Path]:
    """Return the files of a folder that is one bag: those that ROS 2's `metadata.yaml` names.

    Without it, `NAME_0.mcap`, `NAME_1.mcap` and so on are one if their folder is called `NAME`, or
    if each begins within a second after the one before ends.
    """
    files = [file for file in folder.glob("*.mcap") if re.search(r"_\d+$", file.stem)]
    files.sort(key=lambda file: int(file.stem.rpartition("_")[2]))
    stems = {file.stem.rpartition("_")[0] for file in files}
    if len(stems) != 1:
        return []
    named = (folder / "metadata.yaml").is_file() or stems == {folder.resolve().name}
    return files if named or _follow_each_other(files) else []


def _follow_each_other(files: Sequence[Path]) -> bool:
    reader, spans = require("mcap.reader", EXTRA), []
    for each in files:
        try:
            with open_file(each) as file:
                about = reader.make_reader(file).get_summary().statistics
                spans.append((about.message_start_time, about.message_end_time))
        except (require("mcap.exceptions", EXTRA).McapError, AttributeError):
            return False  # A damaged file, or one without a summary.
    return all(0 <= b[0] - a[1] <= 10**9 for a, b in itertools.pairwise(spans))


def _messages(path: Path, notes: dict[str, int]) -> Iterator[tuple[Any, Any, Any]]:
    """Yield the messages of an MCAP file; of one that is damaged, those before the damage."""
    reader, count = require("mcap.reader", EXTRA), 0
    try:
        with open_file(path) as file:
            for each in reader.make_reader(file).iter_messages():
                count += 1
                yield each
        return
    except Exception as error:  # Those of decompression are no McapError.
        if count:
            raise ValueError(f"{path} cannot be read: {one_line(str(error))}") from None
        damage = error
    try:
        with open_file(path) as file:
            for each in reader.NonSeekingReader(file).iter_messages(log_time_order=False):
                count += 1
                yield each
    except Exception as error:
        damage = error
    if not count:
        raise ValueError(f"{path} cannot be read: {one_line(format_error(damage))}")
    notes[f"{path} is damaged or was cut: only its first {count} messages are read"] = 1


def read_mcap(paths: Sequence[Path], time: str, notes: dict[str, int]) -> list[Table]:
    """Read the topics of MCAP files that are one bag, each with the log times of its messages.

    Fields of messages become columns: `/odom` and `twist.linear.x` become `odom.twist.linear.x`.
    JSON, ROS 2 and Protobuf messages are read; other topics, and messages that cannot be decoded,
    are left out.

    **Arguments:**
    - `notes`: receives a note on each topic, and on the messages of each, that are left out.
    **Raises:** `MissingExtra`; `ValueError` for a file that is damaged or has no such topic.
    """
    import pyarrow

    require("mcap", EXTRA)
    decoders: dict[tuple[Path, int], Decoder | None] = {}
    topics: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    faults: dict[str, list[Exception]] = {}
    for path in paths:
        for schema, channel, message in _messages(path, notes):
            topic, key = channel.topic.strip("/").replace("/", "."), (path, channel.id)
            row: dict[str, Any] = {}
            # Decoders of other packages raise what they like, and one topic is not the others.
            try:
                if key not in decoders:
                    decoders[key] = _decoder(channel.message_encoding, schema)
                decode = decoders[key]
                if decode is None:
                    kind = channel.message_encoding
                    notes[f"topic {channel.topic} is left out: its messages are {kind!r}"] = 1
                    continue
                _flatten(topic, decode(message.data), row)
            except MissingExtra:
                raise
            except Exception as error:
                faults.setdefault(channel.topic, []).append(error)
                continue
            topics.setdefault(topic, []).append((message.log_time, row))
    for topic, errors in faults.items():
        said, why = counted(len(errors), "message"), f"{type(errors[0]).__name__}: {errors[0]}"
        note = f"{said} of topic {topic} cannot be decoded, and left out: {one_line(why)}"
        notes[note] = len(errors)
    if not topics:
        said = "".join(f"; {note}" for note in notes)
        raise ValueError(f"{paths[0]} has no topic of JSON, ROS 2 or Protobuf messages{said}")
    tables = []
    for rows in topics.values():
        rows.sort(key=operator.itemgetter(0))
        names = dict.fromkeys(name for _, row in rows for name in row)
        stamps = pyarrow.array([at for at, _ in rows], pyarrow.timestamp("ns"))
        columns = {name: _cells([row.get(name) for _, row in rows]) for name in names}
        tables.append(table_of({time: stamps, **columns}))
    return tables


def _decoder(encoding: str, schema: Any) -> Decoder | None:
    if encoding == "json":
        return json.loads
    package = {"cdr": "mcap_ros2.decoder", "protobuf": "mcap_protobuf.decoder"}.get(encoding)
    if package is None:
        return None
    return require(package, EXTRA).DecoderFactory().decoder_for(encoding, schema)


def _flatten(prefix: str, value: Any, row: dict[str, Any]) -> None:
    """Put the numbers of a message, and its short lists of numbers, into a row."""
    if isinstance(value, bool | int | float):
        row[prefix] = value
    elif isinstance(value, str | bytes | None):
        return
    elif isinstance(value, Mapping):
        for name, part in value.items():
            _flatten(f"{prefix}.{name}", part, row)
    elif hasattr(value, "DESCRIPTOR"):
        for part in value.DESCRIPTOR.fields:
            _flatten(f"{prefix}.{part.name}", getattr(value, part.name), row)
    elif hasattr(value, "__len__"):
        entries = list(value) if len(value) <= MAX_ENTRIES else []
        if entries and all(isinstance(entry, bool | int | float) for entry in entries):
            row[prefix] = entries
    else:
        for name in getattr(value, "__slots__", vars(value)):
            _flatten(f"{prefix}.{name}", getattr(value, name), row)


def _cells(cells: list[Any]) -> Any:
    """Return cells of one kind unchanged, and others as texts, which do not become a signal."""
    import pyarrow

    try:
        return pyarrow.array(cells)
    except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError, OverflowError):
        return pyarrow.array([None if cell is None else str(cell) for cell in cells])


def read_dataset(path: Path, time: str, notes: dict[str, int]) -> list[Table]:
    """Read the variables of a NetCDF file or a Zarr store as one table for each first dimension.

    **Raises:** `MissingExtra`; `ValueError` for a file that cannot be read.
    """
    xarray = require("xarray", EXTRA)
    store = path.suffix.lower() == ".zarr"
    try:
        # Versions of xarray differ in the units of the times that they make.
        opened = xarray.open_zarr if store else xarray.open_dataset
        if not store:
            open_file(path).close()
        with opened(path, decode_times=False) as dataset:
            for name, variable in dataset.variables.items():
                check_values(variable.size, f"{name} of {path}")
            return list(_dimensions(dataset, time, notes))
    except (ImportError, ValueError) as error:
        require("netCDF4", EXTRA)
        raise ValueError(f"{path} cannot be read: {error}") from None


def _dimensions(dataset: Any, time: str, notes: dict[str, int]) -> Iterator[Table]:
    tables: dict[str, dict[str, np.ndarray]] = {}
    units: dict[str, str] = {}
    for name, variable in dataset.data_vars.items():
        if variable.ndim in (1, 2):
            tables.setdefault(variable.dims[0], {})[str(name)] = variable.values
            units[str(name)] = str(variable.attrs.get("units", ""))
    for dimension, columns in tables.items():
        known = {str(n): v for n, v in dataset.variables.items() if v.dims == (dimension,)}
        name = find_clock(known, time) or (str(dimension) if dimension in known else None)
        own = {each: array for each, array in columns.items() if each != name}
        clock = {} if name is None else {time: known[name].values}
        said = {} if name is None else {time: known[name].attrs.get("units") or unit_in_name(name)}
        yield table_of_arrays({**clock, **own}, time if clock else None, notes, {**units, **said})


def read_hdf5(path: Path, time: str, notes: dict[str, int]) -> list[Table]:
    """Read the data sets of an HDF5 file, each with the times of the nearest enclosing group.

    Group names become part of the name: `imu/gyro` becomes `imu.gyro`.

    **Raises:** `MissingExtra`; `ValueError` for a file that cannot be read.
    """
    found: dict[str, Any] = {}
    units: dict[str, str] = {}

    def visit(name: str, item: Any) -> None:
        if getattr(item, "ndim", 0):
            if item.ndim < 3 and item.dtype.kind in "biufS":
                check_values(item.size, f"{name} of {path}")
                found[name] = item[()]
            else:  # What is no signal is left out by its form, unread.
                found[name] = np.broadcast_to(np.empty((), item.dtype), item.shape)
            said = item.attrs.get("units", item.attrs.get("unit", ""))
            units[name] = said.decode() if isinstance(said, bytes) else str(said)

    with open_file(path) as opened, require("h5py", EXTRA).File(opened, "r") as file:
        file.visititems(visit)
    groups: dict[str, list[str]] = {}
    for name in found:
        group, _, last = name.rpartition("/")
        groups.setdefault(group, []).append(last)
    clocks = {group: find_clock(names, time) for group, names in groups.items()}
    tables: dict[str, tuple[dict[str, np.ndarray], dict[str, str]]] = {}
    for name, array in found.items():
        group, _, last = name.rpartition("/")
        own = last == clocks[group]
        while group and clocks.get(group) is None:
            group = group.rpartition("/")[0]
        columns, said = tables.setdefault(group, ({}, {}))
        column = last if own else name.replace("/", ".")
        columns[column], said[column] = array, units[name]
    return [
        table_of_arrays(columns, clocks.get(group), notes, said)
        for group, (columns, said) in tables.items()
    ]


def lerobot_files(folder: Path) -> list[Path]:
    """Return the data files of a LeRobot data set; none for any other folder."""
    if not (folder / "meta" / "info.json").is_file():
        return []
    return sorted((folder / "data").rglob("*.parquet"))


def episodes_of(files: Sequence[Path]) -> Iterator[Episode]:
    """Yield the episodes in data files of a LeRobot data set."""
    for file in files:
        numbers = read_parquet_file(file, [EPISODE]).column(EPISODE).unique()
        yield from (Episode(file, number) for number in sorted(numbers.to_pylist()))


def read_parquet(path: Path, time: str, episode: int | None) -> list[Table]:
    """Read a Parquet file; for a LeRobot data set one episode, with its own time stamps.

    **Raises:** `ValueError` for a file of several episodes if none is named, and for an episode
    that it does not contain.
    """
    from pyarrow import compute

    table = read_parquet_file(path)
    if not {EPISODE, FRAME, STAMP} <= set(table.column_names):
        if episode is not None:
            raise ValueError(f"{path} has no episodes: it lacks the columns of a LeRobot data set")
        return [table]
    numbers = sorted(table.column(EPISODE).unique().to_pylist())
    if episode is None and len(numbers) > 1:
        raise ValueError(
            f"{path} has episodes {numbers[0]} to {numbers[-1]}: name one, as in episode="
            f"{numbers[0]}, or judge all of them"
        )
    if episode is not None:
        if episode not in numbers:
            raise ValueError(f"{path} has no episode {episode}, but {numbers[0]} to {numbers[-1]}")
        table = table.filter(compute.field(EPISODE) == episode)
    if time not in table.column_names:
        names = [time if name == STAMP else name for name in table.column_names]
        table = table.rename_columns(names)
    return [table]
