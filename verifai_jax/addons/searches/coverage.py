"""Coverage-guided fuzzing: mutations of points with rarely covered items.

Each simulation has coverage ids, numbers of what it covered: transitions of an automaton, cells of
behaviour, the clause nearest to breaking. For each coverage id the search keeps the point with the
lowest robustness among those that have it (an archive of elites: Mouret, Clune, Illuminating search
spaces by mapping elites, 2015), and mutates points with rare coverage ids more often (Boehme, Pham,
Roychoudhury, Coverage-based greybox fuzzing as Markov chain, IEEE Transactions on Software
Engineering 45(5), 2019). So new coverage guides the search where the robustness is flat. Each kind
of coverage id gets the same share, so that many pairs of transitions do not dominate a few cells.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt32

from verifai_jax.core.messages.checks import check_positive
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import KIND, Asked, Observations, Search, Wants, check_options
from verifai_jax.search.draws import standard_normal

# The shares and sizes below were chosen by hand; no comparison with other values is recorded.
STEP = 0.1  # standard deviation of small steps, in unit coordinates
MOVES = (0.35, 0.55, 0.75, 0.9)
"""Cumulative shares of mutations: a few coordinates, a stretch, all from one coordinate on, a
splice; the rest are small steps."""
SHARES = (0.25, 0.5, 0.25, 0.25)
"""Shares of the kinds of ids: of features, of cells of behaviour, of verdicts, and others."""
KINDS = len(SHARES)  # number of kinds of coverage ids that the search distinguishes
VERDICT = 2  # the kind of coverage ids of verdicts
EDITED = 0.85  # share of mutations that edit an item of an array, where there are such
EDITS = (0.3, 0.38, 0.72, 0.8)
"""Cumulative shares of edits: putting an item in, another item in place of one, the same kind of
item with one other number, taking one out; the rest are new items from one on."""
APPENDED = 0.3
"""Share of edits at the end of an array, where what has happened before stays as it is."""
EXTREME = 0.5  # share of new items whose numbers are drawn towards the ends of their ranges
LONGER = 0.5  # share of mutations that make an array no shorter and perhaps longer


class CoverageState(NamedTuple):
    key: Key[Array, ""]
    round: UInt32[Array, ""]
    elites: Float[Array, "kinds*buckets d"]
    score: Float[Array, " kinds*buckets"]  # infinite where no point has the coverage id
    hits: Float[Array, " kinds*buckets"]  # simulations with the coverage id


@dataclass(frozen=True)
class Coverage(Search[CoverageState]):
    """Mutations of points that covered rare items; see the module's docstring.

    **Arguments:**
    - `exploration`: share of points that are always drawn from the prior.
    - `rarity`: exponent of the preference for rare coverage ids; 0 for none.
    - `buckets`: number of coverage ids of a kind that are distinguished; further ids share buckets.
    **Raises:** `ValueError` for values out of range.
    """

    wants: ClassVar[Wants] = Wants(coverage_ids=True, max_batch=64)
    exploration: float = 0.15
    rarity: float = 2.0
    buckets: int = 512

    def __post_init__(self) -> None:
        check_options(self, {"buckets": 1}, ["exploration"])
        if self.rarity:
            check_positive("rarity", self.rarity, finite=True)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> CoverageState:
        return CoverageState(
            key=key,
            round=jnp.uint32(0),
            elites=jnp.full((KINDS * self.buckets, cube.dim), 0.5, jnp.float32),
            score=jnp.full(KINDS * self.buckets, jnp.inf, jnp.float32),
            hits=jnp.zeros(KINDS * self.buckets, jnp.float32),
        )

    def ask(self, state: CoverageState, cube: Cube, batch: int) -> Asked[CoverageState]:
        d = cube.dim
        key = jax.random.fold_in(state.key, state.round)
        # One call for all random numbers: each costs a good part of a second to compile.
        random = jax.random.uniform(key, (batch, 12 + 3 * d), jnp.float32)
        coins, fresh, masks, noise = jnp.split(random, [12, 12 + d, 12 + 2 * d], axis=1)
        there = state.hits > 0
        weights = jnp.where(there, jnp.maximum(state.hits, 1.0) ** -self.rarity, 0.0)
        each = weights.reshape(KINDS, self.buckets)
        each = each / jnp.maximum(jnp.sum(each, axis=1, keepdims=True), 1e-30)
        each = each * np.array(SHARES, np.float32)[:, None]
        edges = jnp.cumsum(each.ravel())
        last = KINDS * self.buckets - 1
        parent, other = (
            state.elites[jnp.minimum(jnp.searchsorted(edges, coin * edges[-1]), last)]
            for coin in (coins[:, 0], coins[:, 1])
        )
        changed = self._mutated(cube, parent, other, coins[:, 2:], fresh, masks, noise)
        explores = (coins[:, 11] < self.exploration) | ~jnp.any(there)
        return jnp.where(explores[:, None], fresh, changed), state._replace(round=state.round + 1)

    def _mutated(
        self, cube: Cube, parent: Float[Array, "n d"], other: Float[Array, "n d"],
        coins: Float[Array, "n coins"], fresh: Float[Array, "n d"], masks: Float[Array, "n d"],
        noise: Float[Array, "n d"],
    ) -> Float[Array, "n d"]:  # fmt: skip
        d = max(cube.dim, 1)
        index = np.arange(cube.dim)
        begin = jnp.floor(coins[:, 0] * d)[:, None]
        length = jnp.ceil(2.0 ** (coins[:, 1] * np.log2(d)))[:, None]
        # One coordinate surely, and one, two, four or eight of them in the mean.
        few = (index == begin) | (masks * d < 2.0 ** jnp.floor(coins[:, 2:3] * 4) - 1)
        stretch = (index >= begin) & (index < begin + length)
        tail = index >= begin
        move = coins[:, 3][:, None]
        drawn = jnp.where(
            move < MOVES[0], few, jnp.where(move < MOVES[1], stretch, tail & (move < MOVES[2]))
        )
        spliced = tail & (move >= MOVES[2]) & (move < MOVES[3])
        moved = jnp.where(drawn, fresh, jnp.where(spliced, other, parent))
        continuous = np.array(cube.levels) == 0
        steps = few & continuous & (move >= MOVES[3])
        moved = jnp.where(steps, moved + STEP * standard_normal(noise), moved)
        if cube.lengths:
            # Items after the end change nothing.
            is_length = np.isin(index, cube.lengths)
            longer = is_length & (coins[:, 4:5] < LONGER)
            moved = jnp.where(longer, jnp.maximum(parent, fresh), moved)
        if cube.sequences:
            edited = _edited(cube, parent, coins, fresh)
            moved = jnp.where(coins[:, 5:6] < EDITED, edited, moved)
        return jnp.clip(moved, 0.0, 1.0)

    def tell(self, state: CoverageState, cube: Cube, observations: Observations) -> CoverageState:
        usable, n = observations.usable, len(observations.rho)
        coverage_ids = observations.coverage_ids
        if coverage_ids is None or not coverage_ids.shape[1]:
            coverage_ids = jnp.zeros((n, 1), jnp.int32)
        u = jnp.where(usable[:, None], observations.u, 0.5)
        known, size = usable[:, None] & (coverage_ids >= 0), KINDS * self.buckets
        index = (coverage_ids // KIND) % KINDS * self.buckets + coverage_ids % KIND % self.buckets
        bucket = jnp.where(known, index, size)
        rows = jnp.broadcast_to(jnp.arange(n)[:, None], bucket.shape)
        scores = self._scores(cube, observations, index)
        best = jnp.full(size, jnp.inf, jnp.float32).at[bucket].min(scores, mode="drop")
        nearest = best[jnp.minimum(bucket, size - 1)]
        first = jnp.where(scores <= nearest, rows, n)
        winner = jnp.full(size, n, jnp.int32).at[bucket].min(first, mode="drop")
        # Of equally good points the newest: where nothing falls, it walks.
        better = (winner < n) & (best <= state.score)
        elites = jnp.where(better[:, None], u[jnp.minimum(winner, n - 1)], state.elites)
        return state._replace(
            elites=elites,
            score=jnp.where(better, best, state.score),
            hits=state.hits.at[bucket].add(1.0, mode="drop"),
        )

    def _scores(
        self, cube: Cube, observations: Observations, index: Int[Array, "n ids"]
    ) -> Float[Array, "n ids"]:
        """Return what is kept for each coverage id: short arrays, then the lowest robustness.

        For coverage ids of verdicts the robustness alone: those lead to what fails.
        """
        score = observations.score.astype(jnp.float32)
        score = jnp.where(jnp.isfinite(score), score / (1 + score), 1.0)
        size = jnp.zeros_like(score)
        if cube.lengths:
            is_length = np.isin(cube.discrete, cube.lengths)
            size = jnp.sum(cube.cells(observations.u)[:, is_length], axis=1).astype(jnp.float32)
        verdict = index // self.buckets == VERDICT
        return jnp.where(verdict, score[:, None], (size + score)[:, None])


def _edited(
    cube: Cube, parent: Float[Array, "n d"], coins: Float[Array, "n coins"],
    fresh: Float[Array, "n d"],
) -> Float[Array, "n d"]:  # fmt: skip
    """Put an item into an array, take one out, or change one or all from it on."""
    chosen = jnp.floor(coins[:, 0] * len(cube.sequences))
    result = parent
    for number, (length, first, width, count) in enumerate(cube.sequences):
        levels = cube.levels[length]
        min_items = count + 1 - levels
        items = jnp.minimum(jnp.floor(parent[:, length] * levels), levels - 1) + min_items
        block = parent[:, first : first + width * count].reshape(-1, count, width)
        new = fresh[:, first : first + width * count].reshape(block.shape)
        # After the last item too, where one more goes.
        slot = jnp.floor(coins[:, 1] * (items + 1))
        slot = jnp.where(coins[:, 6] < APPENDED, items, slot)
        changes = (coins[:, 3] >= EDITS[1]) & (coins[:, 3] < EDITS[2])
        slot = jnp.where(changes, jnp.floor(coins[:, 1] * items), slot)
        slot = jnp.minimum(slot, count - 1)[:, None]
        # Arcsine distributed: dense at both ends. The kind of an item is its first coordinate.
        extreme = (coins[:, 7] < EXTREME)[:, None, None] & (np.arange(width) > 0)
        new = jnp.where(extreme, jnp.sin(0.5 * np.pi * new) ** 2, new)
        indices, move = jnp.arange(count), coins[:, 3][:, None]
        here = (indices == slot)[:, :, None]
        after = (indices > slot)[:, :, None]
        inserted = jnp.where(here, new, jnp.where(after, jnp.roll(block, 1, axis=1), block))
        removed = jnp.where(here | after, jnp.roll(block, -1, axis=1), block)
        # Some changes keep the kind of an item and all its numbers but one.
        one = 1 + jnp.floor(coins[:, 8] * max(width - 1, 1))[:, None, None]
        within = here & ((np.arange(width) == one) | (move[:, :, None] < EDITS[1]))
        replaced = jnp.where(within, new, block)
        tail = jnp.where(here | after, new, block)
        moves = [move < EDITS[0], move < EDITS[2], move < EDITS[3]]
        sizes = [items + 1, jnp.maximum(items, slot[:, 0] + 1), items - 1]
        longest = jnp.maximum(items, jnp.floor(fresh[:, length] * levels) + min_items)
        size = jnp.select([w[:, 0] for w in moves], sizes, longest)
        edited = jnp.select([w[:, :, None] for w in moves], [inserted, replaced, removed], tail)
        size = jnp.clip(size, min_items, count)
        whole = parent.at[:, first : first + width * count].set(edited.reshape(len(parent), -1))
        whole = whole.at[:, length].set((size - min_items + 0.5) / levels)
        result = jnp.where((chosen == number)[:, None], whole, result)
    return result
