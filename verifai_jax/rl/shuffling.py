"""Random permutations equal to those of `jax.random.permutation`, and faster on a CPU."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key


def permutation(key: Key[Array, ""], n: int) -> Int[Array, " n"]:
    """Return the numbers from 0 to `n - 1` in the order of `jax.random.permutation(key, n)`.

    XLA sorts one array of integers on a CPU six times as fast as keys with values, and a shuffle
    would take a tenth of the time of PPO. So the keys are sorted alone and the rank of each is
    searched for. Not for use under `vmap`, where both branches would be computed.
    """
    order = jnp.arange(n, dtype=jnp.int32)
    if n > 1600:  # Where JAX sorts more than once.
        return jax.random.permutation(key, order)
    _, subkey = jax.random.split(key)
    bits = jax.random.bits(subkey, (n,), jnp.uint32)
    ascending = jnp.sort(bits)

    def ordered_by_rank() -> Int[Array, " n"]:
        rank = jnp.searchsorted(ascending, bits, method="scan_unrolled")
        return jnp.zeros(n, jnp.int32).at[rank].set(order, unique_indices=True)

    # Of equal keys, once in ten thousand, all would get one rank.
    tied = jnp.any(ascending[1:] == ascending[:-1])
    return jax.lax.cond(tied, lambda: jax.lax.sort_key_val(bits, order)[1], ordered_by_rank)
