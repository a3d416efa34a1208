"""Adaptive multilevel splitting (subset simulation) by preconditioned Crank-Nicolson moves.

    run = run_splitting(limit_state, rng, per_level=2560, chains=256)
    run.estimate, run.cv, run.points                # failures, distributed as the prior's

Failures are reached through levels of the robustness, each about a tenth as probable as the
previous one; their probability is the product of the levels' conditional probabilities.

Sources: Au and Beck, Estimation of small failure probabilities in high dimensions by subset
simulation, Probabilistic Engineering Mechanics 16 (2001), equations 8, 19 and 25 to 29;
Papaioannou, Betz, Zwirglmaier and Straub, MCMC algorithms for subset simulation, Probabilistic
Engineering Mechanics 41 (2015), whose adaptive conditional sampling the moves are.
"""

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation.normal_space import Ended, LimitState, scores_of

ACCEPTED = 0.44
"""Share of moves that the scale of the moves aims at (Papaioannou et al., section 4.3)."""
MAX_LEVELS = 60
"""Levels of a run, at most."""
MIN_SURVIVORS = 8
"""Points that must lie below a level."""
FirstLevel: TypeAlias = tuple[
    Float[np.ndarray, "n d"],
    Float[np.ndarray, " n"],
    Bool[np.ndarray, " n"],
    Bool[np.ndarray, " n"],
]
"""Samples of the prior, and their score, failing and proper; see `Scores`."""


@dataclass
class SplittingRun:
    """One splitting run.

    - `levels`: robustness at each level, from the prior down; the last is minus infinity.
    - `fractions`: the conditional probability of each level.
    - `cv2`: squared relative error of each fraction, including correlation along chains.
    - `accepted`: share of accepted moves, for each level after the first.
    - `points`: failures `[n, d]` of the last level.
    - `chain_ids`: the chain `[n]` that each failure comes from.
    - `first`: counts of the first level, independent samples of the prior: simulations, failures,
      and missing verdicts.
    - `stopped`: the reason for an early end; None if the run reached failures.
    """

    levels: list[float] = field(default_factory=list)
    fractions: list[float] = field(default_factory=list)
    cv2: list[float] = field(default_factory=list)
    accepted: list[float] = field(default_factory=list)
    points: Float[np.ndarray, "n d"] = field(default_factory=lambda: np.zeros((0, 0)))
    chain_ids: Int[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(0, int))
    first: tuple[int, int, int] = (0, 0, 0)
    stopped: str | None = None

    @property
    def estimate(self) -> float:
        """Failure probability: the product of `fractions`; NaN for a stopped run."""
        return float(np.prod(self.fractions)) if self.stopped is None else float("nan")

    @property
    def cv(self) -> float:
        """Relative standard error of the estimate if the levels were independent."""
        return float(np.sqrt(np.sum(self.cv2)))


def run_splitting(
    limit_state: LimitState, rng: np.random.Generator, per_level: int, chains: int,
    first: FirstLevel | None = None, reserve: int = 0,
) -> SplittingRun:  # fmt: skip
    """Run multilevel splitting once.

    **Arguments:**
    - `per_level`: number of states in a level: `chains` times the length of a chain.
    - `chains`: number of chains in a level; they start at the lowest points of the previous level.
    - `first`: first samples of the prior, with score, failing and proper; drawn when left out.
    - `reserve`: number of simulations that must be left over.
    **Returns:** the run; `stopped` says why it reached no failure.
    """
    run = SplittingRun()
    try:
        if first is None:
            z = limit_state.sample_prior(rng, per_level)
            scores = limit_state(z)
            first = (z, scores.score, scores.failing, scores.proper)
        z, score, failing, proper = first
        run.first = (len(z), int(failing.sum()), int((~proper).sum()))
        steps, above, scale = 1, np.inf, 0.8
        chain_ids = np.arange(len(z))
        for _ in range(MAX_LEVELS):
            level = _level(score, chains / per_level, above)
            if level is None:
                run.stopped = "stuck"
                return run
            inside = score <= level
            run.levels.append(level)
            run.fractions.append(float(inside.mean()))
            run.cv2.append(_cv2(inside, steps))
            if level == -np.inf:
                run.points, run.chain_ids = z[inside], chain_ids[inside]
                return run
            if limit_state.left - reserve < per_level - chains:
                run.stopped = "budget"
                return run
            steps = per_level // chains
            seeds = rng.permutation(np.flatnonzero(inside))
            seeds = np.resize(seeds, chains)
            z, score, rate, scale = _walk(
                limit_state, rng, z[seeds], score[seeds], level, steps, scale
            )
            chain_ids = np.tile(np.arange(chains), steps)
            run.accepted.append(rate)
            above = level
        run.stopped = "stuck"
    except Ended:
        run.stopped = limit_state.ended or "ended"
    return run


