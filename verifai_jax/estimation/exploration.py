"""Searches for failing regions that do not depend on one another, nor on splitting.

    exploration = explore(limit_state, rng, chains=64)
    exploration.points, exploration.chain_ids       # failures, and the chain of each
    exploration.nearest                             # least distant failure of each chain

Splitting follows the robustness as a population: where it falls fastest, all chains gather, and a
region that the robustness leads to more slowly is left behind, however probable it is. Here every
chain is alone. It starts anywhere from the middle of the prior to far outside of it, descends until
it fails, comes in towards the origin, where failures are more probable, and then walks among the
failures by moves that keep the prior.

Sources: Breitung, The geometry of limit state functions and subset simulation, Reliability
Engineering and System Safety 182 (2019), for the failures of splitting that this mends; Hasofer and
Lind, Exact and invariant second-moment code format, Journal of the Engineering Mechanics Division
100 (1974), and Rackwitz and Fiessler, Structural reliability under combined random load sequences,
Computers and Structures 9 (1978), for the least distant failure and the steps to it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.estimation.normal_space import LimitState
from verifai_jax.estimation.splitting import ACCEPTED

WIDEST = 3.0
"""Standard deviation of the starts that lie farthest out; that of the others is 0.5 at least."""
DESCENT = 24
"""Steps of a descent without gradients, at most."""
GRADIENT_DESCENT = 8
"""Steps of a descent with gradients, at most."""
HALVINGS = 5
"""Halvings of the way in towards the origin."""
WALK = 24
"""Steps of a walk among the failures; the second half of its states is kept."""
NEAREST_STEPS = 6
"""Steps to the least distant failure, at most, where there are gradients."""
DRAWN = 6
"""Starts that are drawn for each chain."""
COST = DRAWN + DESCENT + HALVINGS + WALK
"""Simulations of one chain, at most, without gradients."""
GRADIENT_COST = (
    DRAWN + 2 * (1 + GRADIENT_DESCENT) + DESCENT // 2 + HALVINGS + WALK + 3 * NEAREST_STEPS
)
"""The same with gradients, one of which counts as a further simulation."""
BEYOND = 0.05
"""Share of the way to the limit state that a step with gradients goes beyond it."""
LONGEST = 3.0
"""Length of a step with gradients, at most."""


@dataclass(frozen=True)
class Exploration:
    """Failures found by independent chains.

    - `points`: failures `[n, d]`, several of each chain.
    - `chain_ids`: the chain `[n]` of each.
    - `nearest`: for each chain the failure `[m, d]` nearest to the origin.
    """

    points: Float[np.ndarray, "n d"]
    chain_ids: Int[np.ndarray, " n"]
    nearest: Float[np.ndarray, "m d"]


def explore(limit_state: LimitState, rng: np.random.Generator, chains: int) -> Exploration:
    """Search for failures by chains that do not know of one another.

    **Arguments:**

    - `chains`: number of starts; those that find no failure are left out of the result.

    **Returns:** the failures; none where no chain found one.

    **Raises:** `Ended` where time is over.
    """
    z, score = _descend(limit_state, rng, *_starts(limit_state, rng, chains))
    z = z[score == -np.inf]
    if not len(z):
        none = np.zeros((0, limit_state.dim))
        return Exploration(none, np.zeros(0, int), none)
    z = _come_in(limit_state, z)
    states, nearest = _walk_alone(limit_state, rng, z)
    if limit_state.gradient is not None:
        nearest = approach_origin(limit_state, nearest)
    chain_ids = np.tile(np.arange(len(z)), len(states))
    return Exploration(np.concatenate(states), chain_ids, nearest)


def _starts(
    limit_state: LimitState, rng: np.random.Generator, chains: int
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
    """Draw starts between the middle of the prior and far outside of it, and score them.

    Of more starts than there are chains, those that fail themselves come first, up to half of the
    chains: a region that no descent leads to may be large enough to be hit.
    """
    wanted = DRAWN * chains
    accepted = np.zeros((0, limit_state.dim))
    for _ in range(20):
        spread = rng.uniform(0.5, WIDEST, (wanted, 1))
        z = spread * rng.standard_normal((wanted, limit_state.dim))
        accepted = np.concatenate([accepted, z[limit_state.accepts(z)]])[:wanted]
        if len(accepted) == wanted:
            break
    score = limit_state(accepted).score
    failing, others = np.flatnonzero(score == -np.inf), np.flatnonzero(score > -np.inf)
    # The starts are independent, so the first ones are as good as any.
    hits = failing[: max(chains // 2, chains - len(others))]
    rows = np.concatenate([hits, others[: chains - len(hits)]])
    return accepted[rows], score[rows]


def _descend(
    limit_state: LimitState,
    rng: np.random.Generator,
    z: Float[np.ndarray, "n d"],
    score: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
    """Lower the robustness of each point until it fails or its steps are used up."""
    steps = DESCENT
    if limit_state.gradient is not None:
        # Points without a usable gradient go on without.
        z, score = _descend_by_gradient(limit_state, z)
        steps = DESCENT // 2
    length, last = np.ones(len(z)), np.zeros_like(z)
    for _ in range(steps):
        rows = np.flatnonzero(score > -np.inf)
        if not len(rows):
            break
        # A step that was good is taken again, with some noise.
        step = length[rows, None] * rng.standard_normal((len(rows), limit_state.dim))
        repeats = np.any(last[rows] != 0, axis=1)
        step[repeats] = 1.3 * last[rows[repeats]] + 0.3 * step[repeats]
        moved = z[rows] + step
        new = _scores(limit_state, moved)
        better = new < score[rows]
        z[rows[better]], score[rows[better]] = moved[better], new[better]
        last[rows] = np.where(better[:, None], step, 0.0)
        length[rows] *= np.where(better, 1.2, np.where(repeats, 1.0, 0.85))
    return z, score


def _descend_by_gradient(
    limit_state: LimitState, z: Float[np.ndarray, "n d"]
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
    """Take Newton's steps to the limit state, halved where they do not lower the robustness."""
    z = z.copy()
    score, _, gradient = limit_state.linearize(z)
    longest = np.full(len(z), LONGEST)
    for _ in range(GRADIENT_DESCENT):
        square = np.sum(gradient * gradient, axis=1)
        rows = np.flatnonzero((score > -np.inf) & np.isfinite(score) & (square > 0))
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
        gradient[took] = new.gradient[better]
        longest[rows] = np.where(better, longest[rows], np.minimum(longest[rows], size) / 2)
    return z, score


