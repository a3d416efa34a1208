"""Archives, NumPy's arrays and Parquet of files that may come from anywhere.

Their declared sizes are checked before anything is unpacked, so no small file fills the memory.
"""

import io
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.core.store.foreign_files import MAX_BYTES, ForeignFileError, open_file, read_bytes

if TYPE_CHECKING:
    import pyarrow as pa
MAX_VALUES = 1 << 29
"""Maximum count of values of a table or an array."""


def check_values(count: int, what: str) -> None:
    """Refuse what declares more values than are read.

    **Raises:** `ForeignFileError`.
    """
    if count > MAX_VALUES:
        raise ForeignFileError(f"{what} declares {count:,} values; at most {MAX_VALUES:,} are read")


def open_archive(
    source: bytes | Path, what: str, max_bytes: int = MAX_BYTES, within: Path | None = None
) -> zipfile.ZipFile:
    """Open an archive, given as its content or its path.

    **Arguments:**
    - `max_bytes`: maximum bytes, also when it is unpacked.
    **Raises:** `ForeignFileError` for anything else; the errors of `open_file`.
    """
    data = source if isinstance(source, bytes) else read_bytes(source, max_bytes, within)
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except Exception as error:  # Bytes can be wrong in any way.
        why = one_line(str(error))
        raise ForeignFileError(f"{what} is not an archive, or is damaged: {why}") from error
    if (size := sum(entry.file_size for entry in archive.infolist())) > max_bytes:
        size, max_bytes = size // 10**6, max_bytes // 10**6
        raise ForeignFileError(f"{what} unpacks to {size:,} MB; at most {max_bytes:,} MB are read")
    return archive


def read_member(
    archive: zipfile.ZipFile, name: str, what: str, max_bytes: int = MAX_BYTES
) -> bytes:
    """Return the bytes of a member of an archive, at most so many.

    **Raises:** `ForeignFileError` for one that is missing or damaged, or larger than stated.
    """
    try:
        with archive.open(name) as file:
            size = archive.getinfo(name).file_size
            data = file.read(min(size, max_bytes) + 1)
    except Exception as error:
        raise ForeignFileError(f"{what} has no readable {name}: {one_line(str(error))}") from error
    if len(data) > min(size, max_bytes):
        raise ForeignFileError(
            f"{name} of {what} is longer than stated, or than {max_bytes:,} bytes"
        )
    return data


def read_arrays(
    source: bytes | Path, what: str, max_bytes: int = MAX_BYTES, within: Path | None = None,
    left_out: dict[str, str] | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Return the arrays of an `.npz` archive by name; nothing in it is unpickled.

    **Raises:** as `open_archive`, and `ForeignFileError` for a member that is not an array, unless
    there is `left_out`, which then says why by its name.
    """
    archive, arrays = open_archive(source, what, max_bytes, within), {}
    for member in archive.namelist():
        data, name = read_member(archive, member, what), member.removesuffix(".npy")
        try:
            file = io.BytesIO(data)
            first = np.lib.format.read_magic(file) == (1, 0)
            form = np.lib.format
            read = form.read_array_header_1_0 if first else form.read_array_header_2_0
            shape, _, dtype = read(file)
            if math.prod(shape) * dtype.itemsize != len(data) - file.tell():
                raise ValueError(f"it has not the bytes of shape {list(shape)}")
            arrays[name] = form.read_array(io.BytesIO(data), allow_pickle=False)
        except Exception as error:
            why = one_line(format_error(error))
            if left_out is None:
                raise ForeignFileError(f"{name!r} of {what} is not an array: {why}") from error
            left_out[name] = why
    return arrays


def read_parquet(
    path: Path, columns: Sequence[str] | None = None, within: Path | None = None
) -> "pa.Table":
    """Read a Parquet file, or some columns of it.

    **Raises:** `ForeignFileError` for more values than are read; those of `open_file`, PyArrow.
    """
    import pyarrow.parquet as pq

    with open_file(path, MAX_BYTES, within) as file:
        opened = pq.ParquetFile(file, page_checksum_verification=True)
        groups = [opened.metadata.row_group(i) for i in range(opened.metadata.num_row_groups)]
        parts = [group.column(i) for group in groups for i in range(group.num_columns)]
        check_values(sum(part.num_values for part in parts), str(path))
        return opened.read(columns=None if columns is None else [*columns])
