"""The account of a portfolio's descents into the interior: when they begin, what they may spend.

    state = begin(key, cube, batch)
    state = wait(state, score, spent)                       # while waits(state)
    u, state = propose(state, cube, batch)                  # state.turn: whether u is to be used
    state = learn(state, cube, observations, score, spent)

Corners and the surroundings of the best points are where most failures are, and the other members
look there. The descents of `descent.Descent` begin late, so that what the others find by then costs
not one simulation more. From then on their share grows while the others make no progress, and falls
with how far what they reach lies above what the others have; it is nothing where these have
failures. Every second descent starts from one of the best points of all, apart from where earlier
ones began and ended.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.core.cube import Cube
from verifai_jax.search.base import Observations, Plan, choose
from verifai_jax.search.descent import Descent, DescentState

AT_ONCE = 16
"""Maximum number of descents of a round; as many as are differentiated in one call."""

BEGINS = 1500.0
"""Simulations before the descents begin: the budget of the ARCH competition. Beginning at 256, CC4
took 429 simulations instead of 357, beginning at 64, SB3 took 330 instead of 271
(`benchmarks/RESULTS.md`)."""

# The numbers below were chosen by hand; no comparison with other values is recorded.
IDLE = 100.0
"""Simulations without progress of the others after which the share of the descents is greatest."""

MAX_SHARE = 0.6
"""Greatest share of the budget of the descents."""

PROGRESS = 0.99
"""Share of the lowest robustness below which a new one is progress."""

TRIED = 100.0
"""Simulations that the descents spend before what they reach is compared."""

TAKEN = 16
"""Points that are remembered as starts and ends of descents."""

APART = 0.1
"""Distance in some coordinate from all of these at which a point is a new start."""

MIN_SHARE = 0.02
"""Share of the budget at least; all there is where gradients say nothing."""


class InteriorState(NamedTuple):
    descent: DescentState
    turn: Bool[Array, ""]  # the last proposals are of the descents
    credit: Float[Array, ""]  # simulations that they may still spend
    cost: Float[Array, ""]  # simulations of all, one with gradients counted as two
    spent: Float[Array, ""]  # and those of the descents
    idle: Float[Array, ""]  # simulations since the others made progress
    own: Float[Array, ""]  # the lowest robustness of the descents, 0 or more
    theirs: Float[Array, ""]  # and of the others
    taken: Float[Array, "taken d"]  # the latest points where descents from theirs began or ended


def _search(batch: int) -> Descent:
    return Descent(descents=min(AT_ONCE, batch))


def begin(key: Key[Array, ""], cube: Cube, batch: int) -> InteriorState:
    """Return the state before the first round."""
    zero, infinite = jnp.zeros((), jnp.float32), jnp.full((), jnp.inf, jnp.float32)
    return InteriorState(
        descent=_search(batch).init(key, cube, batch),
        turn=jnp.array(False),
        credit=zero,
        cost=zero,
        spent=zero,
        idle=zero,
        own=infinite,
        theirs=infinite,
        taken=jnp.full((TAKEN, cube.dim), jnp.inf, jnp.float32),
    )


def propose(
    state: InteriorState, cube: Cube, batch: int
) -> tuple[Float[Array, "batch d"], InteriorState]:
    """Propose the next points of the descents, and decide whether it is their turn."""
    points, descent = _search(batch).ask(state.descent, cube, batch)
    turn = state.credit >= _max_credit(state) / 2
    descent = choose(turn, descent, state.descent)
    return points, state._replace(descent=descent, turn=turn)


def plan(state: InteriorState, cube: Cube, batch: int) -> Plan:
    """Return the simulations wanted of the last proposals, where it is the descents' turn."""
    return _search(batch).plan(state.descent, cube, batch)


