"""Recent transitions in one array of fixed shape: a ring from which batches are drawn.

One transition is one row of one array, so that adding is one write and sampling one gather. Both
work in place inside a compiled loop; no step copies the buffer.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key


class ReplayBuffer(NamedTuple):
    """A ring of transitions: `rows` `[capacity, 2 * size + actions + 2]`, where `unpack` takes
    the number of actions; the `index` of the row to write next; the number of rows that are
    `filled`.
    """

    rows: Float[Array, "capacity width"]
    index: Int[Array, ""]
    filled: Int[Array, ""]


class StoredTransitions(NamedTuple):
    """Transitions from a buffer: the policy's input and output, the reward, the observation of the
    state that the step led to, before any reset, and 1.0 if the episode ended for good, else 0.0.
    """

    observation: Float[Array, "batch size"]
    next_observation: Float[Array, "batch size"]
    action: Float[Array, "batch actions"]
    reward: Float[Array, " batch"]
    terminated: Float[Array, " batch"] | Bool[Array, " batch"]


def empty_buffer(capacity: int, size: int, actions: int) -> ReplayBuffer:
    """Make a buffer for observations of `size` numbers and actions of `actions`."""
    rows = jnp.zeros((capacity, 2 * size + actions + 2))
    return ReplayBuffer(rows, jnp.int32(0), jnp.int32(0))


def add(buffer: ReplayBuffer, new: StoredTransitions) -> ReplayBuffer:
    """Overwrite the oldest rows with transitions. Their number must divide the capacity."""
    columns = (new.observation, new.next_observation, new.action)
    scalars = (new.reward[:, None], new.terminated[:, None])
    rows = jnp.concatenate([part.astype(jnp.float32) for part in (*columns, *scalars)], axis=1)
    capacity, count = len(buffer.rows), len(rows)
    assert capacity % count == 0, (capacity, count)
    written = jax.lax.dynamic_update_slice(buffer.rows, rows, (buffer.index, 0))
    filled = jnp.minimum(buffer.filled + count, capacity)
    return ReplayBuffer(written, (buffer.index + count) % capacity, filled)


def sample(
    buffer: ReplayBuffer, key: Key[Array, ""], count: int, actions: int
) -> StoredTransitions:
    """Draw `count` transitions uniformly with replacement; the buffer must not be empty."""
    indices = jax.random.randint(key, (count,), 0, buffer.filled)
    return unpack(buffer.rows[indices], actions)


def unpack(rows: Float[Array, "batch width"], actions: int) -> StoredTransitions:
    """Split rows into their parts; an action has `actions` entries."""
    size = (rows.shape[1] - actions - 2) // 2
    return StoredTransitions(
        rows[:, :size], rows[:, size : 2 * size], rows[:, 2 * size : -2], rows[:, -2], rows[:, -1]
    )