def _come_in(limit_state: LimitState, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Halve the way to the origin as far as the points still fail."""
    low, high = np.zeros(len(z)), np.ones(len(z))
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        fails = _scores(limit_state, middle[:, None] * z) == -np.inf
        low, high = np.where(fails, low, middle), np.where(fails, middle, high)
    return high[:, None] * z


def _walk_alone(
    limit_state: LimitState, rng: np.random.Generator, z: Float[np.ndarray, "n d"]
) -> tuple[list[Float[np.ndarray, "n d"]], Float[np.ndarray, "n d"]]:
    """Walk among the failures, each chain by moves of its own size that keep the prior.

    **Returns:** the states of the second half, and the state of each chain nearest to the origin.
    """
    scale, states, nearest = np.full(len(z), 0.5), [], z.copy()
    # What gradients lead to needs less of a walk.
    steps = WALK if limit_state.gradient is None else WALK // 2
    for step in range(1, steps + 1):
        moved = np.sqrt(1 - scale**2)[:, None] * z
        moved += scale[:, None] * rng.standard_normal(z.shape)
        take = _scores(limit_state, moved) == -np.inf
        z = np.where(take[:, None], moved, z)
        # Gains fall with the steps, so that the sizes settle.
        gain = np.where(take, 1 - ACCEPTED, -ACCEPTED) / np.sqrt(1 + step / 8)
        scale = np.clip(scale * np.exp(gain), 1e-4, 0.95)
        closer = np.sum(z * z, axis=1) < np.sum(nearest * nearest, axis=1)
        nearest = np.where(closer[:, None], z, nearest)
        if step > steps // 2:
            states.append(z)
    return states, nearest


def approach_origin(
    limit_state: LimitState, z: Float[np.ndarray, "n d"], steps: int = NEAREST_STEPS
) -> Float[np.ndarray, "n d"]:
    """Move failures to the least distant ones near them, by the gradient.

    A step goes to the point nearest to the origin where the linearised robustness is just below
    zero (Rackwitz and Fiessler, 1978); it is halved where that does not fail or is no nearer.

    **Returns:** failures `[n, d]`, none farther from the origin than its start.
    """
    best, point = z.copy(), z.copy()
    share = np.ones(len(z))
    for _ in range(steps):
        _, rho, gradient = limit_state.linearize(point)
        square = np.sum(gradient * gradient, axis=1)
        usable = np.isfinite(rho) & (square > 0)
        square = np.where(usable, square, 1.0)
        inner = np.sum(gradient * point, axis=1) - np.where(usable, rho, 0.0)
        target = (inner / square)[:, None] * gradient * (1 + 1e-3)
        moved = np.where(usable[:, None], point + share[:, None] * (target - point), point)
        fails = _scores(limit_state, moved) == -np.inf
        closer = fails & (np.sum(moved**2, axis=1) < np.sum(best**2, axis=1))
        best = np.where(closer[:, None], moved, best)
        share = np.where(fails, np.minimum(1.0, 1.5 * share), share / 2)
        point = np.where(fails[:, None], moved, best)
    return best


def _scores(limit_state: LimitState, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Return the scores of points; infinity where the constraint refuses one."""
    fits: Bool[np.ndarray, " n"] = limit_state.accepts(z)
    score = np.full(len(z), np.inf)
    if fits.any():
        score[fits] = limit_state(z[fits]).score
    return score
