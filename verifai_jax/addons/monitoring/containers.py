"""Recordings of several clocks: NetCDF, Zarr and HDF5 as Arrow tables, LeRobot's episodes.

Each table has one clock: the variables of one dimension, or a group with its own times. The caller
names its column of times. Nothing in a file is unpickled.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from verifai_jax.addons.monitoring.columns import LeftOut
from verifai_jax.addons.monitoring.readers import Asked, Table
from verifai_jax.addons.monitoring.stamps import find_clock, unit_in_name
from verifai_jax.core.messages.errors import require
from verifai_jax.core.store.foreign_archives import check_values
from verifai_jax.core.store.foreign_archives import read_parquet as read_parquet_file
from verifai_jax.core.store.foreign_files import open_file

EXTRA = "recordings"
UNIT = b"unit"
"""Key of Arrow's metadata of a field under which its unit stands."""
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


def read_dataset(path: Path, asked: Asked) -> list[Table]:
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
            return list(_dimensions(dataset, asked.time, asked.notes))
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


def read_hdf5(path: Path, asked: Asked) -> list[Table]:
    """Read the data sets of an HDF5 file, each with the times of the nearest enclosing group.

    MATLAB stores the transposes of its arrays.

    **Raises:** `MissingExtra`; `ValueError` for a file that cannot be read.
    """
    found: dict[str, Any] = {}
    units: dict[str, str] = {}

    def visit(name: str, item: Any) -> None:
        if getattr(item, "ndim", 0):
            kind = item.attrs.get("MATLAB_class")
            if name.startswith("#") or kind == b"char":
                return
            if item.ndim < 3 and item.dtype.kind in "biufS":
                check_values(item.size, f"{name} of {path}")
                found[name] = item[()] if kind is None else item[()].T
                if kind is not None and 1 in item.shape:
                    found[name] = found[name].reshape(-1)
                if kind == b"logical":
                    found[name] = found[name].astype(bool)
            else:  # What is no signal is left out by its form, unread.
                found[name] = np.broadcast_to(np.empty((), item.dtype), item.shape)
            said = item.attrs.get("units", item.attrs.get("unit", ""))
            units[name] = said.decode() if isinstance(said, bytes) else str(said)

    with open_file(path) as opened, require("h5py", EXTRA).File(opened, "r") as file:
        file.visititems(visit)
    return tables_of_groups(found, units, asked)


def tables_of_groups(
    found: Mapping[str, np.ndarray], units: Mapping[str, str], asked: Asked
) -> list[Table]:
    """Return arrays by name as tables, each with the times of the nearest enclosing group.

    Group names become part of the name: `imu/gyro` becomes `imu.gyro`.
    """
    groups: dict[str, list[str]] = {}
    for name in found:
        group, _, last = name.rpartition("/")
        groups.setdefault(group, []).append(last)
    clocks = {group: find_clock(names, asked.time) for group, names in groups.items()}
    tables: dict[str, tuple[dict[str, np.ndarray], dict[str, str]]] = {}
    for name, array in found.items():
        group, _, last = name.rpartition("/")
        own = last == clocks[group]
        while group and clocks.get(group) is None:
            group = group.rpartition("/")[0]
        columns, said = tables.setdefault(group, ({}, {}))
        column = last if own else name.replace("/", ".")
        columns[column], said[column] = array, units.get(name, "")
    return [
        table_of_arrays(columns, clocks.get(group), asked.notes, said)
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


def read_columns(path: Path, asked: Asked) -> list[Table]:
    """Read a Parquet file; for a LeRobot data set one episode, with its own time stamps.

    **Raises:** `ValueError` for a file of several episodes if none is named, and for an episode
    that it does not contain.
    """
    from pyarrow import compute

    time, episode, table = asked.time, asked.episode, read_parquet_file(path)
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
