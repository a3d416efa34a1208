"""Models of the robustness, which propose most points of small rounds.

    model = model.learned(u, score)                     # after each round
    u = model.propose(key, cube, batch, others)         # points to simulate

Some proposals are minima of functions drawn from the posterior of an additive model, with an effect
of each choice and a parabola of each other coordinate: it needs few points, and its minima are
known in closed form (Agrawal, Goyal, Thompson sampling for contextual bandits with linear payoffs,
ICML 2013). The others are from a Gaussian process, which knows what coordinates do together. Each
has the lowest confidence bound of many points, with a factor from the exponential distribution
(Hutter, Hoos, Leyton-Brown, Parallel algorithm configuration, LION 2012), and few of them choose
among the same points: a point that is simulated already would be in vain.

In a curved valley the process has to look along it. So it may measure distances by the covariance
of the best points, as CMA-ES does, where that explains the robustness better, and chooses among
steps with this covariance too (Bajer, Pitra, Repicky, Holena, Gaussian process surrogate models for
the CMA evolution strategy, Evolutionary Computation 27(4), 2019).
"""

from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.best_points import newest_first
from verifai_jax.search.draws import draw_columns, standard_normal

# `benchmarks/search_quality.py constants` measures the effect of these numbers.
CAPACITY = 128
"""Points of the models: the best half, and the newest others."""
ENOUGH = 8
"""Points from which on the models say something."""
NOISES = (0.1, 1.0, 10.0, 100.0)
"""Variances of the noise of the additive model, in units of that of its weights. The evidence
chooses one of these, and of the lengths and noises of the process."""
LENGTHS = (0.2, 0.6, 1.8)
"""Length scales of the process, as root mean squares over the coordinates."""
ALONG = (1.0, 3.0, 10.0)
"""The same by the covariance of the best points, in standard deviations."""
ELITE = 32
"""Best points whose covariance that is."""
STEPS = (0.3, 3.0)
"""Smallest and largest step from one of the best points, in standard deviations."""
ADDITIVE = 0.25, 0.5
"""Share of the additive model of what is not drawn from the prior: without choices, and with them.
A quarter instead of a half took 1.09 times as many simulations on eight problems with choices, and
a half instead of a quarter 1.08 times as many on eleven of which most have none."""
GROUPS = 8
"""Groups of candidates, of which each proposal sees one."""
NUGGETS = (1e-3, 3e-2)
"""Variances of the noise of the process, in units of its own."""
EVENLY = 0.1
"""Share of the proposals that are drawn from the prior, at least."""
PATIENCE = 80
"""Simulations without progress after which half of the proposals are drawn from the prior: slopes
may lead away from the failures."""
CHOICES = 384
"""Candidates that the process compares: a third each from the prior, from another search, and steps
from the best points."""
FLOOR = 1e-6
"""Least variance of the covariance of the best points, in unit coordinates."""
MAX_DIM = 256
"""Coordinates up to which there are models: more are left to the other members."""


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

    def propose(
        self, key: Key[Array, ""], cube: Cube, batch: int, others: Float[Array, "m d"],
        stale: Int[Array, ""],
    ) -> Float[Array, "batch d"]:  # fmt: skip
        """Propose points; those of the prior as long as there is nothing to tell points apart.

        **Arguments:**
        - `others`: proposals of other searches, among which the process chooses too.
        - `stale`: the number of simulations since the last progress.
        """
        p, d = _features(self.u, cube).shape[1], cube.dim
        if d == 0:  # One point is all that there is.
            return jnp.zeros((batch, 0), jnp.float32)
        each = -(-CHOICES // (3 * batch))
        widths = 2, d, each * d, each * 2, p + CAPACITY + each * ELITE
        coins, prior, shared, sizes, numbers = draw_columns(key, batch, *widths)
        evenly = jnp.maximum(EVENLY, stale / (stale + PATIENCE))
        there = jnp.isfinite(self.score)
        spread = jnp.max(self.score, where=there, initial=0.0) > jnp.min(self.score)

        def modelled() -> Float[Array, "batch d"]:
            y = targets(self.score, there)
            normal = standard_normal(numbers)
            weights, noises, steps = jnp.split(normal, [p, p + CAPACITY], axis=1)
            drawn = self._minima(cube, y, there, weights, noises)
            near = self._near(sizes.reshape(-1, 2), steps.reshape(-1, ELITE))
            choices = jnp.concatenate([shared.reshape(-1, d), others, near])
            lowest = self._lowest(cube, y, there, choices, -jnp.log1p(-coins[:, 1:]))
            additive = ADDITIVE[bool(_parts(cube)[0])]
            return jnp.where(coins[:, :1] < evenly + additive * (1 - evenly), drawn, lowest)

        informed = spread & (jnp.sum(there) >= ENOUGH)
        u = jax.lax.cond(informed, modelled, lambda: prior)
        u = jnp.where(coins[:, :1] < evenly, prior, u)
        return u.at[:, cube.discrete].set(cube.centres(cube.cells(u)))

    def _minima(
        self, cube: Cube, y: Float[Array, " n"], there: Bool[Array, " n"],
        weights: Float[Array, "batch p"], noises: Float[Array, "batch n"],
    ) -> Float[Array, "batch d"]:  # fmt: skip
        """Return the minima of functions of the additive model, from standard normal numbers."""
        x = _features(self.u, cube) * there[:, None]
        noise = jnp.asarray(NOISES, jnp.float32)
        best, factor, half = _fit(x @ x.T, noise[:, None], y, there)
        scale = jnp.sqrt(half @ half / jnp.sum(there))
        left = y - scale * (weights @ x.T + jnp.sqrt(noise[best]) * noises)
        solved = cho_solve((factor, True), jnp.where(there, left, 0.0).T)
        weights = scale * weights + solved.T @ x
        codes, others = _parts(cube)
        u = jnp.zeros((len(weights), cube.dim), jnp.float32)
        line, bend = weights[:, : len(others)], weights[:, len(others) : 2 * len(others)]
        inside = -line / (2 * jnp.maximum(bend, 1e-9))
        lowest = jnp.where(2 * bend > jnp.abs(line), inside, -jnp.sign(line))
        u, first = u.at[:, others].set((lowest + 1) / 2), 2 * len(others)
        cells = jnp.asarray(cube.cells(u))
        for i in codes:
            cell = jnp.argmin(weights[:, first : first + cube.levels[i]], axis=1)
            cells = cells.at[:, cube.discrete.tolist().index(i)].set(cell)
            first += cube.levels[i]
        return u.at[:, cube.discrete].set(cube.centres(cells))

    def _lowest(
        self, cube: Cube, y: Float[Array, " n"], there: Bool[Array, " n"],
        choices: Float[Array, "m d"], optimism: Float[Array, "batch 1"],
    ) -> Float[Array, "batch d"]:  # fmt: skip
        """Return for each factor the choice of its group with the lowest bound of the process."""
        known, new = positions(self.u, cube), positions(choices, cube)
        _, mean, spread = self._best(known)
        floor = FLOOR / cube.dim * jnp.eye(known.shape[1], dtype=jnp.float32)
        root = jnp.linalg.cholesky(spread.T @ spread + floor) * np.sqrt(known.shape[1])

        def along(points: Float[Array, "m p"]) -> Float[Array, "m p"]:
            return solve_triangular(root, (points - mean).T, lower=True).T

        known, new = jnp.stack([known, along(known)]), jnp.stack([new, along(new)])
        options = np.array(
            list(product([0], LENGTHS, NUGGETS)) + list(product([1], ALONG, NUGGETS))
        )
        measure, (lengths, nuggets) = options[:, 0].astype(int), options[:, 1:].T.astype(np.float32)
        square = jax.vmap(squared_distances)(known, known)[measure]
        values = matern(square / lengths[:, None, None] ** 2)
        best, factor, half = _fit(
            jnp.where(there[:, None] & there, values, 0.0), jnp.asarray(nuggets)[:, None], y, there
        )
        chosen = jnp.asarray(measure)[best]
        square = squared_distances(known[chosen], new[chosen])
        cross = matern(square / jnp.asarray(lengths)[best] ** 2)
        cross = solve_triangular(factor, jnp.where(there[:, None], cross, 0.0), lower=True)
        scale = half @ half / jnp.sum(there)
        std = jnp.sqrt(scale * jnp.maximum(1 - jnp.sum(cross**2, axis=0), 0.0))
        rows, columns = np.arange(len(optimism))[:, None], np.arange(len(choices))
        group = (columns - rows) % min(len(optimism), GROUPS) == 0
        return choices[jnp.argmin(jnp.where(group, half @ cross - optimism * std, jnp.inf), axis=1)]

    def _best(self, points: Float[Array, "n p"]) -> tuple[Array, Array, Float[Array, "elite p"]]:
        """Return the order of the best rows, their mean, and a square root of their covariance."""
        order = jnp.argsort(self.score, stable=True)[:ELITE]
        there = jnp.isfinite(self.score[order])[:, None]
        count = jnp.maximum(jnp.sum(there), 1)
        mean = jnp.sum(jnp.where(there, points[order], 0.0), axis=0) / count
        return order, mean, jnp.where(there, points[order] - mean, 0.0) / jnp.sqrt(count)

    def _near(
        self, coins: Float[Array, "m 2"], normal: Float[Array, "m elite"]
    ) -> Float[Array, "m d"]:
        """Return steps from the best four points, each half as often as the one before."""
        order, _, spread = self._best(self.u)
        rank = jnp.floor(-jnp.log2(jnp.maximum(coins[:, 0], 2.0**-3))).astype(jnp.int32)
        size = STEPS[0] * (STEPS[1] / STEPS[0]) ** coins[:, 1:]
        return jnp.clip(self.u[order[rank]] + size * (normal @ spread), 0.0, 1.0)


def _fit(
    covariances: Float[Array, "*options n n"], noises: Float[Array, "options 1"],
    y: Float[Array, " n"], there: Bool[Array, " n"],
) -> tuple[Array, Float[Array, "n n"], Float[Array, " n"]]:  # fmt: skip
    """Return the number of the covariance of the greatest evidence, its factor, and that times y.

    The evidence is that with the best scale of the covariance, which is zero for absent points.
    """
    count, n = jnp.sum(there), len(y)
    covariances = jnp.broadcast_to(covariances, (len(noises), n, n))
    covariances += jnp.eye(n) * jnp.where(there, noises, 1.0)[:, None]

    def evidence(covariance: Array) -> tuple[Array, Array, Array]:
        factor = jnp.linalg.cholesky(covariance)
        half = solve_triangular(factor, y, lower=True)
        found = -0.5 * count * jnp.log(half @ half) - jnp.sum(jnp.log(jnp.diag(factor)))
        return jnp.where(jnp.isfinite(found), found, -jnp.inf), factor, half

    found, factors, halves = jax.lax.map(evidence, covariances)
    best = jnp.argmax(found)
    return best, factors[best], halves[best]


def _parts(cube: Cube) -> tuple[list[int], list[int]]:
    """Return the coordinates that are choices without an order, and the others."""
    codes = [i for i in cube.discrete.tolist() if not cube.ordered[i]]
    return codes, [i for i in range(cube.dim) if i not in codes]


def _chosen(u: Float[Array, "n d"], cube: Cube) -> list[Float[Array, "n cells"]]:
    """Return for each choice which cell it is in."""
    cells = dict(zip(cube.discrete.tolist(), cube.cells(u).T, strict=True))
    return [jax.nn.one_hot(cells[i], cube.levels[i]) for i in _parts(cube)[0]]


def _features(u: Float[Array, "n d"], cube: Cube) -> Float[Array, "n p"]:
    """Return the features of the additive model."""
    line = 2 * u[:, np.array(_parts(cube)[1], int)] - 1
    effects = [each - 1 / each.shape[1] for each in _chosen(u, cube)]
    return jnp.concatenate([line, line**2 - 1 / 3, *effects], axis=1)


def positions(u: Float[Array, "n d"], cube: Cube) -> Float[Array, "n p"]:
    """Return points at root mean square distances over the coordinates; choices differ by 1."""
    chosen = [each / np.sqrt(2, dtype=np.float32) for each in _chosen(u, cube)]
    joined = jnp.concatenate([u[:, np.array(_parts(cube)[1], int)], *chosen], axis=1)
    return joined / np.sqrt(cube.dim, dtype=np.float32)


def squared_distances(one: Float[Array, "n p"], two: Float[Array, "m p"]) -> Float[Array, "n m"]:
    """Return the squared distances of points."""
    square = jnp.sum(one**2, axis=1)[:, None] + jnp.sum(two**2, axis=1) - 2 * one @ two.T
    return jnp.maximum(square, 0.0)


@jax.custom_jvp
def matern(square: Array) -> Array:
    """Return Matern-5/2 of the squared distance; its derivative is finite at zero."""
    r = jnp.sqrt(5 * square)
    return (1 + r + r**2 / 3) * jnp.exp(-r)


@matern.defjvp
def _matern_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    r = jnp.sqrt(5 * primals[0])
    decay = jnp.exp(-r)
    return (1 + r + r**2 / 3) * decay, -5 / 6 * (1 + r) * decay * tangents[0]


def targets(score: Float[Array, " n"], there: Bool[Array, " n"]) -> Float[Array, " n"]:
    """Return what the models learn: the logarithm of the robustness in quartiles, of mean 0."""
    positive = jnp.sort(jnp.where(there & (score > 0), score, jnp.inf))
    quartile = positive[jnp.sum(jnp.isfinite(positive)) // 4]
    score = jnp.where(there, score, 0.0) / jnp.where(jnp.isfinite(quartile), quartile, 1.0)
    # Of huge values the logarithm is no more than of thirty quartiles.
    y = jnp.log1p(jnp.minimum(score, 30.0))
    return jnp.where(there, y - jnp.mean(y, where=there), 0.0)
