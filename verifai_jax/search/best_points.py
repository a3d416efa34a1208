"""Memory of the best points so far; among equal ones the newest comes first."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def newest_first(
    u: Float[Array, "n d"], new: Float[Array, " n"], points: Float[Array, "k d"],
    score: Float[Array, " k"],
) -> tuple[Float[Array, "n+k d"], Float[Array, " n+k"]]:  # fmt: skip
    """Return the points of a round before those of a memory, with their scores.

    **Arguments:**
    - `u`, `new`: points and scores of the round; a score is infinite if there is nothing to learn.
    - `points`, `score`: points and scores of the memory; a score is infinite in an empty row.
    """
    u = jnp.where(jnp.isinf(new)[:, None], 0.5, u)
    return jnp.concatenate([u, points]), jnp.concatenate([new, score])


def keep_best(
    u: Float[Array, "n d"], new: Float[Array, " n"], points: Float[Array, "k d"],
    score: Float[Array, " k"],
) -> tuple[Float[Array, "k d"], Float[Array, " k"]]:  # fmt: skip
    """Return the best points of a round and a memory, sorted; the newest first among equal ones.

    **Arguments:** those of `newest_first`.
    """
    points, scores = newest_first(u, new, points, score)
    _, best = jax.lax.top_k(-scores, len(score))
    return points[best], scores[best]
