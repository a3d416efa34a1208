"""The state of a search on disk: named arrays in one NumPy file, replaced whole.

With them stand a checksum of their names, types, shapes and bytes, one of the rows of the table
that the search has seen, and one of what the record says of the run: none of the three is
exchanged for that of another run, or of another moment, unnoticed.
"""

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from verifai_jax.core.text import format_error, printable

STATE = "search.npz"
"""Name of the checkpoint in a run's folder."""
ROWS_CHECKSUM = "rows.checksum"
"""Entry for the rows that the search has seen, `ErrorTable.digest`."""
RECORD_CHECKSUM = "record.checksum"
"""Entry for what the record says of the run, `record_checksum`."""
_CHECKSUM = "checksum"


class CheckpointError(ValueError):
    """An error for a checkpoint that is damaged."""


def write_checkpoint(
    checkpoint: Mapping[str, Any], folder: Path, rows_checksum: int, record_checksum: int
) -> None:
    """Write a checkpoint to `folder`, in place of an earlier one, never half.

    **Arguments:**

    - `checkpoint`: the state of the search, with the number of `rows` that it has seen.
    - `folder`: of the run.
    - `rows_checksum`: of these rows.
    - `record_checksum`: of the record.
    """
    partial = folder / f"{STATE}.part"
    arrays: dict[str, Any] = {name: _plain(value) for name, value in checkpoint.items()}
    arrays[ROWS_CHECKSUM] = np.array(rows_checksum, np.uint32)
    arrays[RECORD_CHECKSUM] = np.array(record_checksum, np.uint32)
    arrays[_CHECKSUM] = np.array(_checksum(arrays), np.uint32)
    with open(partial, "wb") as file:
        np.savez(file, **arrays)
    partial.replace(folder / STATE)


def read_checkpoint(folder: Path) -> dict[str, Any] | None:
    """Return the checkpoint in `folder`; None if there is none.

    **Raises:** `CheckpointError` for one that cannot be read.
    """
    file = folder / STATE
    if not file.exists():
        return None
    try:
        with open(file, "rb") as opened, np.load(opened, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except Exception as error:  # The bytes of an archive can be wrong in any way.
        why = "it is empty" if isinstance(error, EOFError) else printable(format_error(error), 300)
        raise CheckpointError(f"{file} is damaged: {why}") from error
    stored = arrays.pop(_CHECKSUM, None)
    if stored is None or stored.shape != () or stored != _checksum(arrays):
        raise CheckpointError(f"{file} is damaged: its arrays have changed since it was written")
    rows = arrays.get("rows")
    if rows is None or rows.shape != () or rows.dtype.kind not in "iu" or rows < 0:
        raise CheckpointError(f"{file} is damaged: it does not say how many rows its search saw")
    return arrays


def _checksum(arrays: Mapping[str, np.ndarray]) -> int:
    checksum = 0
    for name in sorted(set(arrays) - {_CHECKSUM}):
        value = arrays[name]
        head = repr((name, value.dtype.str, value.shape)).encode()
        checksum = zlib.crc32(value.tobytes(), zlib.crc32(head, checksum))
    return checksum


def _plain(value: ArrayLike) -> np.ndarray:
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return np.asarray(jax.random.key_data(value))
    return np.asarray(value)
