"""CMA-ES: one Gaussian that learns where to go, how far, and along which directions.

Hansen, The CMA Evolution Strategy: A Tutorial, 2016: the parameters' defaults are those of its
table 1, without negative weights. A Cholesky factor stands for the symmetric root of the
covariance (Krause, Arbones, Igel, A CMA-ES with optimal covariance update and storage complexity,
2016). Above `full_up_to` coordinates the covariance is diagonal and learns faster by a factor
(Ros, Hansen, A simple modification in CMA-ES achieving linear time and space complexity, 2008).

What is made for falsification:

- a run begins with a generation of the prior. As long as all of it has the same robustness there is
  nothing to learn, and the next generation is another one;
- points are clipped to the cube, and the run learns from the clipped ones;
- a coordinate with ordered cells keeps a standard deviation that reaches the next cell (as Hamano
  et al., CMA-ES with margin, GECCO 2022); one with unordered cells has probabilities instead;
- all failures are equally good. A run ends when it has failed often enough, has converged or makes
  no progress. The next one begins alternately with large steps, from the prior, and with small
  ones, at the best of the points that exploration has found meanwhile (as Hansen, Benchmarking a
  BI-population CMA-ES on the BBOB-2009 function testbed, alternates between two regimes).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import ndtri
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from verifai_jax.search.base import (
    Cube,
    Evaluated,
    Search,
    check_count,
    check_fraction,
)
from verifai_jax.search.halton import halton_points

# More cells than this are an ordered quantity: a generation cannot tell their probabilities.
MOST_CELLS = 32
MARGIN = 0.25  # standard deviation of an ordered discrete coordinate, in cells, at least
LEARNING = 0.3  # of the probabilities of unordered cells, per generation
LARGEST = 1e30  # robustness


class CMAESState(NamedTuple):
    key: Key[Array, ""]
    round: UInt32[Array, ""]  # asks
    told: UInt32[Array, ""]  # rows, in all
    explored: UInt32[Array, ""]  # points of the prior asked for
    run: Int[Array, ""]
    generation: Int[Array, ""]  # of the run; 0 is drawn from the prior
    mean: Float[Array, " n"]
    size: Float[Array, ""]  # of the step
    covariance: Float[Array, "n *n"]  # over the squared size; a diagonal above `full_up_to`
    way: Float[Array, " n"]  # evolution paths, of the covariance and of the size
    whitened: Float[Array, " n"]
    choices: Float[Array, "k cells"]  # probabilities of unordered cells
    u: Float[Array, "population d"]  # the generation so far
    score: Float[Array, " population"]  # robustness, 0 for all failures; infinite if not to be used
    filled: Int[Array, ""]  # rounds of it
    best: Float[Array, ""]  # score in the run
    stale: Int[Array, ""]  # generations without a better one
    failures: Int[Array, ""]  # points in the run
    reserve: Float[Array, " d"]  # best point of exploration since the run began, and its score
    reserve_score: Float[Array, ""]


@dataclass(frozen=True)
class CMAES(Search):
    """Covariance matrix adaptation, with restarts; a generation is a batch.

    Batches smaller than a population should be (`4 + 3 log d`) are collected until there is one.

    **Arguments:**

    - `step`: standard deviation, in unit coordinates, with which a run from the prior begins.
    - `small_step`: that of a run around a point of exploration.
    - `exploration`: share of the points drawn from the prior, for ever.
    - `full_up_to`: coordinates up to which there is a whole covariance matrix.
    - `least_std`: standard deviation at which a run has converged, if all coordinates are below.
    - `patience`: generations without progress after which a run ends; more in many dimensions.
    - `failures`: after this many failing points, and no fewer than two generations', a run ends.

    **Raises:** `ValueError` for values out of range.
    """

    step: float = 0.3
    small_step: float = 0.1
    exploration: float = 0.1
    full_up_to: int = 40
    least_std: float = 0.005
    patience: int = 6
    failures: int = 20

    def __post_init__(self) -> None:
        for name in ("step", "small_step", "exploration", "least_std"):
            check_fraction(name, getattr(self, name))
        check_count("full_up_to", self.full_up_to, 0)
        check_count("patience", self.patience)
        check_count("failures", self.failures)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> CMAESState:
        n, d = len(_gaussian(cube)), cube.dim
        population = _population(cube, batch)
        full = n <= self.full_up_to
        return CMAESState(
            key=key,
            round=jnp.uint32(0),
            told=jnp.uint32(0),
            explored=jnp.uint32(0),
            run=jnp.int32(0),
            generation=jnp.int32(0),
            mean=jnp.full(n, 0.5, jnp.float32),
            size=jnp.float32(self.step),
            covariance=jnp.eye(n, dtype=jnp.float32) if full else jnp.ones(n, jnp.float32),
            way=jnp.zeros(n, jnp.float32),
            whitened=jnp.zeros(n, jnp.float32),
            choices=jnp.asarray(_prior(cube)),
            u=jnp.full((population, d), 0.5, jnp.float32),
            score=jnp.full(population, jnp.inf, jnp.float32),
            filled=jnp.int32(0),
            best=jnp.float32(jnp.inf),
            stale=jnp.int32(0),
            failures=jnp.int32(0),
            reserve=jnp.full(d, 0.5, jnp.float32),
            reserve_score=jnp.float32(jnp.inf),
        )

    def ask(
        self, state: CMAESState, cube: Cube, batch: int
    ) -> tuple[Float[Array, "batch d"], CMAESState]:
        prior = self._explores(state, batch) | (state.generation == 0)
        number = state.explored + jnp.cumsum(prior).astype(jnp.uint32)
        fresh = halton_points(number, cube.dim, state.key)
        drawn = self._draw(jax.random.fold_in(state.key, state.round), state, cube, batch)
        u = jnp.where(prior[:, None], fresh, drawn)
        return u, state._replace(round=state.round + 1, explored=number[-1])

    def tell(self, state: CMAESState, cube: Cube, evaluated: Evaluated) -> CMAESState:
        batch = len(evaluated.rho)
        usable = evaluated.counted & (evaluated.rho < jnp.inf)
        score = jnp.where(usable, jnp.clip(evaluated.rho, 0.0, LARGEST), jnp.inf)
        u = jnp.where(usable[:, None], evaluated.u, 0.5)

        # Points of exploration are far away from the run: they say nothing about its next step.
        outside = self._explores(state, batch) & (state.generation > 0)
        state = _reserved(state, u, jnp.where(outside, score, jnp.inf))
        row = state.filled * batch
        inside = jnp.where(outside, jnp.inf, score)
        state = state._replace(
            told=state.told + np.uint32(batch),
            u=jax.lax.dynamic_update_slice(state.u, u, (row, jnp.int32(0))),
            score=jax.lax.dynamic_update_slice(state.score, inside, (row,)),
            filled=state.filled + 1,
            failures=state.failures + jnp.sum(inside == 0, dtype=jnp.int32),
        )
        complete = state.filled * batch == len(state.score)
        return _where(complete, self._next(state, cube), state)

    def warm(self, state: CMAESState, cube: Cube, evaluated: Evaluated) -> CMAESState:
        """Begin with small steps at the best of these points."""
        usable = evaluated.counted & (evaluated.rho < jnp.inf)
        score = jnp.where(usable, jnp.clip(evaluated.rho, 0.0, LARGEST), jnp.inf)
        u = jnp.where(usable[:, None], evaluated.u, 0.5)
        # The best of all calls so far is the mean of the run that would begin now.
        better = jnp.min(score, initial=jnp.inf) < state.best
        found = _reserved(state._replace(reserve_score=jnp.float32(jnp.inf)), u, score)
        begun = self._begin(found, cube, jnp.array(True))
        return _where(better, begun._replace(best=found.reserve_score), state)

    def _explores(self, state: CMAESState, batch: int) -> Bool[Array, " batch"]:
        """Every tenth row, say, whatever the batch is; in integers, which do not drift."""
        row = (state.told % 1000 + jnp.arange(batch, dtype=jnp.uint32)) % 1000
        share = np.uint32(np.ceil(1000 * self.exploration))
        return row * share % 1000 < share

    def _draw(
        self, key: Key[Array, ""], state: CMAESState, cube: Cube, batch: int
    ) -> Float[Array, "batch d"]:
        """Points of the Gaussian, and of the choices."""
        plain, codes = _gaussian(cube), _unordered(cube)
        sizes = [batch * len(plain), batch * len(codes)]
        # Drawn flat and kept: to compile it takes a fifth of the time.
        random = jax.lax.optimization_barrier(jax.random.uniform(key, (sum(sizes),), jnp.float32))
        normal, draw = jnp.split(random, [sizes[0]])
        normal = ndtri(jnp.maximum(normal, np.float32(2**-25))).reshape(batch, len(plain))
        x = state.mean + state.size * _coloured(state.covariance, normal)
        u = jnp.full((batch, cube.dim), 0.5, jnp.float32)
        u = u.at[:, plain].set(jnp.clip(x, 0.0, 1.0))
        if len(codes) == 0:
            return u
        limits = jnp.cumsum(state.choices, axis=1)
        cell = jnp.sum(draw.reshape(batch, -1, 1) > limits, axis=-1).astype(jnp.int32)
        levels = np.array([cube.levels[i] for i in codes], np.int32)
        among = np.searchsorted(cube.discrete, codes)
        cells = cube.cells(u).at[:, among].set(jnp.minimum(cell, levels - 1))
        return u.at[:, codes].set(cube.centres(cells)[:, among])

    def _next(self, state: CMAESState, cube: Cube) -> CMAESState:
        """After a whole generation: learn from it, or begin a new run."""
        n = len(_gaussian(cube))
        population = len(state.score)
        there = jnp.isfinite(state.score)
        worst = jnp.max(state.score, where=there, initial=-jnp.inf)
        least = jnp.min(state.score, where=there, initial=jnp.inf)
        informed = (least < worst) | (least == 0)
        better = (least < 0.99 * state.best) | ((least == 0) & (state.best > 0))
        stale = jnp.where(better, 0, state.stale + 1).astype(jnp.int32)

        weights = _weights(state.score)
        placed = self._place(state, cube, weights)
        moved = self._move(state, cube, weights)
        learned = _where(state.generation == 0, placed, moved)
        learned = learned._replace(
            choices=_chosen(state, cube, weights),
            generation=state.generation + 1,
            best=jnp.minimum(least, state.best),
            stale=stale,
        )
        # Without differences between points there is nothing to learn.
        learned = _where(informed, learned, state._replace(stale=stale))
        empty = jnp.full(population, jnp.inf, jnp.float32)
        learned = learned._replace(score=empty, filled=jnp.int32(0))

        variance = (
            learned.covariance
            if learned.covariance.ndim == 1
            else (jnp.diagonal(learned.covariance))
        )
        widest = learned.size * jnp.sqrt(jnp.max(variance, initial=0.0))
        ended = (learned.failures >= max(self.failures, 2 * population)) | (
            (stale >= self.patience + 5 * n // population) & (state.generation > 0)
        )
        if n:
            ended |= (widest < self.least_std) | ~jnp.isfinite(widest)
        small = (learned.run % 2 == 0) & jnp.isfinite(learned.reserve_score)
        return _where(ended, self._begin(learned, cube, small), learned)

    def _begin(self, state: CMAESState, cube: Cube, small: Bool[Array, ""]) -> CMAESState:
        """A new run: with small steps around the reserve, or with a generation of the prior."""
        plain, codes = _gaussian(cube), _unordered(cube)
        prior = jnp.asarray(_prior(cube))
        choices = prior
        if len(codes):
            among = np.searchsorted(cube.discrete, codes)
            cell = cube.cells(state.reserve)[among]
            choices = 0.5 * prior + 0.5 * jax.nn.one_hot(cell, prior.shape[1])
        full = state.covariance.ndim == 2
        begun = state._replace(
            run=state.run + 1,
            generation=jnp.where(small, 1, 0).astype(jnp.int32),
            mean=state.reserve[plain],
            size=jnp.where(small, self.small_step, self.step).astype(jnp.float32),
            covariance=jnp.eye(len(plain)) if full else jnp.ones(len(plain)),
            way=jnp.zeros_like(state.way),
            whitened=jnp.zeros_like(state.whitened),
            choices=jnp.where(small, choices, prior),
            score=jnp.full_like(state.score, jnp.inf),
            filled=jnp.int32(0),
            best=jnp.float32(jnp.inf),
            stale=jnp.int32(0),
            failures=jnp.int32(0),
            reserve_score=jnp.float32(jnp.inf),
        )
        return _widened(begun, cube)

    def _place(
        self, state: CMAESState, cube: Cube, weights: Float[Array, " population"]
    ) -> CMAESState:
        """After the generation of the prior: where the run begins."""
        mean = weights @ state.u[:, _gaussian(cube)]
        return _widened(state._replace(mean=mean), cube)

    def _move(
        self, state: CMAESState, cube: Cube, weights: Float[Array, " population"]
    ) -> CMAESState:
        """One step of the strategy; names in comments are those of the tutorial."""
        n = len(_gaussian(cube))
        if n == 0:
            return state
        steps = (state.u[:, _gaussian(cube)] - state.mean) / state.size
        white = _whitened(state.covariance, steps)
        # Points that others replaced may be far out: as for injected ones, their steps are cut
        # (Hansen, Injecting external solutions into CMA-ES, 2011).
        norm = jnp.sqrt(jnp.sum(white**2, axis=1, keepdims=True))
        most = math.sqrt(n) + 2 * n / (n + 2)
        cut = jnp.minimum(1.0, most / jnp.maximum(norm, 1e-12))
        steps, white = steps * cut, white * cut

        mass = 1 / jnp.sum(weights**2)  # mu_eff
        size_rate = (mass + 2) / (n + mass + 5)  # c_sigma
        damping = 1 + 2 * jnp.maximum(0, jnp.sqrt((mass - 1) / (n + 1)) - 1) + size_rate
        way_rate = (4 + mass / n) / (n + 4 + 2 * mass / n)  # c_c
        one = 2 / ((n + 1.3) ** 2 + mass)  # c_1
        many = 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass)  # c_mu
        if state.covariance.ndim == 1:
            one, many = (jnp.minimum(rate * (n + 2) / 3, 0.5) for rate in (one, many))
        many = jnp.clip(many, 0.0, 1 - one)

        step = weights @ steps
        mean = jnp.clip(state.mean + state.size * step, 0.0, 1.0)
        gain = jnp.sqrt(size_rate * (2 - size_rate) * mass)
        whitened = (1 - size_rate) * state.whitened + gain * (weights @ white)
        length = jnp.sqrt(jnp.sum(whitened**2))
        expected = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
        growth = size_rate / damping * (length / expected - 1)
        size = jnp.minimum(state.size * jnp.exp(jnp.minimum(growth, 1.0)), 1.0)

        age = state.generation.astype(jnp.float32)
        unbiased = jnp.sqrt(1 - (1 - size_rate) ** (2 * age))
        steady = length / unbiased < (1.4 + 2 / (n + 1)) * expected  # h_sigma
        gain = jnp.sqrt(way_rate * (2 - way_rate) * mass)
        way = (1 - way_rate) * state.way + steady * gain * step
        kept = 1 - one - many + one * (1 - steady) * way_rate * (2 - way_rate)
        if state.covariance.ndim == 1:
            covariance = kept * state.covariance + one * way**2 + many * (weights @ steps**2)
        else:
            spread = (weights * steps.T) @ steps
            covariance = kept * state.covariance + one * jnp.outer(way, way) + many * spread
        return _widened(
            state._replace(mean=mean, size=size, covariance=covariance, way=way, whitened=whitened),
            cube,
        )


def _gaussian(cube: Cube) -> Int[np.ndarray, " n"]:
    """Indices of the coordinates that the Gaussian has."""
    return np.setdiff1d(np.arange(cube.dim), _unordered(cube))


def _unordered(cube: Cube) -> Int[np.ndarray, " k"]:
    """Indices of the coordinates that have probabilities."""
    return np.array(
        [i for i in cube.discrete if not cube.ordered[i] and cube.levels[i] <= MOST_CELLS], np.int64
    )


def _prior(cube: Cube) -> Float[np.ndarray, "k cells"]:
    codes = _unordered(cube)
    prior = np.zeros((len(codes), max((cube.levels[i] for i in codes), default=0)), np.float32)
    for row, j in zip(prior, np.searchsorted(cube.discrete, codes), strict=True):
        row[: len(cube.probabilities[j])] = cube.probabilities[j]
    return prior


def _population(cube: Cube, batch: int) -> int:
    """Points in a generation: whole batches, and no fewer than the tutorial's default."""
    least = 4 + int(3 * math.log(max(cube.dim, 1)))
    return batch * -(-least // batch)


def _weights(score: Float[Array, " n"]) -> Float[Array, " n"]:
    """Of the recombination: logarithmic in the rank, zero in the worse half, equal where tied."""
    there = jnp.isfinite(score)
    count = jnp.sum(there).astype(jnp.float32)
    rank = jnp.argsort(jnp.argsort(score)).astype(jnp.float32)
    weight = jnp.maximum(jnp.log((count + 1) / 2) - jnp.log(rank + 1), 0.0)
    # A single point is all that there is.
    weight = jnp.where(there, jnp.where(count > 1, weight, 1.0), 0.0)
    tied = (score[:, None] == score[None]) & there
    weight = jnp.where(there, (tied @ weight) / jnp.maximum(jnp.sum(tied, axis=1), 1), 0.0)
    return weight / jnp.maximum(jnp.sum(weight), 1e-12)


def _chosen(
    state: CMAESState, cube: Cube, weights: Float[Array, " population"]
) -> Float[Array, "k cells"]:
    """Probabilities of the unordered cells after this generation."""
    codes = _unordered(cube)
    if len(codes) == 0:
        return state.choices
    cell = cube.cells(state.u)[:, np.searchsorted(cube.discrete, codes)]
    prior = _prior(cube)
    share = jnp.einsum("p,pkc->kc", weights, jax.nn.one_hot(cell, prior.shape[1]))
    learned = (1 - LEARNING) * state.choices + LEARNING * share
    # So that on average one coordinate in every third point leaves what was learned.
    kept = 1 - 1 / (3 * len(codes))
    return kept * learned + (1 - kept) * prior


def _reserved(state: CMAESState, u: Float[Array, "n d"], score: Float[Array, " n"]) -> CMAESState:
    """The state with the best point of exploration, of equally good ones the newest."""
    place = jnp.argmin(score)
    better = jnp.isfinite(score[place]) & (score[place] <= state.reserve_score)
    return state._replace(
        reserve=jnp.where(better, u[place], state.reserve),
        reserve_score=jnp.where(better, score[place], state.reserve_score),
    )


def _coloured(covariance: Array, normal: Float[Array, "batch n"]) -> Float[Array, "batch n"]:
    if covariance.ndim == 1:
        return jnp.sqrt(covariance) * normal
    return normal @ jnp.linalg.cholesky(covariance).T


def _whitened(covariance: Array, steps: Float[Array, "m n"]) -> Float[Array, "m n"]:
    if covariance.ndim == 1:
        return steps / jnp.sqrt(covariance)
    return solve_triangular(jnp.linalg.cholesky(covariance), steps.T, lower=True).T


def _widened(state: CMAESState, cube: Cube) -> CMAESState:
    """With deviations that reach the neighbouring cells, and a covariance that has a factor."""
    plain = _gaussian(cube)
    if len(plain) == 0:
        return state
    least = np.array([MARGIN / cube.levels[i] if cube.levels[i] else 0.0 for i in plain])
    full = state.covariance.ndim == 2
    variance = jnp.diagonal(state.covariance) if full else state.covariance
    # A direction may become narrow, but not so that 32 bits lose it.
    floor = jnp.maximum(1e-6 * jnp.max(variance), 1e-12)
    std = state.size * jnp.sqrt(jnp.maximum(variance, floor))
    factor = jnp.maximum(least.astype(np.float32) / std, 1.0)
    if full:
        covariance = state.covariance + floor * jnp.eye(len(plain), dtype=jnp.float32)
        covariance = factor[:, None] * covariance * factor
    else:
        covariance = factor**2 * jnp.maximum(state.covariance, floor)
    return state._replace(covariance=covariance)


def _where(condition: Bool[Array, ""], one: CMAESState, other: CMAESState) -> CMAESState:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)
