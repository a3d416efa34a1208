"""Rows as columns of NumPy arrays, and their other forms: of pandas, of Arrow, a checksum."""

import zlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from jaxtyping import Int, Shaped

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Columns: TypeAlias = Mapping[str, np.ndarray]
"""Columns `[n]` by name, `rho` among them; texts are arrays of objects."""
Batch: TypeAlias = tuple[int, Columns]
"""Consecutive rows: number of the first, and their columns."""
ROW = "row"
"""Name of the column that numbers the rows."""


def import_tables() -> None:
    """Import what tables are made of, which takes a fifth of a second."""
    import pandas as pd  # noqa: F401
    import pyarrow as pa  # noqa: F401


def length(columns: Columns) -> int:
    """Return the number of rows."""
    return len(columns["rho"])


def cut(batch: Batch, begin: int, stop: int) -> Batch:
    """Return those rows of a batch that have numbers from `begin` to `stop - 1`, as views."""
    first, columns = batch
    rows = slice(max(begin - first, 0), max(stop - first, 0))
    return max(begin, first), {name: values[rows] for name, values in columns.items()}


def merge(batches: Sequence[Batch]) -> Columns:
    """Return the columns of batches behind each other."""
    if len(batches) == 1:
        return batches[0][1]
    return {name: np.concatenate([batch[name] for _, batch in batches]) for name in batches[0][1]}


def row_numbers(batches: Sequence[Batch]) -> Int[np.ndarray, " n"]:
    """Return the numbers of the rows of batches."""
    return np.concatenate([first + np.arange(length(columns)) for first, columns in batches])


def to_frame(
    numbers: Int[np.ndarray, " n"], columns: Columns, names: Sequence[str] | None = None
) -> "pd.DataFrame":
    """Return rows, or some columns of them, as a DataFrame that is indexed by their numbers."""
    import pandas as pd

    wanted = columns if names is None else {name: columns[name] for name in names}
    # Numbers are not copied: a table of a column each takes no more memory than its columns.
    return pd.DataFrame(dict(wanted), index=pd.Index(numbers, name=ROW), copy=False)


def from_frame(frame: "pd.DataFrame") -> Columns:
    """Return the columns of a DataFrame."""
    return {str(name): frame[name].to_numpy() for name in frame.columns}


def to_arrow(columns: Columns) -> "pa.RecordBatch":
    """Return rows as a batch of Arrow's."""
    import pyarrow as pa

    return pa.RecordBatch.from_pydict(
        {name: column_to_arrow(each) for name, each in columns.items()}
    )


def column_to_arrow(values: Shaped[np.ndarray, " n"]) -> "pa.Array":
    """Return a column as Arrow's; texts are texts, and null where absent, even if all are."""
    import pandas as pd
    import pyarrow as pa

    if values.dtype != object:
        return pa.array(values)
    known = values[~pd.isna(values)]
    texts = all(isinstance(value, str) for value in known)
    return pa.array(values, pa.string() if texts else None, from_pandas=True)


def checksum(values: Shaped[np.ndarray, " n"], before: int | None = None) -> int:
    """Return the checksum of a column, of a part of it behind one with the checksum `before`."""
    import pandas as pd

    if values.dtype == object and len(values) and not isinstance(values[0], str):
        # Numbers as objects come back from the disk as what they are.
        values = to_arrow({"": values}).column(0).to_numpy(zero_copy_only=False)
    text = values.dtype.kind in "OUT"
    if before is None:
        before = zlib.crc32(b"text" if text else values.dtype.str.encode())
    if text:
        codes, known = pd.factorize(values)
        each = [*(zlib.crc32(str(text).encode(errors="replace")) for text in known), 0]
        values = np.array(each, np.uint32)[codes]
    return zlib.crc32(values.tobytes(), before)
