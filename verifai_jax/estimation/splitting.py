"""Adaptive multilevel splitting (subset simulation) by preconditioned Crank-Nicolson moves.

    climb = split(judge, rng, per_level=2560, chains=256)
    climb.estimate, climb.cv, climb.points          # failures, distributed as the prior's

The failure is reached through levels of the robustness, each about a tenth as probable as the one
before; the probability is the product of the conditional ones.

Sources: Au and Beck, Estimation of small failure probabilities in high dimensions by subset
simulation, Probabilistic Engineering Mechanics 16 (2001), equations 8, 19 and 25 to 29;
Papaioannou, Betz, Zwirglmaier and Straub, MCMC algorithms for subset simulation, Probabilistic
Engineering Mechanics 41 (2015), whose adaptive conditional sampling the moves are.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.estimation.normal_space import Ended, Judge

ACCEPTED = 0.44
"""Share of moves that the scale of the moves aims at (Papaioannou et al., section 4.3)."""
MOST_LEVELS = 60
FEWEST = 8
"""Points below a level without which it is no level."""


@dataclass
class Climb:
    """What one splitting run found.

    - `levels`: robustness at each level, from the prior down; the last is minus infinity.
    - `fractions`: the conditional probability of each level.
    - `cv2`: squared relative error of each fraction, correlation along chains included.
    - `accepted`: share of moves accepted, for each level after the first.
    - `points`, `family`: failures `[n, d]` of the last level, and the chain each comes from.
    - `first`: the verdicts of the first level, independent samples of the prior:
      simulations, failures, without verdict.
    - `stopped`: why it went no further; None where it arrived.
    """

    levels: list[float] = field(default_factory=list)
    fractions: list[float] = field(default_factory=list)
    cv2: list[float] = field(default_factory=list)
    accepted: list[float] = field(default_factory=list)
    points: Float[np.ndarray, "n d"] = field(default_factory=lambda: np.zeros((0, 0)))
    family: Int[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(0, int))
    first: tuple[int, int, int] = (0, 0, 0)
    stopped: str | None = None

    @property
    def estimate(self) -> float:
        """The product of the conditional probabilities."""
        return float(np.prod(self.fractions)) if self.stopped is None else float("nan")

    @property
    def cv(self) -> float:
        """Relative standard error, were the levels independent."""
        return float(np.sqrt(np.sum(self.cv2)))


def split(
    judge: Judge,
    rng: np.random.Generator,
    per_level: int,
    chains: int,
    first: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> Climb:
    """One run of splitting.

    **Arguments:**

    - `per_level`: states of a level, `chains` times the length of a chain.
    - `chains`: chains of a level, which the lowest of the level before start.
    - `first`: samples of the prior with their score, failing, proper, to begin with; drawn when
      left out.
    """
    climb = Climb()
    try:
        if first is None:
            z = judge.prior(rng, per_level)
            seen = judge(z)
            first = (z, seen.score, seen.failing, seen.proper)
        z, score, failing, proper = first
        climb.first = (len(z), int(failing.sum()), int((~proper).sum()))
        steps, above, scale = 1, np.inf, 0.8
        family = np.arange(len(z))
        for _ in range(MOST_LEVELS):
            level = _level(score, chains / per_level, above)
            if level is None:
                climb.stopped = "stuck"
                return climb
            inside = score <= level
            climb.levels.append(level)
            climb.fractions.append(float(inside.mean()))
            climb.cv2.append(_cv2(inside, steps))
            if level == -np.inf:
                climb.points, climb.family = z[inside], family[inside]
                return climb
            if judge.left < per_level - chains:
                climb.stopped = "budget"
                return climb
            steps = per_level // chains
            seeds = rng.permutation(np.flatnonzero(inside))
            seeds = np.resize(seeds, chains)
            z, score, rate, scale = _walk(judge, rng, z[seeds], score[seeds], level, steps, scale)
            family = np.tile(np.arange(chains), steps)
            climb.accepted.append(rate)
            above = level
        climb.stopped = "stuck"
    except Ended:
        climb.stopped = judge.ended or "ended"
    return climb


def explore(
    judge: Judge, rng: np.random.Generator, climb: Climb, chains: int, steps: int
) -> tuple[Float[np.ndarray, "n d"], Int[np.ndarray, " n"]]:
    """More failures, by chains from those of the last level that stay among them.

    Points, and the chain each comes from; those of the climb are among them.
    """
    rows = np.resize(rng.permutation(len(climb.points)), chains)
    z, score = climb.points[rows], np.full(chains, -np.inf)
    z, _, _, _ = _walk(judge, rng, z, score, -np.inf, steps + 1, 0.5)
    family = np.concatenate([climb.family, np.tile(climb.family[rows], steps)])
    return np.concatenate([climb.points, z[chains:]]), family


def _level(score: Float[np.ndarray, " n"], share: float, above: float) -> float | None:
    """The next level: the `share` quantile, or lower where that would be no progress."""
    ordered = np.sort(score)
    level = ordered[max(FEWEST, round(share * len(score))) - 1]
    if level == -np.inf or (level < above and np.mean(score <= level) < 0.7):
        return float(level)
    # A plateau: what lies strictly below it, if anything does.
    below = ordered[ordered < min(level, above)]
    return float(below[-1]) if len(below) >= FEWEST else None


def _walk(
    judge: Judge,
    rng: np.random.Generator,
    z: Float[np.ndarray, "chains d"],
    score: Float[np.ndarray, " chains"],
    level: float,
    steps: int,
    scale: float,
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Chains of `steps` states that leave the prior below the level invariant, one after another.

    A move is `z' = sqrt(1 - s^2) z + s xi` in each coordinate, reversible for the standard normal,
    and taken where the robustness stays below the level.
    """
    # Coordinates in which the level set is wide are moved further (their equation 22).
    spread = np.minimum(z.std(axis=0) + 1e-6, 1.0)
    states, scores, taken = [z], [score], []
    for step in range(1, steps):
        s = np.minimum(scale * spread, 1.0)
        moved = np.sqrt(1 - s * s) * z + s * rng.standard_normal(z.shape)
        fits = judge.accepts(moved)
        new = np.full(len(z), np.inf)
        if fits.any():
            new[fits] = judge(moved[fits]).score
        take = fits & (new <= level)
        z, score = np.where(take[:, None], moved, z), np.where(take, new, score)
        states.append(z)
        scores.append(score)
        taken.append(take.mean())
        scale = float(np.clip(scale * np.exp((taken[-1] - ACCEPTED) / np.sqrt(step)), 1e-6, 3.0))
    return np.concatenate(states), np.concatenate(scores), float(np.mean(taken or [1.0])), scale


def _cv2(inside: Bool[np.ndarray, " n"], steps: int) -> float:
    """Squared relative error of a fraction of states (Au and Beck, equations 25 to 29)."""
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
