"""Trust-region Bayesian optimization (TuRBO): a Gaussian process used only near its best point.

Eriksson, Pearce, Gardner, Turner, Poloczek, Scalable global optimization via local Bayesian
optimization, NeurIPS 2019, with one region at a time. The process knows the points since the last
restart. Its guesses are used in a box around the best of them, with sides in proportion to the
length scales; each new point minimizes a function drawn from the posterior over candidates in the
box, which differ from the best point in about twenty coordinates. The box doubles after a few
rounds with progress in a row and halves after many without; when it is very small, all begins anew
at points of the prior.

All failures are equally good: after a failure the region shrinks around it, and the next region
lies elsewhere.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from verifai_jax.addons.searches.process_data import (
    LARGEST,
    NO_VERDICT,
    ProcessMemory,
    encode,
    process_of,
    scores,
    snap,
)
from verifai_jax.core.messages.checks import check_positive
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Search, Wants, check_options, choose
from verifai_jax.search.draws import draw_uniform
from verifai_jax.search.halton import halton_points

# The first two as in `bayes`, the third chosen by hand; no comparison with others is recorded.
MAX_PATHS = 32  # functions drawn for a batch; larger batches take several points from each
WAVES = 256  # random waves of such a function
FIT_STEPS = 12  # steps of Adam in a fit
COORDINATES = 20  # in which a candidate differs from the best point, on average; of the paper
SIDES = (2.0**-7, 0.8, 1.6)  # smallest, first and largest of the box, in cubes; of the paper
PROGRESS = 1e-3
"""Share of the lowest robustness by which a point must be below it, to be progress; that of the
authors' program."""
KNOWN = 1 - 1e-5
"""Correlation with an observation, above which a point need not be simulated. As in `bayes`."""


class TuRBOState(NamedTuple):
    key: Key[Array, ""]
    round: UInt32[Array, ""]
    explored: UInt32[Array, ""]  # points of the prior so far
    memory: ProcessMemory  # points since the last restart, as all that follows
    side: Float[Array, ""]  # of the box
    successes: Int[Array, ""]  # rounds with progress in a row
    failures: Int[Array, ""]  # points without, in a row


