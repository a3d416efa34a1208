"""The state of a search on disk: named arrays in one NumPy file, replaced whole."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

STATE = "search.npz"
"""Name of the checkpoint in a run's folder."""


def write_checkpoint(checkpoint: Mapping[str, Any], folder: Path) -> None:
    """Write a checkpoint to `folder`, in place of an earlier one, never half."""
    partial = folder / f"{STATE}.part"
    with open(partial, "wb") as file:
        arrays: dict[str, Any] = {name: _plain(value) for name, value in checkpoint.items()}
        np.savez(file, **arrays)
    partial.replace(folder / STATE)


def read_checkpoint(folder: Path) -> dict[str, Any] | None:
    """Return the checkpoint in `folder`; None if there is none."""
    if not (folder / STATE).exists():
        return None
    with np.load(folder / STATE, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def _plain(value: ArrayLike) -> np.ndarray:
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return np.asarray(jax.random.key_data(value))
    return np.asarray(value)
