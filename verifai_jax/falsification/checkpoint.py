"""The state of a search on disk: named arrays in one NumPy file, replaced whole."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from verifai_jax.core.text import format_error

STATE = "search.npz"
"""Name of the checkpoint in a run's folder."""


class CheckpointError(ValueError):
    """An error for a checkpoint that is damaged."""


def write_checkpoint(checkpoint: Mapping[str, Any], folder: Path) -> None:
    """Write a checkpoint to `folder`, in place of an earlier one, never half."""
    partial = folder / f"{STATE}.part"
    with open(partial, "wb") as file:
        arrays: dict[str, Any] = {name: _plain(value) for name, value in checkpoint.items()}
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
        why = "it is empty" if isinstance(error, EOFError) else format_error(error)
        raise CheckpointError(f"{file} is damaged: {why}") from error
    rows = arrays.get("rows")
    if rows is None or rows.shape != () or rows.dtype.kind not in "iu" or rows < 0:
        raise CheckpointError(f"{file} is damaged: it does not say how many rows its search saw")
    return arrays


def _plain(value: ArrayLike) -> np.ndarray:
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return np.asarray(jax.random.key_data(value))
    return np.asarray(value)
