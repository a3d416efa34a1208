"""Rare failures of slow simulators: a surrogate proposes, and simulations decide.

    answer = estimate_by_surrogate(limit_state, rng, plan)

A Gaussian process models the robustness near the border of the failures, from simulations chosen
where its sign is least certain. A proposal is fitted to failures of the surrogate, without
simulations. The estimate uses only fresh samples of that proposal, all simulated and weighted, with
the surrogate as a control variate if that shortens the interval. It is unbiased for any surrogate;
a poor surrogate only widens the interval.

Sources: Echard, Gayton, Lemaire, AK-MCS, Structural Safety 33 (2011), for the choice of
simulations; Dubourg, Sudret, Deheeger, Metamodel-based importance sampling for structural
reliability analysis, Probabilistic Engineering Mechanics 33 (2013), for the rest.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation import importance
from verifai_jax.addons.estimation.answers import (
    WORST_TAIL,
    Answer,
    Plan,
    bound_answer,
    bound_from_pilot,
)
from verifai_jax.addons.estimation.components import Prior
from verifai_jax.addons.estimation.control_variate import Control, ControlledMean
from verifai_jax.addons.estimation.fitting import effective_size
from verifai_jax.addons.estimation.gaussian_surrogate import CHUNK, Surrogate
from verifai_jax.addons.estimation.importance import ImportanceSamples
from verifai_jax.addons.estimation.mixture import Mixture
from verifai_jax.addons.estimation.monte_carlo import Counts
from verifai_jax.addons.estimation.normal_space import Begun, Ended, LimitState, to_normal_space
from verifai_jax.addons.estimation.splitting import SplittingRun, run_splitting
from verifai_jax.core.messages.text import format_percent

FAR = 3.5
"""Distance from the shell of the prior's samples, in standard deviations, of the outermost points
of the first design: failures down to 1e-6 lie within."""
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
SETTLED_BY_CHEAP = 0.15
"""The same with a cheap model, at which learning ends."""
ATTEMPTS, LEARNED, GOOD = 3, 40, 1.2
"""Attempts to estimate with a cheap model, simulations that learn for each but the last one, and
the width, as a share of the wanted one, above which an attempt is given up after its first look:
its samples teach the surrogate more than they tell."""
EXPLORED = 3
"""One of so many simulations of a round goes where the surrogate knows least, whatever it says
there: it is wrong about failures that its points gave no hint of."""
PER_LEVEL, CHAINS = 800, 200
"""States and chains of a level of splitting on the surrogate."""
FITTING = 16_000
"""Evaluations of the surrogate by which the proposal is fitted."""
FIRST_LOOK = 0.3
"""Share of the final samples after which it is asked whether the proposal meets failures at all."""
MIN_FAILING = 10
"""Failures among these below which the proposal is given up: their weights say too little."""
UNDERSTATED = 1.2
"""Factor on the logarithms of the interval: samples of a proposal that was fitted to a model of the
failures seldom show the weights beyond its edges."""
LOOKS, FIRST_SIZE = 6, 30
"""Looks at the interval, where it decides when to stop, and samples before the first one."""
CAUTIOUS = 1.15
"""Factor on the samples that the width of an interval asks for."""
MIN_LOOK = 60
"""Samples at least of a proposal that is given up."""


def estimate_by_surrogate(limit_state: LimitState, rng: np.random.Generator, plan: Plan) -> Answer:
    """Estimate with few simulations: half train the surrogate, half make the estimate.

    With a cheap model fewer are needed for training, since it shows where failures may be.
    """
    limit_state.rows = []
    surrogate = Surrogate(limit_state.dim, plan.cheap)
    counts = Counts(0, 0, 0)
    try:
        counts = _first_design(limit_state, rng)
        attempts = 1 if plan.cheap is None or plan.within is None else ATTEMPTS
        for left in reversed(range(attempts)):
            _learn(limit_state, rng, surrogate, LEARNED if left else None)
            proposal = _proposal(limit_state, rng, surrogate)
            control = Control(limit_state, rng, surrogate, proposal)
            found = _sample(limit_state, rng, proposal, plan, control, left > 0)
            if found is not None:
                break
        assert found is not None
        samples, mean = found
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


def _learn(
    limit_state: LimitState, rng: np.random.Generator, surrogate: Surrogate,
    count: int | None = None,
) -> None:  # fmt: skip
    """Simulate where the surrogate is least sure of the sign, and where it knows least at all.

    Workers of an executor are given a round while the one before it is simulated: it is chosen by
    the results of those before that one, and by the points of that one. So it depends on the
    numbers of the simulations, and not on when they end. A cheap model settles so much that few
    rounds are better, each of which knows all of them; if a `count` is given, it takes no more.
    """
    from scipy.special import ndtr

    learning = min(LEARNING * limit_state.budget, MAX_LEARNING)
    until = limit_state.budget - learning
    if count is not None:
        until = max(until, limit_state.left - count)
    knows_all = surrogate.cheap is not None
    rounds = ROUNDS_BY_CHEAP if knows_all else ROUNDS
    size = max(1, int(learning / rounds))
    begun: Begun | None = None
    while True:
        z, rho = _known(limit_state)
        if len(z) > 1:
            surrogate.learn(z, rho)
        coming = np.zeros((0, limit_state.dim)) if begun is None else begun.z
        left = limit_state.left - len(coming) - until
        if left <= 0 or len(z) < 2:
            if begun is None:
                return
            begun.result()
            begun = None
            continue
        size = min(size, int(left) + 1)
        # As many points as fit into one shape.
        anywhere = _spread(limit_state, rng, CHUNK)[: CHUNK - len(coming)]
        covariance = surrogate.covariance(np.concatenate([coming, anywhere]))
        unknown = _in_doubt(np.zeros(len(anywhere)), _given(covariance, len(coming)), size)
        population, _ = _failures_of(limit_state, rng, surrogate, CAUTION)
        if not len(population):
            population = limit_state.sample_prior(rng, PER_LEVEL)
        mean, std = surrogate.predict(population)
        wrong = ndtr(-np.abs(mean) / std)
        doubt = float(wrong.sum() / max(np.sum(mean < 0), 1.0))
        if surrogate.cheap is not None and doubt < SETTLED_BY_CHEAP:
            return
        population = population[: CHUNK - len(coming)]
        explored = size if doubt < SETTLED else size // EXPLORED
        covariance = surrogate.covariance(np.concatenate([coming, population]))
        chosen = _in_doubt(
            mean[: len(population)], _given(covariance, len(coming)), size - explored
        )
        points = np.concatenate([population[chosen], anywhere[unknown[:explored]]])
        following = limit_state.begin(points)
        try:
            if (waited := following if knows_all else begun) is not None:
                waited.result()
        except Ended:
            following.cancel()
            raise
        begun = None if knows_all else following


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


def _given(covariance: Float[np.ndarray, "n n"], count: int) -> Float[np.ndarray, "m m"]:
    """Return the covariance of the values of all but the first points, once those are known."""
    if not count:
        return covariance
    first, cross = covariance[:count, :count], covariance[:count, count:]
    noise = 1e-4 * float(np.max(np.diag(covariance))) * np.eye(count)
    return covariance[count:, count:] - cross.T @ np.linalg.solve(first + noise, cross)


def _state_of(limit_state: LimitState, surrogate: Surrogate, caution: float) -> LimitState:
    """Return the surrogate as a limit state, at which nothing is simulated."""

    def evaluate(
        u: Float[np.ndarray, "n d"],
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        z = to_normal_space(u)
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


def _sample(
    limit_state: LimitState, rng: np.random.Generator, proposal: Mixture, plan: Plan,
    control: Control, again: bool = False,
) -> tuple[ImportanceSamples, ControlledMean] | None:  # fmt: skip
    """Simulate fresh samples until the interval is as short as wanted, or the budget is spent.

    Nearly no failures among the first ones end it, too: the rest is worth more elsewhere. None
    where the first look says that it is better to learn `again`.
    """
    left, confidence = max(limit_state.left, 1), plan.confidence
    looks, size = 2, max(1, round(FIRST_LOOK * left))
    if plan.within is not None:
        # Each look has an equal part of the error, so that their intervals hold together, also
        # those of attempts that were given up.
        shares = LOOKS + (ATTEMPTS - 1 if plan.cheap is not None else 0)
        looks, size, confidence = LOOKS, FIRST_SIZE, 1 - (1 - confidence) / shares
    found: ImportanceSamples | None = None
    mean = ControlledMean(0.0, np.inf, 0.0, 1.0)
    for look in range(looks):
        size = limit_state.left if look == looks - 1 else min(size, limit_state.left)
        if found is not None and size < 1:
            break
        new = importance.sample_proposal(limit_state, rng, proposal, max(size, 1), plan.clamped)
        found = new if found is None else found.join(new)
        mean = control.estimate(found, confidence)
        few = found.failing.sum() < MIN_FAILING
        if again and few and not limit_state.ended:
            return None
        if limit_state.ended or (few and len(found.x) >= min(MIN_LOOK, FIRST_LOOK * left)):
            break
        if plan.within is not None:
            width = np.log(mean.high / mean.low) / np.log(plan.within) / 2 if mean.low else np.inf
            width *= UNDERSTATED
            if width <= 1 and not few:
                break
            if again and look == 0 and width > GOOD:
                return None
            # The width falls with the root of the samples; this is how many are still needed.
            size = round(len(found.x) * min(CAUTIOUS * width**2 - 1, 1)) if not few else FIRST_SIZE
    assert found is not None
    return found, mean


def _answer(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan, counts: Counts,
    samples: ImportanceSamples, control: Control, mean: ControlledMean,
) -> Answer:  # fmt: skip
    failing, drawn = samples.defensive_counts
    # The defensive part of the proposal is a sample of the prior.
    counts = counts + Counts(drawn, failing, int(np.sum(samples.without[samples.origin == 0] > 0)))
    if samples.failing.sum() < MIN_FAILING:
        answer = bound_answer(limit_state, rng, plan, SplittingRun(stopped="stuck"), counts)
        answer.notes.append(
            f"the surrogate does not help: of {len(samples.x):,} samples where it predicts "
            f"failures {int(samples.failing.sum()):,} fail, so samples of the prior are counted "
            "instead"
        )
        return answer
    weights, value = samples.mean, min(mean.value, 1.0)
    low, high = (value * (end / value) ** UNDERSTATED for end in (mean.low, mean.high))
    answer = Answer(counts, value, low, min(high, 1.0), "surrogate", weights.effective, mean.cv)
    right = float(np.mean(control.sees(samples.points) == samples.failing))
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
