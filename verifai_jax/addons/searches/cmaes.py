"""CMA-ES: one Gaussian that learns where to go, how far, and along which directions.

Hansen, The CMA Evolution Strategy: A Tutorial, 2016; one step of it is in `evolution.py`.

Additions for falsification:

- a run begins with a generation from the prior. If all of its points have the same robustness,
  another generation from the prior follows;
- points are clipped to the cube, and the run learns from the clipped ones;
- a coordinate with ordered cells keeps a standard deviation that reaches the next cell (as Hamano
  et al., CMA-ES with margin, GECCO 2022); one with unordered cells has probabilities instead;
- all failures are equally good. A run ends when it has failed often enough, has converged or makes
  no progress. The next one begins alternately with small steps, at the best of the points that
  exploration has found meanwhile, and with large ones, from the prior (as Hansen, Benchmarking a
  BI-population CMA-ES on the BBOB-2009 function testbed, alternates between two regimes);
- after `k` runs without a failure the prior is sampled for `k / 2` times as long as the last run
  took, and the next run begins at the best of these points. So if the robustness misleads, most
  simulations finally sample the prior;
- how long a run waits for progress follows from its dimension, by the learning rates of the
  covariance: in ten dimensions a narrow valley is learned in hundreds of points.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from verifai_jax.addons.searches.evolution import (
    Evolution,
    rates,
    recombination,
    reverse_recombination,
)
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Search, check_options, choose
from verifai_jax.search.draws import draw_uniform, standard_normal
from verifai_jax.search.halton import halton_points

MAX_CELLS = 32
"""Cells up to which an unordered coordinate has probabilities: a generation cannot learn more."""
MARGIN = 0.25
"""Minimum standard deviation of an ordered discrete coordinate, in cells: the next cell, whose edge
is then two standard deviations away, is still drawn in one of twenty points."""
LEARNING = 0.3
"""Learning rate of the probabilities of unordered cells, per generation. Chosen by hand;
no comparison with other values is recorded."""
LARGEST = 1e30
"""Robustness above which all is equally bad: sums of such stay finite in float32."""
ADAPTATIONS = 4
"""Times that the covariance could be learned anew without progress before a run ends. With 1,
every third run in ten dimensions ended too early on Rastrigin's function; with 4, one in thirty."""
FEW_COORDINATES = 5
"""Coordinates up to which the share of exploration is the given one. In more of them, a point of
the prior is seldom near anything: with 5 % instead of 10 % in ten coordinates, CMA-ES needs 0.93
times the simulations on Rosenbrock's function, and finds Rastrigin's as often."""


