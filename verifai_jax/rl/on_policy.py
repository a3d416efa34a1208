"""Learning from one stretch of experience: a few passes over it in shuffled minibatches.

weights, moments = minibatch_epochs(loss, (weights, moments), batch, key, optimizer, rate, 4, 8)
"""

from collections.abc import Callable
from typing import TypeVar

import jax
from jaxtyping import Array, Float, Key, PyTree

from verifai_jax.rl.algorithm import Number
from verifai_jax.rl.optimizer import Optimizer
from verifai_jax.rl.shuffling import permutation

Weights = TypeVar("Weights")
Batch = TypeVar("Batch")


def minibatch_epochs(
    loss: Callable[[Weights, Batch], Float[Array, ""]],
    start: tuple[Weights, PyTree],
    batch: Batch,
    key: Key[Array, ""],
    optimizer: Optimizer,
    rate: Number,
    epochs: int,
    minibatches: int,
) -> tuple[Weights, PyTree]:
    """Descend the loss, one step for each minibatch.

    **Arguments:**

    - `loss(weights, minibatch) -> number`: what is descended.
    - `start`: weights, and the optimizer's state.
    - `batch`: a pytree of arrays with two leading axes, such as environments and time.
    - `key`: a random key, of the order.
    - `optimizer`, `rate`: the direction of a step, and its length.
    - `epochs`, `minibatches`: passes over the batch, and parts in a pass.

    **Returns:** weights, and the optimizer's state.
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