def learn(
    state: InteriorState,
    cube: Cube,
    observations: Observations,
    score: Float[Array, " n"],
    spent: Float[Array, ""],
    best: tuple[Float[Array, "k d"], Float[Array, " k"]],
) -> InteriorState:
    """Learn from a round.

    **Arguments:**

    - `observations`: of the round, whoever proposed its points.
    - `score`: robustness of each row, 0 for all failures, infinite for rows not to learn from.
    - `spent`: simulations of the round, one with gradients counted as two.
    - `best`: the best points of all so far and their scores.
    """
    turn = state.turn
    descent = _search(len(score)).tell(state.descent, cube, observations)
    share = _share(state)
    earned = jnp.where(turn, -spent, spent * share / (1.0 - share))
    earned = jnp.where(state.cost < BEGINS, 0.0, earned)
    max_credit = _max_credit(state)
    descent, taken = _offer(choose(turn, descent, state.descent), state, *best)
    return _counted(state, score, spent)._replace(
        descent=descent,
        credit=jnp.clip(state.credit + earned, -max_credit, max_credit).astype(jnp.float32),
        taken=taken,
    )


def wait(state: InteriorState, score: Float[Array, " n"], spent: Float[Array, ""]) -> InteriorState:
    """Count a round of the others; `learn` does no more that matters while the descents wait."""
    return _counted(state._replace(turn=jnp.array(False)), score, spent)


def waits(state: InteriorState) -> bool:
    """Return whether the next round, and what is learned from it, is none of the descents'."""
    # As numbers: each operation of JAX outside of a program would compile one.
    cost, theirs, credit = (float(each) for each in (state.cost, state.theirs, state.credit))
    return cost < BEGINS or (theirs <= 0 and credit < _max_credit(state) / 2)


def _max_credit(state: InteriorState) -> float:
    return 4.0 * len(state.descent.step)


def _counted(
    state: InteriorState, score: Float[Array, " n"], spent: Float[Array, ""]
) -> InteriorState:
    """Count the simulations of a round, and note the lowest robustness."""
    lowest, turn = jnp.min(score, initial=jnp.inf), state.turn
    progress = (lowest < PROGRESS * state.theirs) & ~turn
    return state._replace(
        cost=(state.cost + spent).astype(jnp.float32),
        spent=(state.spent + jnp.where(turn, spent, 0.0)).astype(jnp.float32),
        idle=jnp.where(progress, 0.0, state.idle + jnp.where(turn, 0.0, spent)).astype(jnp.float32),
        own=jnp.where(turn, jnp.minimum(state.own, lowest), state.own).astype(jnp.float32),
        theirs=jnp.where(turn, state.theirs, jnp.minimum(state.theirs, lowest)).astype(jnp.float32),
    )


def _offer(
    descent: DescentState,
    state: InteriorState,
    points: Float[Array, "k d"],
    score: Float[Array, " k"],
) -> tuple[DescentState, Float[Array, "taken d"]]:
    """Offer the best point from which no descent began or ended as the next start but one."""
    index = jnp.argmax(descent.step == 0)
    ends = state.turn & state.descent.given[index] & (descent.step[index] == 0)
    begins = state.turn & state.descent.given[index] & (state.descent.step[index] == 0)
    taken = jnp.where(
        ends | begins,
        jnp.concatenate([state.descent.point[index][None], state.taken[:-1]]),
        state.taken,
    )
    free = not_taken(points, score, taken)
    chosen = jnp.argmin(jnp.where(free, score, jnp.inf))
    offers = (descent.step[index] == 0) & free[chosen] & (descent.starts % 2 == 0)
    near = descent.near.at[index].set(jnp.where(offers, score[chosen], jnp.inf))
    return descent._replace(offered=descent.offered.at[index].set(points[chosen]), near=near), taken


def not_taken(
    points: Float[Array, "k d"], score: Float[Array, " k"], taken: Float[Array, "taken d"]
) -> Bool[Array, " k"]:
    """Return which points can be new starts: apart from those taken, and not failing."""
    distance = jnp.max(jnp.abs(points[:, None] - taken[None]), axis=2)
    return jnp.all(distance > APART, axis=1) & (score > 0) & jnp.isfinite(score)


def _share(state: InteriorState) -> Float[Array, ""]:
    """Return the share of the budget for the descents."""
    near = jnp.minimum(state.theirs / jnp.maximum(state.own, 1e-9), 1.0)
    near = jnp.where(state.spent < TRIED, 1.0, near)
    share = MAX_SHARE * jnp.minimum(state.idle / IDLE, 1.0) * near**2
    share = jnp.where(state.descent.useless >= 2, MIN_SHARE, jnp.maximum(share, MIN_SHARE))
    return jnp.where(state.theirs > 0, share, 0.0).astype(jnp.float32)
