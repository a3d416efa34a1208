"""What happened lately, in an array of fixed shape: a ring of transitions to draw batches from.

    buffer = empty(capacity=50_000, size=3, actions=1)
    buffer = remember(buffer, rows)            # the oldest rows make place
    batch = draw(buffer, key, 128)

One transition is one row of one array, so that remembering is one write and drawing one gather.
Both work in place inside a compiled loop; no step copies the buffer.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key


class ReplayBuffer(NamedTuple):
    """Rows `[capacity, 2 * size + actions + 2]`, where the next one goes, and how many there are.

    The widths of an observation and an action are not kept: `split` is told them.
    """

    rows: Float[Array, "capacity width"]
    place: Int[Array, ""]
    filled: Int[Array, ""]


class Remembered(NamedTuple):
    """Transitions: what was seen, done and earned, what was seen next (before any reset)."""

    observation: Float[Array, "batch size"]
    next_observation: Float[Array, "batch size"]
    action: Float[Array, "batch actions"]
    reward: Float[Array, " batch"]
    terminated: Float[Array, " batch"]


def empty(capacity: int, size: int, actions: int) -> ReplayBuffer:
    """For observations of `size` numbers and actions of `actions`."""
    rows = jnp.zeros((capacity, 2 * size + actions + 2))
    return ReplayBuffer(rows, jnp.int32(0), jnp.int32(0))


def remember(buffer: ReplayBuffer, new: Remembered) -> ReplayBuffer:
    """Add transitions, over the oldest. The capacity is a multiple of their number."""
    columns = (new.observation, new.next_observation, new.action)
    scalars = (new.reward[:, None], new.terminated[:, None])
    rows = jnp.concatenate([part.astype(jnp.float32) for part in (*columns, *scalars)], axis=1)
    capacity, count = len(buffer.rows), len(rows)
    assert capacity % count == 0, (capacity, count)
    written = jax.lax.dynamic_update_slice(buffer.rows, rows, (buffer.place, 0))
    filled = jnp.minimum(buffer.filled + count, capacity)
    return ReplayBuffer(written, (buffer.place + count) % capacity, filled)


def draw(buffer: ReplayBuffer, key: Key[Array, ""], count: int, actions: int) -> Remembered:
    """Transitions drawn uniformly, with replacement, from a buffer that is not empty."""
    chosen = jax.random.randint(key, (count,), 0, buffer.filled)
    return split(buffer.rows[chosen], actions)


def split(rows: Float[Array, "batch width"], actions: int) -> Remembered:
    """The parts of rows whose actions have this many numbers."""
    size = (rows.shape[1] - actions - 2) // 2
    return Remembered(
        rows[:, :size], rows[:, size : 2 * size], rows[:, 2 * size : -2], rows[:, -2], rows[:, -1]
    )
