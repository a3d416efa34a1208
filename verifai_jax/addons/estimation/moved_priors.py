"""Proposals for systems that draw random numbers: the prior, moved towards where failures are.

    if share_failing_again(limit_state, rng, failures) < SURE:
        proposals = [moved_priors(ends) for ends in found]
        fitted = share_out(limit_state, rng, mix(proposals), limit_state.left)

If points fail with a probability, failures are distributed as the prior times this probability. A
proposal fitted to failures is then a poor choice: regions that fail seldom get few samples, and a
failure there weighs as much as thousands of others, or is missed unnoticed. The prior, moved by a
vector at unchanged width, has weights without such a heavy tail.

Source: Asmussen and Glynn, Stochastic Simulation (2007), chapter VI, for exponential tilting.
"""

from contextlib import suppress

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.estimation.components import Gaussian, Prior, log_ratios
from verifai_jax.addons.estimation.fitting import effective_size
from verifai_jax.addons.estimation.importance import (
    DEFENSIVE,
    MAX_STAGES,
    SHARE_OF_STAGE,
    FittedProposal,
    draw,
)
from verifai_jax.addons.estimation.intervals import tail_index
from verifai_jax.addons.estimation.mixture import Mixture, optimal_shares
from verifai_jax.addons.estimation.normal_space import Ended, LimitState, fails_at, farthest_first
from verifai_jax.evaluation.confirmations import came_otherwise

TWICE = 8
"""Samples of the prior that are simulated twice on the host, to learn whether a system has memory
or chance of its own; fewer in budgets of which they are more than a hundredth."""
TRIED_AGAIN = 64
"""Failures that are simulated again, to learn whether the system's own draws decide."""
SURE = 0.8
"""Share of them that has to fail again for proposals to be fitted to failures: then the place at
which the draws decide is thinner than the failing region, and no narrower than what is fitted."""
RUNGS = (0.3, 0.5, 0.7, 0.85, 1.0)
"""Parts of the way from the middle of the prior to a failure by which the prior is moved: the less
the more the draws decide."""
ENDS = 12
"""Failures towards which the prior is moved, at most."""
EVEN = 0.5
"""Share of the proposal with equal weights of all moves; the rest follows the failures."""


def notice_own_chance(limit_state: LimitState, rng: np.random.Generator) -> None:
    """Simulate a few samples of the prior twice, and note differing results.

    A function on the host may draw numbers that do not depend on the random key, or keep state.
    """
    samples = min(TWICE, limit_state.budget // 200)
    if limit_state.draws or not samples:
        return
    with suppress(Ended):
        z = limit_state.sample_prior(rng, samples)
        once, again = limit_state(z).score, limit_state(z).score
        turned = (once == -np.inf) != (again == -np.inf)
        if count := int((turned | came_otherwise(once, again)).sum()):
            limit_state.draws = True
            limit_state.own_chance = (
                f"the system has memory or chance of its own: of {samples} samples of the prior "
                f"simulated again with the same features {count} gave another robustness"
            )


def notice_lost_failures(
    limit_state: LimitState, rng: np.random.Generator, failures: Float[np.ndarray, "n d"]
) -> None:
    """Simulate a few failures again, and note if some do not fail: the system may be random."""
    if limit_state.left < TWICE:
        return
    with suppress(Ended):
        again = fails_at(limit_state, failures[rng.choice(len(failures), TWICE)])
        if lost := int(np.sum(~again)):
            limit_state.own_chance = (
                f"the system has memory or chance of its own: of {TWICE} failures simulated again "
                f"with the same features {lost} did not fail"
            )


def share_failing_again(
    limit_state: LimitState, rng: np.random.Generator, failures: Float[np.ndarray, "n d"]
) -> float:
    """Simulate failures again with other random keys; return the share that fails."""
    count = min(TRIED_AGAIN, limit_state.left)
    if not limit_state.draws or not count:
        return 1.0
    rows = rng.choice(len(failures), count)
    return float(np.mean(fails_at(limit_state, failures[rows])))


def moved_priors(ends: Float[np.ndarray, "m d"]) -> Mixture:
    """Return equal parts of the prior and of priors moved some of the way towards failures."""
    d = ends.shape[1]
    if len(ends) > ENDS:
        nearest = int(np.sum(ends**2, axis=1).argmin())
        gaps = lambda row: np.linalg.norm(ends - ends[row], axis=1)  # noqa: E731
        ends = ends[farthest_first(nearest, gaps, ENDS)]
    moved = [Gaussian(part * end, np.eye(d), np.ones(d)) for end in ends for part in RUNGS]
    shares = np.full(len(moved), (1 - DEFENSIVE) / len(moved))
    return Mixture((Prior(d), *moved), np.append(DEFENSIVE, shares))


def share_out(
    limit_state: LimitState, rng: np.random.Generator, moves: Mixture, simulations: int
) -> FittedProposal:
    """Sample a mixture of moved priors in stages, increasing the share of the best moves.

    **Arguments:**
    - `moves`: the mixture, with equal shares.
    - `simulations`: number of simulations left, of which each stage takes a share.
    **Returns:** the proposal, with the quality predicted from all stages together.
    """
    size = max(1, int(SHARE_OF_STAGE * simulations))
    proposal, counts = moves, []
    zs: list[np.ndarray] = []
    proposals: list[Mixture] = []
    weight = np.zeros(0)
    for _ in range(MAX_STAGES - 2):
        z, _, scores, *_ = draw(limit_state, rng, proposal, size)
        zs.append(z[scores.failing])
        counts.append(len(z))
        proposals.append(proposal)
        new = np.concatenate(zs)
        if len(new) < 10:
            continue
        part = np.array(counts, float) / sum(counts)
        weight = 1 / (np.stack([p.ratio(new) for p in proposals], axis=1) @ part)
        table = np.exp(log_ratios(moves.components[1:], new))
        best = optimal_shares(table, weight / weight.sum(), DEFENSIVE)
        proposal = moves.with_shares(EVEN * moves.shares[1:] / (1 - DEFENSIVE) + (1 - EVEN) * best)
    total = max(sum(counts), 1)
    tail = tail_index(weight) if len(weight) else np.inf
    return FittedProposal(
        proposal, effective_size(weight) / total, tail, float(weight.sum()) / total
    )