def explore_failures(
    limit_state: LimitState, rng: np.random.Generator, run: SplittingRun, chains: int, steps: int
) -> tuple[Float[np.ndarray, "n d"], Int[np.ndarray, " n"]]:
    """Walk chains from the failures of the last level that stay among the failures.

    **Returns:** failures `[n, d]`, including those of the run, and the chain `[n]` of each.
    """
    rows = np.resize(rng.permutation(len(run.points)), chains)
    z, score = run.points[rows], np.full(chains, -np.inf)
    z, _, _, _ = _walk(limit_state, rng, z, score, -np.inf, steps + 1, 0.5)
    chain_ids = np.concatenate([run.chain_ids, np.tile(run.chain_ids[rows], steps)])
    return np.concatenate([run.points, z[chains:]]), chain_ids


def _level(score: Float[np.ndarray, " n"], share: float, above: float) -> float | None:
    """Return the next level: the `share` quantile, or lower where that makes no progress."""
    ordered = np.sort(score)
    level = ordered[max(MIN_SURVIVORS, round(share * len(score))) - 1]
    if level == -np.inf or (level < above and np.mean(score <= level) < 0.7):
        return float(level)
    # A plateau: take the points strictly below it, if there are any.
    below = ordered[ordered < min(level, above)]
    return float(below[-1]) if len(below) >= MIN_SURVIVORS else None


def _walk(
    limit_state: LimitState, rng: np.random.Generator, z: Float[np.ndarray, "chains d"],
    score: Float[np.ndarray, " chains"], level: float, steps: int, scale: float,
) -> tuple[Float[np.ndarray, "states d"], Float[np.ndarray, " states"], float, float]:  # fmt: skip
    """Walk chains of `steps` states that leave the prior below the level invariant.

    A move is `z' = sqrt(1 - s^2) z + s xi` in each coordinate, reversible for the standard normal,
    and taken where the robustness stays below the level.

    **Returns:** all states, their scores, the share of accepted moves, and the scale of the moves.
    """
    # Coordinates in which the level set is wide are moved further (their equation 22).
    spread = np.minimum(z.std(axis=0) + 1e-6, 1.0)
    states, all_scores, taken = [z], [score], []
    for step in range(1, steps):
        s = np.minimum(scale * spread, 1.0)
        moved = np.sqrt(1 - s * s) * z + s * rng.standard_normal(z.shape)
        new = scores_of(limit_state, moved)
        take = new <= level
        z, score = np.where(take[:, None], moved, z), np.where(take, new, score)
        states.append(z)
        all_scores.append(score)
        taken.append(take.mean())
        scale = float(np.clip(scale * np.exp((taken[-1] - ACCEPTED) / np.sqrt(step)), 1e-6, 3.0))
    rate = float(np.mean(taken or [1.0]))
    return np.concatenate(states), np.concatenate(all_scores), rate, scale


def _cv2(inside: Bool[np.ndarray, " n"], steps: int) -> float:
    """Return the squared relative error of a fraction (Au and Beck, equations 25 to 29)."""
    n, share = len(inside), float(inside.mean())
    if share >= 1.0:
        return 0.0
    gamma = 0.0
    if steps > 1:
        table = inside.reshape(steps, -1) - share
        variance = share * (1 - share)
        for lag in range(1, steps):
            correlation = float(np.mean(table[lag:] * table[:-lag])) / variance
            gamma += 2 * (1 - lag / steps) * correlation
    return (1 - share) / (share * n) * (1 + max(gamma, 0.0))
