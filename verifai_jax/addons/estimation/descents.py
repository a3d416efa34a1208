"""Descents from many points into failing regions, the first part of an independent search.

    ends = descend_from_many(limit_state, rng, simulations=2000)
    ends.points                                     # failures [n, d], one of each that fails
    ends.feet                                       # where their tangent planes are least distant

Starts lie anywhere from the middle of the prior to far outside of it. A region with a small basin
of attraction is only found by many descents. So descents end at their first failure, and starts
that are local minima among the starts go first. With gradients, starts count as near each other if
their slopes lead to the same point.

Sources: Breitung, The geometry of limit state functions and subset simulation, Reliability
Engineering and System Safety 182 (2019), for the regions that a population is led away from;
Preuss, Niching the CMA-ES via nearest-better clustering, GECCO 2010, for the order of the starts;
Schroeder, Ueber unendlich viele Algorithmen zur Aufloesung der Gleichungen, Mathematische Annalen
2 (1870), for Newton's steps where the slope vanishes.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation.natural_coordinates import move_naturally, natural_slopes
from verifai_jax.addons.estimation.normal_space import LimitState, scores_of, squared_distances
from verifai_jax.addons.estimation.towards_origin import BEYOND, come_in

WIDEST = 2.5
"""Standard deviation of the starts that lie farthest out; that of the others is 0.5 at least."""
WHERE_RARE = 0.5
"""Share of the starts that lie no farther out than rare failures do, `FAR` from the middle: little
of the space farther out leads to a small region among them."""
FAR = 4.0
"""Distance of rare failures from the middle of the prior, in standard deviations."""
DRAWN, DRAWN_WITH_SLOPES = 0.2, 0.33
"""Starts that are drawn together, in parts of the simulations; the most promising descend first."""
MAX_DRAWN = 2048
"""Starts that are drawn together, at most, since all are compared with one another."""
HITS = 0.02
"""Maximum share of the simulations used for starts that fail themselves and count as ends."""
MIN_AT_ONCE, MAX_AT_ONCE = 16, 128
"""Minimum and maximum number of simultaneous descents."""
STEPS, FURTHER_STEPS = 60, 12
"""Steps of a descent without gradients, at most, and of one that gradients have led nowhere."""
NEWTON_STEPS, MISSES = 24, 4
"""Steps of a descent with gradients, and those that do not lower the robustness, at most."""
SAME_PLANE, ENOUGH = 0.07, 8
"""Distance of planes below which they are one, and descents to one after which no more go on."""
LONGEST = 3.0
"""Length of a step with gradients, at most."""
MAX_POWER = 4.0
"""Power of the way that is left like which the robustness falls, at most."""
FELL, STRAIGHT = 0.9, 0.9
"""Part to which a step has lowered the robustness that says something of the power, and the cosine
from which the next one goes the same way."""


@dataclass(frozen=True)
class Ends:
    """Failures at which descents ended.

    - `points`: the failures `[n, d]`.
    - `feet`: for each failure, the point `[n, d]` nearest to the origin on the tangent plane of the
      limit state there, if there are gradients; descents to one flat region share it. Otherwise the
      failure itself.
    """

    points: Float[np.ndarray, "n d"]
    feet: Float[np.ndarray, "n d"]

    @cached_property
    def planes(self) -> Float[np.ndarray, "n coordinates"]:
        """Points whose distances reflect how similar the tangent planes are."""
        return _planes(self.feet)


@dataclass
class Descents:
    """Simultaneous descents: their points, scores, and slopes if there are gradients."""

    z: Float[np.ndarray, "n d"]
    score: Float[np.ndarray, " n"]
    rho: Float[np.ndarray, " n"]
    gradient: Float[np.ndarray, "n d"]

    @property
    def feet(self) -> Float[np.ndarray, "n d"]:
        """The points nearest to the origin on the linearised limit state; `z` without gradients."""
        square = np.sum(self.gradient * self.gradient, axis=1)
        known = np.isfinite(self.rho) & (square > 0)
        inner = np.sum(self.gradient * self.z, axis=1) - np.where(known, self.rho, 0.0)
        foot = (inner / np.where(known, square, 1.0))[:, None] * self.gradient
        return np.where(known[:, None], foot, self.z)

    def of(self, rows: Int[np.ndarray, " m"]) -> "Descents":
        """Return the descents at these indices."""
        return Descents(self.z[rows], self.score[rows], self.rho[rows], self.gradient[rows])

    def replace(self, rows: Int[np.ndarray, " m"], others: "Descents") -> None:
        """Replace the descents at these indices by others."""
        self.z[rows], self.score[rows] = others.z, others.score
        self.rho[rows], self.gradient[rows] = others.rho, others.gradient


def descend_from_many(limit_state: LimitState, rng: np.random.Generator, simulations: int) -> Ends:
    """Descend from as many starts as the simulations allow; the number may be exceeded slightly.

    **Returns:** the failures; empty if no descent found one.
    **Raises:** `Ended` when the time is over.
    """
    begin = limit_state.simulations
    share = DRAWN if limit_state.gradient is None else DRAWN_WITH_SLOPES
    drawn = min(max(MIN_AT_ONCE, round(share * simulations)), MAX_DRAWN)
    starts = begin_descents(limit_state, draw_starts(limit_state, rng, drawn))
    hits = np.flatnonzero(starts.score == -np.inf)[: max(8, round(HITS * simulations))]
    others = np.flatnonzero(starts.score > -np.inf)
    worse = _worse_neighbours(points_ahead(limit_state, starts), starts.score)
    others = others[np.argsort(-worse[others], kind="stable")]
    # Far out, where they lie, several regions overlap.
    failing = starts.of(hits)
    failing.z = come_in(limit_state, failing.z)
    if limit_state.gradient is not None:
        failing = begin_descents(limit_state, failing.z)
    points, feet = [failing.z], [failing.feet]
    count, before, begun = MIN_AT_ONCE, limit_state.simulations, 0
    while limit_state.simulations - begin < simulations:
        now, others = others[:count], others[count:]
        if len(now):
            descents = starts.of(now)
        else:
            descents = begin_descents(limit_state, draw_starts(limit_state, rng, count))
        if not len(descents.z):
            break
        _descend(limit_state, rng, descents, np.concatenate(feet))
        ends = descents.of(np.flatnonzero(descents.score == -np.inf))
        if limit_state.gradient is None:
            ends.z = come_in(limit_state, ends.z)
        points.append(ends.z)
        feet.append(ends.feet)
        # As many more as what is left allows, if they take as long as those so far.
        begun += len(descents.z)
        left = begin + simulations - limit_state.simulations
        count = left * begun // max(limit_state.simulations - before, 1)
        count = min(max(count, MIN_AT_ONCE), MAX_AT_ONCE)
    return Ends(np.concatenate(points), np.concatenate(feet))


def begin_descents(limit_state: LimitState, z: Float[np.ndarray, "n d"]) -> Descents:
    """Simulate points that the constraint accepts, with their slopes if there are gradients."""
    if limit_state.gradient is not None:
        return Descents(z, *limit_state.linearize(z))
    return Descents(z, limit_state(z).score, np.full(len(z), np.nan), np.zeros_like(z))


def draw_starts(
    limit_state: LimitState, rng: np.random.Generator, count: int
) -> Float[np.ndarray, "n d"]:
    """Draw starts that the constraint accepts; fewer if it refuses nearly all."""
    accepted = np.zeros((0, limit_state.dim))
    for _ in range(20):
        spread = rng.uniform(0.5, WIDEST, (count, 1))
        near = np.maximum(1.0, rng.uniform(0.5, 1, (count, 1)) * FAR / np.sqrt(limit_state.dim))
        spread = np.where(rng.random((count, 1)) < WHERE_RARE, near, spread)
        z = spread * rng.standard_normal((count, limit_state.dim))
        accepted = np.concatenate([accepted, z[limit_state.accepts(z)]])[:count]
        if len(accepted) == count:
            break
    return accepted


def _planes(feet: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n coordinates"]:
    """Return points that distinguish planes: the feet and the directions.

    Where planes pass near the origin their feet lie together, wherever their regions are.
    """
    norms = np.linalg.norm(feet, axis=1, keepdims=True)
    return np.concatenate([feet, FAR * feet / np.maximum(norms, 1e-9)], axis=1)


def points_ahead(limit_state: LimitState, descents: Descents) -> Float[np.ndarray, "n d"]:
    """Return the point at which each slope predicts the limit state, or the point itself.

    The prediction is limited to the length of one step.
    """
    direction, norm, rows = _downhill(limit_state, descents)
    steps = np.zeros_like(descents.z)
    length = np.minimum(descents.score[rows] / norm[rows], LONGEST)
    steps[rows] = length[:, None] * direction[rows]
    return move_naturally(descents.z, steps, limit_state.uniform)


def _downhill(
    limit_state: LimitState, descents: Descents
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"], Int[np.ndarray, " m"]]:
    """Return directions in natural coordinates, slopes along them, and the rows that have one."""
    slopes = natural_slopes(descents.z, descents.gradient, limit_state.uniform)
    norm = np.sqrt(np.sum(slopes * slopes, axis=1))
    usable = np.isfinite(descents.score) & (norm > 0) & np.isfinite(norm)
    direction = np.where(usable[:, None], -slopes, 0.0) / np.where(usable, norm, 1.0)[:, None]
    return direction, norm, np.flatnonzero(usable)


def _worse_neighbours(
    z: Float[np.ndarray, "n d"], score: Float[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """Return for each point how many others are nearer than the nearest better one."""
    gaps = squared_distances(z, z)
    nearest = np.where(score[None] < score[:, None], gaps, np.inf).min(axis=1)
    return np.sum(gaps < nearest[:, None], axis=1)


def _descend(
    limit_state: LimitState, rng: np.random.Generator, descents: Descents,
    known: Float[np.ndarray, "m d"],
) -> None:  # fmt: skip
    """Lower the robustness of each point until it fails or its steps are used up.

    With gradients a descent ends at once where many before it reached the same plane, one of
    `known`.
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
        moved = move_naturally(z[rows], step, limit_state.uniform)
        new = scores_of(limit_state, moved)
        better = new < score[rows]
        took = rows[better]
        z[took], score[took], descents.gradient[took] = moved[better], new[better], 0.0
        last[rows] = np.where(better[:, None], step, 0.0)
        length[rows] *= np.where(better, 1.2, np.where(repeats, 1.0, 0.85))


