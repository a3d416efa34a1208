"""Models of the robustness, which propose most points of small rounds.

    model = model.learned(u, score)                     # after each round
    u = model.propose(key, cube, batch, others)         # points to simulate

Half of the proposals are minima of functions drawn from the posterior of an additive model, with an
effect of each choice, and a parabola of each other coordinate. It needs few points, and its minima
are known in closed form (Thompson sampling of a linear model: Agrawal, Goyal, Thompson sampling for
contextual bandits with linear payoffs, ICML 2013). The other half are from a Gaussian process,
which knows what coordinates do together: each is the lowest lower confidence bound among many
points, with a factor drawn from the exponential distribution, so that they differ (Hutter, Hoos,
Leyton-Brown, Parallel algorithm configuration, LION 2012).
"""

from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.best_points import newest_first
from verifai_jax.search.draws import draw_columns, draw_uniform, standard_normal
from verifai_jax.search.moves import near_others

CAPACITY = 128
"""Points of the models: the better half, and the newest others."""
ENOUGH = 8
"""Points before the models say anything."""
NOISES = (0.1, 1.0, 10.0, 100.0)
"""Variances of the noise of the additive model, in units of that of its weights; the evidence
decides between these, as between the numbers below."""
LENGTHS = (0.1, 0.2, 0.4, 0.8, 1.6)
"""Length scales of the process, in root mean square distances over the coordinates."""
NUGGETS = (1e-4, 1e-2, 1e-1)
"""Variances of its noise, in units of its own."""
CAP = 30.0
"""Quartiles of the robustness above which all values are the same to the models."""
PRIOR = 0.1
"""Share of proposals that are drawn from the prior."""
SHARED = 128
"""Points of the prior among which the process chooses, besides those of other searches."""
NEARER = 32
"""Points near each choice of the process among which it chooses again."""


class Surrogate(NamedTuple):
    """Points and their robustness, 0 for all failures, infinite where there is none."""

    u: Float[Array, "n d"]
    score: Float[Array, " n"]

    @classmethod
    def nothing(cls, d: int) -> "Surrogate":
        """Return the models before the first round."""
        return cls(jnp.full((CAPACITY, d), 0.5, jnp.float32), jnp.full(CAPACITY, jnp.inf))

    def learned(self, u: Float[Array, "m d"], score: Float[Array, " m"]) -> "Surrogate":
        """Return the models after a round; a score is infinite if there is nothing to learn."""
        u, score = newest_first(u, score, self.u, self.score)
        best = jnp.argsort(jnp.argsort(score, stable=True)) < CAPACITY // 2
        group = jnp.where(jnp.isinf(score), 2, jnp.where(best, 0, 1))
        kept = jnp.argsort(group, stable=True)[:CAPACITY]
        return Surrogate(u[kept], score[kept])

    @property
    def informed(self) -> Bool[Array, ""]:
        """Whether the robustness differs between enough points."""
        there = jnp.isfinite(self.score)
        highest = jnp.max(self.score, where=there, initial=0.0)
        return (highest > jnp.min(self.score)) & (jnp.sum(there) >= ENOUGH)

    def propose(
        self, key: Key[Array, ""], cube: Cube, batch: int, others: Float[Array, "m d"]
    ) -> Float[Array, "batch d"]:
        """Propose points, of the prior as long as the models are not informed.

        **Arguments:**
        - `others`: proposals of other searches, among which the process chooses too.
        """
        keys = jax.random.split(key, 3)
        coins, prior = draw_columns(keys[0], batch, 1, cube.dim)

        def modelled() -> Float[Array, "batch d"]:
            there = jnp.isfinite(self.score)
            y = _target(self.score, there)
            additive = self._minima(keys[1], cube, batch, y, there)
            chosen = self._lowest(keys[2], cube, batch, y, there, others)
            return jnp.where(jnp.arange(batch)[:, None] % 2 == 0, additive, chosen)

        found = jax.lax.cond(self.informed, modelled, lambda: prior)
        u = jnp.where(coins < PRIOR, prior, found)
        return u.at[:, cube.discrete].set(cube.centres(cube.cells(u)))

    def _minima(
        self, key: Key[Array, ""], cube: Cube, count: int, y: Float[Array, " n"],
        there: Bool[Array, " n"],
    ) -> Float[Array, "count d"]:  # fmt: skip
        """Return minima of functions drawn from the posterior of the additive model."""
        codes, others = _codes(cube)
        x = _features(self.u, cube) * there[:, None]
        n, p = x.shape
        covariances = (x @ x.T)[None] + jnp.eye(n) * np.array(NOISES, np.float32)[:, None, None]
        best, factor, half = _fit(covariances, y)
        scale = jnp.sqrt(half @ half / jnp.sum(there))
        noise = jnp.asarray(NOISES, jnp.float32)[best]
        weights, noises = draw_columns(key, count, p, n)
        weights = scale * standard_normal(weights)
        left = y - weights @ x.T - scale * jnp.sqrt(noise) * standard_normal(noises)
        solved = jax.scipy.linalg.cho_solve((factor, True), jnp.where(there, left, 0.0).T)
        weights += solved.T @ x
        u = jnp.zeros((count, cube.dim), jnp.float32)
        line, bend = weights[:, : len(others)], weights[:, len(others) : 2 * len(others)]
        inside = -line / (2 * jnp.maximum(bend, 1e-9))
        lowest = jnp.where(2 * bend > jnp.abs(line), inside, -jnp.sign(line))
        u = u.at[:, others].set((lowest + 1) / 2)
        first = 2 * len(others)
        for i in codes:
            cell = jnp.argmin(weights[:, first : first + cube.levels[i]], axis=1)
            u = u.at[:, i].set((cell + 0.5) / cube.levels[i])
            first += cube.levels[i]
        return u

    def _lowest(
        self, key: Key[Array, ""], cube: Cube, count: int, y: Float[Array, " n"],
        there: Bool[Array, " n"], others: Float[Array, "m d"],
    ) -> Float[Array, "count d"]:  # fmt: skip
        """Return the points with the lowest bounds of the process."""
        known = _places(self.u, cube)
        far = _apart(known, known, cube.dim)
        both = there[:, None] & there[None]
        options = np.array(list(product(LENGTHS, NUGGETS)), np.float32)
        values = matern(far[None] / options[:, 0, None, None])
        nuggets = jnp.eye(len(y)) * jnp.where(there, options[:, 1, None], 1.0)[:, None]
        best, factor, half = _fit(jnp.where(both, values, 0.0) + nuggets, y)
        length = jnp.asarray(options)[best, 0]
        scale = jnp.sqrt(half @ half / jnp.sum(there))
        d = cube.dim
        prior, optimism, random = jnp.split(
            draw_uniform(key, (SHARED * d + count + count * NEARER * (3 + 2 * d),)),
            [SHARED * d, SHARED * d + count],
        )
        optimism = -jnp.log1p(-optimism)

        def predict(u: Float[Array, "k d"]) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
            cross = matern(_apart(known, _places(u, cube), d) / length)
            cross = solve_triangular(factor, jnp.where(there[:, None], cross, 0.0), lower=True)
            variance = jnp.maximum(1 - jnp.sum(cross**2, axis=0), 0.0)
            return half @ cross, scale * jnp.sqrt(variance)

        shared = jnp.concatenate([prior.reshape(SHARED, d), others])
        mean, std = predict(shared)
        parents = shared[jnp.argmin(mean - optimism[:, None] * std, axis=1)]
        around = near_others(
            jnp.repeat(parents, NEARER, axis=0), random.reshape(count * NEARER, -1), cube,
            jnp.array([0.2, 0.01]),
        )  # fmt: skip
        around = around.reshape(count, NEARER, d).at[:, 0].set(parents)
        mean, std = (each.reshape(count, NEARER) for each in predict(around.reshape(-1, d)))
        index = jnp.argmin(mean - optimism[:, None] * std, axis=1)
        return around[jnp.arange(count), index]


