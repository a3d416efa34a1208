"""Bandits: each coordinate has its own bandit, whose arms are intervals.

Arms with a higher upper confidence bound are drawn more often. The bound is the mean reward plus a
bonus that shrinks with each draw (UCB1: Auer, Cesa-Bianchi, Fischer, Finite-time analysis of the
multiarmed bandit problem, Machine Learning 47, 2002). VerifAI has such a search; this one works in
batches and learns before the first failure:

- rewards come from ranks, so the scale of the robustness does not matter: the best remembered point
  gets 1, and points outside of the best share get 0. All failures are equally good and share their
  ranks: with more failures each gets less reward, and the search explores more;
- only the last points are remembered (sliding-window UCB: Garivier, Moulines, On upper-confidence
  bound policies for switching bandits, 2011), as the value of an arm changes while other
  coordinates learn;
- arms split: under each of them is another bandit, whose arms start at the mean of their parent's
  (UCT: Kocsis, Szepesvari, 2006). With few points the bonus is large and the draws are even, so
  that splitting refines the search only where it has many points;
- within a batch each draw counts at once, before its reward is known. In the limit of small draws
  the bounds of all drawn arms become equal, at a level found by bisection. The shares of the arms
  define a density, and the rows are a Latin hypercube sample of it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Search, check_options
from verifai_jax.search.best_points import newest_first
from verifai_jax.search.draws import draw_columns

BISECTIONS = 20
"""Halvings of the interval that holds the common level of the bounds: the level is then known to
a millionth of the interval, which is near the precision of float32."""


class BanditState(NamedTuple):
    key: Key[Array, ""]
    round: UInt32[Array, ""]
    u: Float[Array, "window d"]  # the newest first
    score: Float[Array, " window"]  # robustness, 0 for all failures; infinite where no point is


@dataclass(frozen=True)
class Bandit(Search[BanditState]):
    """Upper confidence bounds over buckets of each coordinate, which are split recursively.

    Ordered cells of discrete coordinates are grouped into buckets; each unordered one is an arm.

    **Arguments:**
    - `buckets`: number of buckets of a coordinate, and of parts into which a bucket is split.
    - `depth`: number of levels of buckets.
    - `optimism`: factor on the bonus; larger values make the draws more even.
    - `best`: share of the remembered points that get rewards.
    - `window`: number of points that are remembered; at least two batches.
    - `exploration`: share of points that are always drawn from the prior.
    **Raises:** `ValueError` for values out of range, and for more than 10 000 buckets in all.
    """

    buckets: int = 5
    depth: int = 2
    optimism: float = 0.6
    best: float = 0.25
    window: int = 256
    exploration: float = 0.1

    def __post_init__(self) -> None:
        counts = {"buckets": 2, "depth": 1, "window": 1}
        check_options(self, counts, ["best", "exploration"], ["optimism"])
        if self.buckets**self.depth > 10_000:
            raise ValueError(
                "buckets**depth must be at most 10000; got "
                f"buckets={self.buckets}, depth={self.depth}"
            )

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> BanditState:
        window = max(self.window, 2 * batch)
        return BanditState(
            key=key, round=jnp.uint32(0), u=jnp.full((window, cube.dim), 0.5, jnp.float32),
            score=jnp.full(window, jnp.inf, jnp.float32),
        )  # fmt: skip

    def ask(self, state: BanditState, cube: Cube, batch: int) -> Asked[BanditState]:
        key = jax.random.fold_in(state.key, state.round)
        chance, order, prior = draw_columns(key, batch, 1, cube.dim, cube.dim)
        # A Latin hypercube: in each coordinate one row in each of `batch` equal parts.
        even = (jnp.argsort(order, axis=0) + prior) / batch
        reward = self._rewards(state.score)
        u = jnp.zeros((batch, cube.dim), jnp.float32)
        for indices, edges, branching in self._bandits(cube):
            part = draw_cells(
                self._density(state, reward, indices, edges, branching, batch),
                edges,
                even[:, indices],
            )
            u = u.at[:, indices].set(part)
        u = jnp.where(chance < self.exploration, prior, u)
        u = u.at[:, cube.discrete].set(cube.centres(cube.cells(u)))
        return u, state._replace(round=state.round + 1)

    def tell(self, state: BanditState, cube: Cube, observations: Observations) -> BanditState:
        u = observations.u.at[:, cube.discrete].set(cube.centres(cube.cells(observations.u)))
        u, score = newest_first(u, observations.score, state.u, state.score)
        # Points without a verdict push none out.
        kept = jnp.argsort(jnp.isinf(score), stable=True)[: len(state.score)]
        return state._replace(u=u[kept], score=score[kept])

    def _rewards(self, score: Float[Array, " window"]) -> Float[Array, " window"]:
        """Return rewards: 1 for the best to 0 beyond the best share; equal scores share ranks."""
        ranked = jnp.sort(score)
        below = jnp.searchsorted(ranked, score, side="left")
        upto = jnp.searchsorted(ranked, score, side="right")
        rewarded = self.best * jnp.maximum(jnp.sum(jnp.isfinite(score)), 1)
        return jnp.clip(1 - (below + upto) / (2 * rewarded), 0.0, 1.0)

    def _bandits(
        self, cube: Cube
    ) -> list[tuple[np.ndarray, Float[np.ndarray, "d edges"], tuple[int, ...]]]:
        """Return groups of coordinates, the edges of their finest buckets, and their branchings."""
        cells = dict(zip(cube.discrete.tolist(), cube.probabilities, strict=True))
        choices = [i for i in cells if not cube.ordered[i]]
        others = [i for i in range(cube.dim) if i not in choices]
        groups = []
        max_levels = max((cube.levels[i] for i in choices), default=0)
        for indices, branching in (
            (others, (self.buckets,) * self.depth),
            (choices, (max_levels,)),
        ):
            if not indices:
                continue
            leaves = int(np.prod(branching))
            edges = np.tile(np.linspace(0, 1, leaves + 1), (len(indices), 1))
            for row, i in zip(edges, indices, strict=True):
                if i in cells:
                    # Cell c is in leaf c * leaves // n (or, a choice, in leaf c).
                    n = cube.levels[i]
                    first = np.arange(leaves + 1)
                    first = np.minimum(first, n) if i in choices else -(-first * n // leaves)
                    row[:] = np.concatenate([[0], np.cumsum(cells[i])])[first]
            groups.append((np.array(indices), edges.astype(np.float32), branching))
        return groups

    def _density(
        self, state: BanditState, reward: Float[Array, " window"], indices: np.ndarray,
        edges: Float[np.ndarray, "d edges"], branching: tuple[int, ...], batch: int,
    ) -> Float[Array, "d edges-1"]:  # fmt: skip
        """Return the share of the next batch that each leaf gets."""
        d, leaves = len(indices), edges.shape[1] - 1
        find = jax.vmap(lambda edge, x: jnp.searchsorted(edge, x, side="right"), (0, 1), 1)
        leaf = find(jnp.asarray(edges[:, 1:-1]), state.u[:, indices])
        present = jnp.isfinite(state.score).astype(jnp.float32)
        sums = jnp.zeros((d, leaves, 2), jnp.float32)
        sums = sums.at[np.arange(d), leaf].add(jnp.stack([present, reward], axis=1)[:, None])
        share = jnp.ones((d, 1), jnp.float32)
        total = jnp.broadcast_to(jnp.sum(present), (d, 1))
        mean = jnp.broadcast_to(jnp.sum(reward), (d, 1)) / jnp.maximum(total, 1.0)
        for level, branches in enumerate(branching):
            shape = (d, int(np.prod(branching[:level])), branches)
            node = jnp.sum(sums.reshape(*shape, -1, 2), axis=3)
            exists = np.sum(np.diff(edges).reshape(*shape, -1), axis=3) > 0
            # An arm starts with one draw that had its parent's mean.
            count = node[..., 0] + 1
            means = (node[..., 1] + mean[..., None]) / count
            budget = jnp.maximum(batch * share, 1.0)
            bonus = self.optimism**2 * jnp.log(1 + total + budget)
            split = fill_cells(means, count, exists, budget[..., None], bonus[..., None])
            share = (share[..., None] * split).reshape(d, -1)
            total, mean = node[..., 0].reshape(d, -1), means.reshape(d, -1)
        return share


def fill_cells(
    mean: Float[Array, "*nodes arms"],
    count: Float[Array, "*nodes arms"],
    exists: Bool[np.ndarray, "*nodes arms"],
    budget: Float[Array, "*nodes 1"],
    bonus: Float[Array, "*nodes 1"],
) -> Float[Array, "*nodes arms"]:
    """Distribute `budget` draws one by one, each to the arm with the highest bound.

    The bound of an arm after `n` more draws is `mean + sqrt(bonus / (count + n))`. So the arm gets
    `bonus / (level - mean)^2 - count` draws until its bound has fallen to `level`.
    """

    def draws(level: Array) -> Array:
        gap = jnp.maximum(level - mean, 1e-6)
        return jnp.where(exists, jnp.maximum(bonus / gap**2 - count, 0.0), 0.0)

    def halve(_: Int[Array, ""], limits: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = limits
        level = (low + high) / 2
        more = jnp.sum(draws(level), axis=-1, keepdims=True) > budget
        return jnp.where(more, level, low), jnp.where(more, high, level)

    highest = jnp.max(mean + jnp.sqrt(bonus / count), axis=-1, keepdims=True)
    low, _ = jax.lax.fori_loop(0, BISECTIONS, halve, (jnp.zeros_like(highest), highest))
    filled = draws(low)
    total = jnp.sum(filled, axis=-1, keepdims=True)
    # A node without arms has no share to give.
    return filled / jnp.where(total > 0, total, 1.0)


def draw_cells(
    density: Float[Array, "d leaves"], edges: Float[np.ndarray, "d leaves+1"],
    even: Float[Array, "n d"],
) -> Float[Array, "n d"]:  # fmt: skip
    """Return quantiles of a density that is constant in each leaf."""
    limits = jnp.cumsum(density, axis=1)
    limits = limits / limits[:, -1:]
    find = jax.vmap(lambda limit, x: jnp.searchsorted(limit, x, side="right"), (0, 1), 1)
    leaf = jnp.minimum(find(limits, even), density.shape[1] - 1)
    d = np.arange(len(edges))
    low = jnp.where(leaf > 0, limits[d, leaf - 1], 0.0)
    inside = (even - low) / jnp.maximum(limits[d, leaf] - low, 1e-12)
    left, right = jnp.asarray(edges)[d, leaf], jnp.asarray(edges)[d, leaf + 1]
    return jnp.clip(left + jnp.clip(inside, 0.0, 1.0) * (right - left), 0.0, 1.0)
