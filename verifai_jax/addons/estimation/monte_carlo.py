"""Monte Carlo: independent samples of the prior, and the exact interval of their failures.

counts = sample_prior(limit_state, rng, 10_000)
counts.failures, counts.simulations, counts.interval(0.95)
"""

from dataclasses import dataclass

import numpy as np

from verifai_jax.addons.estimation.intervals import upper_bound
from verifai_jax.addons.estimation.normal_space import Ended, LimitState
from verifai_jax.statistics.binomial import clopper_pearson

AT_ONCE = 8
"""Batches between two looks at the clock, after which nothing of them is lost."""


@dataclass(frozen=True)
class Counts:
    """Counts of independent samples of the prior.

    - `simulations`: number of samples.
    - `failures`: samples that break a formula.
    - `no_verdict`: samples without a verdict.
    """

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
        """Return the Clopper-Pearson interval of the failure probability.

        A sample without a verdict is safe at the lower end, and a failure at the upper end.
        """
        if not self.simulations:
            return 0.0, 1.0
        low = clopper_pearson(self.failures, self.simulations, confidence).low
        worst = self.failures + self.no_verdict
        return low, clopper_pearson(worst, self.simulations, confidence).high

    def upper_bound(self, confidence: float) -> float:
        """Return the one-sided bound; a sample without a verdict counts as failing."""
        return upper_bound(self.failures + self.no_verdict, self.simulations, confidence)


def sample_prior(limit_state: LimitState, rng: np.random.Generator, simulations: int) -> Counts:
    """Simulate independent samples of the prior; fewer than asked for if the time ends."""
    total = Counts(0, 0, 0)
    size = limit_state.batch * AT_ONCE
    try:
        while total.simulations < simulations:
            z = limit_state.sample_prior(rng, min(size, simulations - total.simulations))
            while len(z):
                some, z = np.split(z, [limit_state.step])
                scores = limit_state(some)
                part = Counts(
                    len(scores.score), int(scores.failing.sum()), int((~scores.proper).sum())
                )
                total = total + part
    except Ended:
        pass
    return total
