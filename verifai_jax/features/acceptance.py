"""Measurement of the share of a space that its constraint accepts."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.core.text import format_percent
from verifai_jax.core.user_errors import explain_user_error

SAMPLES = 65_536
"""Samples of the prior at most."""

BLOCK = 4096
"""Samples of the prior at a time."""

ENOUGH = 1000
"""Accepted samples after which the rate is known well enough."""


def acceptance_rate(
    where: Callable[[Float[Array, " d"]], Array],
    accepts: Callable[[Float[np.ndarray, "n d"]], Bool[Array, " n"]],
    names: Sequence[str],
    dim: int,
    seed: int | Key[Array, ""] = 0,
) -> float:
    """Estimate the share of the prior's samples that a constraint accepts.

    **Arguments:**

    - `where`: the constraint as a function of one point of the unit cube.
    - `accepts`: the same for many points, compiled.
    - `names`: of the features, for messages.
    - `dim`: number of unit coordinates.
    - `seed`: of the samples.

    **Raises:** `ValueError` for a constraint that raises, does not return one truth value, or
    accepts none of the samples.
    """
    try:
        answer = jax.eval_shape(where, jax.ShapeDtypeStruct((dim,), jnp.float32))
    except Exception as error:
        why = explain_user_error(error, dict.fromkeys(names), system=False)
        raise ValueError(f"where must be a JAX function of the features: {why}") from error
    if getattr(answer, "shape", None) != () or answer.dtype != jnp.bool_:
        shown = type(answer).__name__
        if hasattr(answer, "shape"):
            shown = f"shape {list(answer.shape)} of {answer.dtype}"
        raise ValueError(f"where must return one truth value; got {shown}")
    accepted = tried = 0
    random = np.random.default_rng(_entropy(seed))
    while tried < SAMPLES and accepted < ENOUGH:
        accepted += int(np.sum(accepts(random.random((BLOCK, dim), np.float32))))
        tried += BLOCK
    if not accepted:
        most = -np.log(0.05) / tried
        raise ValueError(
            f"where accepted none of {tried} samples of the space, so fewer than "
            f"{format_percent(most)} of it are allowed (95 % confidence): make the domains "
            "narrower, or check the condition"
        )
    return accepted / tried


def _entropy(seed: int | Key[Array, ""]) -> int | list[int]:
    """Return the seed of NumPy's generator; that of a key are its words."""
    if isinstance(seed, jax.Array) and jnp.issubdtype(seed.dtype, jax.dtypes.prng_key):
        return [int(word) for word in np.ravel(jax.random.key_data(seed))]
    return seed  # pyright: ignore[reportReturnType]
