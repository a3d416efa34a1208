"""The results of a compiled batch in few arrays: one fetch from the devices for each dtype.

    packing = Packing()
    packed = packing.pack(row)                          # under jit and vmap: dtype -> vector
    rows = packing.unpack(jitted(...), n)               # NumPy, the pytree as it was, `[n, ...]`

Fetching a leaf costs about 50 microseconds whatever its size, and features have many leaves.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


class _Slot(NamedTuple):
    dtype: str
    start: int
    shape: tuple[int, ...]


class Packing:
    """The places of a pytree's leaves in one vector for each dtype, known once `pack` is traced."""

    def __init__(self) -> None:
        self._slots: list[_Slot] = []
        self._form: Any = None

    def pack(self, row: Any) -> dict[str, Array]:
        """One row's leaves, concatenated by dtype."""
        leaves, self._form = jax.tree.flatten(row)
        self._slots, parts, filled = [], {}, {}
        for leaf in map(jnp.asarray, leaves):
            dtype = leaf.dtype.name
            start = filled.get(dtype, 0)
            self._slots.append(_Slot(dtype, start, leaf.shape))
            parts.setdefault(dtype, []).append(leaf.ravel())
            filled[dtype] = start + leaf.size
        return {dtype: jnp.concatenate(vectors) for dtype, vectors in parts.items()}

    def unpack(self, packed: dict[str, Array], n: int) -> Any:
        """The first `n` rows of a batch of packed rows."""
        whole = {dtype: np.asarray(block)[:n] for dtype, block in packed.items()}
        leaves = [
            whole[slot.dtype][:, slot.start : slot.start + math.prod(slot.shape)].reshape(
                n, *slot.shape
            )
            for slot in self._slots
        ]
        return jax.tree.unflatten(self._form, leaves)
