"""Descent into the interior of the space: L-BFGS on the smooth robustness, from many starts.

    vj.falsify(problem, "descent")
    vj.falsify(problem, search.Descent(rate=0.03, steps=80))

Failures need not lie at corners: a well-trained network fails in small regions anywhere. Each
descent follows the gradient of the greatest clause (or of several, weighted by a softmax) with
quasi-Newton steps inside the cube (`curvature`), which can follow a curved valley, while the
temperature falls.

Most starts lead to minima that are no failures, which shows early. So after 1, 2, 4 ... times
`trial` steps only the better share `kept` of the descents continues; each is decided on arrival
(asynchronous successive halving: Li, Jamieson, Rostamizadeh et al., A system for massively parallel
hyperparameter tuning, MLSys 2020, algorithm 2). Each start is a new point of a sequence that fills
the space evenly, or a good point of another search. Descents from the latter are not compared,
since they would always be ahead.

A portfolio has a separate budget for these descents, in `begin`, `waits`, `propose` and `learn`.
Its other members search corners and the surroundings of the best points, where most failures are.
So descents begin after `EARLY` simulations of the others, and continue while they lower the least
robustness; otherwise they wait. Later their share grows while the others make no progress, and
shrinks if their own results are worse; it is zero once the others have failures. Every second
descent starts from one of the best points, away from the starts and ends of earlier ones.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Plan, SlopeSearch, check_options, choose
from verifai_jax.search.clause_values import comparable_clauses
from verifai_jax.search.curvature import Curvature, advance
from verifai_jax.search.curvature import begin as begin_curvature
from verifai_jax.search.halton import halton_points

# The first two were chosen by hand; no comparison with other values is recorded.
NEARER = 0.5  # factor on the first step of a descent that starts from a good point
CLEARLY = 0.995  # share of the lowest value so far below which a new one is clearly lower
SMALLEST = 1e-5
"""Trust region, in unit coordinates, below which a descent ends: float32 has seven digits."""
REMEMBERED = 32
"""Latest descents at each rung among which one must be good to go on: enough for a quantile such as
the half, and few enough to follow the search."""


class DescentState(NamedTuple):
    key: Key[Array, ""]
    starts: UInt32[Array, ""]  # how many starts were made
    point: Float[Array, "descents d"]
    curvature: Curvature
    step: Int[Array, " descents"]  # gradients taken since the start; 0 for a descent yet to start
    best: Float[Array, " descents"]  # lowest greatest clause since the start
    slow: Int[Array, " descents"]  # gradients since it fell clearly
    given: Bool[Array, " descents"]  # descents whose start came from elsewhere
    offered: Float[Array, "descents d"]  # starts from elsewhere
    near: Float[Array, " descents"]  # their robustness; infinite where there is none
    rungs: Float[Array, "rungs remembered"]  # the best of the latest descents that came so far
    useless: Int[Array, ""]  # starts in a row whose gradients were zero or not finite


@dataclass(frozen=True)
class Descent(SlopeSearch[DescentState]):
    """L-BFGS from many starts; discrete coordinates keep the values of their start.

    **Arguments:**
    - `descents`: maximum number of simultaneous descents; at most the batch.
    - `rate`: size of the first step, in unit coordinates.
    - `steps`: maximum number of gradients in a descent.
    - `trial`: number of steps after which a descent is first compared with others.
    - `kept`: share of the descents that continue after each comparison.
    - `hottest`, `coldest`: temperature of the smooth robustness at the start and at the end of a
      descent, in units of the spread of the predicates.
    - `patience`: consecutive gradients without a clearly lower point after which a descent ends.
    **Raises:** `ValueError` for values out of range; in `check` also without continuous features.
    """

    descents: int = 64
    rate: float = 0.06
    steps: int = 96
    trial: int = 4
    kept: float = 0.5
    hottest: float = 0.4
    coldest: float = 0.04
    patience: int = 10

    def __post_init__(self) -> None:
        counts = {"descents": 1, "steps": 1, "trial": 1, "patience": 1}
        check_options(self, counts, ["rate", "kept"], ["hottest", "coldest"])

    @property
    def rungs(self) -> tuple[int, ...]:
        """Steps at which descents are compared with each other."""
        found = [self.trial]
        while 2 * found[-1] < self.steps:
            found.append(2 * found[-1])
        return tuple(found)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> DescentState:
        n, d = min(self.descents, batch), cube.dim
        return DescentState(
            key=key,
            starts=jnp.uint32(0),
            point=jnp.full((n, d), 0.5, jnp.float32),
            curvature=begin_curvature(n, d),
            step=jnp.zeros(n, jnp.int32),
            best=jnp.full(n, jnp.inf, jnp.float32),
            slow=jnp.zeros(n, jnp.int32),
            given=jnp.zeros(n, bool),
            offered=jnp.full((n, d), 0.5, jnp.float32),
            near=jnp.full(n, jnp.inf, jnp.float32),
            rungs=jnp.full((len(self.rungs), REMEMBERED), jnp.inf, jnp.float32),
            useless=jnp.int32(0),
        )

    def ask(self, state: DescentState, cube: Cube, batch: int) -> Asked[DescentState]:
        fresh = state.step == 0
        number = state.starts + jnp.cumsum(fresh).astype(jnp.uint32)
        points = halton_points(number, cube.dim, state.key)
        points = jnp.where(jnp.isfinite(state.near)[:, None], state.offered, points)
        point = jnp.where(fresh[:, None], points, state.point)
        state = state._replace(
            point=point,
            starts=state.starts + jnp.sum(fresh).astype(jnp.uint32),
            given=jnp.where(fresh, jnp.isfinite(state.near), state.given),
            near=jnp.where(fresh, jnp.inf, state.near),
        )
        return point[jnp.arange(batch) % len(point)], state

    def plan(self, state: DescentState, cube: Cube, batch: int) -> Plan:
        n = len(state.step)
        cooled = (self.coldest / self.hottest) ** self._progress(state.step)
        temperature = (self.hottest * cooled).astype(jnp.float32)
        return Plan(jnp.int32(n), jnp.array(True), temperature[jnp.arange(batch) % n])

    def tell(self, state: DescentState, cube: Cube, observations: Observations) -> DescentState:
        assert observations.clause_gradients is not None, "the descent search needs clauses"
        n = len(state.step)
        observed = jax.tree.map(lambda each: each[:n], observations)
        clauses = comparable_clauses(observed)
        usable = observed.usable
        # The greatest clause has the largest weight: the gradient of a maximum that is smooth.
        weights = jax.nn.softmax(clauses / self.coldest, axis=1)
        gradients = jnp.where(usable[:, None, None], observed.clause_gradients, 0.0)
        gradient = jnp.sum(weights[:, :, None] * gradients, axis=1)
        gradient = jnp.where(np.array(cube.levels) == 0, gradient, 0.0)
        informative = jnp.all(jnp.isfinite(gradient), axis=1) & jnp.any(gradient != 0, axis=1)
        informative &= usable
        gradient = jnp.where(informative[:, None], gradient, 0.0)
        merit = jnp.where(usable, jnp.max(clauses, axis=1), jnp.inf)
        best = jnp.minimum(state.best, merit)
        step = state.step + 1
        slow = jnp.where(merit < CLEARLY * state.best, 0, state.slow + 1)
        over = ~informative | (observed.rho < 0) | (step >= self.steps) | (slow >= self.patience)
        arrives = (step[None] == np.array(self.rungs)[:, None]) & ~over & ~state.given
        rungs = _latest(jnp.where(arrives, best, jnp.inf), state.rungs)
        better = jnp.sum(rungs[:, None] < best[:, None], axis=2)
        goes_on = better < self.kept * jnp.sum(jnp.isfinite(rungs), axis=1)[:, None]
        over |= jnp.any(arrives & ~goes_on, axis=0)
        rate = self.rate * jnp.where(state.given, NEARER, 1.0)
        value = jnp.where(usable, merit, 0.0)
        curvature, point = advance(
            state.curvature, observed.u, value, gradient, state.step == 0, rate
        )
        over |= curvature.radius < SMALLEST
        useless = state.useless + jnp.sum(usable & ~informative)
        return state._replace(
            point=point,
            curvature=curvature,
            step=jnp.where(over, 0, step).astype(jnp.int32),
            best=jnp.where(over, jnp.inf, best),
            slow=jnp.where(over, 0, slow).astype(jnp.int32),
            rungs=rungs,
            useless=jnp.where(jnp.any(informative), 0, useless).astype(jnp.int32),
        )

    def _progress(self, step: Int[Array, " n"]) -> Float[Array, " n"]:
        return jnp.minimum(step / max(self.steps - 1, 1), 1.0).astype(jnp.float32)


def _latest(
    new: Float[Array, "rungs n"], remembered: Float[Array, "rungs m"]
) -> Float[Array, "rungs m"]:
    """Put the finite ones of new numbers before those that are remembered."""
    both = jnp.concatenate([new, remembered], axis=1)
    # Of equal ones the first comes first.
    _, order = jax.lax.top_k(jnp.isfinite(both).astype(jnp.int32), remembered.shape[1])
    return jnp.take_along_axis(both, order, axis=1)


AT_ONCE = 2
"""Maximum number of descents of a round: few, so that within a thousand simulations some come far.
"""
EARLY = 400.0
"""Simulations before the first descent begins, from the best point of the others: more than most
budgets of the ARCH competition, in which they need no help. Rosenbrock's function in ten dimensions
fell below 1 within 1500 simulations from 10, 9, 9 and 9 of 10 seeds in batches of 1, 2, 4 and 16;
beginning at 500 from 2 of 10 in batches of 1, where the others are in the wrong hollow by then."""
TRIAL = 24.0
"""Simulations of descents, before `BEGINS`, that may lower no robustness: a dozen slopes, in which
one from a good point gets on if any does. They may spend as many more as they had spent when they
last got on: a valley that led to a minimum which is no failure has others nearby."""
BEGINS = 1500.0
"""Simulations before descents go on that are behind the others: the budget of the ARCH competition.
When all began at 256, CC4 took 429 simulations instead of 357, at 64, SB3 took 330 instead of 271
(`benchmarks/RESULTS.md`)."""
# The numbers below were chosen by hand; no comparison with other values is recorded.
IDLE = 100.0
"""Simulations without progress of the others after which the share of the descents is greatest."""
MAX_SHARE = 0.6  # greatest share of the budget of the descents
PROGRESS = 0.99  # share of the lowest robustness below which a new one is progress
TRIED = 100.0  # simulations that the descents spend before what they reach is compared
TAKEN = 16  # points that are remembered as starts and ends of descents
APART = 0.1  # distance in some coordinate from all of these at which a point is a new start
MIN_SHARE = 0.02  # share of the budget at least; all there is where gradients say nothing


class InteriorState(NamedTuple):
    descent: DescentState
    turn: Bool[Array, ""]  # the last proposals are of the descents
    credit: Float[Array, ""]  # simulations that they may still spend
    cost: Float[Array, ""]  # simulations of all, one with gradients counted as two
    spent: Float[Array, ""]  # and those of the descents
    since: Float[Array, ""]  # of these, those since they lowered the robustness of all
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
        since=zero,
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
    """Return the simulations wanted of the last proposals, if it is the descents' turn."""
    return _search(batch).plan(state.descent, cube, batch)


