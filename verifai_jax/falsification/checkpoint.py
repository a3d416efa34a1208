"""The state of a search on disk: named arrays in a log of one entry, which is replaced whole.

With them stand a checksum of the rows of the table that the search has seen, and one of what the
record says of the run: none of the three is exchanged for that of another run, or of another
moment, unnoticed.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from verifai_jax.store.files import DamagedError
from verifai_jax.store.log import Log, write_log

STATE = "search.state"
"""Name of the checkpoint in a run's folder."""
ROWS_CHECKSUM = "rows.checksum"
"""Array with the checksum of the rows that the search has seen, `ErrorTable.digest`."""
RECORD_CHECKSUM = "record.checksum"
"""Array with that of what the record says of the run, `record.deciding_checksum`."""
_ENTRY = "search"


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
    arrays = {name: _plain(value) for name, value in checkpoint.items()}
    arrays[ROWS_CHECKSUM] = np.array(rows_checksum, np.uint32)
    arrays[RECORD_CHECKSUM] = np.array(record_checksum, np.uint32)
    write_log(folder / STATE, {_ENTRY: arrays})


def read_checkpoint(folder: Path) -> dict[str, Any] | None:
    """Return the checkpoint in `folder`; None if there is none.

    **Raises:** `DamagedError` for one that cannot be read.
    """
    file = folder / STATE
    if not file.exists():
        return None
    arrays = Log(file).get(_ENTRY)
    if arrays is None:
        raise DamagedError(f"{file} is damaged: it holds no state of a search")
    rows = arrays.get("rows")
    if rows is None or rows.shape != () or rows.dtype.kind not in "iu" or rows < 0:
        raise DamagedError(f"{file} is damaged: it does not say how many rows its search saw")
    return arrays


def _plain(value: ArrayLike) -> np.ndarray:
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return np.asarray(jax.random.key_data(value))
    return np.asarray(value)
