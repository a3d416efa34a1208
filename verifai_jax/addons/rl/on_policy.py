"""Learning from one stretch of experience: a few passes over it in shuffled minibatches.

    weights, moments = minibatch_epochs(loss, (weights, moments), batch, key, optimizer, rate, 4, 8)

The permutations are those of `jax.random.permutation`, computed faster on a CPU.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from verifai_jax.addons.rl.algorithm import Number
from verifai_jax.addons.rl.optimizer import Optimizer

Weights = TypeVar("Weights")
Batch = TypeVar("Batch")


def minibatch_epochs(
    loss: Callable[[Weights, Batch], Float[Array, ""]], start: tuple[Weights, PyTree], batch: Batch,
    key: Key[Array, ""], optimizer: Optimizer, rate: Number, epochs: int, minibatches: int,
) -> tuple[Weights, PyTree]:  # fmt: skip
    """Minimise the loss, with one gradient step for each minibatch.

    **Arguments:**
    - `loss(weights, minibatch) -> number`: the loss.
    - `start`: the initial weights and optimizer state.
    - `batch`: a pytree of arrays with two leading axes, such as environments and time.
    - `key`: a random key for the order of minibatches.
    - `optimizer`, `rate`: the optimizer, and the learning rate.
    - `epochs`, `minibatches`: number of passes over the batch, and of minibatches in a pass.
    **Returns:** the weights, and the optimizer's state.
    """
    rows = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), batch)
    count = len(jax.tree.leaves(rows)[0])

    def minibatch(
        carry: tuple[Weights, PyTree], part: Batch
    ) -> tuple[tuple[Weights, PyTree], None]:
        weights, moments = carry
        gradient = jax.grad(loss)(weights, part)
        direction, moments = optimizer.update(gradient, moments)
        weights = jax.tree.map(lambda w, d: w - rate * d, weights, direction)
        return (weights, moments), None

    def epoch(
        carry: tuple[Weights, PyTree], key: Key[Array, ""]
    ) -> tuple[tuple[Weights, PyTree], None]:
        order = permutation(key, count)
        parts = jax.tree.map(
            lambda leaf: leaf[order].reshape(minibatches, -1, *leaf.shape[1:]), rows
        )
        return jax.lax.scan(minibatch, carry, parts)

    return jax.lax.scan(epoch, start, jax.random.split(key, epochs))[0]


def permutation(key: Key[Array, ""], n: int) -> Int[Array, " n"]:
    """Return the numbers from 0 to `n - 1` in the order of `jax.random.permutation(key, n)`.

    On a CPU, XLA sorts one array of integers six times as fast as keys with values, and a shuffle
    would take a tenth of PPO's time. So only the keys are sorted, and the rank of each is searched
    for. Do not use it under `vmap`, where both branches would be computed.
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
