"""Descents from many places into failing regions, the first part of an independent search.

    ends = descend_from_many(limit_state, rng, simulations=2000)
    ends.points                                     # failures [n, d], one of each that fails
    ends.feet                                       # where their tangent planes are least distant

Starts lie anywhere from the middle of the prior to far outside of it. A region of which little
leads to it is found only where many descents begin, so they end at the first failure, and those
that begin at a local minimum of the starts go first.

Sources: Breitung, The geometry of limit state functions and subset simulation, Reliability
Engineering and System Safety 182 (2019), for the regions that a population is led away from;
Preuss, Niching the CMA-ES via nearest-better clustering, GECCO 2010, for the order of the starts.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.estimation.normal_space import (
    LimitState,
    Linearized,
    scores_of,
    squared_distances,
)
from verifai_jax.estimation.towards_origin import BEYOND, come_in

WIDEST = 2.5
"""Standard deviation of the starts that lie farthest out; that of the others is 0.5 at least."""
DRAWN = 0.2
"""Share of the simulations that score starts, of which the most promising descend first."""
HITS = 0.02
"""Starts that fail themselves and count as ends, at most, in parts of the simulations."""
FEWEST_AT_ONCE, MOST_AT_ONCE = 16, 128
"""Descents that are side by side."""
STEPS, FURTHER_STEPS = 60, 12
"""Steps of a descent without gradients, at most, and of one that gradients have led nowhere."""
NEWTON_STEPS = 8
"""Steps of a descent with gradients, at most."""
SAME_FOOT, ENOUGH = 0.05, 8
"""Distance of feet below which planes are one, and descents to one after which no more go on."""
LONGEST = 3.0
"""Length of a step with gradients, at most."""


@dataclass(frozen=True)
class Ends:
    """Failures where descents ended.

    - `points`: the failures `[n, d]`.
    - `feet`: the point `[n, d]` nearest to the origin of the plane that touches the limit state
      there, where there are gradients; descents to one flat region share it. Else the failure.
    """

    points: Float[np.ndarray, "n d"]
    feet: Float[np.ndarray, "n d"]


@dataclass
class _Descents:
    """Descents side by side: their points, scores, and ends as far as they are known."""

    z: Float[np.ndarray, "n d"]
    score: Float[np.ndarray, " n"]
    feet: Float[np.ndarray, "n d"]


def descend_from_many(limit_state: LimitState, rng: np.random.Generator, simulations: int) -> Ends:
    """Descend from as many starts as the simulations allow, a few more at most.

    **Returns:** the failures; none where no descent found one.

    **Raises:** `Ended` where time is over.
    """
    begin = limit_state.simulations
    z = draw_starts(limit_state, rng, max(FEWEST_AT_ONCE, round(DRAWN * simulations)))
    score = scores_of(limit_state, z)
    hits = np.flatnonzero(score == -np.inf)[: max(8, round(HITS * simulations))]
    others = np.flatnonzero(score > -np.inf)
    others = others[np.argsort(-_worse_neighbours(z, score)[others], kind="stable")]
    # Far out, where they lie, several regions overlap.
    points = [come_in(limit_state, z[hits])]
    feet = points.copy()
    if limit_state.gradient is not None:
        feet = [_feet(points[0], limit_state.linearize(points[0]))]
    count, before, begun = FEWEST_AT_ONCE, limit_state.simulations, 0
    while limit_state.simulations - begin < simulations:
        now, others = others[:count], others[count:]
        if len(now):
            descents = _Descents(z[now], score[now], z[now])
        else:
            start = draw_starts(limit_state, rng, count)
            descents = _Descents(start, scores_of(limit_state, start), start)
        if not len(descents.z):
            break
        _descend(limit_state, rng, descents, np.concatenate(feet))
        fails = descents.score == -np.inf
        if limit_state.gradient is None:
            descents.z[fails] = come_in(limit_state, descents.z[fails])
            descents.feet = descents.z
        points.append(descents.z[fails])
        feet.append(descents.feet[fails])
        # As many more as what is left allows, if they take as long as those so far.
        begun += len(descents.z)
        left = begin + simulations - limit_state.simulations
        count = left * begun // max(limit_state.simulations - before, 1)
        count = min(max(count, FEWEST_AT_ONCE), MOST_AT_ONCE)
    return Ends(np.concatenate(points), np.concatenate(feet))


def draw_starts(
    limit_state: LimitState, rng: np.random.Generator, count: int
) -> Float[np.ndarray, "n d"]:
    """Draw starts that the constraint accepts; fewer where it refuses nearly all."""
    accepted = np.zeros((0, limit_state.dim))
    for _ in range(20):
        spread = rng.uniform(0.5, WIDEST, (count, 1))
        z = spread * rng.standard_normal((count, limit_state.dim))
        accepted = np.concatenate([accepted, z[limit_state.accepts(z)]])[:count]
        if len(accepted) == count:
            break
    return accepted


def _worse_neighbours(
    z: Float[np.ndarray, "n d"], score: Float[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """Return for each point how many others are nearer than the nearest better one."""
    gaps = squared_distances(z, z)
    nearest = np.where(score[None] < score[:, None], gaps, np.inf).min(axis=1)
    return np.sum(gaps < nearest[:, None], axis=1)


def _descend(
    limit_state: LimitState,
    rng: np.random.Generator,
    descents: _Descents,
    known: Float[np.ndarray, "m d"],
) -> None:
    """Lower the robustness of each point until it fails or its steps are used up.

    With gradients a descent ends at once where many before it have come to the same plane, `known`
    by their feet.
    """
    steps, given_up = STEPS, np.zeros(len(descents.z), bool)
    if limit_state.gradient is not None:
        # Points without a usable gradient go on without.
        given_up = _descend_by_gradient(limit_state, descents, known)
        steps = FURTHER_STEPS
    z, score = descents.z, descents.score
    length, last = np.ones(len(z)), np.zeros_like(z)
    for _ in range(steps):
        rows = np.flatnonzero((score > -np.inf) & ~given_up)
        if not len(rows):
            break
        # A step that was good is taken again, with some noise.
        step = length[rows, None] * rng.standard_normal((len(rows), limit_state.dim))
        repeats = np.any(last[rows] != 0, axis=1)
        step[repeats] = 1.3 * last[rows[repeats]] + 0.3 * step[repeats]
        moved = z[rows] + step
        new = scores_of(limit_state, moved)
        better = new < score[rows]
        took = rows[better]
        z[took], score[took], descents.feet[took] = moved[better], new[better], moved[better]
        last[rows] = np.where(better[:, None], step, 0.0)
        length[rows] *= np.where(better, 1.2, np.where(repeats, 1.0, 0.85))


def _descend_by_gradient(
    limit_state: LimitState, descents: _Descents, known: Float[np.ndarray, "m d"]
) -> Bool[np.ndarray, " n"]:
    """Take Newton's steps to the limit state, halved where they do not lower the robustness.

    **Returns:** which descents are given up, because many have come to the same plane.
    """
    z = descents.z
    # Its arrays are kept up to date as steps are taken.
    score, rho, gradient = linearized = limit_state.linearize(z)
    gaps = squared_distances(_feet(z, linearized), known)
    given_up = np.sum(gaps < SAME_FOOT**2, axis=1) >= ENOUGH
    longest = np.full(len(z), LONGEST)
    for _ in range(NEWTON_STEPS):
        square = np.sum(gradient * gradient, axis=1)
        usable = np.isfinite(score) & (square > 0) & ~given_up
        rows = np.flatnonzero((score > -np.inf) & usable)
        if not len(rows):
            break
        step = -(1 + BEYOND) * (score[rows] / square[rows])[:, None] * gradient[rows]
        size = np.linalg.norm(step, axis=1)
        # A robustness of zero is no failure yet: a small step goes beyond it.
        direction = -gradient[rows] / np.sqrt(square[rows])[:, None]
        moved = z[rows] + direction * np.clip(size, 1e-3, longest[rows])[:, None]
        fits = limit_state.accepts(moved)
        new = limit_state.linearize(np.where(fits[:, None], moved, z[rows]))
        better = fits & (new.score < score[rows])
        took = rows[better]
        z[took], score[took] = moved[better], new.score[better]
        rho[took], gradient[took] = new.rho[better], new.gradient[better]
        longest[rows] = np.where(better, longest[rows], np.minimum(longest[rows], size) / 2)
    descents.score = score
    descents.feet = _feet(z, linearized)
    return given_up


def _feet(z: Float[np.ndarray, "n d"], linearized: Linearized) -> Float[np.ndarray, "n d"]:
    """Return the points of the linearised limit state nearest to the origin, or `z` without one."""
    _, rho, gradient = linearized
    square = np.sum(gradient * gradient, axis=1)
    known = np.isfinite(rho) & (square > 0)
    inner = np.sum(gradient * z, axis=1) - np.where(known, rho, 0.0)
    foot = (inner / np.where(known, square, 1.0))[:, None] * gradient
    return np.where(known[:, None], foot, z)
