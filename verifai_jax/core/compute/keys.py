"""Random keys of a run and of its simulations: functions of the seed and the row alone."""

import jax
import jax.core
import numpy as np
from jaxtyping import Array, Int, Key, UInt32

IMPLEMENTATION = "threefry2x32"
"""The generator is named so that a user's JAX settings do not change results."""
ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
"""Bits by which the rounds of the generator rotate, of every other four."""


def run_keys(seed: int) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """Split a seed into the key of the search and the key of the simulations.

    They equal `jax.random.split(jax.random.key(seed))`, whose programs JAX would compile in every
    process; NumPy needs no compilation.
    """
    key = np.array([0, int(seed) & 0xFFFFFFFF], np.uint32)
    first, second = _threefry(key, np.zeros(2, np.uint32), np.arange(2, dtype=np.uint32))
    search, simulations = np.stack([first, second], axis=1)
    return as_key(search), as_key(simulations)


def as_key(data: UInt32[np.ndarray, "*shape 2"]) -> Key[Array, "*shape"]:
    """Return the keys of these words; nothing compiles."""
    return jax.random.wrap_key_data(data, impl=IMPLEMENTATION)  # pyright: ignore[reportArgumentType]


def simulation_key(key: Key[Array, ""], row: Int[Array, ""] | int) -> Key[Array, ""]:
    """Derive the random key of one simulation from the run's key and the row number."""
    known = isinstance(row, int | np.integer) and not isinstance(key, jax.core.Tracer)
    if not known or key.ndim or jax.random.key_impl(key) != IMPLEMENTATION:
        return jax.random.fold_in(key, row)
    # The same in NumPy, for which nothing compiles.
    counter = np.array([0, int(row) & 0xFFFFFFFF], np.uint32)
    words = np.asarray(jax.random.key_data(key))
    return as_key(np.concatenate(_threefry(words, counter[:1], counter[1:])))


def mixed_bits(value: UInt32[Array | np.ndarray, "*shape"]) -> UInt32[Array | np.ndarray, "*shape"]:
    """Mix the bits of numbers, as a hash does: the finalizer of MurmurHash3."""
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        value = (value ^ (value >> shift)) * np.uint32(factor)
    return value ^ (value >> 16)


def _threefry(
    key: UInt32[np.ndarray, "2"], high: UInt32[np.ndarray, " n"], low: UInt32[np.ndarray, " n"]
) -> tuple[UInt32[np.ndarray, " n"], UInt32[np.ndarray, " n"]]:
    """Encrypt the words of counters by Threefry-2x32 of 20 rounds (Salmon et al., SC 2011)."""
    with np.errstate(over="ignore"):
        words = (key[0], key[1], key[0] ^ key[1] ^ np.uint32(0x1BD11BDA))
        high, low = high + words[0], low + words[1]
        for turn in range(5):
            for bits in ROTATIONS[turn % 2]:
                high = high + low
                low = ((low << np.uint32(bits)) | (low >> np.uint32(32 - bits))) ^ high
            high = high + words[(turn + 1) % 3]
            low = low + words[(turn + 2) % 3] + np.uint32(turn + 1)
    return high, low
