"""The error table: one row a simulation, written to disk while it grows.

    table.all               every simulation: features, rho, violated, status
    table.violating         rows that ended properly and broke the property, as simulated
    table.counterexamples   those among them that a closer look did not refute
    table.unconfirmed       the others: refuted, or not sure
    table.safe              rows that ended properly and kept it

On disk a growing table is an Arrow stream, to which each batch is appended; a process that dies
loses at most the batch in flight. A finished table is one Parquet file. A run that is resumed
keeps its earlier rows in the Parquet file and streams the new ones beside it until it ends.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.core.text import format_error

if TYPE_CHECKING:
    import pandas as pd

STREAM = "rows.arrows"
"""Name of the growing table on disk."""
FINISHED = "table.parquet"
"""Name of the finished table on disk."""
RESERVED = (
    "row",
    "rho",
    "violated",
    "status",
    "message",
    "gradient_finite",
    "differentiated",
    "verdict",
)
"""Names of the table's own columns, which no feature may have."""
NOT_CLAIMED = ("fragile", "refuted")
"""Verdicts of rows that violate the property as simulated, and do not when looked at closely."""


class ErrorTable:
    """Rows in the order in which they were simulated; append-only.

    **Arguments:**

    - `features`: names of the feature columns; may not be one of `RESERVED`.
    - `folder`: where to keep the rows; in memory only when left out.

    **Raises:** `ValueError` for a feature with a reserved name.
    """

    def __init__(self, features: tuple[str, ...], folder: Path | None = None) -> None:
        for name in features:
            if name in RESERVED:
                raise ValueError(
                    f"a feature may not be called {name!r}: the error table has a column of that "
                    f"name; reserved are {', '.join(RESERVED)}"
                )
        self.features = tuple(features)
        self._batches: list[dict[str, Any]] = []
        self._frame: pd.DataFrame | None = None
        self._rows = 0
        self._stream = _Stream(folder) if folder is not None else None

    def __len__(self) -> int:
        return self._rows

    def append(self, columns: Mapping[str, Any]) -> None:
        """Add a batch: a mapping of column name to `[n]` values, with `rho` and `status`."""
        batch = dict(columns)
        n = len(batch["rho"])
        self._batches.append({"row": np.arange(self._rows, self._rows + n), **batch})
        self._rows += n
        self._frame = None
        if self._stream is not None:
            self._stream.append(self._batches[-1])

    def close(self) -> None:
        """Turn the stream on disk into a Parquet file.

        **Raises:** `OSError` where it cannot be written; the stream then stays as it is.
        """
        if self._stream is not None:
            stream, self._stream = self._stream, None
            stream.close(self.all)

    @property
    def all(self) -> "pd.DataFrame":
        """Every simulation asked for, once, indexed by row number."""
        import pandas as pd

        if self._frame is None:
            if self._batches:
                merged = {
                    name: np.concatenate([np.asarray(batch[name]) for batch in self._batches])
                    for name in self._batches[0]
                }
                # One array per column from here on: appending stays linear.
                self._batches = [merged]
                self._frame = pd.DataFrame(merged).set_index("row")
            else:
                empty = {"rho": np.zeros(0, np.float32), "violated": np.zeros(0, bool)}
                names = {name: np.zeros(0) for name in self.features}
                self._frame = pd.DataFrame({**names, **empty, "status": np.zeros(0, object)})
                self._frame.index.name = "row"
        return self._frame

    @property
    def counterexamples(self) -> "pd.DataFrame":
        """Rows that ended properly and violate the property, also when looked at closely.

        That is without those whose column `verdict` says `fragile` or `refuted`.
        """
        return self._violating(claimed=True)

    @property
    def unconfirmed(self) -> "pd.DataFrame":
        """Rows that violate the property as simulated, and not surely when looked at closely."""
        return self._violating(claimed=False)

    @property
    def violating(self) -> "pd.DataFrame":
        """Rows that violate the property as simulated, whatever a closer look said."""
        table = self.all
        return table.loc[(table["status"] == "ok") & table["violated"]]

    def _violating(self, claimed: bool) -> "pd.DataFrame":
        violating = self.violating
        if "verdict" in violating:
            return violating.loc[violating["verdict"].isin(NOT_CLAIMED) != claimed]
        return violating if claimed else violating.iloc[:0]

    @property
    def safe(self) -> "pd.DataFrame":
        """Rows that ended properly and satisfy the property."""
        table = self.all
        return table.loc[(table["status"] == "ok") & ~table["violated"]]

    @property
    def failed(self) -> "pd.DataFrame":
        """Rows without a verdict: the simulation raised, timed out or went non-finite."""
        table = self.all
        return table.loc[table["status"] != "ok"]

    @classmethod
    def load(cls, folder: Path, features: tuple[str, ...]) -> "ErrorTable":
        """Read a table back, finished or cut off.

        **Raises:** `FileNotFoundError` where there is none; `TableError` for a damaged one.
        """
        table, frame = cls(features), _read(folder)
        _check(frame, folder, table.features)
        table._fill(frame)
        return table

    @staticmethod
    def exists(folder: Path) -> bool:
        """Return whether there is a table in `folder`, finished or growing."""
        return (folder / FINISHED).exists() or (folder / STREAM).exists()

    def resumed(self, rows: int, folder: Path | None = None) -> "ErrorTable":
        """Return a table with the first `rows` rows of this one, to which more can be appended.

        With a `folder` it is kept there, in place of what the folder held.
        """
        table = ErrorTable(self.features)
        table._fill(self.all.iloc[:rows])
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            _write(table.all, folder)
            (folder / STREAM).unlink(missing_ok=True)
            table._stream = _Stream(folder)
        return table

    def save(self, folder: Path) -> None:
        """Write the rows to `folder` as one Parquet file."""
        folder.mkdir(parents=True, exist_ok=True)
        _write(self.all, folder)

    def _fill(self, frame: "pd.DataFrame") -> None:
        if len(frame):
            self.append({name: frame[name].to_numpy() for name in frame.columns})

    def __repr__(self) -> str:
        return (
            f"ErrorTable({len(self)} simulations: {len(self.counterexamples)} counterexamples, "
            f"{len(self.safe)} safe, {len(self.failed)} without a verdict)"
        )