def _descend_by_gradient(
    limit_state: LimitState, descents: Descents, known: Float[np.ndarray, "m d"]
) -> Bool[np.ndarray, " n"]:
    """Take Newton's steps to the limit state, halved where they do not lower the robustness.

    Where the robustness falls like a power of the way that is left, Newton's step is that power too
    short (Schroeder, 1870). Its slope is a power of it then, which two points tell.

    **Returns:** which descents are given up, because many have come to the same plane.
    """
    gaps = squared_distances(_planes(descents.feet), _planes(known))
    given_up = np.sum(gaps < SAME_PLANE**2, axis=1) >= ENOUGH
    longest, power = np.full(len(descents.z), LONGEST), np.ones(len(descents.z))
    misses = np.zeros(len(descents.z), int)
    directions, slopes, rows = _downhill(limit_state, descents)
    for _ in range(NEWTON_STEPS):
        rows = rows[~given_up[rows] & (misses[rows] < MISSES)]
        if not len(rows):
            break
        direction, slope, score = directions[rows], slopes[rows], descents.score[rows]
        size = (1 + BEYOND) * power[rows] * score / slope
        # A robustness of zero is no failure yet: a small step goes beyond it.
        length = np.clip(size, 1e-3, longest[rows])
        here = descents.z[rows]
        moved = move_naturally(here, length[:, None] * direction, limit_state.uniform)
        fits = limit_state.accepts(moved)
        new = begin_descents(limit_state, np.where(fits[:, None], moved, here))
        better = fits & (new.score < score)
        descents.replace(rows[better], new.of(np.flatnonzero(better)))
        misses[rows[~better]] += 1
        longest[rows] = np.where(better, longest[rows], np.minimum(longest[rows], size) / 2)
        directions, slopes, usable = _downhill(limit_state, descents)
        fell = better & np.isin(rows, usable)
        fell &= (new.score > 0) & (new.score < FELL * score)
        lower = rows[fell]
        exponent = np.log(slopes[lower] / slope[fell]) / np.log(new.score[fell] / score[fell])
        estimate = 1 / np.clip(1 - exponent, 1 / MAX_POWER, 1.0)
        # Where the way turns, another part of the system may have a slope of its own.
        straight_on = np.sum(directions[lower] * direction[fell], axis=1) > STRAIGHT
        power[lower] = np.where(straight_on, estimate, np.sqrt(power[lower] * estimate))
        rows = usable
    return given_up
