"""How much of a space its constraint accepts, and what is wrong with one that accepts nothing."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.core.text import format_percent

SAMPLES = 65_536
BLOCK = 4096
ENOUGH = 1000
"""Accepted samples after which the rate is known well enough."""


def acceptance_rate(space: Any, seed: Any = 0) -> float:
    """The share of the prior's samples that `space.where` accepts.

    **Raises:** `ValueError` for a constraint that raises, does not return one truth value, or
    accepts none of the samples.
    """
    point = jax.ShapeDtypeStruct((space.dim,), jnp.float32)
    try:
        answer = jax.eval_shape(lambda u: space.where(space.unflatten(u)), point)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        raise ValueError(
            "where is traced by JAX, so it cannot use `and`, `or`, `not`, `if` or NumPy on "
            f"features: use &, |, ~, jnp.where and jnp ({type(error).__name__})"
        ) from error
    except Exception as error:
        raise ValueError(
            f"where raised {type(error).__name__} for the features {list(space.domains)}: {error}"
        ) from error
    if getattr(answer, "shape", None) != () or answer.dtype != jnp.bool_:
        shown = type(answer).__name__
        if hasattr(answer, "shape"):
            shown = f"shape {list(answer.shape)} of {answer.dtype}"
        raise ValueError(f"where must return one truth value; got {shown}")
    accepted = tried = 0
    if isinstance(seed, jax.Array) and jnp.issubdtype(seed.dtype, jax.dtypes.prng_key):
        seed = [int(word) for word in np.ravel(jax.random.key_data(seed))]
    random = np.random.default_rng(seed)
    while tried < SAMPLES and accepted < ENOUGH:
        accepted += int(np.sum(space.accepts_points(random.random((BLOCK, space.dim), np.float32))))
        tried += BLOCK
    if not accepted:
        most = -np.log(0.05) / tried
        raise ValueError(
            f"where accepted none of {tried} samples of the space, so fewer than "
            f"{format_percent(most)} of it are allowed (95 % confidence): make the domains "
            "narrower, or check the condition"
        )
    return accepted / tried
