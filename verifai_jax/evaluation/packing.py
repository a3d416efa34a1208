"""The results of a compiled batch in one array: a single fetch from the devices.

    packing = Packing()
    packed = packing.pack(row)                          # under jit and vmap
    rows = packing.unpack(jitted(...), n)               # NumPy, the pytree as it was, `[n, ...]`

Fetching an array costs about 50 microseconds whatever its size, and features have many.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree


class _Slot(NamedTuple):
    group: str
    start: int
    shape: tuple[int, ...]
    dtype: Any


class Packing:
    """The indices of a pytree's leaves in one vector for each width; set when `pack` is traced."""

    def __init__(self) -> None:
        self._slots: list[_Slot] = []
        self._form: Any = None

    def pack(self, row: PyTree) -> dict[str, Array]:
        """Concatenate one row's leaves bit by bit: all of four bytes, all of eight."""
        leaves, self._form = jax.tree.flatten(row)
        self._slots, parts, filled = [], {}, {}
        for leaf in map(jnp.asarray, leaves):
            group = f"uint{8 * leaf.dtype.itemsize}"
            start = filled.get(group, 0)
            self._slots.append(_Slot(group, start, leaf.shape, np.dtype(leaf.dtype)))
            bits = leaf.astype(group) if leaf.dtype == bool else leaf.view(group)
            parts.setdefault(group, []).append(bits.ravel())
            filled[group] = start + leaf.size
        return {group: jnp.concatenate(vectors) for group, vectors in parts.items()}

    def unpack(self, packed: dict[str, Array], n: int) -> PyTree:
        """Return the first `n` rows of a batch of packed rows."""
        whole = {group: np.asarray(block)[:n] for group, block in packed.items()}

        def taken(slot: _Slot) -> np.ndarray:
            bits = whole[slot.group][:, slot.start : slot.start + math.prod(slot.shape)]
            return np.ascontiguousarray(bits).view(slot.dtype).reshape(n, *slot.shape)

        return jax.tree.unflatten(self._form, [taken(slot) for slot in self._slots])
