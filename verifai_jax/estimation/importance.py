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

from verifai_jax.estimation.intervals import Weighted, skewed_interval, tail_index, weighted
from verifai_jax.estimation.mixture import Mixture, fitted
from verifai_jax.estimation.normal_space import Ended, Judge, Seen

SHARE_OF_STAGE = 0.1
"""Of the simulations, for each stage that improves the proposal before it is frozen,"""
MOST_STAGES = 5
KEPT = 0.25
"""Share of the proposal before in the next one, so that no stage can spoil it."""
CHAINS_WORTH = 1.5
"""Failures that the states of a chain of the splitting stand for."""
ENOUGH = 2500
"""Effective failures, of which one stage more would not be worth its simulations."""
DEFENSIVE = 0.1
OUTERMOST = 5.54
"""Standard deviations that a normal feature reaches,"""
HIDDEN = 3.0
"""and how many times the failures seen beyond them may be hidden there."""
LIGHT, SLOPE = 0.2, 0.8
"""Tail index up to which intervals cover as they are, and how fast they widen beyond; measured."""
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
        low, high = self._widened(self.x, confidence)
        if self.without.any():
            high = self._widened(self.x + self.without, confidence)[1]
        widened = float(np.exp(2 * error)) * (1 + self.unresolved)
        return low / share / widened, min(high / share * widened, 1.0)

    def _widened(self, x: Float[np.ndarray, " n"], confidence: float) -> tuple[float, float]:
        """Heavy tails hide a part of the variance that samples show: wider by what they lack."""
        told = weighted(x)
        factor = 1 + SLOPE * float(np.clip(told.tail - LIGHT, 0.0, 1.0))
        low, high = skewed_interval(x, confidence)
        low = max(told.mean - factor * (told.mean - low), low / factor**2)
        return low, told.mean + factor * (high - told.mean)

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
    - `simulations`: in all that are left; each stage takes a share of them.
    - `defensive`: share of the prior in the proposal.
    """
    proposal = fitted(points, np.ones(len(points)), family, rng, defensive)
    size = max(1, int(SHARE_OF_STAGE * simulations))
    proposals, zs, failing = [], [], []
    effective, tail, before, left = 0.0, np.inf, 0.0, simulations
    for stage in range(MOST_STAGES):
        z, _, seen, ratio = _drawn(judge, rng, proposal, size)
        left -= size
        proposals.append(proposal)
        zs.append(z)
        failing.append(seen.failing)
        w = 1 / ratio[seen.failing]
        if len(w) < 10:
            continue
        effective, tail = _worth(w) / len(z), tail_index(w)
        # All stages together are samples of the mean of their proposals.
        new = np.concatenate([z[f] for z, f in zip(zs, failing, strict=True)])
        counts = np.array([len(z) for z in zs], float)
        density = np.stack([p.ratio(new) for p in proposals], axis=1) @ (counts / counts.sum())
        # Failures of the splitting and of the stages stand for the same distribution, each for as
        # much as they are worth; states of a chain are alike and worth less than they count.
        worth = np.array([CHAINS_WORTH * len(np.unique(family)), _worth(1 / density)])
        worth[0] *= worth[0] / (worth[0] + worth[1])
        inverse = 1 / density
        weight = np.concatenate(
            [np.full(len(points), worth[0] / len(points)), worth[1] * inverse / inverse.sum()]
        )
        families = np.append(family, family.max() + 1 + np.arange(len(new)))
        proposal = fitted(np.concatenate([points, new]), weight, families, rng, defensive)
        proposal = proposal.joined(proposals[-1], KEPT)
        if stage and (effective * left > ENOUGH or effective * left < before):
            break
        before = effective * left
    return Fit(proposal, effective, tail)


def _worth(weight: Float[np.ndarray, " n"]) -> float:
    """As many equally weighted samples."""
    return float(weight.sum() ** 2 / np.sum(weight * weight))


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