@dataclass(frozen=True)
class TuRBO(Search[TuRBOState]):
    """Bayesian optimization in a trust region; for 20 coordinates and more.

    **Arguments:**
    - `capacity`: maximum number of points in the process since the last restart. If there are more,
      it keeps the best half and a random choice of the others.
    - `candidates`: number of points of the box among which each drawn function is minimised.
    - `initial`: number of points of the prior at each start.
    - `successes`: consecutive rounds with progress after which the box doubles.
    - `patience`: points without progress after which the box halves, as a multiple of the
      dimension; never less than four points.
    **Raises:** `ValueError` for values out of range.
    """

    wants: ClassVar[Wants] = Wants(no_verdict_rows=True, max_batch=16)
    capacity: int = 512
    candidates: int = 1024
    initial: int = 12
    successes: int = 3
    patience: float = 1.0

    def __post_init__(self) -> None:
        check_options(self, {"capacity": 16, "candidates": 32, "initial": 2, "successes": 1})
        check_positive("patience", self.patience)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> TuRBOState:
        return TuRBOState(
            key=key,
            round=jnp.uint32(0),
            explored=jnp.uint32(0),
            memory=ProcessMemory.nothing(self.capacity, cube),
            side=jnp.float32(SIDES[1]),
            successes=jnp.int32(0),
            failures=jnp.int32(0),
        )

    def ask(self, state: TuRBOState, cube: Cube, batch: int) -> Asked[TuRBOState]:
        informed = state.memory.says_something(self.initial)
        # Points of the prior are numbered on, whether or not a round uses them.
        rows = jnp.arange(1, batch + 1, dtype=jnp.uint32)
        fresh = halton_points(state.explored + rows, cube.dim, state.key)
        fresh = jax.lax.optimization_barrier(fresh)
        after = state._replace(
            round=state.round + 1, explored=state.explored + np.uint32(batch) * ~informed
        )
        if cube.dim == 0:
            return fresh, after
        key = jax.random.fold_in(state.key, state.round)
        chosen = jax.lax.cond(
            informed, lambda: self._in_region(key, state, cube, batch), lambda: fresh
        )
        return chosen, after

    def _in_region(
        self, key: Key[Array, ""], state: TuRBOState, cube: Cube, batch: int
    ) -> Float[Array, "batch d"]:
        """Return minima of functions drawn from the posterior, over candidates of the box."""
        process, d = process_of(cube), cube.dim
        drawing, placing = jax.random.split(key)
        memory = state.memory
        posterior, best = memory.posterior(cube), memory.u[jnp.argmin(memory.score)]
        low, high = trust_box(state, cube, best)
        count = max(self.candidates, 2 * batch)
        random = draw_uniform(placing, (count, 2 * d))
        pick, position = random[:, :d], random[:, d:]
        moves = pick < min(COORDINATES / d, 1.0)
        moves |= pick == jnp.min(pick, axis=1, keepdims=True)
        candidates = snap(jnp.where(moves, low + (high - low) * position, best), cube)
        paths = process.paths(posterior, drawing, min(batch, MAX_PATHS), WAVES)
        terms = process.basis(posterior, paths, encode(candidates, cube))
        known = jnp.max(terms[:, WAVES:], axis=1) > KNOWN * jnp.exp(memory.hyper.variance)
        values = (terms @ paths.weights).T  # [paths, candidates]

        def choose(
            taken: Bool[Array, " candidates"], row: Int[Array, ""]
        ) -> tuple[Bool[Array, " candidates"], Int[Array, ""]]:
            # Simulated already, or in this batch: only if there is nothing else.
            value = values[row % len(values)] + 100.0 * taken
            chosen = jnp.argmin(value)
            return taken.at[chosen].set(True), chosen

        _, chosen = jax.lax.scan(choose, known, jnp.arange(batch))
        return candidates[chosen]

    def tell(self, state: TuRBOState, cube: Cube, observations: Observations) -> TuRBOState:
        score, memory = scores(observations), state.memory
        # One without a verdict is taken for the worst, so that the region stays away from it.
        seen = jnp.concatenate([score, memory.score])
        worst = jnp.max(seen, where=seen <= LARGEST, initial=-jnp.inf)
        worst = jnp.where(worst >= 0, worst, jnp.inf)
        score = jnp.where(score == NO_VERDICT, worst, score)
        count = jnp.sum(jnp.isfinite(score), dtype=jnp.int32)
        started = memory.verdicts >= self.initial
        progress = jnp.min(score) < (1 - PROGRESS) * jnp.min(memory.score)
        successes = jnp.where(progress & started, state.successes + 1, 0)
        failures = jnp.where(progress | ~started, 0, state.failures + count)
        # A round without a verdict is neither.
        successes = jnp.where(count > 0, successes, state.successes)
        wider = successes >= self.successes
        narrower = failures >= max(4, math.ceil(self.patience * cube.dim))
        side = jnp.where(wider, jnp.minimum(2 * state.side, SIDES[2]), state.side)
        side = jnp.where(narrower, side / 2, side)
        state = state._replace(
            memory=memory.with_rows(observations.u, score), side=side,
            successes=jnp.where(wider, 0, successes), failures=jnp.where(narrower, 0, failures),
        )  # fmt: skip
        # Where the region has become too small it is forgotten, and its points.
        state = choose(side < SIDES[0], _begun(state, state.memory.emptied(cube)), state)
        return state._replace(memory=state.memory.refitted(cube, self.initial, FIT_STEPS))

    def warm_start(self, state: TuRBOState, cube: Cube, observations: Observations) -> TuRBOState:
        # Points that it did not ask for say nothing of the region.
        warmed = self.tell(state, cube, observations)
        return _begun(warmed, warmed.memory)


def trust_box(
    state: TuRBOState, cube: Cube, best: Float[Array, " d"]
) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
    """Return the lowest and the highest corner of the trust region.

    Sides are proportional to the length scales, and the volume is that of a cube. A discrete
    coordinate can always reach the neighbouring cells, and one without an order all of its cells.
    """
    lengths = state.memory.hyper.lengths
    width = state.side * jnp.exp(lengths - jnp.mean(lengths))
    levels, ordered = np.array(cube.levels), np.array(cube.ordered)
    cells = np.where(levels > 0, np.where(ordered, 3 / np.maximum(levels, 1), 2.0), 0.0)
    width = jnp.maximum(width, cells.astype(np.float32))
    return jnp.clip(best - width / 2, 0.0, 1.0), jnp.clip(best + width / 2, 0.0, 1.0)


def _begun(state: TuRBOState, memory: ProcessMemory) -> TuRBOState:
    """Return the state with a region of the first size."""
    none, side = jnp.int32(0), jnp.float32(SIDES[1])
    return state._replace(memory=memory, side=side, successes=none, failures=none)
