"""Learning from one stretch of experience: a few passes over it in shuffled minibatches.

optimizer, rate = adam(max_gradient=0.5), annealed(1e-3, done, updates, enabled=True)
weights, moments = minibatch_epochs(loss, (weights, moments), batch, key, optimizer, rate, 4, 8)
"""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from verifai_jax.addons.rl.algorithm import Number
from verifai_jax.addons.rl.policy import ACTIVATIONS, Layers

Optimizer: TypeAlias = Any
"""An `optax.GradientTransformation`, whose types know no weights in classes."""
Weights = TypeVar("Weights")
Batch = TypeVar("Batch")
EPSILON = 1e-5
"""Adam's constant against division by zero, as PPO and its successors set it."""


def adam(max_gradient: Number | None = None) -> Optimizer:
    """Make Adam with rate 1, with gradients clipped to the norm `max_gradient` if it is given."""
    import optax

    if max_gradient is None:
        return optax.scale_by_adam(eps=EPSILON)
    return optax.chain(optax.clip_by_global_norm(max_gradient), optax.scale_by_adam(eps=EPSILON))


def annealed(rate: Number, done: Int[Array, ""], updates: Int[Array, ""], enabled: bool) -> Number:
    """Return the learning rate after `done` of `updates` updates.

    It falls linearly from `rate` to 0 if `enabled`, and otherwise stays `rate`.
    """
    left = 1.0 - done * (1.0 / updates) if enabled else 1.0
    return rate * left


def minibatch_epochs(
    loss: Callable[[Weights, Batch], Float[Array, ""]], start: tuple[Weights, PyTree], batch: Batch,
    key: Key[Array, ""], optimizer: Optimizer, rate: Number, epochs: int, minibatches: int,
) -> tuple[Weights, PyTree]:  # fmt: skip
    """Minimise the loss, with one gradient step for each minibatch.

    **Arguments:**
    - `loss(weights, minibatch) -> number`: the loss.
    - `start`: the initial weights and optimizer state.
    - `batch`: a pytree of arrays with two leading axes, such as environments and time.
    - `epochs`, `minibatches`: number of passes over the batch, and of minibatches in a pass.
    **Returns:** the weights, and the optimizer's state.
    """
    rows = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), batch)
    count = len(jax.tree.leaves(rows)[0])

    def minibatch(
        carry: tuple[Weights, PyTree], part: Batch
    ) -> tuple[tuple[Weights, PyTree], None]:
        weights, moments = carry
        direction, moments = optimizer.update(jax.grad(loss)(weights, part), moments)
        return (jax.tree.map(lambda w, d: w - rate * d, weights, direction), moments), None

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
    """Return the numbers from 0 to `n - 1` in random order.

    On a CPU, XLA sorts one array of integers many times as fast as keys with values, so the lowest
    bits of each key are the number itself. Numbers whose other bits are equal stay in order: one
    pair in `2^32 / n`.
    """
    lowest = jnp.uint32((1 << max(n - 1, 1).bit_length()) - 1)
    random = jax.random.bits(key, (n,), jnp.uint32) & ~lowest
    return (jnp.sort(random | jnp.arange(n, dtype=jnp.uint32)) & lowest).astype(jnp.int32)


def minibatch_network(
    layers: Layers, rows: Float[Array, "rows inputs"], activation: str = "tanh"
) -> Float[Array, "rows outputs"]:
    """Evaluate `network` for many rows at once, with one unit a row in memory.

    On a CPU, the gradients of its weights are then products of matrices without a transposition,
    which for narrow layers take a tenth of the time.
    """
    # Transposed here, or else XLA would do it in each product.
    units, between = jax.lax.optimization_barrier(rows.T), ACTIVATIONS[activation]
    for weight, bias in layers[:-1]:
        units = between(weight.T @ units + bias[:, None])
    weight, bias = layers[-1]
    return jnp.transpose(weight.T @ units + bias[:, None])