class CMAESState(NamedTuple):
    key: Key[Array, ""]
    round: UInt32[Array, ""]  # asks
    results: UInt32[Array, ""]  # rows, in all
    explored: UInt32[Array, ""]  # points of the prior asked for
    run: Int[Array, ""]
    generation: Int[Array, ""]  # of the run; 0 is drawn from the prior
    length: Int[Array, ""]  # generations that the run has taken
    fruitless: Int[Array, ""]  # runs without a failure, since the last one with
    rest: Int[Array, ""]  # generations of the prior before the run may begin
    gaussian: Evolution  # over the coordinates without probabilities
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
class CMAES(Search[CMAESState]):
    """CMA-ES, covariance matrix adaptation, with restarts; a generation is a batch.

    Batches smaller than a population should be (`4 + 3 log d`) are collected until they are enough.

    **Arguments:**
    - `step`: initial standard deviation of a run that starts from the prior, in unit coordinates.
    - `small_step`: initial standard deviation of a run that starts from an explored point.
    - `exploration`: share of points that are always drawn from the prior, in up to five
      coordinates; proportionally less in more.
    - `full_up_to`: maximum number of coordinates for a full covariance matrix.
    - `min_std`: a run has converged when the standard deviations of all coordinates are below this.
    - `patience`: generations without progress after which a run ends, in addition to four times
      those needed to learn the covariance (25 in total in four coordinates with batches of 16, 130
      in ten with batches of 10).
    - `failures`: a run ends after this many failing points, but not before two generations' worth.
    **Raises:** `ValueError` for values out of range.
    """

    step: float = 0.3
    small_step: float = 0.1
    exploration: float = 0.1
    full_up_to: int = 40
    min_std: float = 1e-5
    patience: int = 6
    failures: int = 20

    def __post_init__(self) -> None:
        shares = "step", "small_step", "exploration", "min_std"
        check_options(self, {"full_up_to": 0, "patience": 1, "failures": 1}, shares)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> CMAESState:
        n, d = len(_plain(cube)), cube.dim
        population = _population(cube, batch)
        middle = jnp.full(n, 0.5, jnp.float32)
        return CMAESState(
            key=key,
            round=jnp.uint32(0),
            results=jnp.uint32(0),
            explored=jnp.uint32(0),
            run=jnp.int32(0),
            generation=jnp.int32(0),
            length=jnp.int32(0),
            fruitless=jnp.int32(0),
            rest=jnp.int32(0),
            gaussian=Evolution.begin(middle, jnp.float32(self.step), n <= self.full_up_to),
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

    def ask(self, state: CMAESState, cube: Cube, batch: int) -> Asked[CMAESState]:
        prior = self._explores(state, cube, batch) | (state.generation == 0)
        number = state.explored + jnp.cumsum(prior).astype(jnp.uint32)
        fresh = halton_points(number, cube.dim, state.key)
        drawn = self._draw(jax.random.fold_in(state.key, state.round), state, cube, batch)
        u = jnp.where(prior[:, None], fresh, drawn)
        return u, state._replace(round=state.round + 1, explored=number[-1])

    def tell(self, state: CMAESState, cube: Cube, observations: Observations) -> CMAESState:
        batch = len(observations.rho)
        u, score = _scored(observations)
        # Points of exploration are far away from the run: they say nothing about its next step.
        outside = self._explores(state, cube, batch) & (state.generation > 0)
        state = _with_reserve(state, u, jnp.where(outside, score, jnp.inf))
        row = state.filled * batch
        inside = jnp.where(outside, jnp.inf, score)
        state = state._replace(
            results=state.results + np.uint32(batch),
            u=jax.lax.dynamic_update_slice(state.u, u, (row, jnp.int32(0))),
            score=jax.lax.dynamic_update_slice(state.score, inside, (row,)),
            filled=state.filled + 1,
            failures=state.failures + jnp.sum(inside == 0, dtype=jnp.int32),
        )
        complete = state.filled * batch == len(state.score)
        return choose(complete, self._next(state, cube), state)

    def warm_start(self, state: CMAESState, cube: Cube, observations: Observations) -> CMAESState:
        """Start with small steps at the best of these points."""
        u, score = _scored(observations)
        # The best of all calls so far is the mean of the run that would begin now.
        better = jnp.min(score, initial=jnp.inf) < state.best
        found = _with_reserve(state._replace(reserve_score=jnp.float32(jnp.inf)), u, score)
        begun = self._begin(found, cube, jnp.array(True), jnp.float32(self.small_step))
        return choose(better, begun._replace(best=found.reserve_score), state)

    def _explores(self, state: CMAESState, cube: Cube, batch: int) -> Bool[Array, " batch"]:
        """Return the rows from the prior: every tenth, say, whatever the batch; in integers."""
        row = (state.results % 1000 + jnp.arange(batch, dtype=jnp.uint32)) % 1000
        explored = self.exploration * min(1.0, FEW_COORDINATES / max(cube.dim, 1))
        share = np.uint32(np.ceil(1000 * explored))
        return row * share % 1000 < share

    def _draw(
        self, key: Key[Array, ""], state: CMAESState, cube: Cube, batch: int
    ) -> Float[Array, "batch d"]:
        """Draw points of the Gaussian, and of the choices."""
        plain, codes = _plain(cube), _codes(cube)
        sizes = [batch * len(plain), batch * len(codes)]
        random = draw_uniform(key, (sum(sizes),))
        normal, draw = jnp.split(random, [sizes[0]])
        normal = standard_normal(normal).reshape(batch, len(plain))
        u = jnp.full((batch, cube.dim), 0.5, jnp.float32)
        u = u.at[:, plain].set(jnp.clip(state.gaussian.draw(normal), 0.0, 1.0))
        if len(codes) == 0:
            return u
        limits = jnp.cumsum(state.choices, axis=1)
        cell = jnp.sum(draw.reshape(batch, -1, 1) > limits, axis=-1).astype(jnp.int32)
        levels = np.array([cube.levels[i] for i in codes], np.int32)
        among = np.searchsorted(cube.discrete, codes)
        cells = jnp.asarray(cube.cells(u)).at[:, among].set(jnp.minimum(cell, levels - 1))
        return u.at[:, codes].set(cube.centres(cells)[:, among])

    def _next(self, state: CMAESState, cube: Cube) -> CMAESState:
        """Learn from a whole generation, wait, or begin another run."""
        following = choose(state.rest > 0, self._wait(state, cube), self._learn(state, cube))
        empty = jnp.full_like(state.score, jnp.inf)
        return following._replace(score=empty, filled=jnp.int32(0))

    def _learn(self, state: CMAESState, cube: Cube) -> CMAESState:
        there = jnp.isfinite(state.score)
        worst = jnp.max(state.score, where=there, initial=-jnp.inf)
        lowest = jnp.min(state.score, where=there, initial=jnp.inf)
        better = (lowest < 0.99 * state.best) | ((lowest == 0) & (state.best > 0))
        weights = recombination(state.score)
        points = state.u[:, _plain(cube)]
        # A generation of the prior says where the run begins.
        placed = state.gaussian._replace(mean=weights @ points)
        moved = state.gaussian.learn(points, weights, reverse_recombination(state.score))
        gaussian = choose(state.generation == 0, placed, moved)
        gaussian = gaussian._replace(size=jnp.minimum(gaussian.size, 1.0))
        learned = state._replace(
            gaussian=gaussian.widened(_margins(cube)),
            choices=_updated_choices(state, cube, weights),
            generation=state.generation + 1,
        )
        # Without differences between points there is nothing to learn.
        learned = choose((lowest < worst) | (lowest == 0), learned, state)
        learned = learned._replace(
            best=jnp.minimum(lowest, state.best),
            stale=jnp.where(better, 0, state.stale + 1).astype(jnp.int32),
            length=state.length + 1,
        )
        return choose(self._over(learned, cube), self._after(learned, cube), learned)

    def _over(self, state: CMAESState, cube: Cube) -> Bool[Array, ""]:
        """Return whether a run has failed often enough, or leads nowhere."""
        n, population = len(_plain(cube)), len(state.score)
        patience = jnp.float32(self.patience)
        if n:
            patience += ADAPTATIONS * _learning_time(n, population, n <= self.full_up_to)
        stuck = state.stale >= patience
        if n:
            widest = state.gaussian.size * jnp.sqrt(jnp.max(state.gaussian.variance()))
            stuck |= (widest < self.min_std) | ~jnp.isfinite(widest)
        failed = state.failures >= max(self.failures, 2 * population)
        return failed | (stuck & (state.generation > 0))

    def _after(self, state: CMAESState, cube: Cube) -> CMAESState:
        """Begin what follows a run: another one, or first many points of the prior."""
        fruitful = (state.failures > 0) | (state.reserve_score == 0)
        fruitless = jnp.where(fruitful, 0, state.fruitless + 1).astype(jnp.int32)
        small = (state.run % 2 == 0) & jnp.isfinite(state.reserve_score)
        small |= state.reserve_score == 0
        next_run = self._begin(state, cube, small, jnp.float32(self.small_step))
        # The best point so far remains that until there is a run at it.
        waiting = self._begin(state, cube, jnp.array(False), jnp.float32(self.step))
        waiting = waiting._replace(
            reserve_score=state.reserve_score,
            fruitless=fruitless,
            rest=jnp.minimum(fruitless * state.length // 2, 1000),
        )
        return choose(fruitful, next_run._replace(fruitless=fruitless), waiting)

    def _wait(self, state: CMAESState, cube: Cube) -> CMAESState:
        """Advance after a generation of the prior between two runs."""
        waiting = _with_reserve(state, state.u, state.score)._replace(rest=state.rest - 1)
        over = (waiting.rest == 0) | (waiting.reserve_score == 0)
        size = jnp.where(state.run % 2 == 0, self.step, self.small_step)
        begun = self._begin(waiting, cube, jnp.array(True), size)._replace(run=state.run)
        return choose(over & jnp.isfinite(waiting.reserve_score), begun, waiting)

    def _begin(
        self, state: CMAESState, cube: Cube, there: Bool[Array, ""], size: Float[Array, ""]
    ) -> CMAESState:
        """Begin a run: at the reserve with steps of this size, or by a generation of the prior."""
        plain, codes = _plain(cube), _codes(cube)
        choices = prior = jnp.asarray(_prior(cube))
        if len(codes):
            among = np.searchsorted(cube.discrete, codes)
            cell = cube.cells(state.reserve)[among]
            choices = 0.5 * prior + 0.5 * jax.nn.one_hot(cell, prior.shape[1])
        size = jnp.where(there, size, self.step).astype(jnp.float32)
        gaussian = Evolution.begin(state.reserve[plain], size, len(plain) <= self.full_up_to)
        return state._replace(
            run=state.run + 1,
            generation=jnp.where(there, 1, 0).astype(jnp.int32),
            length=jnp.int32(0),
            rest=jnp.int32(0),
            gaussian=gaussian.widened(_margins(cube)),
            choices=jnp.where(there, choices, prior),
            score=jnp.full_like(state.score, jnp.inf),
            filled=jnp.int32(0),
            best=jnp.float32(jnp.inf),
            stale=jnp.int32(0),
            failures=jnp.int32(0),
            reserve_score=jnp.float32(jnp.inf),
        )


def _plain(cube: Cube) -> Int[np.ndarray, " n"]:
    """Return indices of the coordinates that the Gaussian has."""
    return np.setdiff1d(np.arange(cube.dim), _codes(cube))


def _codes(cube: Cube) -> Int[np.ndarray, " k"]:
    """Return indices of the coordinates that have probabilities."""
    return np.array(
        [i for i in cube.discrete if not cube.ordered[i] and cube.levels[i] <= MAX_CELLS], np.int64
    )


def _prior(cube: Cube) -> Float[np.ndarray, "k cells"]:
    codes = _codes(cube)
    prior = np.zeros((len(codes), max((cube.levels[i] for i in codes), default=0)), np.float32)
    for row, j in zip(prior, np.searchsorted(cube.discrete, codes), strict=True):
        row[: len(cube.probabilities[j])] = cube.probabilities[j]
    return prior


def _population(cube: Cube, batch: int) -> int:
    """Return the points in a generation: whole batches, no fewer than the tutorial's default."""
    smallest = 4 + int(3 * math.log(max(cube.dim, 1)))
    return batch * -(-smallest // batch)


def _learning_time(n: int, population: int, full: bool) -> Float[Array, ""]:
    """Return in how many generations the covariance of `n` coordinates is learned."""
    weights = recombination(jnp.arange(population, dtype=jnp.float32))
    one, many = rates(1 / jnp.sum(weights**2), n, full)
    return 1 / (one + many)


def _updated_choices(
    state: CMAESState, cube: Cube, weights: Float[Array, " population"]
) -> Float[Array, "k cells"]:
    """Return probabilities of the unordered cells after this generation."""
    codes = _codes(cube)
    if len(codes) == 0:
        return state.choices
    cell = cube.cells(state.u)[:, np.searchsorted(cube.discrete, codes)]
    prior = _prior(cube)
    share = jnp.einsum("p,pkc->kc", weights, jax.nn.one_hot(cell, prior.shape[1]))
    learned = (1 - LEARNING) * state.choices + LEARNING * share
    # So that on average one coordinate in every third point leaves what was learned.
    kept = 1 - 1 / (3 * len(codes))
    return kept * learned + (1 - kept) * prior


def _margins(cube: Cube) -> Float[np.ndarray, " n"]:
    """Return the minimum standard deviation of each coordinate of the Gaussian."""
    return np.array(
        [MARGIN / cube.levels[i] if cube.levels[i] else 0.0 for i in _plain(cube)], np.float32
    )


def _scored(observations: Observations) -> tuple[Float[Array, "n d"], Float[Array, " n"]]:
    """Return points and their scores: 0 for all failures, infinite where there is no verdict."""
    usable = observations.valid & (observations.rho < jnp.inf)
    score = jnp.where(usable, jnp.clip(observations.rho, 0.0, LARGEST), jnp.inf)
    return jnp.where(usable[:, None], observations.u, 0.5), score


def _with_reserve(
    state: CMAESState, u: Float[Array, "n d"], score: Float[Array, " n"]
) -> CMAESState:
    """Record the best point of exploration, of equally good ones the newest."""
    index = jnp.argmin(score)
    better = jnp.isfinite(score[index]) & (score[index] <= state.reserve_score)
    return state._replace(
        reserve=jnp.where(better, u[index], state.reserve),
        reserve_score=jnp.where(better, score[index], state.reserve_score),
    )
