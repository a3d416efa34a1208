"""Monte Carlo: independent samples of the prior, and the exact interval of their failures.

counts = sample(judge, rng, 10_000)
counts.failures, counts.simulations, counts.interval(0.95)
"""

from dataclasses import dataclass

import numpy as np

from verifai_jax.estimation.intervals import upper_bound
from verifai_jax.estimation.normal_space import Ended, Judge
from verifai_jax.statistics.binomial import clopper_pearson

AT_ONCE = 8
"""Batches between two looks at the clock, after which nothing of them is lost."""


@dataclass(frozen=True)
class Counts:
    """What came of independent samples of the prior."""

    simulations: int
    failures: int
    no_verdict: int

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(
            self.simulations + other.simulations,
            self.failures + other.failures,
            self.no_verdict + other.no_verdict,
        )

    def interval(self, confidence: float) -> tuple[float, float]:
        """Clopper-Pearson; what has no verdict is no failure at the lower end, one at the upper."""
        if not self.simulations:
            return 0.0, 1.0
        low = clopper_pearson(self.failures, self.simulations, confidence).low
        worst = self.failures + self.no_verdict
        return low, clopper_pearson(worst, self.simulations, confidence).high

    def upper_bound(self, confidence: float) -> float:
        """One-sided, with what has no verdict counted as failing."""
        return upper_bound(self.failures + self.no_verdict, self.simulations, confidence)


def sample(judge: Judge, rng: np.random.Generator, simulations: int) -> Counts:
    """So many samples of the prior; fewer where time ends."""
    total = Counts(0, 0, 0)
    size = judge.batch * AT_ONCE
    try:
        while total.simulations < simulations:
            z = judge.prior(rng, min(size, simulations - total.simulations))
            for start in range(0, len(z), judge.batch):
                seen = judge(z[start : start + judge.batch])
                part = Counts(len(seen.score), int(seen.failing.sum()), int((~seen.proper).sum()))
                total = total + part
    except Ended:
        pass
    return total