def learn(
    state: InteriorState, cube: Cube, observations: Observations, score: Float[Array, " n"],
    spent: Float[Array, ""], best: tuple[Float[Array, "k d"], Float[Array, " k"]],
) -> InteriorState:  # fmt: skip
    """Learn from a round.

    **Arguments:**
    - `observations`: the observations of the round, of all its points.
    - `score`: robustness of each row, 0 for all failures, infinite for rows to ignore.
    - `spent`: number of simulations in the round; one with gradients counts as two.
    - `best`: the best points so far and their scores.
    """
    turn = state.turn
    descent = _search(len(score)).tell(state.descent, cube, observations)
    share = _share(state)
    earned = jnp.where(turn, -spent, spent * share / (1.0 - share))
    earned = jnp.where(state.cost < EARLY, 0.0, earned)
    max_credit = _max_credit(state)
    descent, taken = _offer(choose(turn, descent, state.descent), state, *best)
    return _counted(state, score, spent)._replace(
        descent=descent,
        credit=jnp.clip(state.credit + earned, -max_credit, max_credit).astype(jnp.float32),
        taken=taken,
    )


def wait(state: InteriorState, score: Float[Array, " n"], spent: Float[Array, ""]) -> InteriorState:
    """Count a round in which the descents wait; this replaces `learn` then."""
    return _counted(state._replace(turn=jnp.array(False)), score, spent)


