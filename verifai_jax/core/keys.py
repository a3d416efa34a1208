"""Random keys of a run and of its simulations: functions of the seed and the row alone."""

import jax
from jaxtyping import Array, Int, Key

IMPLEMENTATION = "threefry2x32"
"""The generator is named so that a user's JAX settings do not change results."""


def run_keys(seed: int) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """Split a seed into the key of the search and the key of the simulations."""
    search, simulations = jax.random.split(jax.random.key(seed, impl=IMPLEMENTATION))
    return search, simulations


def simulation_key(key: Key[Array, ""], row: Int[Array, ""] | int) -> Key[Array, ""]:
    """Derive the random key of one simulation from the run's key and the row number."""
    return jax.random.fold_in(key, row)
