"""Readers of recordings by the endings of their files, ours and those of other packages.

    def read(path: Path, asked: Asked) -> list[Table]:      # a table for each clock of the file
        with open_file(path) as file:
            columns = my_library.load(file)
        return [table_of(columns, units={"speed": "km/h"})]

Another package registers its function by the ending, in the group `verifai_jax.recordings` of entry
points. What a reader raises becomes one `ValueError` that names the file.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeAlias

from verifai_jax.core.display.extensions import extension, extensions
from verifai_jax.core.messages.errors import MissingExtra
from verifai_jax.core.messages.text import format_error

Table: TypeAlias = Any
"""An Arrow table, whose package has no types."""
Stamps: TypeAlias = Literal["log", "header"]


@dataclass(frozen=True)
class Asked:
    """Options of a reader of recordings.

    **Arguments:**
    - `time`: the name of the column of sample times, which `find_clock` looks for; a table whose
      times are known without a name has them under this one.
    - `stamps`: whether the messages of a bag have the times of the log or those of their headers.
    - `episode`: the number of an episode of a LeRobot data set.
    - `databases`: files that say what the frames of a bus mean, such as `.dbc`.
    - `notes`: receives what was left out; a `LeftOut` is about one column.
    """

    time: str = "time"
    stamps: Stamps = "log"
    episode: int | None = None
    databases: tuple[Path, ...] = ()
    notes: dict[str, int] = field(default_factory=dict)


Reader: TypeAlias = Callable[[Path, Asked], list[Table]]
GROUP = "verifai_jax.recordings"
_HERE = "verifai_jax.addons.monitoring"
OURS = {
    ".csv": "csv_tables:read_delimited", ".tsv": "csv_tables:read_delimited",
    ".csv.gz": "csv_tables:read_delimited", ".tsv.gz": "csv_tables:read_delimited",
    ".parquet": "containers:read_columns", ".feather": "flat_files:read_feather",
    ".arrow": "flat_files:read_feather", ".jsonl": "flat_files:read_json_lines",
    ".ndjson": "flat_files:read_json_lines", ".npz": "flat_files:read_npz",
    ".mcap": "topics:read_mcap", ".db3": "ros_bags:read_bag", ".bag": "ros_bags:read_bag",
    ".ulg": "ulog:read_ulog", ".mf4": "mdf:read_mdf", ".mdf": "mdf:read_mdf",
    ".mat": "matlab:read_mat", ".nc": "containers:read_dataset",
    ".zarr": "containers:read_dataset", ".h5": "containers:read_hdf5",
    ".hdf5": "containers:read_hdf5",
}  # fmt: skip
"""The function of this package that reads files with an ending."""


def endings() -> tuple[str, ...]:
    """Return the endings of files that are recordings."""
    return (*OURS, *(f".{name}" for name in extensions(GROUP) if f".{name}" not in OURS))


def ending_of(path: Path) -> str | None:
    """Return the ending by which a file is a recording, the longest one; None for other files."""
    name = path.name.lower()
    return max((each for each in endings() if name.endswith(each)), key=len, default=None)


def read_tables(path: Path, asked: Asked) -> list[Table]:
    """Read the tables of a file, one for each of its clocks.

    **Raises:** `ValueError` that names the file; `MissingExtra`; `FileNotFoundError`.
    """
    ending = ending_of(path)
    if ending is None:
        *others, last = endings()
        raise ValueError(f"a recording is a {', '.join(others)} or {last} file; got {path.name}")
    if asked.episode is not None and ending != ".parquet":
        raise ValueError(f"episodes are those of a LeRobot data set; {path.name} has none")
    module, _, name = OURS.get(ending, "").partition(":")
    own = extension(GROUP, ending[1:]) if not name else None
    return named_errors(path, own or getattr(import_module(f"{_HERE}.{module}"), name), path, asked)


def named_errors(path: Path, read: Callable[..., list[Table]], *arguments: object) -> list[Table]:
    """Call a reader; whatever it raises becomes an error that names the file.

    **Raises:** `ValueError`; `MissingExtra`; `FileNotFoundError`.
    """
    try:
        return read(*arguments)
    except (MissingExtra, FileNotFoundError):
        raise
    except Exception as error:  # The readers of other packages raise what they like.
        if isinstance(error, ValueError) and str(path) in str(error):
            raise
        raise ValueError(f"{path} cannot be read: {format_error(error)}") from None
