"""Mutations of the best points, large and small: for few simulations and rough landscapes.

Most proposals change one of the best points so far: by a step of any size in a few coordinates, by
a shift of a stretch of a signal, or by the difference of two other good points (differential
evolution: Storn, Price, 1997). Steps that leave the cube end on its faces, where failures often
are. Some proposals explore: with coordinates drawn towards the ends of their range, and signals
that change seldom, coarse before fine (Fainekos et al., ARCH competition reports: tools that draw
from the corners and with few control points need the fewest simulations).

Once failures are known it starts from any of them, and equally often from the one with the lowest
robustness, which lies deeper in the failure region, so that more neighbours fail.

Nothing is fitted, so it works from the first few simulations on, when cross-entropy still has to
fill its elite.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt32

from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Search, check_options
from verifai_jax.search.best_points import keep_best
from verifai_jax.search.draws import draw_uniform, standard_normal

# The numbers below were chosen by hand. Nine variants were compared on NN of the ARCH competition:
# half to a sixth of the exploration, steps up to 0.2, eight and sixteen parents, patience of 80.
# They took 54 to 65 simulations and these 61, too near to choose by one row
# (`benchmarks/RESULTS.md`).
PARENTS = 4
"""Best points that are mutated; each half as often as the one before. Of failures all are."""
MIN_STEP = 0.02  # smallest standard deviation of steps, in unit coordinates; they are log-uniform
MAX_STEP = 0.6  # largest standard deviation of steps, in unit coordinates
MAX_EXPLORATION = 0.9  # share of proposals that explore after many simulations without progress
EVENLY = 0.1  # share of exploration that samples the prior; it grows where nothing else helps
FEW = 4
"""Dimensions below which corners are few, and points that are spread find soon what descents find:
more of exploration samples the prior, and the portfolio descends less before there is evidence."""
SELDOM = 0.35  # share of exploration in which signals change seldom
SWINGING = 0.35  # share of exploration in which signals swing to and fro
TO_AND_FRO = 0.9
"""Share of control points, in such signals, on the other side of the middle than the one before."""


class MutationState(NamedTuple):
    key: Key[Array, ""]
    round: UInt32[Array, ""]
    points: Float[Array, "k d"]  # the best so far, the very best first
    score: Float[Array, " k"]  # infinite where there is no point yet
    verdicts: Int[Array, ""]  # simulations with a verdict since the last beginning
    stale: Int[Array, ""]  # simulations without progress
    highest: Float[Array, ""]  # robustness so far


@dataclass(frozen=True)
class Mutation(Search[MutationState]):
    """Mutations of the best points so far, with steps of all sizes, and exploration.

    **Arguments:**
    - `kept`: number of best points kept.
    - `first`: number of simulations for exploration before the first mutation.
    - `exploration`: share of proposals for exploration.
    - `idle`: simulations without progress after which nearly all proposals explore.
    - `difference`: share of mutations that add the difference of two good points.
    - `patience`: simulations without progress after which it restarts.
    **Raises:** `ValueError` for values out of range.
    """

    kept: int = 32
    first: int = 12
    exploration: float = 0.3
    difference: float = 0.4
    idle: int = 150
    patience: int = 400

    def __post_init__(self) -> None:
        check_options(self, {"kept": 6, "first": 1, "idle": 1, "patience": 1}, ["exploration"])
        check_fraction("difference", self.difference, zero=True, one=True)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> MutationState:
        return MutationState(
            key=key,
            round=jnp.uint32(0),
            points=jnp.full((self.kept, cube.dim), 0.5, jnp.float32),
            score=jnp.full(self.kept, jnp.inf, jnp.float32),
            verdicts=jnp.int32(0),
            stale=jnp.int32(0),
            highest=jnp.full((), -jnp.inf, jnp.float32),
        )

    def ask(self, state: MutationState, cube: Cube, batch: int) -> Asked[MutationState]:
        u = self.proposed(state, cube, [(state.key, batch)])
        return u, state._replace(round=state.round + 1)

    def proposed(
        self, state: MutationState, cube: Cube, wanted: Sequence[tuple[Key[Array, ""], int]]
    ) -> Float[Array, "n d"]:
        """Return proposals, of each key so many, by one program."""
        keys = [(jax.random.fold_in(key, state.round), rows) for key, rows in wanted]
        numbers = [draw_uniform(key, (rows, 16 + 4 * cube.dim)) for key, rows in keys]
        ends = 16 + cube.dim * np.arange(4)
        coins, values, cuts, masks, noise = jnp.split(jnp.concatenate(numbers), ends, axis=1)
        idle = jnp.minimum(state.stale / self.idle, 1.0)
        # Where all points are equally good there is nothing to start from, nor to lean to.
        level = (state.highest <= state.score[0]) & (state.score[0] >= 0)
        # Signals lean all the same: those that swing, or change seldom, are rare in the prior.
        evenly = level & (state.verdicts >= self.first) & (not cube.signals)
        even = jnp.where(evenly, 0.0, coins[:, 14])
        fresh = _explore(cube, coins[:, 0], coins[:, 1], even, idle, values, cuts)
        changed = self._mutate(state, cube, coins[:, 2:], values, masks, standard_normal(noise))
        # The longer without progress, the more it explores.
        share = self.exploration + (MAX_EXPLORATION - self.exploration) * idle
        explores = (state.verdicts < self.first) | level | (coins[:, 15] < share)
        return jnp.where(explores[:, None], fresh, changed)

    def tell(self, state: MutationState, cube: Cube, observations: Observations) -> MutationState:
        # Of failures, which are equally good, the worst are kept, and of equal ones the newest.
        new = jnp.where(observations.usable, observations.rho, jnp.inf)
        points, score = keep_best(observations.u, new, state.points, state.score)
        usable = jnp.sum(observations.usable).astype(jnp.int32)
        progress = jnp.maximum(score[0], 0.0) < 0.999 * state.score[0]
        stale = jnp.where(progress, 0, state.stale + usable)
        again = stale >= self.patience
        return state._replace(
            points=points,
            score=jnp.where(again, jnp.inf, score),
            verdicts=jnp.where(again, 0, state.verdicts + usable),
            stale=jnp.where(again, 0, stale),
            highest=jnp.maximum(state.highest, jnp.max(jnp.where(jnp.isinf(new), -jnp.inf, new))),
        )

    def _mutate(
        self, state: MutationState, cube: Cube, coins: Float[Array, "n 14"],
        values: Float[Array, "n d"], masks: Float[Array, "n d"], normal: Float[Array, "n d"],
    ) -> Float[Array, "n d"]:  # fmt: skip
        d = cube.dim
        there = jnp.sum(jnp.isfinite(state.score)).astype(jnp.float32)
        # Every second parent is any of several failures, so that not all come from the worst.
        failures = jnp.sum(state.score < 0)
        coin = jnp.where(failures > 1, 2 * coins[:, 0] % 1, coins[:, 0])
        any_of_them = (failures > 1) & (coins[:, 0] >= 0.5)
        # Rank r with a probability of 2^-(r + 1), among those that there are.
        rank = jnp.floor(-jnp.log2(jnp.maximum(coin, 2.0**-PARENTS)))
        rank = jnp.where(any_of_them, jnp.floor(coin * failures), rank)
        parent = state.points[jnp.minimum(rank, jnp.maximum(there - 1, 0)).astype(jnp.int32)]
        good = jnp.minimum(there, jnp.maximum(6.0, there / 3))
        one, two = (state.points[(coins[:, i] * good).astype(jnp.int32)] for i in (1, 2))
        factor = jnp.array([0.3, 0.6, 1.0])[(coins[:, 3] * 3).astype(jnp.int32)]
        share = jnp.where(coins[:, 4] < 0.5, 0.3, 0.9)
        crossed = parent + (masks < share[:, None]) * factor[:, None] * (one - two)
        differs = (coins[:, 5] < self.difference) & (there >= 6)
        base = jnp.where(differs[:, None], crossed, parent)
        size = MIN_STEP * (MAX_STEP / MIN_STEP) ** coins[:, 6]
        # One coordinate, two, an eighth or a third of them; at least one.
        counts = np.array([1, 2, max(1, d // 8), max(1, d // 3)], np.float32)
        count = jnp.asarray(counts)[(coins[:, 7] * 4).astype(jnp.int32)]
        forced = (coins[:, 8] * d).astype(jnp.int32)[:, None] == jnp.arange(d)
        moves = forced | (masks * d < (count - 1)[:, None])
        step = size[:, None] * normal * moves
        if cube.signals:
            shift = size * normal[:, 0]
            stretch = _stretch(cube, coins[:, 9], coins[:, 10], coins[:, 11])
            shifts = coins[:, 12] < 0.5
            step = jnp.where(shifts[:, None], shift[:, None] * stretch, step)
            moves = jnp.where(shifts[:, None], stretch > 0, moves)
        still = differs & (coins[:, 13] < 0.5)
        moved = jnp.where(still[:, None], base, base + step)
        if len(cube.discrete):
            source = jnp.where(differs[:, None], one, parent)
            chosen = _other_cells(cube, source, step, values)
            chosen = jnp.where(moves & ~still[:, None], chosen, source)
            moved = jnp.where(np.array(cube.levels) > 0, chosen, moved)
        # Half of the steps out of the cube end on its faces, half turn back at them.
        inside = 1 - jnp.abs(1 - jnp.abs(moved))
        return jnp.clip(jnp.where((coins[:, 11] < 0.5)[:, None], inside, moved), 0.0, 1.0)


def _other_cells(
    cube: Cube, points: Float[Array, "n d"], step: Float[Array, "n d"], values: Float[Array, "n d"]
) -> Float[Array, "n d"]:
    """Move each discrete coordinate to another cell: by the step if it is ordered, or to any."""
    levels = np.array(cube.levels)[cube.discrete]
    ordered = np.array(cube.ordered)[cube.discrete]
    cells, step = cube.cells(points), step[:, cube.discrete] * levels
    near = jnp.where(step < 0, jnp.minimum(jnp.round(step), -1), jnp.maximum(jnp.round(step), 1))
    near = near.astype(jnp.int32)
    beyond = (cells + near < 0) | (cells + near >= levels)
    along = jnp.clip(jnp.where(beyond, cells - near, cells + near), 0, levels - 1)
    any_other = 1 + (values[:, cube.discrete] * (levels - 1)).astype(jnp.int32)
    to = jnp.where(ordered, along, (cells + any_other) % levels)
    return points.at[:, cube.discrete].set(cube.centres(to))


def _explore(
    cube: Cube, direction: Float[Array, " n"], change: Float[Array, " n"], even: Float[Array, " n"],
    idle: Float[Array, ""], values: Float[Array, "n d"], cuts: Float[Array, "n d"],
) -> Float[Array, "n d"]:  # fmt: skip
    """Draw points towards the ends of the range; signals change seldom, always or at random."""
    # Arcsine distributed: dense at both ends, as the best controls often are.
    u = jnp.sin(0.5 * np.pi * values) ** 2
    evenly = even < max(EVENLY, 1 - cube.dim / FEW) + (MAX_EXPLORATION - EVENLY) * idle
    u = jnp.where(evenly[:, None] | (np.array(cube.levels) > 0), values, u)
    for signal in cube.signals:
        indices = np.array(signal)
        begins = (cuts[:, indices] < change[:, None]) | (np.arange(len(indices)) == 0)
        last = jax.lax.cummax(jnp.where(begins, jnp.arange(len(indices)), 0), axis=1)
        held = jnp.take_along_axis(u[:, indices], last, axis=1)
        # To and fro: where a control point is on the side of the one before, it changes sides.
        side = jnp.cumsum(cuts[:, indices] < TO_AND_FRO, axis=1) % 2 == 0
        high = jnp.maximum(u[:, indices], 1 - u[:, indices])
        swinging = jnp.where(side, high, 1 - high)
        found = jnp.where((direction < SELDOM)[:, None], held, u[:, indices])
        found = jnp.where((direction > 1 - SWINGING)[:, None], swinging, found)
        found = jnp.where(evenly[:, None], u[:, indices], found)
        u = u.at[:, indices].set(found)
    return u


def _stretch(
    cube: Cube, which: Float[Array, " n"], start: Float[Array, " n"], length: Float[Array, " n"]
) -> Float[Array, "n d"]:
    """Return one in a random stretch of a random signal, zero elsewhere."""
    number = (which * len(cube.signals)).astype(jnp.int32)
    found = jnp.zeros((len(which), cube.dim), jnp.float32)
    for i, signal in enumerate(cube.signals):
        m = len(signal)
        first = (start * m).astype(jnp.int32)
        last = first + (length * (m - first)).astype(jnp.int32)
        index = jnp.arange(m)
        inside = (index >= first[:, None]) & (index <= last[:, None]) & (number == i)[:, None]
        found = found.at[:, np.array(signal)].set(inside.astype(jnp.float32))
    return found
