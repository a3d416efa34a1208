"""Measurement of the share of a space that its constraint accepts."""

import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.core.messages.text import format_percent
from verifai_jax.core.user_code.user_errors import explain_user_error

SAMPLES = 65_536
"""Greatest number of samples of the prior: if it accepts none of them, at most 0.005 % of the prior
is allowed (95 % confidence)."""
BLOCK = 4096
"""Samples of the prior at a time, so that one shape compiles."""
ENOUGH = 1000
"""Accepted samples after which the rate is known well enough: to about 3 % of itself."""
ON_HOST = 16
"""Samples at a time of a constraint that Python decides, which may take 40 ms for each."""
PATIENCE, LIMIT = 1.0, 60.0
"""Seconds after which one accepted sample of such a constraint is enough, and after which none ends
the measurement."""


def acceptance_rate(
    where: Callable[[Float[Array, " d"]], Array],
    accepts: Callable[[Float[np.ndarray, "n d"]], Bool[Array | np.ndarray, " n"]],
    names: Sequence[str],
    dim: int,
    seed: int | Key[Array, ""] = 0,
) -> float:
    """Estimate the share of the prior's samples that a constraint accepts.

    A constraint that Python evaluates is called for a second, or until it has accepted one sample.

    **Arguments:**
    - `where`: the constraint as a function of a point of the unit cube.
    - `accepts`: the same for many points, compiled.
    **Raises:** `ValueError` for a constraint that raises, does not return one truth value, or
    accepts no sample.
    """
    try:
        form = jax.ShapeDtypeStruct((dim,), jnp.float32)
        program, answer = jax.make_jaxpr(where, return_shape=True)(form)
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
    on_host = "callback" in str(program)
    block, began = ON_HOST if on_host else BLOCK, time.perf_counter()
    while tried < SAMPLES and accepted < ENOUGH:
        accepted += int(np.sum(accepts(random.random((block, dim), np.float32))))
        tried += block
        if on_host and time.perf_counter() - began > (PATIENCE if accepted else LIMIT):
            break
    if not accepted:
        bound = -np.log(0.05) / tried
        raise ValueError(
            f"where accepted none of {tried} samples of the space, so fewer than "
            f"{format_percent(bound)} of it are allowed (95 % confidence): make the domains "
            "narrower, or check the condition"
        )
    return accepted / tried


def _entropy(seed: int | Key[Array, ""]) -> int | list[int]:
    """Return the seed of NumPy's generator; the words of a key are its seed."""
    if isinstance(seed, jax.Array) and jnp.issubdtype(seed.dtype, jax.dtypes.prng_key):
        return [int(word) for word in np.ravel(jax.random.key_data(seed))]
    return seed  # pyright: ignore[reportReturnType]
