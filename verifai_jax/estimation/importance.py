"""Importance sampling: a proposal fitted to failures, then fresh samples of it as it is.

    found = sample(judge, rng, points, family, simulations=30_000)
    found.interval(0.95); found.tail; found.effective

The proposal is fitted to the failures that a splitting run ended with, then once or twice to those
of samples of itself, which the cross-entropy method does. Only samples drawn after that, from the
frozen proposal, are in the estimate, which is therefore unbiased whatever the fit.

Source: Rubinstein and Kroese, The cross-entropy method (2004), chapter 3; Owen and Zhou, Safe and
effective importance sampling, JASA 95 (2000).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.estimation.bounds import Weighted, skewed_interval, weighted
from verifai_jax.estimation.judging import Ended, Judge
from verifai_jax.estimation.mixture import Mixture, fitted

STAGES = (0.12, 0.18)
"""Shares of the simulations that improve the proposal before it is frozen."""


@dataclass(frozen=True)
class Sampled:
    """Fresh samples of the frozen proposal.

    - `x`: `[n]`, prior density over proposal density at failures, zero elsewhere; `without`: the
      same at simulations without a verdict.
    - `origin`: the component that each came from, 0 the prior's.
    - `acceptance`: share of the prior that the constraint accepts, and its relative error.
    - `simulations`: in all, those for fitting included.
    """

    x: Float[np.ndarray, " n"]
    without: Float[np.ndarray, " n"]
    origin: Int[np.ndarray, " n"]
    failing: Bool[np.ndarray, " n"]
    proposal: Mixture
    acceptance: tuple[float, float]
    simulations: int

    @property
    def told(self) -> Weighted:
        """Estimate, relative error and diagnostics."""
        found = weighted(self.x)
        cv = float(np.hypot(found.cv, self.acceptance[1]))
        return found._replace(mean=found.mean / self.acceptance[0], cv=cv)

    def interval(self, confidence: float) -> tuple[float, float]:
        """Of the probability of failing; without verdict counts as failing at the upper end."""
        share, error = self.acceptance
        low, high = skewed_interval(self.x, confidence)
        if self.without.any():
            high = skewed_interval(self.x + self.without, confidence)[1]
        widened = np.exp(2 * error)
        return low / share / widened, min(high / share * widened, 1.0)

    @property
    def by_prior(self) -> tuple[int, int]:
        """Failures among the samples of the defensive part, and their number."""
        own = self.origin == 0
        return int(self.failing[own].sum()), int(own.sum())


def sample(
    judge: Judge,
    rng: np.random.Generator,
    points: Float[np.ndarray, "n d"],
    family: Int[np.ndarray, " n"],
    simulations: int,
    defensive: float = 0.1,
) -> Sampled:
    """Fit, improve, freeze and sample, with so many simulations in all.

    **Arguments:**

    - `points`, `family`: failures, about as the prior has them, and the chain each comes from.
    - `defensive`: share of the prior in the proposal.
    """
    started, budget = judge.simulations, simulations
    weight = np.ones(len(points))
    acceptance = judge.acceptance(rng)
    proposal = fitted(points, weight, family, rng, defensive)
    try:
        for share in STAGES:
            z, _, seen, ratio = _drawn(judge, rng, proposal, int(share * budget))
            if seen is None:
                break
            new, w = z[seen.failing], 1 / ratio[seen.failing]
            if len(new) < 10:
                continue
            # Old and new stand for the same distribution, each for as much as it is worth.
            worth = [weight.sum() ** 2 / np.sum(weight**2), w.sum() ** 2 / np.sum(w**2)]
            # Points of a chain are alike: they are worth less than they count.
            worth[0] /= 3 if family.max() + 1 < len(points) else 1
            weight = np.concatenate([weight / weight.sum() * worth[0], w / w.sum() * worth[1]])
            points = np.concatenate([points, new])
            family = np.concatenate([family, family.max() + 1 + np.arange(len(new))])
            proposal = fitted(points, weight, family, rng, defensive)
    except Ended:
        pass
    left = budget - (judge.simulations - started)
    z, origin, seen, ratio = _drawn(judge, rng, proposal, left)
    x, without, failing = np.zeros(len(z)), np.zeros(len(z)), np.zeros(len(z), bool)
    if seen is not None:
        failing = seen.failing
        x[failing] = 1 / ratio[failing]
        without[~seen.proper] = 1 / ratio[~seen.proper]
    return Sampled(
        x, without, origin, failing, proposal, acceptance, judge.simulations - started
    )


def _drawn(judge, rng, proposal, n):
    z, origin = proposal.sample(rng, n)
    return z, origin, judge(z), proposal.ratio(z)
