"""Search for the parameters with the lowest failure probability under the prior.

    search = FailureCounts(loop, margin, limits, seed, start)
    search.run()
    search.theta, search.failing, search.samples

If no parameters satisfy the formula everywhere, the least robustness of an attack is not
informative. All candidates are simulated on the same samples of the prior: first many candidates,
from cross-entropy, on few samples, then the best candidates on many fresh samples, which decide.
"""

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.synthesis.budget import Budget
from verifai_jax.addons.synthesis.held_out import draw
from verifai_jax.addons.synthesis.optimize import Choice, typical_size, worst_case
from verifai_jax.addons.synthesis.parametric import FeatureParameters

CANDIDATES = 64
"""Candidates that the first samples are for, about."""
SHARE = 0.6
"""Share of the budget for them."""
POPULATION, ELITE = 16, 5
"""Candidates of a round, and those that the next ones are drawn around."""
FINALISTS = 8
"""Candidates that are compared in fresh samples."""
MIN_SAMPLES = 16
"""Samples at least."""
STD = 0.01, 0.3
"""Least and greatest standard deviation of a round, in unit coordinates."""


class FailureCounts:
    """A search for the lowest failure count, whose best candidate is available at any time.

    **Arguments:**
    - `loop`: the system with its parameters; the other features are its environment.
    - `margin`: robustness below which a sample counts as failing.
    - `limits`: its budget.
    - `seed`: the seed, which alone determines samples and candidates.
    - `start` `[p]`: nominal parameters. They are candidates, and among parameters that fail equally
      often the nearest to them are best. None without any.
    **Raises:** `ValueError` if nothing varies except the parameters.
    """

    def __init__(
        self, loop: FeatureParameters, margin: float, limits: Budget, seed: int,
        start: Float[np.ndarray, " p"] | None = None,
    ) -> None:  # fmt: skip
        if loop.environment is None:
            raise ValueError(
                "aim='probability' needs features that vary: all are parameters here, so leave it "
                "out, or name fewer parameters"
            )
        self.loop, self.margin, self.limits, self.seed = loop, margin, limits, seed
        self.start = start
        self.theta = np.full(loop.dim, 0.5) if start is None else start
        self.failing = self.samples = 0
        self.rho: Float[np.ndarray, " n"] = np.zeros(0)
        self.value, self._lowest = -np.inf, np.inf
        self.environments: Float[np.ndarray, "n d"] = np.zeros((0, loop.environment.dim))
        self.final: list[Choice] = []

    def run(self) -> None:
        """Search within the budget."""
        rng = np.random.default_rng((self.seed, 5))
        first = self.limits.slice(max(MIN_SAMPLES, int(SHARE * self.limits.left)))
        samples = self._draw(max(MIN_SAMPLES, first.left // CANDIDATES), 6)
        p = self.loop.dim
        # One in each of as many slices of every coordinate: a Latin hypercube.
        cells = np.argsort(rng.random((2 * POPULATION, p)), axis=0)
        drawn = (cells + rng.random(cells.shape)) / len(cells)
        drawn[0] = self.theta
        thetas, scores = np.zeros((0, p)), np.zeros(0)
        while first.left >= len(samples):
            drawn = drawn[: first.left // len(samples)]
            thetas = np.concatenate([thetas, drawn])
            scores = np.append(scores, self._evaluate(drawn, samples))
            elite = thetas[np.argsort(scores, kind="stable")[:ELITE]]
            std = np.clip(1.5 * elite.std(axis=0), *STD)
            parents = elite[rng.integers(0, len(elite), POPULATION)]
            moved = np.clip(parents + std * rng.standard_normal(parents.shape), 0.0, 1.0)
            anew = np.where(rng.random(parents.shape) < 0.1, rng.random(parents.shape), parents)
            drawn = np.where(self.loop.free, moved, anew)
        best = np.unique(thetas[np.argsort(scores, kind="stable")[:FINALISTS]], axis=0)
        if self.start is not None and len(best):
            best = np.unique(np.concatenate([best, self.start[None]]), axis=0)
        if len(best) and (count := self.limits.left // len(best)) >= MIN_SAMPLES:
            self._evaluate(best, self._draw(count, 7), last=True)

    def _draw(self, count: int, number: int) -> Float[np.ndarray, "n d"]:
        points = draw(self.loop, self.theta, count, (self.seed, number))
        if not len(points):
            raise ValueError("where accepts no environment with these parameters")
        return points

    def _evaluate(
        self, thetas: Float[np.ndarray, "k p"], samples: Float[np.ndarray, "n d"],
        last: bool = False,
    ) -> Float[np.ndarray, " k"]:  # fmt: skip
        """Return what is to be least: the share that fails, and where that ties, how nearly."""
        pairs = self.loop.evaluate(thetas, samples)
        happens = ~np.isposinf(pairs.rho)
        bad = happens & (pairs.violates(self.margin) | ~pairs.proper)
        scale = typical_size(pairs.rho.ravel().tolist())
        above = np.nan_to_num((pairs.rho - self.margin) / scale, nan=0.0, posinf=50.0)
        near = np.mean(1 / (1 + np.exp(np.clip(above, -50, 50))), axis=1)
        count = np.maximum(1, happens.sum(axis=1))
        share = np.where(happens.any(axis=1), bad.sum(axis=1) / count, 1.0)
        score = share + near / (2 * len(samples))
        values = worst_case(pairs)
        order = score
        if last and self.start is not None:
            far = np.linalg.norm(thetas - self.start, axis=1)
            order = np.where(share == share.min(), far, np.inf)
        index = int(np.argmin(order))
        if last or score[index] < self._lowest:
            self._lowest = float(score[index])
            self.theta, self.failing = thetas[index], int(bad[index].sum())
            self.samples, self.environments = int(happens[index].sum()), samples
            self.rho, self.value = pairs.rho[index], float(values[index])
            self.final = [
                Choice(theta, float(value), len(samples))
                for theta, value in zip(thetas, values, strict=True)
            ]
        return score
