"""Random numbers of a fault at an instant: a hash of its seed, the instant and the entry.

JAX's generator would cost more than a step of a small plant, even for a fault that is off. Two
rounds of the finalizer of MurmurHash3 over 32 bits suffice for noise, and NumPy gives the same.
"""

from typing import Any

import numpy as np
from jax.lax import erf_inv
from jaxtyping import Float


def uniform(seed: Any, step: Any, count: int, xp: Any) -> Float[Any, " count"]:
    """Return numbers between 0 and 1, the same for the same seed (two words) and step."""
    entry = xp.arange(count, dtype=np.uint32) * xp.uint32(0x9E3779B9)
    word = _mixed(entry + xp.asarray(step).astype(np.uint32) ^ seed[0], xp)
    word = _mixed(word + seed[1], xp)
    # Of 24 bits, which float32 holds; never 0 nor 1.
    return ((word >> 8).astype(np.float32) + xp.float32(0.5)) * xp.float32(2**-24)


def normal(chance: Float[Any, " n"], xp: Any) -> Float[Any, " n"]:
    """Return standard normal numbers of uniform ones."""
    number = erf_inv(2 * chance - 1) * np.float32(2**0.5)
    return np.asarray(number) if xp is np else number


def _mixed(word: Any, xp: Any) -> Any:
    word = (word ^ (word >> 16)) * xp.uint32(0x85EBCA6B)
    word = (word ^ (word >> 13)) * xp.uint32(0xC2B2AE35)
    return word ^ (word >> 16)
