"""Random keys of an augmentation: functions of its seed, the repetition and the purpose alone."""

import jax
from jaxtyping import Array, Key

from verifai_jax.core.compute.keys import run_keys

INITIAL, TRAINING, FURTHER, SEARCH, CHOICE, TEST, MEASURES = range(7)
"""Purposes of random numbers in one repetition."""
INDEPENDENT = 2**31 - 1
"""Number of the repetition of the independent network, higher than that of any seed."""


def purpose_key(seed: int, number: int, purpose: int) -> Key[Array, ""]:
    """Return the random key for a purpose, which is the same for all arms of a repetition.

    **Arguments:**
    - `purpose`: one of the constants of this file.
    """
    repetition = jax.random.fold_in(run_keys(seed)[0], number)
    return jax.random.fold_in(repetition, purpose)


def choice_key(seed: int, number: int) -> Key[Array, ""]:
    """Return the random key with which arms choose and transform inputs."""
    return purpose_key(seed, number, CHOICE)
