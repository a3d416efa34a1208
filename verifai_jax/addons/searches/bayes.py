"""Bayesian optimization: a Gaussian process predicts the robustness and its uncertainty.

Each round proposes a batch of points that might fail, by one of two rules.

- Thompson sampling: each point minimizes a function drawn from the posterior (Thompson 1933; in
  batches Hernandez-Lobato et al., Parallel and distributed Thompson sampling for large-scale
  accelerated exploration of chemical space, ICML 2017). The drawn functions can be evaluated
  anywhere, so the minima are sought in two steps: among candidates common to all functions, then
  around each function's best candidate.
- Expected improvement (`improvement`).

While no failure is known, every fourth point refines the best one: a second process is fitted to
the points near it, and its mean is minimised over their box almost without regard to its
uncertainty. If simulations had no verdict, another process predicts the probability of a verdict.

All failures are equally good: below zero the target is flat. Above zero the target is logarithmic
in the robustness divided by its lower quartile, and capped, so that huge values do not dominate.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float, Int, Key, UInt32

from verifai_jax.addons.searches.gaussian import Posterior, TrainingData
from verifai_jax.addons.searches.improvement import APART, PARENTS, already_simulated, improving
from verifai_jax.addons.searches.moves import near_others
from verifai_jax.addons.searches.process_data import (
    LARGEST,
    NO_VERDICT,
    ProcessMemory,
    encode,
    process_of,
    scores,
    snap,
    training_data,
)
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Search, Wants, check_options
from verifai_jax.search.draws import draw_uniform
from verifai_jax.search.halton import halton_points

# The numbers without another reason were chosen by hand; no comparison with other values is
# recorded. With them it is held to 5 times fewer simulations than uniform sampling
# (tests/addons/searches/test_bayes.py).
MAX_PATHS = 32  # functions drawn for a batch; larger batches take several points from each
WAVES = 256  # random waves of such a function
FIT_STEPS = 8
MARGIN = 0.1  # of the box around the best points, on each side
REFITS = 20  # steps of its fit, from the first hyper-parameters on
GREEDY = 0.1  # factor on its standard deviations: it is there to refine
PATIENCE = 80  # points without progress, after which half of them are those of the prior


class BayesState(NamedTuple):
    key: Key[Array, ""]
    round: UInt32[Array, ""]
    proposals: UInt32[Array, ""]  # points, in all
    explored: UInt32[Array, ""]  # points of the prior among them
    stale: Int[Array, ""]  # points since the last failure or progress
    memory: ProcessMemory


@dataclass(frozen=True)
class Bayes(Search[BayesState]):
    """A Gaussian process on the robustness; proposes points where it may be negative.

    **Arguments:**
    - `acquisition`: `"thompson"` or `"expected_improvement"`.
    - `capacity`: maximum number of points in the process. If there are more, it keeps the best half
      (a random choice among equally good ones) and a random choice of the others.
    - `candidates`: number of points among which each step of the acquisition chooses.
    - `initial`: number of points of the prior before the process proposes any.
    - `exploration`: share of points that are always drawn from the prior; it grows while there is
      neither a failure nor progress.

    Hyper-parameters are refitted, from the last ones, for every quarter more points.

    **Raises:** `ValueError` for values out of range.
    """

    wants: ClassVar[Wants] = Wants(no_verdict_rows=True, max_batch=16)
    acquisition: str = "thompson"
    capacity: int = 512
    candidates: int = 512
    initial: int = 12
    exploration: float = 0.1

    def __post_init__(self) -> None:
        if self.acquisition not in ("thompson", "expected_improvement"):
            raise ValueError(
                "acquisition must be 'thompson' or 'expected_improvement'; "
                f"got {self.acquisition!r}"
            )
        check_options(self, {"capacity": 16, "candidates": 32, "initial": 2}, ["exploration"])

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> BayesState:
        return BayesState(
            key=key, round=jnp.uint32(0), proposals=jnp.uint32(0), explored=jnp.uint32(0),
            stale=jnp.int32(0), memory=ProcessMemory.nothing(self.capacity, cube),
        )  # fmt: skip

    def ask(self, state: BayesState, cube: Cube, batch: int) -> Asked[BayesState]:
        key = jax.random.fold_in(state.key, state.round)
        row = jnp.arange(batch, dtype=jnp.uint32)
        informed = state.memory.says_something(self.initial)
        # Where the process leads nowhere, more and more of the points are those of the prior.
        share = jnp.maximum(self.exploration, state.stale / (state.stale + PATIENCE))
        # Every tenth point, say, whatever the batch is; in integers, which do not drift.
        share = jnp.ceil(1000 * share).astype(jnp.uint32)
        due = (state.proposals % 1000 + row) % 1000 * share % 1000 < share
        prior = ~informed | due
        number = state.explored + jnp.cumsum(prior).astype(jnp.uint32)
        # The candidates are further points of the same sequence, far ahead.
        half = max(self.candidates // 2, batch)
        ahead = np.uint32(2**24) + state.round * np.uint32(half)
        ahead = ahead + jnp.arange(half, dtype=jnp.uint32)
        points = halton_points(jnp.concatenate([number, ahead]), cube.dim, state.key)
        # Barriers, or else every use of these numbers compiles and computes them anew.
        points = jax.lax.optimization_barrier(points)
        fresh, anywhere = points[:batch], points[batch:]
        after = state._replace(
            round=state.round + 1, proposals=state.proposals + np.uint32(batch), explored=number[-1]
        )
        if cube.dim == 0:
            return fresh, after

        def propose() -> Float[Array, "batch d"]:
            return self._propose(key, state, cube, batch, anywhere)

        chosen = jax.lax.cond(informed, propose, lambda: fresh)
        # In a small space several functions have the same minimum: one simulation will do.
        mark = chosen @ jnp.cos(jnp.arange(1, cube.dim + 1, dtype=jnp.float32))
        again = jnp.any(jnp.tril(mark[:, None] == mark[None], -1), axis=1)
        chosen = jnp.where(again[:, None], anywhere[:batch], chosen)
        return jnp.where(prior[:, None], fresh, chosen), after

    def tell(self, state: BayesState, cube: Cube, observations: Observations) -> BayesState:
        score, before = scores(observations), state.memory.score
        # Where no failure is near, what is left above the lowest counts, not above zero.
        lowest, ordered = jnp.min(before), jnp.sort(before)
        middle = ordered[jnp.sum(ordered <= LARGEST) // 2]
        progress = jnp.min(score) < lowest - 0.01 * jnp.where(middle <= LARGEST, middle - lowest, 0)
        progress |= jnp.any(score == 0)
        count = jnp.sum(jnp.isfinite(score), dtype=jnp.int32)
        memory = state.memory.with_rows(observations.u, score)
        return state._replace(
            stale=jnp.where(progress, 0, state.stale + count),
            memory=memory.refitted(cube, self.initial, FIT_STEPS),
        )

    def _propose(
        self, key: Key[Array, ""], state: BayesState, cube: Cube, batch: int,
        anywhere: Float[Array, "half d"],
    ) -> Float[Array, "batch d"]:  # fmt: skip
        """Return the points that the acquisition function ranks first."""
        memory = state.memory
        posterior, risk = memory.posterior(cube), _risk(memory, cube)
        drawing, placing = jax.random.split(key)
        half, d = anywhere.shape
        paths = min(batch, MAX_PATHS)
        each = -(-batch // paths)  # points from each path
        steps = (paths * each, max(self.candidates // (paths * each), 4))
        if self.acquisition != "thompson":
            steps = (0, 0)
        # Half of the candidates are anywhere, half of them around the best points, far and near.
        children = steps[0] * steps[1]
        width = 3 + 2 * d
        random = draw_uniform(placing, (half + 2 * children, width))
        first, later = random[:half], random[half:].reshape(2, *steps, width)
        _, best = jax.lax.top_k(-memory.score, PARENTS)
        parent = best[jnp.minimum((first[:, 0] * PARENTS).astype(jnp.int32), PARENTS - 1)]
        near = near_others(memory.u[parent], first, cube, jnp.array([0.5, 0.01]))
        shared = jnp.concatenate([anywhere, near])
        if self.acquisition == "thompson":
            chosen = _minima(drawing, posterior, risk, cube, shared, later, paths)[:batch]
        else:
            chosen = improving(posterior, risk, cube, (0.0, 1.0), 1.0, shared, batch)
        # Where no failure is known every fourth point refines the best one.
        refined = _refined(memory, risk, cube, anywhere, batch)
        row = jnp.arange(batch, dtype=jnp.uint32)
        turn = (jnp.min(memory.score) > 0) & ((state.proposals + row) % 4 == 0)
        return jnp.where(turn[:, None], refined, chosen)


def _risk(memory: ProcessMemory, cube: Cube) -> Callable[[Float[Array, "m d"]], Float[Array, " m"]]:
    """Return minus the log probability of a verdict as a function of points; zero if all had one.

    By another process, of zero for simulations with a verdict and one for those without.
    """
    process, without = process_of(cube), memory.score == NO_VERDICT
    data = TrainingData(encode(memory.u, cube), without * 1.0, jnp.isfinite(memory.score))
    some, n = jnp.any(without), len(without)
    nothing = jnp.eye(n, dtype=jnp.float32), jnp.zeros(n, jnp.float32)
    # Where all simulations had a verdict nothing of this is computed.
    posterior = jax.lax.cond(
        some,
        lambda: process.condition(process.first(), data),
        lambda: Posterior(process.first(), data.x, data.mask, data.y, *nothing),
    )

    def risk(u: Float[Array, "m d"]) -> Float[Array, " m"]:
        def known() -> Float[Array, " m"]:
            share, std = process.predict(posterior, encode(u, cube))
            return -log_ndtr((0.5 - share) / std)

        return jax.lax.cond(some, known, lambda: jnp.zeros(len(u), u.dtype))

    return risk


def _refined(
    memory: ProcessMemory, risk: Callable[[Float[Array, "m d"]], Float[Array, " m"]], cube: Cube,
    anywhere: Float[Array, "half d"], batch: int,
) -> Float[Array, "batch d"]:  # fmt: skip
    """Return points of the greatest expected improvement by a process of those near the best.

    Over the box around them, which shrinks with them, and by the values in it: so it tells
    values apart that are the same to the process of all points.
    """
    process, count = process_of(cube), min(3 * (cube.dim + 2), len(memory.score))
    away = jnp.sum((memory.u - memory.u[jnp.argmin(memory.score)]) ** 2, axis=1)
    _, best = jax.lax.top_k(-jnp.where(memory.score <= LARGEST, away, jnp.inf), count)
    there = memory.score[best] <= LARGEST
    points = memory.u[best]
    low = jnp.min(points, axis=0, where=there[:, None], initial=1.0)
    high = jnp.max(points, axis=0, where=there[:, None], initial=0.0)
    margin = jnp.maximum(MARGIN * (high - low), APART)
    low, high = jnp.maximum(low - margin, 0.0), jnp.minimum(high + margin, 1.0)
    discrete = np.array(cube.levels) > 0
    low, high = jnp.where(discrete, 0.0, low), jnp.where(discrete, 1.0, high)
    box = (low, jnp.maximum(high - low, APART))
    score = jnp.where(there, memory.score[best] - jnp.min(memory.score), jnp.inf)
    x = jnp.where(discrete, encode(points, cube), (points - box[0]) / box[1])
    _, y, mask = training_data(points, score, cube)
    data = TrainingData(x, y, mask)
    hyper = process.fit(process.first(), data, REFITS)
    posterior = process.condition(hyper, data)
    shared = jnp.concatenate([(points - box[0]) / box[1], anywhere])
    return improving(posterior, risk, cube, box, GREEDY, shared, batch)


# How far around its best candidate a function's minimum is sought, in two steps: the largest and
# the smallest distance. Each step searches a fifth to a tenth of the one before; chosen by hand.
CLOSER = ((0.2, 0.02), (0.04, 0.004))


def _minima(
    key: Key[Array, ""], posterior: Posterior,
    risk: Callable[[Float[Array, "m d"]], Float[Array, " m"]], cube: Cube,
    shared: Float[Array, "m d"], random: Float[Array, "2 parents children r"], count: int,
) -> Float[Array, "parents d"]:  # fmt: skip
    """Return minima of `count` functions drawn from the posterior, several of each."""
    process = process_of(cube)
    paths = process.paths(posterior, key, count, WAVES)
    parents, children = random.shape[1:3]
    each = parents // count

    def basis(u: Float[Array, "m d"]) -> tuple[Array, Array]:
        x = encode(u, cube)
        basis = process.basis(posterior, paths, x)
        # Simulated already: to be chosen only if there is nothing else.
        return basis, risk(u) + 100.0 * already_simulated(x, posterior)

    shared = snap(shared, cube)
    terms, penalty = basis(shared)
    value, index = jax.lax.top_k(-(terms @ paths.weights + penalty[:, None]).T, each)

    def closer(
        carry: tuple[Float[Array, "parents d"], Float[Array, " parents"]],
        step: tuple[Float[Array, " 2"], Float[Array, "parents children r"]],
    ) -> tuple:
        best, lowest = carry
        parent = jnp.repeat(best, children, axis=0)
        u = near_others(parent, step[1].reshape(len(parent), -1), cube, step[0])
        u = snap(u, cube)
        terms, penalty = basis(u)
        value = jnp.einsum("pcf,fp->pc", terms.reshape(count, each * children, -1), paths.weights)
        value = (value.reshape(-1) + penalty).reshape(parents, children)
        chosen = jnp.argmin(value, axis=1)[:, None]
        found = jnp.take_along_axis(value, chosen, 1)[:, 0]
        u = jnp.take_along_axis(u.reshape(parents, children, -1), chosen[:, :, None], 1)[:, 0]
        better = found < lowest
        return (jnp.where(better[:, None], u, best), jnp.where(better, found, lowest)), None

    begin = (shared[index.reshape(-1)], -value.reshape(-1))
    (best, _), _ = jax.lax.scan(closer, begin, (jnp.array(CLOSER), random))
    return best
