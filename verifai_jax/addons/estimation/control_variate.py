"""A surrogate as a control variate: simulations only estimate how often it is wrong.

    control = Control(limit_state, rng, surrogate, proposal)
    control.estimate(samples, 0.95)         # value, cv, low, high

Source: Owen, Monte Carlo theory, methods and examples (2013), chapter 8.9.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.estimation.gaussian_surrogate import Surrogate
from verifai_jax.addons.estimation.importance import ImportanceSamples
from verifai_jax.addons.estimation.intervals import student_quantile
from verifai_jax.addons.estimation.mixture import Mixture
from verifai_jax.addons.estimation.normal_space import LimitState

SAMPLES = 8000
"""Samples of the proposal by which it is known how often the surrogate sees a failure."""
UNSEEN = 8.0
"""Degrees of freedom of an interval without a wrong verdict of the surrogate."""


class ControlledMean(NamedTuple):
    """A mean with its relative error and its interval, and a flag for the use of the surrogate."""

    value: float
    cv: float
    low: float
    high: float
    controlled: bool = False


class Control:
    """The surrogate as a control variate of the samples of a proposal.

    Its rate of predicted failures is computed from samples without simulation; simulations only
    estimate how often it is wrong. If it is wrong too often, the simulations are used alone.
    """

    def __init__(
        self, limit_state: LimitState, rng: np.random.Generator, surrogate: Surrogate,
        proposal: Mixture,
    ) -> None:  # fmt: skip
        self._surrogate, self._accepts = surrogate, limit_state.accepts
        self.mean = self.error = 0.0
        if surrogate.posterior is not None:
            z = proposal.sample(rng, SAMPLES)[0]
            weights = np.where(self.sees(z), 1 / proposal.ratio(z), 0.0)
            self.mean, self.error = float(weights.mean()), float(weights.std() / len(z) ** 0.5)

    def sees(self, z: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
        """Return flags of points that the constraint accepts and the surrogate predicts to fail."""
        return (self._surrogate.predict(z)[0] < 0) & self._accepts(z)

    def estimate(self, samples: ImportanceSamples, confidence: float) -> ControlledMean:
        """Return the more precise of the two means of samples."""
        mean = samples.mean
        low, high = samples.interval(confidence)
        alone = ControlledMean(mean.mean, mean.cv, low, high)
        if not self.mean or samples.without.any() or not low:
            return alone
        seen = self.sees(samples.points)
        weights = 1 / samples.proposal.ratio(samples.points)
        gap = weights * (samples.failing.astype(float) - seen)
        # As if it were wrong once more in either direction: it is, somewhere.
        unseen = 2 * float(np.mean(weights[samples.failing] ** 2))
        value = self.mean + float(gap.mean())
        if value <= 0:
            return alone
        spread = np.sqrt(len(gap) * float(gap.var()) + unseen) / len(gap)
        share, error = samples.acceptance
        cv = float(np.hypot(np.hypot(spread, self.error) / value, error))
        freedom = int(np.sum(samples.failing != seen)) + UNSEEN
        reach = student_quantile(confidence, freedom) * cv
        widened = 1 + samples.unresolved
        low = value / share * max(1 - reach, np.exp(-1.5 * reach)) / widened
        high = value / share * (1 + reach) * widened
        if high / low > alone.high / alone.low:
            return alone
        return ControlledMean(value / share, cv, low, high, True)
