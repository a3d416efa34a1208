"""Importance sampling: a proposal fitted to failures, then fresh samples of it as it is.

    made = fit(judge, rng, points, family, simulations=30_000)
    found = sample(judge, rng, made.proposal, judge.left)
    found.told, found.interval(0.95)

The proposal is fitted to the failures that a splitting run ended with, then to those of samples of
itself, which the cross-entropy method does. Only samples drawn after that, from the frozen
proposal, are in the estimate, which is therefore unbiased whatever the fit.

Source: Rubinstein and Kroese, The cross-entropy method (2004), chapter 3; Owen and Zhou, Safe and
effective importance sampling, JASA 95 (2000).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.estimation.bounds import Weighted, skewed_interval, tail_index, weighted
from verifai_jax.estimation.judging import Ended, Judge, Seen
from verifai_jax.estimation.mixture import Mixture, fitted

STAGES = (0.12, 0.18)
"""Shares of the simulations that improve the proposal before it is frozen."""
DEFENSIVE = 0.1
OUTERMOST = 5.54
"""Standard deviations that a normal feature reaches,"""
HIDDEN = 3.0
"""and how many times the failures seen beyond them may be hidden there."""
AT_ONCE = 8
"""Batches after which nothing of them is lost when time ends."""


@dataclass(frozen=True)
class Sampled:
    """Fresh samples of the frozen proposal.

    - `x`: `[n]`, prior density over proposal density at failures, zero elsewhere; `without`: the
      same at simulations without a verdict; `edge`: what may be
      hidden beyond the outermost values of a domain, where a simulation cannot see.
    - `origin`: the component that each came from, 0 the prior's.
    - `coarse`: relative error of single precision at the end of a coordinate.
    - `acceptance`: share of the prior that the constraint accepts, and its relative error.
    - `simulations`: of these samples.
    """

    x: Float[np.ndarray, " n"]
    without: Float[np.ndarray, " n"]
    edge: Float[np.ndarray, " n"]
    origin: Int[np.ndarray, " n"]
    failing: Bool[np.ndarray, " n"]
    proposal: Mixture
    coarse: float
    acceptance: tuple[float, float]
    simulations: int

    @property
    def told(self) -> Weighted:
        """Estimate, relative error and diagnostics."""
        found = weighted(self.x)
        cv = float(np.hypot(found.cv, self.acceptance[1]))
        return found._replace(mean=found.mean / self.acceptance[0], cv=cv)

    @property
    def unresolved(self) -> float:
        """Relative error by what single precision and outermost values hide."""
        total = float(self.x.sum())
        return min(self.coarse + float(self.edge.sum()) / total, 1.0) if total > 0 else 0.0

    def interval(self, confidence: float) -> tuple[float, float]:
        """Of the probability of failing; without verdict counts as failing at the upper end."""
        share, error = self.acceptance
        low, high = skewed_interval(self.x, confidence)
        if self.without.any():
            high = skewed_interval(self.x + self.without, confidence)[1]
        widened = float(np.exp(2 * error)) * (1 + self.unresolved)
        return low / share / widened, min(high / share * widened, 1.0)

    @property
    def by_prior(self) -> tuple[int, int]:
        """Failures among the samples of the defensive part, and their number."""
        own = self.origin == 0
        return int(self.failing[own].sum()), int(own.sum())


@dataclass(frozen=True)
class Fit:
    """A proposal, and what its last samples promise.

    - `effective`: effective failures for each simulation; `tail`: index of their weights.
    """

    proposal: Mixture
    effective: float
    tail: float


def fit(
    judge: Judge,
    rng: np.random.Generator,
    points: Float[np.ndarray, "n d"],
    family: Int[np.ndarray, " n"],
    simulations: int,
    defensive: float = DEFENSIVE,
) -> Fit:
    """A proposal for these failures, improved by samples of itself.

    **Arguments:**

    - `points`, `family`: failures, about as the prior has them, and the chain each comes from.
    - `simulations`: in all that are left; the stages take their shares of them.
    - `defensive`: share of the prior in the proposal.
    """
    weight, effective, tail = np.ones(len(points)), 0.0, np.inf
    proposal = fitted(points, weight, family, rng, defensive)
    for share in STAGES:
        z, _, seen, ratio = _drawn(judge, rng, proposal, int(share * simulations))
        new, w = z[seen.failing], 1 / ratio[seen.failing]
        if len(new) < 10:
            continue
        worth = [float(v.sum() ** 2 / np.sum(v * v)) for v in (weight, w)]
        effective, tail = worth[1] / len(z), tail_index(w)
        # Old and new stand for the same distribution, each for as much as it is worth; points of a
        # chain are alike and worth less than they count.
        worth[0] /= 3 if family.max() + 1 < len(points) else 1
        weight = np.concatenate([weight / weight.sum() * worth[0], w / w.sum() * worth[1]])
        points = np.concatenate([points, new])
        family = np.concatenate([family, family.max() + 1 + np.arange(len(new))])
        proposal = fitted(points, weight, family, rng, defensive)
    return Fit(proposal, effective, tail)


def sample(
    judge: Judge,
    rng: np.random.Generator,
    proposal: Mixture,
    simulations: int,
    clamped: Bool[np.ndarray, " d"] | None = None,
) -> Sampled:
    """So many fresh samples of a frozen proposal.

    **Arguments:**

    - `clamped`: coordinates whose domain ends in an outermost value.
    """
    started = judge.simulations
    acceptance = judge.acceptance(rng)
    z, origin, seen, ratio = _drawn(judge, rng, proposal, simulations)
    inverse = 1 / ratio
    x = np.where(seen.failing, inverse, 0.0)
    without = np.where(seen.proper, 0.0, inverse)
    clamped = np.zeros(judge.dim, bool) if clamped is None else clamped
    outside = np.any((np.abs(z) > OUTERMOST) & clamped, axis=1)
    edge = np.where(outside, HIDDEN * x, 0.0)
    return Sampled(
        x, without, edge, origin, seen.failing, proposal, _coarse(z, x), acceptance,
        judge.simulations - started,
    )  # fmt: skip


def _drawn(
    judge: Judge, rng: np.random.Generator, proposal: Mixture, n: int
) -> tuple[np.ndarray, np.ndarray, Seen, np.ndarray]:
    """About `n` simulated points of the proposal; what the constraint refuses is not simulated.

    Points, components, verdicts and densities over the prior's, fewer where time ends.
    """
    if judge.accepts_unit is not None and n:
        share = max(float(np.mean(judge.accepts(proposal.sample(rng, 4096)[0]))), 0.01)
        # A little less, so that the budget is hardly ever what decides how many are drawn.
        n = max(1, int(n / share * (1 - 3 * np.sqrt((1 - share) / max(n, 1)))))
    z, origin = proposal.sample(rng, n)
    accepted = np.flatnonzero(judge.accepts(z))[: judge.left]
    seen = Seen(np.full(n, np.inf), np.zeros(n, bool), np.ones(n, bool))
    size, done = judge.batch * AT_ONCE, 0
    try:
        for start in range(0, len(accepted), size):
            rows = accepted[start : start + size]
            for column, values in zip(seen, judge(z[rows]), strict=True):
                column[rows] = values
            done += len(rows)
    except Ended:
        n = int(accepted[done]) if done < len(accepted) else n
    seen = Seen(*(column[:n] for column in seen))
    return z[:n], origin[:n], seen, proposal.ratio(z[:n])


def _coarse(z: Float[np.ndarray, "n d"], x: Float[np.ndarray, " n"]) -> float:
    """How much of a tail at the upper end of a coordinate a float32 number can miss."""
    from scipy.special import ndtr

    total = float(x.sum())
    if not total > 0:
        return 0.0
    beyond = (x[x > 0] / total) @ ndtr(-z[x > 0])
    # Half a step of 2^-24, of a tail that is about twice as long as its mean.
    return float(np.max(2.0**-25 / (2 * beyond), initial=0.0, where=beyond < 1e-4))