def waits(state: InteriorState) -> bool:
    """Return whether the descents take no part in the next round."""
    # As numbers: each operation of JAX outside of a program would compile one.
    cost, theirs, credit = (float(each) for each in (state.cost, state.theirs, state.credit))
    since, spent = np.asarray(state.since), np.asarray(state.spent)
    tried = cost < BEGINS and bool(_tried(state._replace(since=since, spent=spent)))
    return cost < EARLY or ((theirs <= 0 or tried) and credit < _max_credit(state) / 2)


def _tried(state: InteriorState) -> Bool[Array, ""]:
    """Return whether the descents have been in vain for as long as they are given."""
    return state.since >= TRIAL + (state.spent - state.since)


def _max_credit(state: InteriorState) -> float:
    return 4.0 * len(state.descent.step)


def _counted(
    state: InteriorState, score: Float[Array, " n"], spent: Float[Array, ""]
) -> InteriorState:
    """Count the simulations of a round, and note the lowest robustness."""
    lowest, turn = jnp.min(score, initial=jnp.inf), state.turn
    progress = (lowest < PROGRESS * state.theirs) & ~turn
    lower = turn & (lowest < PROGRESS * jnp.minimum(state.own, state.theirs))
    since = jnp.where(lower, 0.0, state.since + jnp.where(turn, spent, 0.0))
    return state._replace(
        since=since.astype(jnp.float32),
        cost=(state.cost + spent).astype(jnp.float32),
        spent=(state.spent + jnp.where(turn, spent, 0.0)).astype(jnp.float32),
        idle=jnp.where(progress, 0.0, state.idle + jnp.where(turn, 0.0, spent)).astype(jnp.float32),
        own=jnp.where(turn, jnp.minimum(state.own, lowest), state.own).astype(jnp.float32),
        theirs=jnp.where(turn, state.theirs, jnp.minimum(state.theirs, lowest)).astype(jnp.float32),
    )


def _offer(
    descent: DescentState, state: InteriorState, points: Float[Array, "k d"],
    score: Float[Array, " k"],
) -> tuple[DescentState, Float[Array, "taken d"]]:  # fmt: skip
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
    """Return which points can be new starts: not failing, and away from the starts taken."""
    distance = jnp.max(jnp.abs(points[:, None] - taken[None]), axis=2)
    return jnp.all(distance > APART, axis=1) & (score > 0) & jnp.isfinite(score)


def _share(state: InteriorState) -> Float[Array, ""]:
    """Return the share of the budget for the descents."""
    near = jnp.minimum(state.theirs / jnp.maximum(state.own, 1e-9), 1.0)
    near = jnp.where(state.spent < TRIED, 1.0, near)
    share = MAX_SHARE * jnp.minimum(state.idle / IDLE, 1.0) * near**2
    share = jnp.where(state.descent.useless >= 2, MIN_SHARE, jnp.maximum(share, MIN_SHARE))
    goes_on = ~_tried(state) & (state.descent.useless < 2)
    early = jnp.where(goes_on, MAX_SHARE, 0.0)
    share = jnp.where(state.cost < BEGINS, early, share)
    return jnp.where(state.theirs > 0, share, 0.0).astype(jnp.float32)