def _fit(
    covariances: Float[Array, "options n n"], y: Float[Array, " n"]
) -> tuple[Array, Float[Array, "n n"], Float[Array, " n"]]:
    """Return the covariance of the greatest evidence: its number, its factor, and that times y.

    The evidence is that with the best scale of the covariance.
    """

    def evidence(covariance: Array) -> tuple[Array, Array, Array]:
        factor = jnp.linalg.cholesky(covariance)
        half = solve_triangular(factor, y, lower=True)
        found = -0.5 * len(y) * jnp.log(half @ half) - jnp.sum(jnp.log(jnp.diag(factor)))
        return jnp.where(jnp.isfinite(found), found, -jnp.inf), factor, half

    found, factors, halves = jax.lax.map(evidence, covariances)
    best = jnp.argmax(found)
    return best, factors[best], halves[best]


def _codes(cube: Cube) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates that are choices without an order, and the others."""
    codes = (np.array(cube.levels) > 0) & ~np.array(cube.ordered, bool)
    return np.flatnonzero(codes), np.flatnonzero(~codes)


def _chosen(u: Float[Array, "n d"], cube: Cube) -> list[Float[Array, "n cells"]]:
    """Return for each choice which cell it is in."""
    cells = cube.cells(u)
    columns = {int(i): j for j, i in enumerate(cube.discrete)}
    return [jax.nn.one_hot(cells[:, columns[i]], cube.levels[i]) for i in _codes(cube)[0].tolist()]


def _features(u: Float[Array, "n d"], cube: Cube) -> Float[Array, "n features"]:
    """Return the features of the additive model."""
    line = 2 * u[:, _codes(cube)[1]] - 1
    effects = [each - 1 / each.shape[1] for each in _chosen(u, cube)]
    return jnp.concatenate([line, line**2 - 1 / 3, *effects], axis=1)


def _places(u: Float[Array, "n d"], cube: Cube) -> Float[Array, "n places"]:
    """Return points whose distances are those of the process: choices differ by 0 or 1."""
    chosen = [each / np.float32(np.sqrt(2)) for each in _chosen(u, cube)]
    return jnp.concatenate([u[:, _codes(cube)[1]], *chosen], axis=1)


def _apart(one: Float[Array, "n p"], two: Float[Array, "m p"], d: int) -> Float[Array, "n m"]:
    """Return root mean square distances over the coordinates."""
    square = jnp.sum(one**2, axis=1)[:, None] + jnp.sum(two**2, axis=1) - 2 * one @ two.T
    return jnp.sqrt(jnp.maximum(square, 0.0) / d)


def matern(far: Array) -> Array:
    """Return Matern-5/2 of a distance in length scales."""
    r = np.float32(np.sqrt(5)) * far
    return (1 + r + r**2 / 3) * jnp.exp(-r)


def _target(score: Float[Array, " n"], there: Bool[Array, " n"]) -> Float[Array, " n"]:
    """Return what the models learn: the logarithm of the robustness in quartiles, of mean 0."""
    positive = jnp.sort(jnp.where(there & (score > 0), score, jnp.inf))
    quartile = positive[jnp.sum(jnp.isfinite(positive)) // 4]
    score = jnp.where(there, score, 0.0) / jnp.where(jnp.isfinite(quartile), quartile, 1.0)
    y = jnp.log1p(jnp.minimum(score, CAP))
    return jnp.where(there, y - jnp.mean(y, where=there), 0.0)
