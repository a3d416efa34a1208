"""Points with the largest expected improvement on the lowest value of a Gaussian process.

The best candidates climb to maxima by quasi-Newton steps (`curvature`) on its logarithm. A batch
has them one by one, with local penalization of the points already chosen (Gonzalez, Dai, Hennig,
Lawrence, Batch Bayesian optimization via local penalization, AISTATS 2016).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, ndtr
from jaxtyping import Array, Bool, Float

from verifai_jax.addons.searches.gaussian import Posterior
from verifai_jax.addons.searches.process_data import encode, process_of, snap
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.curvature import Curvature, advance, begin

PARENTS = 8  # best candidates that climb. Chosen by hand
APART = 1e-4
"""Distance from an observation, in every coordinate, within which a point says nothing new."""
CLIMBS, CLIMB = 24, 0.05  # steps to a maximum, and their first length. Chosen by hand


def improving(
    posterior: Posterior, risk: Callable[[Float[Array, "m d"]], Float[Array, " m"]], cube: Cube,
    box: tuple[Array | float, Array | float], doubt: float, shared: Float[Array, "m d"], batch: int,
) -> Float[Array, "batch d"]:  # fmt: skip
    """Return points with the largest expected improvement, each away from the earlier ones.

    - `box`: its lowest corner and side lengths; process and candidates use its coordinates.
    - `doubt`: factor on the standard deviations, which increases exploration.
    """
    process, discrete = process_of(cube), np.array(cube.levels) > 0
    predict = process.predictor(posterior)
    lowest = jnp.min(posterior.residual, where=posterior.mask, initial=jnp.inf)

    def seen(v: Float[Array, "m d"]) -> Float[Array, "m d"]:
        return jnp.where(discrete, encode(v, cube), v)

    def merit(v: Float[Array, "m d"]) -> tuple[Array, Array, Array]:
        mean, std = predict(seen(v))
        std = doubt * std
        worth = jnp.log(std) + _log_gain((lowest - mean) / std) - risk(box[0] + box[1] * v)
        known = already_simulated(seen(v), posterior)
        return jnp.where(known, worth - 1e6, worth), mean, std

    def loss(v: Float[Array, "n d"]) -> tuple[Array, Array]:
        worth = merit(v)[0]
        return -jnp.sum(worth), -worth

    def climb(carry: tuple[Curvature, Array, Array], _: None) -> tuple:
        state, v, fresh = carry
        (_, value), slope = jax.value_and_grad(loss, has_aux=True)(v)
        ok = jnp.isfinite(value) & jnp.all(jnp.isfinite(slope), axis=1)
        value, slope = jnp.where(ok, value, 1e9), jnp.where(ok[:, None], slope, 0.0)
        state, v = advance(state, v, value, slope, fresh, jnp.full(len(v), CLIMB))
        return (state, v, jnp.zeros_like(fresh)), v

    shared = snap(shared, cube)
    worth, mean, std = merit(shared)
    _, best = jax.lax.top_k(worth, PARENTS)
    climbing = (begin(PARENTS, cube.dim), shared[best], jnp.ones(PARENTS, bool))
    (state, _, _), trail = jax.lax.scan(climb, climbing, None, length=CLIMBS)
    # A large batch takes points from the ways there too.
    tops = state.point if batch <= PARENTS else trail.reshape(-1, cube.dim)
    v = jnp.concatenate([shared, tops])
    worth, mean, std = (
        jnp.concatenate([one, two])
        for one, two in zip((worth, mean, std), merit(tops), strict=True)
    )
    x = seen(v)
    gradient = jax.grad(lambda x: jnp.sum(predict(x)[0]))(x)
    steepest = jnp.maximum(jnp.sqrt(jnp.max(jnp.sum(gradient**2, axis=1))), 1e-3)
    codes = np.array(process.unordered)

    def choose(worth: Float[Array, " m"], _: None) -> tuple[Array, Array]:
        best = jnp.argmax(worth)
        # Codes that differ are as far apart as the cube is wide.
        apart = jnp.where(codes, x != x[best], x - x[best])
        distance = jnp.sqrt(jnp.sum(apart**2, axis=1))
        # Probability that no point so good lies between there and the one chosen.
        z = (steepest * distance - mean[best] + lowest) / std[best]
        return (worth + log_ndtr(z)).at[best].set(-jnp.inf), best

    _, chosen = jax.lax.scan(choose, worth, None, length=batch)
    return box[0] + box[1] * v[chosen]


def _log_gain(z: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return the logarithm of the expected improvement of a value, in its standard deviations."""
    near, far = jnp.maximum(z, -4.0), jnp.minimum(z, -4.0)
    gain = near * ndtr(near) + jnp.exp(-0.5 * near**2) / np.sqrt(2 * np.pi)
    # Far below zero the sum above is rounding errors; two terms of its series instead.
    series = -0.5 * far**2 - 0.5 * np.log(2 * np.pi) - jnp.log(far**2 + 3)
    return jnp.where(z > -4, jnp.log(gain), series)


def already_simulated(x: Float[Array, "m d"], posterior: Posterior) -> Bool[Array, " m"]:
    distance = jnp.max(jnp.abs(x[:, None] - posterior.x[None]), axis=2)
    return jnp.any((distance < APART) & posterior.mask, axis=1)
