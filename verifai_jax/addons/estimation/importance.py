"""Importance sampling: a proposal is fitted to failures, then frozen and sampled.

    fitted = fit_proposal(limit_state, rng, points, chain_ids, simulations=30_000)
    samples = sample_proposal(limit_state, rng, fitted.proposal, limit_state.left)
    samples.mean, samples.interval(0.95)

The proposal is fitted to the last failures of a splitting run, then to failures among its own
samples (the cross-entropy method). Only samples drawn later, from the frozen proposal, enter the
estimate, so it is unbiased for any fit.

Source: Rubinstein and Kroese, The cross-entropy method (2004), chapter 3; Owen and Zhou, Safe and
effective importance sampling, JASA 95 (2000).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation.anchors import CHAINS_WORTH, Anchors, WeightedFailures
from verifai_jax.addons.estimation.components import log_ratios
from verifai_jax.addons.estimation.fitting import effective_size, weigh_together
from verifai_jax.addons.estimation.intervals import (
    WeightedMean,
    skewed_interval,
    tail_index,
    weighted_mean,
)
from verifai_jax.addons.estimation.mixture import Mixture, fit_mixture, optimal_shares
from verifai_jax.addons.estimation.monte_carlo import Counts
from verifai_jax.addons.estimation.normal_space import Ended, LimitState, Scores

SHARE_OF_STAGE = 0.1
"""Share of the simulations for each stage that improves the proposal before it is frozen."""
MAX_STAGES = 5
"""Stages that improve the proposal, at most."""
KEPT = 0.25
"""Share of the previous proposal in the next one, so that no stage can spoil it."""
ANCHORED = 0.1
"""Share of the anchors in a proposal, so that no stage forgets a region that a search has found."""
MIN_REGION = 1e-3
"""Part of the failures as which a region counts at least, where shares are given out."""
ENOUGH = 2500
"""Effective failures beyond which a further stage is not worth its simulations."""
STEADY = 0.5
"""Tail index below which the weights have a finite variance, and more need not be fitted."""
DEFENSIVE = 0.1
"""Share of the prior in a proposal, which bounds the importance weights."""
OUTERMOST = 5.54
"""Standard deviations that a normal feature reaches."""
HIDDEN = 3.0
"""Failures that may hide beyond the outermost value, per weighted failure observed there."""
LIGHT, SLOPE = 0.2, 0.8
"""Tail index up to which intervals cover unchanged, and the measured widening beyond it."""
AT_ONCE = 8
"""Batches in one call: all of an unfinished call is lost when time ends."""


@dataclass(frozen=True)
class ImportanceSamples:
    """Fresh samples of the frozen proposal.

    - `x`: prior density over proposal density at failures, zero elsewhere.
    - `without`: the same at simulations without a verdict, zero elsewhere.
    - `edge`: weight that may lie beyond the outermost values of a domain, where nothing is
      simulated.
    - `origin`: the component of the proposal that each sample came from; 0 is the prior.
    - `failing`: True where a simulation breaks a formula.
    - `points`: the points of the samples.
    - `failures`: the points among them that fail.
    - `keys`: numbers of the random keys of these failures.
    - `proposal`: the mixture that was sampled.
    - `coarse`: relative error from single precision near the ends of a coordinate.
    - `acceptance`: share of the prior that the constraint accepts, and its relative error.
    - `simulations`: number of simulations that these samples took.
    """

    x: Float[np.ndarray, " n"]
    without: Float[np.ndarray, " n"]
    edge: Float[np.ndarray, " n"]
    origin: Int[np.ndarray, " n"]
    failing: Bool[np.ndarray, " n"]
    points: Float[np.ndarray, "n d"]
    failures: Float[np.ndarray, "failures d"]
    keys: Int[np.ndarray, " failures"]
    proposal: Mixture
    coarse: float
    acceptance: tuple[float, float]
    simulations: int

    @property
    def mean(self) -> WeightedMean:
        """Failure probability, its relative error, and the tail of the weights."""
        mean = weighted_mean(self.x)
        cv = float(np.hypot(mean.cv, self.acceptance[1]))
        return mean._replace(mean=mean.mean / self.acceptance[0], cv=cv)

    @property
    def unresolved(self) -> float:
        """Relative error from failures that single precision and outermost values may hide."""
        total = float(self.x.sum())
        return min(self.coarse + float(self.edge.sum()) / total, 1.0) if total > 0 else 0.0

    def interval(self, confidence: float) -> tuple[float, float]:
        """Return the interval; its upper end counts a missing verdict as a failure."""
        share, error = self.acceptance
        low, high = self._widened(self.x, confidence)
        if self.without.any():
            high = self._widened(self.x + self.without, confidence)[1]
        widened = float(np.exp(2 * error)) * (1 + self.unresolved)
        return low / share / widened, min(high / share * widened, 1.0)

    def join(self, other: "ImportanceSamples") -> "ImportanceSamples":
        """Return these samples joined with further ones of the same proposal."""
        rows = ("x", "without", "edge", "origin", "failing", "points", "failures", "keys")
        both = {n: np.concatenate([getattr(self, n), getattr(other, n)]) for n in rows}
        coarse, simulations = (max(self.coarse, other.coarse), self.simulations + other.simulations)
        return replace(self, **both, coarse=coarse, simulations=simulations)

    def _widened(self, x: Float[np.ndarray, " n"], confidence: float) -> tuple[float, float]:
        """Widen the interval where a heavy tail hides a part of the variance of the samples."""
        mean = weighted_mean(x)
        factor = widening(mean.tail)
        low, high = skewed_interval(x, confidence)
        low = max(mean.mean - factor * (mean.mean - low), low / factor**2)
        return low, mean.mean + factor * (high - mean.mean)

    @property
    def counts(self) -> Counts:
        """Counts of these samples, if the proposal is the prior."""
        missing = int(np.count_nonzero(self.without))
        return Counts(self.simulations, int(self.failing.sum()), missing)

    @property
    def defensive_counts(self) -> tuple[int, int]:
        """Counts of failures and samples in the defensive part of the proposal."""
        own = self.origin == 0
        return int(self.failing[own].sum()), int(own.sum())


@dataclass(frozen=True)
class FittedProposal:
    """A proposal, and the quality predicted by its last samples.

    - `proposal`: the fitted mixture.
    - `effective`: effective failures per simulation.
    - `tail`: tail index of their weights.
    - `probability`: the probability of a failure, estimated from these samples.
    """

    proposal: Mixture
    effective: float
    tail: float
    probability: float = 0.0

    def promise(self, simulations: int) -> float:
        """Return the effective failures expected from `samples`, fewer for a heavy tail."""
        return self.effective * simulations / widening(self.tail) ** 2


def fit_proposal(
    limit_state: LimitState,
    rng: np.random.Generator,
    points: Float[np.ndarray, "n d"],
    chain_ids: Int[np.ndarray, " n"],
    simulations: int,
    initial: Mixture | None = None,
    anchors: Anchors | None = None,
    defensive: float = DEFENSIVE,
) -> FittedProposal:
    """Fit a proposal to failures, and improve it with its own samples.

    **Arguments:**
    - `points`: failures `[n, d]`, distributed approximately as under the prior.
    - `chain_ids`: the splitting chain `[n]` that each failure comes from.
    - `simulations`: number of simulations left, of which each stage takes a share.
    - `initial`: proposal of the first stage; fitted to the failures when left out.
    - `anchors`: regions whose components keep a share of every proposal.
    - `defensive`: share of the prior in the proposal.
    """
    proposal = initial or fit_mixture(points, np.ones(len(points)), chain_ids, rng, defensive)
    mixture, anchored = proposal, None if anchors is None else anchors.fit()
    size = max(1, int(SHARE_OF_STAGE * simulations))
    proposals, zs, failing = [], [], []
    effective, tail, before, left, probability = 0.0, np.inf, 0.0, simulations, 0.0
    for stage in range(MAX_STAGES):
        z, _, scores, ratio, _ = draw(limit_state, rng, proposal, size)
        left -= size
        proposals.append(proposal)
        zs.append(z)
        failing.append(scores.failing)
        w = 1 / ratio[scores.failing]
        if len(w) < 10:
            continue
        effective, tail = effective_size(w) / len(z), tail_index(w)
        probability = float(w.sum()) / len(z)
        # All stages together are samples of the mean of their proposals.
        new = np.concatenate([z[f] for z, f in zip(zs, failing, strict=True)])
        counts = np.array([len(z) for z in zs], float)
        density = np.stack([p.ratio(new) for p in proposals], axis=1) @ (counts / counts.sum())
        # Failures of the splitting and of the stages stand for the same distribution.
        inverse = 1 / density
        worth = CHAINS_WORTH * len(np.unique(chain_ids))
        weight = weigh_together(len(points), worth, inverse)
        all_ids = np.append(chain_ids, chain_ids.max() + 1 + np.arange(len(new)))
        # The shares are those that were best for failures to which the last fit was not fitted.
        before_it = mixture
        mixture = fit_mixture(np.concatenate([points, new]), weight, all_ids, rng, defensive)
        proposal = mixture
        if anchors is not None and anchored is not None:
            shares = _share_out(before_it, anchored, anchors, z[scores.failing], w, defensive)
            anchored = anchors.fit(WeightedFailures(new, inverse))
            best = anchored.with_shares(shares)
            proposal = mixture.join(best, float(shares.sum())).join(anchored, ANCHORED)
        proposal = proposal.join(proposals[-1], KEPT)
        if stage and tail < STEADY and (effective * left > ENOUGH or effective * left < before):
            break
        before = effective * left
    return FittedProposal(proposal, effective, tail, probability)


def widening(tail: float) -> float:
    """Return the factor by which a heavy tail widens an interval."""
    return 1 + SLOPE * float(np.clip(tail - LIGHT, 0.0, 1.0))


def _share_out(
    mixture: Mixture, anchored: Mixture, anchors: Anchors, z: Float[np.ndarray, "n d"],
    weight: Float[np.ndarray, " n"], defensive: float,
) -> Float[np.ndarray, " k"]:  # fmt: skip
    """Return the best share of each component of the anchors next to a mixture; the sum is <= 1.

    The best ones for the whole would leave an improbable region without samples, and its own
    probability unknown. So failures `z` are weighed by one over the probability of their region,
    which gives it samples by the root of its probability.
    """
    owner = anchors.owners(z)
    mass = np.bincount(owner, weight)
    balanced = weight / np.maximum(mass, MIN_REGION * mass.sum())[owner]
    table = np.exp(log_ratios(anchored.components[1:], z))
    others = mixture.fitted_ratio(z) / (1 - mixture.shares[0])
    shares = optimal_shares(np.column_stack([others, table]), balanced / balanced.sum(), defensive)
    return shares[1:]


def sample_proposal(
    limit_state: LimitState, rng: np.random.Generator, proposal: Mixture, simulations: int,
    clamped: Bool[np.ndarray, " d"] | None = None,
) -> ImportanceSamples:  # fmt: skip
    """Simulate fresh samples of a frozen proposal.

    **Arguments:**
    - `simulations`: approximate number of samples; fewer if the time ends.
    - `clamped`: True at coordinates `[d]` whose domain has an outermost value.
    """
    started = limit_state.simulations
    acceptance = limit_state.acceptance(rng)
    z, origin, scores, ratio, numbers = draw(limit_state, rng, proposal, simulations)
    inverse = 1 / ratio
    x = np.where(scores.failing, inverse, 0.0)
    without = np.where(scores.proper, 0.0, inverse)
    clamped = np.zeros(limit_state.dim, bool) if clamped is None else clamped
    outside = np.any((np.abs(z) > OUTERMOST) & clamped, axis=1)
    edge = np.where(outside, HIDDEN * x, 0.0)
    return ImportanceSamples(
        x, without, edge, origin, scores.failing, z, z[scores.failing], numbers[scores.failing],
        proposal, _coarse(z, x), acceptance, limit_state.simulations - started,
    )  # fmt: skip


def draw(
    limit_state: LimitState, rng: np.random.Generator, proposal: Mixture, n: int
) -> tuple[np.ndarray, np.ndarray, Scores, np.ndarray, np.ndarray]:
    """Draw about `n` points of the proposal and simulate those that the constraint accepts.

    **Returns:** points, components, scores, densities over the prior's, and numbers of random keys;
    fewer if the time ends.
    """
    if limit_state.constraint is not None and n:
        share = max(float(np.mean(limit_state.accepts(proposal.sample(rng, 4096)[0]))), 0.01)
        # A little less, so that the budget is hardly ever what decides how many are drawn.
        n = max(1, int(n / share * (1 - 3 * np.sqrt((1 - share) / max(n, 1)))))
    z, origin = proposal.sample(rng, n)
    accepted = np.flatnonzero(limit_state.accepts(z))[: limit_state.left]
    scores = Scores(np.full(n, np.inf), np.zeros(n, bool), np.ones(n, bool))
    numbers = np.zeros(n, int)
    size, done = limit_state.batch * AT_ONCE, 0
    try:
        for start in range(0, len(accepted), size):
            rows = accepted[start : start + size]
            numbers[rows] = limit_state.evaluated + np.arange(len(rows))
            for column, values in zip(scores, limit_state(z[rows]), strict=True):
                column[rows] = values
            done += len(rows)
    except Ended:
        n = int(accepted[done]) if done < len(accepted) else n
    scores = Scores(*(column[:n] for column in scores))
    return z[:n], origin[:n], scores, proposal.ratio(z[:n]), numbers[:n]


def _coarse(z: Float[np.ndarray, "n d"], x: Float[np.ndarray, " n"]) -> float:
    """Bound the share of a tail at the upper end of a coordinate that float32 can miss."""
    from scipy.special import ndtr

    total = float(x.sum())
    if not total > 0:
        return 0.0
    beyond = (x[x > 0] / total) @ ndtr(-z[x > 0])
    # Half a step of 2^-24, of a tail that is about twice as long as its mean.
    return float(np.max(2.0**-25 / (2 * beyond), initial=0.0, where=beyond < 1e-4))