class _Stream:
    """An Arrow stream on disk that stays readable however the process ends."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._file: Any = None
        self._writer: Any = None

    def append(self, columns: dict[str, Any]) -> None:
        import pyarrow as pa

        batch = pa.RecordBatch.from_pydict({name: pa.array(v) for name, v in columns.items()})
        if self._writer is None:
            self._file = open(self.folder / STREAM, "wb")  # noqa: SIM115 - lives as long as the run
            self._writer = pa.ipc.new_stream(self._file, batch.schema)
        self._writer.write_batch(batch)
        self._file.flush()

    def close(self, frame: "pd.DataFrame") -> None:
        if self._writer is not None:
            try:
                self._writer.close()
            finally:
                self._file.close()
        _write(frame, self.folder)
        (self.folder / STREAM).unlink(missing_ok=True)


def _write(frame: "pd.DataFrame", folder: Path) -> None:
    # A reader never meets a half-written file under the final name.
    partial = folder / f"{FINISHED}.part"
    try:
        frame.to_parquet(partial)
        partial.replace(folder / FINISHED)
    except OSError:
        partial.unlink(missing_ok=True)  # What little room there is, others need.
        raise


class TableError(ValueError):
    """An error for a table on disk that is damaged."""


def _read(folder: Path) -> "pd.DataFrame":
    import pandas as pd

    finished, stream = folder / FINISHED, folder / STREAM
    if not ErrorTable.exists(folder):
        raise FileNotFoundError(f"no error table in {folder}: neither {FINISHED} nor {STREAM}")
    parts = [_read_finished(finished)] if finished.exists() else []
    if stream.exists():
        parts.append(_read_stream(stream))
    parts = [part for part in parts if len(part)] or parts[:1]
    frame = parts[0] if len(parts) == 1 else pd.concat(parts)
    # A process that died between finishing the file and removing the stream left rows in both.
    return frame.loc[~frame.index.duplicated()]


def _read_finished(path: Path) -> "pd.DataFrame":
    import pandas as pd

    if not path.is_file():
        # Pandas would read a folder as a table of the files in it.
        raise TableError(f"{path} is damaged: it is not a file")
    try:
        return pd.read_parquet(path)
    except PermissionError:
        raise
    except Exception as error:  # Bytes can be wrong in any way.
        raise TableError(f"{path} is damaged: {format_error(error)}") from error


def _read_stream(path: Path) -> "pd.DataFrame":
    import pandas as pd
    import pyarrow as pa

    if not path.is_file():
        raise TableError(f"{path} is damaged: it is not a file")
    batches = []
    with open(path, "rb") as file:
        try:
            # Reading ends in an error where the process died in the middle of writing a batch;
            # those before it are whole.
            for batch in pa.ipc.open_stream(file):
                # Offsets of damaged bytes point outside of the buffer, and would be followed.
                batch.validate(full=True)
                batches.append(batch)
        except Exception:
            pass
    if not batches:
        return pd.DataFrame()
    try:
        return pa.Table.from_batches(batches).to_pandas().set_index("row")
    except Exception as error:
        raise TableError(f"{path} is damaged: {format_error(error)}") from error


def _check(frame: "pd.DataFrame", folder: Path, features: tuple[str, ...]) -> None:
    """Refuse rows that a table cannot have: missing columns, or rows missing between others."""
    if not len(frame):
        return
    needed = (*features, "rho", "violated", "status")
    missing = [name for name in needed if name not in frame.columns]
    if missing:
        raise TableError(f"the table in {folder} is damaged: it has no column {missing[0]!r}")
    index = frame.index.to_numpy()
    wrong = np.flatnonzero(index != np.arange(len(index)))
    if len(wrong):
        gone = "" if (folder / FINISHED).exists() else f"; {FINISHED} is missing"
        raise TableError(
            f"the table in {folder} is damaged: where row {wrong[0]} should be, there is "
            f"{index[wrong[0]]}{gone}"
        )
