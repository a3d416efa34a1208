"""Rare failures of slow simulators: a surrogate proposes, and simulations decide.

    answer = estimate_by_surrogate(limit_state, rng, plan)

A Gaussian process on the robustness learns where the border of the failures is, from simulations
that are chosen where its sign is least sure. A proposal is fitted to the failures of the surrogate,
at which no simulation is spent. The estimate is made of fresh samples of that proposal alone, all
of them simulated and weighted: it is unbiased whatever the surrogate is worth, and so is the
interval, which is wide where the surrogate is worth little.

Sources: Echard, Gayton, Lemaire, AK-MCS, Structural Safety 33 (2011), for the choice of
simulations; Dubourg, Sudret, Deheeger, Metamodel-based importance sampling for structural
reliability analysis, Probabilistic Engineering Mechanics 33 (2013), for the rest.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from verifai_jax.core.programs import power_of_two
from verifai_jax.core.text import format_percent
from verifai_jax.estimation import importance
from verifai_jax.estimation.answers import (
    WORST_TAIL,
    Answer,
    Cheap,
    Plan,
    bound_answer,
    bound_from_pilot,
)
from verifai_jax.estimation.components import Prior
from verifai_jax.estimation.fitting import effective_size
from verifai_jax.estimation.importance import ImportanceSamples
from verifai_jax.estimation.intervals import student_quantile
from verifai_jax.estimation.mixture import Mixture
from verifai_jax.estimation.monte_carlo import Counts
from verifai_jax.estimation.normal_space import Ended, LimitState, to_unit_cube
from verifai_jax.estimation.splitting import SplittingRun, run_splitting
from verifai_jax.search.gaussian_process import GaussianProcess, Hyper, Posterior, TrainingData

FAR = 3.5
"""Distance from the shell of the prior's samples, in standard deviations, of the outermost points
of the first design: failures down to 1e-6 lie within."""
REACH = 16.0
"""Width of the box of normal space that is the cube of the Gaussian process."""
CAPACITY = 512
"""Simulations that the surrogate knows at most, which bounds its arithmetic."""
LEARNING, MAX_LEARNING = 0.5, 400
"""Share of the budget that is spent on learning, and simulations at most; the rest is the
estimate."""
ROUNDS, ROUNDS_BY_CHEAP = 10, 25
"""Rounds of learning, and those with a cheap model, which often needs few."""
CAUTION, MARGIN = 2.0, 0.5
"""Standard deviations by which a point may be off and still count as failing, while learning and
while the proposal is fitted."""
SCALES = np.array([1.0, 1.4, 1.8, 2.4, 3.2])
WIDENED, ENOUGH = 8000, 100
"""Samples of the prior widened by these factors, and the number of independent failures of the
surrogate among them that makes splitting superfluous."""
SETTLED = 0.01
"""Expected share of the surrogate's failures that are none, or are missed, at which it is good, and
all learning is spent on looking for others."""
SETTLED_BY_CHEAP = 0.05
"""The same with a cheap model, at which learning ends."""
EXPLORED = 3
"""One of so many simulations of a round goes where the surrogate knows least, whatever it says
there: it is wrong about failures that its points gave no hint of."""
CHUNK = 256
"""Points that the surrogate predicts in one call, so that one shape compiles."""
PER_LEVEL, CHAINS = 800, 200
"""States and chains of a level of splitting on the surrogate."""
FITTING = 16_000
"""Evaluations of the surrogate by which the proposal is fitted."""
STEPS = 30
"""Steps of a fit of hyper-parameters, which goes on from the last one."""
FIRST_LOOK = 0.3
"""Share of the final samples after which it is asked whether the proposal meets failures at all."""
MIN_FAILING = 10
"""Failures among these below which the proposal is given up: their weights say too little."""
UNDERSTATED = 1.2
"""Factor on the logarithms of the interval: samples of a proposal that was fitted to a model of the
failures seldom show the weights beyond its edges."""
CONTROL = 8000
"""Samples of the proposal by which it is known how often the surrogate sees a failure."""
UNSEEN = 8.0
"""Degrees of freedom of an interval without a wrong verdict of the surrogate."""
LOOKS, FIRST_SIZE = 6, 30
"""Looks at the interval, where it decides when to stop, and samples before the first one."""
CAUTIOUS = 1.15
"""Factor on the samples that the width of an interval asks for."""
MIN_LOOK = 60
"""Samples at least of a proposal that is given up."""


class Surrogate:
    """A Gaussian process on the robustness over normal space.

    With a cheap model of the same features it is a process on what a multiple of the cheap
    robustness leaves over (Kennedy, O'Hagan, Predicting the output from a complex computer code
    when fast approximations are available, Biometrika 87, 2000). A cheap model of no use has the
    multiple zero.

    **Arguments:**

    - `dim`: number of coordinates.
    - `cheap`: the robustness of the cheap model at points of the unit cube; none when left out.
    """

    def __init__(self, dim: int, cheap: Cheap | None = None) -> None:
        self.process = GaussianProcess((False,) * dim)
        self.hyper, self.scale = self.process.first(), 1.0
        self.posterior: Posterior | None = None
        self.cheap, self.cheap_unit = cheap, 0.0
        self.trend = np.zeros(2)
        """Constant, and multiple of the cheap robustness."""

    def learn(self, z: Float[np.ndarray, "n d"], rho: Float[np.ndarray, " n"]) -> None:
        """Learn the robustness of all points so far; the last ones count if they are too many."""
        z, rho = z[-CAPACITY:], rho[-CAPACITY:]
        # Linear near zero, where the sign is, and logarithmic where it is far away.
        y = np.arcsinh(rho / max(float(np.median(np.abs(rho))), 1e-30))
        basis = self._basis(z)
        self.trend = np.linalg.lstsq(basis, y, rcond=None)[0]
        y = y - basis @ self.trend
        self.scale = max(float(y.std()), 1e-6)
        size = max(128, power_of_two(len(z)))
        pad = size - len(z)
        x: Any = np.pad(_boxed(z), ((0, pad), (0, 0)))
        targets: Any = np.pad(y / self.scale, (0, pad)).astype(np.float32)
        mask: Any = np.arange(size) < len(z)
        data = TrainingData(x, targets, mask)
        self.hyper, self.posterior = _fitted(self.process, self.hyper, data)

    def predict(
        self, z: Float[np.ndarray, "n d"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return means and standard deviations, in units in which a failure is below zero."""
        parts = []
        for start in range(0, len(z), CHUNK):
            part = _boxed(z[start : start + CHUNK])
            padded = np.pad(part, ((0, CHUNK - len(part)), (0, 0)))
            mean, std = _predicted(self.process, self.posterior, padded)
            parts.append((np.asarray(mean)[: len(part)], np.asarray(std)[: len(part)]))
        mean, std = (np.concatenate(column) for column in zip(*parts, strict=True))
        return mean + self._basis(z) @ self.trend / self.scale, std.astype(float)

    def _basis(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n 2"]:
        if self.cheap is None:
            return np.column_stack([np.ones(len(z)), np.zeros(len(z))])
        rho = self.cheap(to_unit_cube(z))
        known = np.isfinite(rho)
        rho = np.where(known, rho, np.max(rho, where=known, initial=0.0))
        self.cheap_unit = self.cheap_unit or max(float(np.median(np.abs(rho))), 1e-30)
        return np.column_stack([np.ones(len(z)), np.arcsinh(rho / self.cheap_unit)])

    def covariance(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n n"]:
        """Return the covariance of the values at points."""
        return np.asarray(_covariance(self.process, self.posterior, _boxed(z)), float)


def _boxed(z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    return np.asarray(0.5 + z / REACH, np.float32)


@partial(jax.jit, static_argnums=0)
def _fitted(process: GaussianProcess, hyper: Hyper, data: TrainingData) -> tuple[Hyper, Posterior]:
    hyper = process.fit(hyper, data, STEPS)
    return hyper, process.condition(hyper, data)


@partial(jax.jit, static_argnums=0)
def _predicted(process: GaussianProcess, posterior: Posterior, x: Array) -> tuple[Array, Array]:
    return process.predict(posterior, x)


@partial(jax.jit, static_argnums=0)
def _covariance(process: GaussianProcess, posterior: Posterior, x: Array) -> Array:
    cross = process.cross(posterior, x)
    left = jax.scipy.linalg.solve_triangular(posterior.factor, cross.T, lower=True)
    return process.covariance(posterior.hyper, x, x) - left.T @ left


def estimate_by_surrogate(limit_state: LimitState, rng: np.random.Generator, plan: Plan) -> Answer:
    """Estimate with few simulations: half of them learn, the others are the estimate.

    With a cheap model fewer learn, since it knows where failures may be.
    """
    limit_state.rows = []
    surrogate = Surrogate(limit_state.dim, plan.cheap)
    counts = Counts(0, 0, 0)
    try:
        counts = _first_design(limit_state, rng)
        _learn(limit_state, rng, surrogate)
        proposal = _proposal(limit_state, rng, surrogate)
        control = _Control(limit_state, rng, surrogate, proposal)
        samples, mean = _sample(limit_state, rng, proposal, plan, control)
    except Ended:
        return bound_from_pilot(limit_state, plan)
    return _answer(limit_state, rng, plan, counts, samples, control, mean)


def _first_design(limit_state: LimitState, rng: np.random.Generator) -> Counts:
    """Simulate samples of the prior, and as many points spread around them."""
    d = limit_state.dim
    count = max(6, min(6 + 2 * d, limit_state.left // 10))
    prior = limit_state(limit_state.sample_prior(rng, count))
    counts = Counts(count, int(prior.failing.sum()), int((~prior.proper).sum()))
    limit_state.pilot = (counts.simulations, counts.failures, counts.no_verdict)
    limit_state(_spread(limit_state, rng, 4 * count)[:count])
    return counts


def _spread(limit_state: LimitState, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
    """Return points of a ball that holds the prior's samples and whatever fails not too rarely."""
    direction = rng.standard_normal((n, limit_state.dim))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    z = direction * (np.sqrt(limit_state.dim) + FAR) * np.sqrt(rng.random((n, 1)))
    return z[limit_state.accepts(z)]


def _known(limit_state: LimitState) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
    """Return all simulated points that have a verdict, and their robustness."""
    assert limit_state.rows is not None
    z = np.concatenate([rows[0] for rows in limit_state.rows])
    rho = np.concatenate([rows[1] for rows in limit_state.rows])
    known = np.isfinite(rho)
    return z[known], rho[known]


def _learn(limit_state: LimitState, rng: np.random.Generator, surrogate: Surrogate) -> None:
    """Simulate where the surrogate is least sure of the sign, and where it knows least at all."""
    from scipy.special import ndtr

    learning = min(LEARNING * limit_state.budget, MAX_LEARNING)
    until = limit_state.budget - learning
    rounds = ROUNDS if surrogate.cheap is None else ROUNDS_BY_CHEAP
    size = max(1, int(learning / rounds))
    while True:
        z, rho = _known(limit_state)
        if len(z) > 1:
            surrogate.learn(z, rho)
        if limit_state.left <= until or len(z) < 2:
            return
        size = min(size, int(limit_state.left - until) + 1)
        anywhere = _spread(limit_state, rng, CHUNK)
        unknown = _in_doubt(np.zeros(len(anywhere)), surrogate.covariance(anywhere), size)
        population, _ = _failures_of(limit_state, rng, surrogate, CAUTION)
        if not len(population):
            population = limit_state.sample_prior(rng, PER_LEVEL)
        mean, std = surrogate.predict(population)
        wrong = ndtr(-np.abs(mean) / std)
        doubt = float(wrong.sum() / max(np.sum(mean < 0), 1.0))
        if surrogate.cheap is not None and doubt < SETTLED_BY_CHEAP:
            return
        population, explored = population[:CHUNK], size if doubt < SETTLED else size // EXPLORED
        covariance = surrogate.covariance(population)
        chosen = _in_doubt(mean[:CHUNK], covariance, size - explored)
        limit_state(np.concatenate([population[chosen], anywhere[unknown[:explored]]]))


def _in_doubt(
    mean: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "n n"], count: int
) -> list[int]:
    """Choose points whose sign is least sure, each once those before it are known.

    Where all means are zero, these are the points whose value is least known.
    """
    chosen: list[int] = []
    noise = 1e-4 * float(np.max(np.diag(covariance)))
    for _ in range(min(count, len(mean))):
        std = np.sqrt(np.maximum(np.diag(covariance), 1e-12))
        sure = np.abs(mean) / std if mean.any() else -std
        sure[chosen] = np.inf
        best = int(sure.argmin())
        chosen.append(best)
        column = covariance[:, best]
        covariance = covariance - np.outer(column, column) / (column[best] + noise)
    return chosen


def _state_of(limit_state: LimitState, surrogate: Surrogate, caution: float) -> LimitState:
    """Return the surrogate as a limit state, at which nothing is simulated."""
    from scipy.special import ndtri

    def evaluate(
        u: Float[np.ndarray, "n d"],
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        z = ndtri(np.clip(u, 1e-300, 1 - 1e-16))
        mean, std = surrogate.predict(z)
        rho = mean - caution * std
        return rho, rho < 0, np.ones(len(rho), bool)

    constraint = limit_state.constraint
    budget, rest = 100 * FITTING, limit_state.rest
    return LimitState(evaluate, limit_state.dim, budget, 4 * CHUNK, constraint, rest=rest)


def _failures_of(
    limit_state: LimitState, rng: np.random.Generator, surrogate: Surrogate, caution: float
) -> tuple[Float[np.ndarray, "n d"], Int[np.ndarray, " n"]]:
    """Return failures of the surrogate, distributed about as the prior's, and their chains.

    Samples of the widened prior have no slope to follow, which may mislead; where they are too few,
    splitting finds more.
    """
    state = _state_of(limit_state, surrogate, caution)
    scale = np.repeat(SCALES, WIDENED // len(SCALES))[:, None]
    z = rng.standard_normal((len(scale), limit_state.dim)) * scale
    z = z[limit_state.accepts(z)]
    z = z[state(z).failing]
    square = np.sum(z**2, axis=1, keepdims=True) / 2
    density = square * (1 - SCALES**-2.0) - limit_state.dim * np.log(SCALES)
    weight = 1 / np.mean(np.exp(density), axis=1)
    effective = effective_size(weight) if len(z) else 0.0
    rows = np.zeros(0, int)
    if len(z):
        rows = rng.choice(len(z), PER_LEVEL, p=weight / weight.sum())
    points, chain_ids = z[rows], rows
    if effective < ENOUGH:
        run = run_splitting(state, rng, PER_LEVEL, CHAINS)
        if len(run.points):
            points = np.concatenate([points, run.points])
            chain_ids = np.concatenate([chain_ids, len(z) + run.chain_ids])
    order = rng.permutation(len(points))[:PER_LEVEL]
    return points[order], chain_ids[order]


def _proposal(limit_state: LimitState, rng: np.random.Generator, surrogate: Surrogate) -> Mixture:
    """Fit a proposal to the failures of the surrogate; the prior if it has none."""
    if surrogate.posterior is not None:
        points, chain_ids = _failures_of(limit_state, rng, surrogate, MARGIN)
        if len(points) >= MIN_FAILING:
            state = _state_of(limit_state, surrogate, MARGIN)
            return importance.fit_proposal(state, rng, points, chain_ids, FITTING).proposal
    return Mixture((Prior(limit_state.dim),), np.ones(1))


class _Mean(NamedTuple):
    """A mean with its relative error and its interval, and whether the surrogate is part of it."""

    value: float
    cv: float
    low: float
    high: float
    controlled: bool = False


class _Control:
    """The surrogate as a control variate of the samples of a proposal.

    How often it sees a failure is known from samples that cost nothing; what simulations have to
    tell is how often it is wrong. Where that is too often, they are taken by themselves.
    """

    def __init__(
        self,
        limit_state: LimitState,
        rng: np.random.Generator,
        surrogate: Surrogate,
        proposal: Mixture,
    ) -> None:
        self.surrogate = surrogate
        self.mean = self.error = 0.0
        if surrogate.posterior is not None:
            z = proposal.sample(rng, CONTROL)[0]
            fails = (surrogate.predict(z)[0] < 0) & limit_state.accepts(z)
            weights = np.where(fails, 1 / proposal.ratio(z), 0.0)
            self.mean, self.error = float(weights.mean()), float(weights.std() / len(z) ** 0.5)

    def estimate(self, samples: ImportanceSamples, confidence: float) -> _Mean:
        """Return the better one of the two means of samples."""
        mean = samples.mean
        low, high = samples.interval(confidence)
        alone = _Mean(mean.mean, mean.cv, low, high)
        if not self.mean or samples.without.any() or not low:
            return alone
        seen = self.surrogate.predict(samples.points)[0] < 0
        weights = 1 / samples.proposal.ratio(samples.points)
        gap = weights * (samples.failing.astype(float) - seen)
        # As if it were wrong once more in either direction: it is, somewhere.
        unseen = 2 * float(np.mean(weights[samples.failing] ** 2))
        value = self.mean + float(gap.mean())
        spread = np.sqrt(len(gap) * float(gap.var()) + unseen) / len(gap)
        share, error = samples.acceptance
        cv = float(np.hypot(np.hypot(spread, self.error) / max(value, 1e-300), error))
        freedom = int(np.sum(samples.failing != seen)) + UNSEEN
        reach = student_quantile(confidence, freedom) * cv
        widened = 1 + samples.unresolved
        low = value / share * max(1 - reach, np.exp(-1.5 * reach)) / widened
        high = value / share * (1 + reach) * widened
        if value <= 0 or high / low > alone.high / alone.low:
            return alone
        return _Mean(value / share, cv, low, high, True)


def _sample(
    limit_state: LimitState,
    rng: np.random.Generator,
    proposal: Mixture,
    plan: Plan,
    control: _Control,
) -> tuple[ImportanceSamples, _Mean]:
    """Simulate fresh samples until the interval is as short as wanted, or the budget is spent.

    Nearly no failures among the first ones end it, too: the rest is worth more elsewhere.
    """
    left, confidence = max(limit_state.left, 1), plan.confidence
    looks, size = 2, max(1, round(FIRST_LOOK * left))
    if plan.within is not None:
        # Each look has an equal part of the error, so that their intervals hold together.
        looks, size, confidence = LOOKS, FIRST_SIZE, 1 - (1 - confidence) / LOOKS
    found: ImportanceSamples | None = None
    mean = _Mean(0.0, np.inf, 0.0, 1.0)
    for look in range(looks):
        size = limit_state.left if look == looks - 1 else min(size, limit_state.left)
        if found is not None and size < 1:
            break
        new = importance.sample_proposal(limit_state, rng, proposal, max(size, 1), plan.clamped)
        found = new if found is None else found.join(new)
        mean = control.estimate(found, confidence)
        few = found.failing.sum() < MIN_FAILING
        if limit_state.ended or (few and len(found.x) >= min(MIN_LOOK, FIRST_LOOK * left)):
            break
        if plan.within is not None:
            width = np.log(mean.high / mean.low) / np.log(plan.within) / 2 if mean.low else np.inf
            width *= UNDERSTATED
            if width <= 1 and not few:
                break
            # The width falls with the root of the samples; this is how many are still needed.
            size = round(len(found.x) * min(CAUTIOUS * width**2 - 1, 1)) if not few else FIRST_SIZE
    assert found is not None
    return found, mean


def _answer(
    limit_state: LimitState,
    rng: np.random.Generator,
    plan: Plan,
    counts: Counts,
    samples: ImportanceSamples,
    control: _Control,
    mean: _Mean,
) -> Answer:
    failing, drawn = samples.defensive_counts
    # The defensive part of the proposal is a sample of the prior.
    counts = counts + Counts(drawn, failing, int(np.sum(samples.without[samples.origin == 0] > 0)))
    if samples.failing.sum() < MIN_FAILING:
        answer = bound_answer(limit_state, rng, plan, SplittingRun(stopped="stuck"), counts)
        answer.notes.append(
            f"the surrogate is worth nothing: of {len(samples.x):,} samples where it sees failures "
            f"{int(samples.failing.sum()):,} fail, so that samples of the prior are counted"
        )
        return answer
    weights, value = samples.mean, min(mean.value, 1.0)
    low, high = (value * (end / value) ** UNDERSTATED for end in (mean.low, mean.high))
    answer = Answer(counts, value, low, min(high, 1.0), "surrogate", weights.effective, mean.cv)
    seen = control.surrogate.predict(samples.points)[0] < 0
    right = float(np.mean(seen == samples.failing))
    worth = (1 - value) / (value * mean.cv**2)
    answer.samples = samples
    answer.diagnostics = {
        "tail_index": weights.tail,
        "largest_share": weights.largest,
        "failing_share": float(samples.failing.mean()),
        "agreement": right,
        "worth": worth,
        "components": len(samples.proposal.shares),
    }
    answer.drawn = {"weights": np.sort(samples.x[samples.failing])[::-1] / samples.x.sum()}
    answer.notes.append(
        f"the surrogate knew the verdict of {format_percent(right)} of {len(samples.x):,} samples "
        f"that it proposed; these are worth {worth:z,.0f} samples of the prior"
    )
    if weights.tail > WORST_TAIL and not mean.controlled:
        answer.notes.append(
            f"the weights have a heavy tail (index {weights.tail:z.2f}): "
            "the interval may be too narrow"
        )
    return answer
