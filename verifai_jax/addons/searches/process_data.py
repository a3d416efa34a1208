"""Points of the cube and their robustness, as training data of a Gaussian process.

    process_of(cube)                                    # which coordinates are codes
    training_data(u, score, cube)                       # rows whose score is not finite are absent
    memory.with_rows(u, score).refitted(cube, 12, 8)    # what two searches keep of their rounds

All failures are equally good, and huge values do not dominate.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from verifai_jax.addons.searches.gaussian import GaussianProcess, Hyper, Posterior, TrainingData
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Observations

CAP = 30.0
"""Quartiles of the robustness above which all values are the same to the process, so that a few
huge ones do not hide the rest. Chosen by hand; no comparison with other values is recorded."""
LARGEST = 1e30  # robustness above which nothing differs: sums of such stay finite in float32
NO_VERDICT = 2e30  # score of a simulation without a verdict
FIT_POINTS = 192
"""Points that hyper-parameters are fitted to. Chosen by hand; no comparison is recorded."""


def scores(observations: Observations) -> Float[Array, " n"]:
    """Return the robustness, 0 for all failures, `NO_VERDICT` for NaN; infinite if unusable."""
    rho = observations.rho
    score = jnp.where(jnp.isnan(rho), NO_VERDICT, jnp.clip(rho, 0.0, LARGEST))
    return jnp.where(observations.valid & ~(rho == jnp.inf), score, jnp.inf)


def process_of(cube: Cube) -> GaussianProcess:
    """Return the process over the coordinates of this cube; unordered choices are codes."""
    return GaussianProcess(
        tuple(
            level > 0 and not ordered
            for level, ordered in zip(cube.levels, cube.ordered, strict=True)
        )
    )


def snap(u: Float[Array, "n d"], cube: Cube) -> Float[Array, "n d"]:
    """Move discrete coordinates to the middles of their cells."""
    if len(cube.discrete) == 0:
        return u
    return u.at[:, cube.discrete].set(cube.centres(cube.cells(u)))


def encode(u: Float[Array, "n d"], cube: Cube) -> Float[Array, "n d"]:
    """Encode points for the process: ordered cells as middles, unordered ones as numbers."""
    if len(cube.discrete) == 0:
        return u
    cells = cube.cells(u)
    codes = ~np.array(cube.ordered)[cube.discrete]
    return u.at[:, cube.discrete].set(jnp.where(codes, cells, cube.centres(cells)))


def training_data(u: Float[Array, "n d"], score: Float[Array, " n"], cube: Cube) -> TrainingData:
    """Return the process' data: a logarithm of the robustness, with mean 0 and deviation 1."""
    mask = score <= LARGEST
    score = jnp.where(mask, score, 0.0)
    positive = jnp.sort(jnp.where(score > 0, score, jnp.inf))
    quartile = positive[jnp.sum(score > 0) // 4]
    y = score / jnp.where(jnp.isfinite(quartile), quartile, 1.0)
    y = jnp.log1p(jnp.minimum(y, CAP))
    count = jnp.maximum(jnp.sum(mask), 1)
    y = y - jnp.sum(y, where=mask) / count
    std = jnp.sqrt(jnp.sum(y**2, where=mask) / count)
    return TrainingData(encode(u, cube), y / jnp.where(std > 0, std, 1.0), mask)


def rows_to_keep(
    score: Float[Array, " n"], luck: Float[Array, " n"], count: int
) -> Int[Array, " count"]:
    """Choose the rows to keep: the best half and random others; empty rows come last."""
    rank = jnp.argsort(jnp.lexsort((luck, score)))
    best = (rank < count // 2) & jnp.isfinite(score)
    return jnp.argsort(jnp.where(best, -1.0, jnp.where(jnp.isfinite(score), luck, 2.0)))[:count]


class ProcessMemory(NamedTuple):
    """The points in a process, and its hyper-parameters."""

    results: UInt32[Array, ""]  # rows, in all
    u: Float[Array, "capacity d"]
    score: Float[Array, " capacity"]  # as of `scores`; infinite where no point is
    luck: Float[Array, " capacity"]  # says which points are kept
    verdicts: Int[Array, ""]  # points with a verdict, in all
    fitted: Int[Array, ""]  # of which the last fit knew
    hyper: Hyper

    @classmethod
    def nothing(cls, capacity: int, cube: Cube) -> "ProcessMemory":
        """Return the memory before the first round."""
        return cls(
            results=jnp.uint32(0),
            u=jnp.full((capacity, cube.dim), 0.5, jnp.float32),
            score=jnp.full(capacity, jnp.inf, jnp.float32),
            luck=jnp.zeros(capacity, jnp.float32),
            verdicts=jnp.int32(0),
            fitted=jnp.int32(0),
            hyper=process_of(cube).first(),
        )

    def emptied(self, cube: Cube) -> "ProcessMemory":
        """Return the memory without its points; the count of rows continues."""
        return ProcessMemory.nothing(len(self.score), cube)._replace(
            results=self.results, u=self.u, luck=self.luck
        )

    def says_something(self, initial: int) -> Bool[Array, ""]:
        """Return whether there are enough verdicts, which differ, to learn from."""
        present = self.score <= LARGEST
        lowest = jnp.min(self.score, where=present, initial=jnp.inf)
        spread = jnp.max(self.score, where=present, initial=0.0) > lowest
        return spread & (self.verdicts >= initial)

    def with_rows(self, u: Float[Array, "n d"], score: Float[Array, " n"]) -> "ProcessMemory":
        """Return the memory with the rows of a round, dropping as many if it is full."""
        usable = jnp.isfinite(score)
        number = self.results + jnp.arange(len(score), dtype=jnp.uint32)
        # A Weyl sequence (in steps of the golden ratio): as good as random for choosing.
        luck = (number * np.uint32(2654435769) >> 8).astype(jnp.float32) / 2**24
        verdicts = jnp.sum(score <= LARGEST, dtype=jnp.int32)
        u = jnp.concatenate([jnp.where(usable[:, None], u, 0.5), self.u])
        score = jnp.concatenate([score, self.score])
        luck = jnp.concatenate([luck, self.luck])
        rows = rows_to_keep(score, luck, len(self.score))
        return self._replace(
            results=self.results + np.uint32(len(usable)), u=u[rows], score=score[rows],
            luck=luck[rows], verdicts=self.verdicts + verdicts,
        )  # fmt: skip

    def refitted(self, cube: Cube, initial: int, steps: int) -> "ProcessMemory":
        """Refit the hyper-parameters, starting from the last ones, if there are 25 % more rows."""

        def fit() -> Hyper:
            some = rows_to_keep(self.score, self.luck, min(FIT_POINTS, len(self.score)))
            data = training_data(self.u, self.score, cube)
            data = jax.tree.map(lambda leaf: leaf[some], data)
            return process_of(cube).fit(self.hyper, data, steps)

        due = (self.verdicts >= initial) & (4 * (self.verdicts - self.fitted) >= self.fitted)
        hyper = jax.lax.cond(due, fit, lambda: self.hyper)
        return self._replace(hyper=hyper, fitted=jnp.where(due, self.verdicts, self.fitted))

    def posterior(self, cube: Cube) -> Posterior:
        """Return the process given these points."""
        return process_of(cube).condition(self.hyper, training_data(self.u, self.score, cube))
