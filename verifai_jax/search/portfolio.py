"""A portfolio of searches that share their observations, with a budget that follows success.

The members are complementary: gradients of clauses lead to corners and to points where clauses are
equal, models of the robustness (`surrogate`) say in small rounds which point is worth a simulation,
mutations work on rough landscapes, and cross-entropy fills the region of failures in large batches.
A bandit divides the simulations between descents and the others: the share of descents follows the
discounted rate at which points are among the best so far, with a small minimum; where gradients are
zero or not finite it drops at once. All members learn from every point, and descents start equally
often from the best points and from new ones.

Once a region of failures is described, all members look for failures elsewhere (`kinds`).

If they find no failure for long, a fourth member with its own budget joins them: descents into the
interior of the space (`descent`).

Large rounds begin without gradients, whose compilation would take longer than the rounds, until no
failure was found for a while (`PortfolioStage`).
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Plan, Search, Wants, choose
from verifai_jax.search.clause_values import without_clauses
from verifai_jax.search.cross_entropy import CrossEntropy, CrossEntropyState
from verifai_jax.search.descent import (
    InteriorState,
    begin,
    learn,
    not_taken,
    plan,
    propose,
    wait,
    waits,
)
from verifai_jax.search.gradient import Gradient, GradientState
from verifai_jax.search.kinds import ENOUGH, Kinds
from verifai_jax.search.mutation import FEW, Mutation, MutationState
from verifai_jax.search.surrogate import CHOICES, MAX_DIM, Surrogate
from verifai_jax.search.wrapper import Wrapper

GRADIENT, MUTATION, CROSS_ENTROPY, MODEL = range(4)  # numbers of the members
# The numbers before `PATIENT` were chosen by hand. About halved and doubled they took 0.87 to 1.2
# times as many simulations on four problems (`search_quality.py constants`); the one that took 0.87
# took more on others. `PATIENT` was not varied, and what follows says its own.
PRIOR_GAINS = 4.0, 2.5
"""Gains before there is evidence, of descents and of the other two together: as if descents had
succeeded always."""
PRIOR_COSTS = 4.0  # cost of these gains, in simulations: few, so that evidence soon decides
DISCOUNT = 0.98  # of evidence, for each simulation since: that of 50 simulations ago counts a third
MIN_SHARE = 0.05  # of the budget of a member, so that its evidence never ends
PATIENT = 4  # rounds in a row without a failure after which failures are rare
LESS_PATIENT = 1
"""The same once a kind of failure is described: of eight wells in four and six dimensions it found
7.8 and 6.7 in the mean, with four rounds 7.4 and 6.2 (`benchmarks/RESULTS.md`)."""
FILLED = 8
"""Batch from which on cross-entropy has nine tenths of what mutations and it have; in rounds of one
simulation, in which it draws from the prior alone, it has a fifth. Shares by gains drifted to
mutations, whose gains are small: five problems took up to 1.5 times as many simulations."""
MODELLED = 0.8
"""Share of the models of what descents leave in small rounds, chosen by hand. By gains, of which
the first few are luck, the other two get half of it after one round."""
IN_VAIN = 3, 6
"""Powers of the share of coordinates that descents can move with which their gains count, without
models and with them, which know what choices do: with 3 the medians of `menu`, `recipe`, `mixed`
and `cruise` were 1.2 to 1.4 times as high (`benchmarks/RESULTS.md`)."""
OPENING = 6
"""Descents before the budget is shared by evidence, and before one starts from the best points."""
OPENING_ROWS = 20
"""Simulations after which the budget is shared by evidence at the latest: in rounds of 16 a slope
of four descents each, and their first jumps. Without a limit, and with the models, the landscape of
ripples took 370 simulations instead of 80, with that of four descents 215."""
MOSTLY = 0.75
"""Share of coordinates that descents can move from which on some descents go first. Where a fifth
of the coordinates or fewer are choices three problems took 0.36, 0.41 and 0.88 times as many
simulations with these descents as without, where more are two took 1.3 and 2.7 times as many."""
MANY = 32
"""Simulations of a round beyond which descents wait until failures are rare: such rounds simulate
thousands in the seconds that gradients take to compile."""
AMONG = 4
"""Number of best points among which a new one is a gain: those that mutations have as parents."""
TAKEN = 32
"""Points remembered as starts and ends of descents; as many as mutations keep to start from."""


class PortfolioState(NamedTuple):
    key: Key[Array, ""]
    gradient: GradientState | None
    mutation: MutationState
    cross_entropy: CrossEntropyState
    model: Surrogate | None
    credit: Float[Array, " members"]  # simulations that each may still spend
    gains: Float[Array, " members"]
    costs: Float[Array, " members"]
    rows: Int[Array, " members"]  # of the last ask, one member after the other
    differentiates: Bool[Array, ""]
    opening: Bool[Array, ""]  # the first descents are on their way, beyond their share
    taken: Float[Array, "taken d"]  # the latest points where descents began or ended
    interior: InteriorState | None
    barren: Int[Array, ""]  # simulations since the last failure that is in no known kind
    kinds: Kinds | None  # regions of failures; None if none is left


@dataclass(frozen=True)
class Portfolio(Search[PortfolioState]):
    """Gradients, models, mutations and cross-entropy, sharing the budget by success; no tuning.

    **Arguments:**
    - `gradients`: whether to use gradients of the robustness. They are left out automatically if
      there are none: for black boxes, if all features are discrete, or if the robustness is
      piecewise constant, for example over whole numbers.
    - `kinds`: whether to look for failures elsewhere once a region of them is described
      (`search/kinds.py`); with False it goes on where failures are.
    """

    gradients: bool = True
    kinds: bool = True

    @property
    def wants(self) -> Wants:
        return Wants(clauses=self.gradients, clause_gradients=self.gradients)

    @property
    def fallback(self) -> "Portfolio | None":
        """The same search without gradients."""
        return replace(self, gradients=False) if self.gradients else None

    def staying(self) -> "Portfolio":
        return replace(self, kinds=False)

    def _differentiates(self, cube: Cube) -> bool:
        return self.gradients and len(cube.continuous) > 0

    def _gradient(self, cube: Cube) -> Gradient:
        # Of choices none knows which are worth a descent: one at a time, from the best so far.
        return Gradient() if self._descends_first(cube) else Gradient(descents=1)

    def _descends_first(self, cube: Cube) -> bool:
        return len(cube.continuous) >= MOSTLY * cube.dim

    def _cross_entropy(self, batch: int) -> CrossEntropy:
        # In small batches a round says little: patience counts simulations.
        return CrossEntropy(patience=max(6, 128 // batch))

    def _prior_gains(self, cube: Cube, batch: int) -> Float[np.ndarray, " members"]:
        descents, others = PRIOR_GAINS
        descents *= min(1.0, cube.dim / FEW)
        fitted = np.clip(batch / FILLED, 0.2, 0.9)
        modelled = MODELLED if self._models(cube, batch) else 0.0
        shares = np.array([1 - fitted, fitted])
        gains = [descents, *((1 - modelled) * others * shares), modelled * others]
        return np.array(gains, np.float32)

    def _models(self, cube: Cube, batch: int) -> bool:
        return 0 < cube.dim <= MAX_DIM and batch <= MANY

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> PortfolioState:
        keys = jax.random.split(key, 3)
        gradient = None
        if self._differentiates(cube):
            gradient = self._gradient(cube).init(keys[0], cube, batch)
        return PortfolioState(
            key=key,
            gradient=gradient,
            mutation=Mutation().init(keys[1], cube, batch),
            cross_entropy=self._cross_entropy(batch).init(keys[2], cube, batch),
            model=Surrogate.nothing(cube.dim) if self._models(cube, batch) else None,
            credit=jnp.zeros(4, jnp.float32),
            gains=jnp.asarray(self._prior_gains(cube, batch)),
            costs=jnp.full(4, PRIOR_COSTS, jnp.float32),
            rows=jnp.zeros(4, jnp.int32),
            differentiates=jnp.array(False),
            opening=jnp.array(False),
            taken=jnp.full((TAKEN, cube.dim), jnp.inf, jnp.float32),
            interior=None if gradient is None else begin(jax.random.fold_in(key, 3), cube, batch),
            barren=jnp.int32(0),
            kinds=Kinds.nothing(cube.dim) if self.kinds else None,
        )

    def stage(self, state: PortfolioState | None, cube: Cube, batch: int) -> Search[PortfolioState]:
        """Return the members that take part in the next round.

        Gradients take seconds to compile, while many simulations at once take almost no time. So
        large rounds begin without gradients, and continue without them as long as failures come.
        """
        if not self._differentiates(cube):
            return self
        kinds = None if state is None else state.kinds
        known = kinds is not None and int(np.asarray(kinds.count).max()) >= ENOUGH
        rounds = (LESS_PATIENT if known else PATIENT) if batch > MANY else 0
        if rounds and (state is None or int(state.barren) < rounds * batch):
            return PortfolioStage(self, descends=False)
        if state is None or (state.interior is not None and waits(state.interior)):
            return PortfolioStage(self, descends=True)
        return self

    def ask(self, state: PortfolioState, cube: Cube, batch: int) -> Asked[PortfolioState]:
        before, key = state, jax.random.fold_in(state.key, state.mutation.round)
        wanted = [(state.mutation.key, batch), (key, CHOICES // 3)]
        wanted = wanted[:1] if state.model is None else wanted
        mutated, more = jnp.split(Mutation().proposed(state.mutation, cube, wanted), [batch])
        mutation = state.mutation._replace(round=state.mutation.round + 1)
        drawn, cross_entropy = self._cross_entropy(batch).ask(state.cross_entropy, cube, batch)
        state = state._replace(mutation=mutation, cross_entropy=cross_entropy)
        share = self._shares(state, cube, batch)
        credit = state.credit + share * batch
        differentiates, descents, points = jnp.array(False), jnp.int32(0), mutated
        opening = differentiates
        if state.gradient is not None:
            points, gradient = self._gradient(cube).ask(state.gradient, cube, batch)
            plan = self._gradient(cube).plan(gradient, cube, batch)
            if not self._descends_first(cube):
                # They begin with the choices of good points.
                turn = (credit[GRADIENT] >= 1) & jnp.isfinite(state.mutation.score[AMONG - 1])
            else:
                # That from the middle of the cube goes before all.
                opening = gradient.starts <= max(OPENING, len(gradient.fresh))
                opening &= gradient.useless == 0
                opening &= state.barren < min(OPENING_ROWS, FEW * cube.dim)
                turn = opening | (credit[GRADIENT] >= 1)
            differentiates = plan.differentiate & turn
            allowed = jnp.where(opening, batch, jnp.floor(credit[GRADIENT]).astype(jnp.int32))
            descents = jnp.where(turn, jnp.minimum(plan.rows, allowed), 0)
            descents = jnp.where(differentiates, plan.rows, descents)
            state = state._replace(gradient=choose(turn, gradient, state.gradient))
        others = jnp.where(differentiates, 0, batch - descents)
        draws = jnp.minimum(jnp.floor(credit[CROSS_ENTROPY]).astype(jnp.int32), others)
        draws = jnp.maximum(draws, 0)
        # What no other takes is of the models, or of mutations where there are none.
        rest = others - draws
        mutations = jnp.clip(jnp.floor(credit[MUTATION]).astype(jnp.int32), 0, rest)
        mutations = rest if before.model is None else mutations
        rows = jnp.stack([descents, mutations, draws, rest - mutations]).astype(jnp.int32)
        member = self._members(rows, batch)[:, None]
        # The last of a batch of cross-entropy explore, which mutations do already.
        drawn = jnp.roll(drawn, batch - draws, axis=0)
        u = jnp.where(
            member == GRADIENT, points, jnp.where(member == CROSS_ENTROPY, drawn, mutated)
        )
        if before.model is not None:
            model = partial(before.model.propose, key, cube, batch, more, before.mutation.stale)
            u = jnp.where(member == MODEL, jax.lax.cond(rows[MODEL] > 0, model, lambda: u), u)
        state = state._replace(rows=rows, differentiates=differentiates, opening=opening)
        if before.interior is None:
            return u, state
        points, descents = propose(before.interior, cube, batch)
        # At their turn the others have not been asked.
        none = before._replace(
            rows=jnp.zeros(4, jnp.int32), differentiates=jnp.array(True), opening=jnp.array(False),
            interior=descents,
        )  # fmt: skip
        state = choose(descents.turn, none, state._replace(interior=descents))
        return jnp.where(descents.turn, points, u), state

    def plan(self, state: PortfolioState, cube: Cube, batch: int) -> Plan:
        if state.gradient is None:
            temperature = jnp.ones(batch, jnp.float32)
        else:
            temperature = state.gradient.temperature[state.gradient.descent]
        usual = Plan(jnp.sum(state.rows), state.differentiates, temperature)
        if state.interior is None:
            return usual
        own = plan(state.interior, cube, batch)
        return jax.tree.map(partial(jnp.where, state.interior.turn), own, usual)

    def tell(self, state: PortfolioState, cube: Cube, observations: Observations) -> PortfolioState:
        batch = len(observations.rho)
        rows = self.plan(state, cube, batch).rows
        simulated = jnp.arange(batch) < rows
        observations = observations._replace(valid=observations.valid & simulated)
        common = without_clauses(observations)
        state, common = self._leave(state, common)
        failed = jnp.any(common.usable & (common.rho < 0))
        barren = jnp.where(failed, 0, state.barren + rows).astype(jnp.int32)
        state = state._replace(barren=barren)
        if state.interior is None:
            return self._learn(state, cube, observations, common)
        score, turn = without_clauses(observations).score, state.interior.turn
        costs = jnp.where(turn | state.differentiates, 2.0, 1.0)
        interior = learn(
            state.interior, cube, observations, score, rows * costs,
            (state.mutation.points, state.mutation.score),
        )  # fmt: skip
        # The steps of a descent are many, and of use to the others where they are good.
        limit = state.mutation.score[AMONG - 1]
        good = jnp.isfinite(limit) & ((score < limit) | (score == 0))
        valid = observations.valid & (good | ~turn)
        common = common._replace(valid=valid)
        learned = self._learn(state, cube, observations._replace(valid=valid), common)
        learned = choose(turn & ~jnp.any(valid), state, learned)
        return learned._replace(interior=interior)

    def _leave(
        self, state: PortfolioState, common: Observations
    ) -> tuple[PortfolioState, Observations]:
        """Raise the robustness near described kinds, and forget the points near new ones."""
        if state.kinds is None:
            return state, common
        kinds = state.kinds.found(common)
        common = common._replace(rho=kinds.raised(common.u, common.rho))
        new = kinds.described & ~state.kinds.described

        def others(points: Array, score: Array) -> tuple[Array, Array]:
            score = jnp.where(kinds.nearness(points, new) > 0, jnp.inf, score)
            order = jnp.argsort(score, stable=True)
            return points[order], score[order]

        mutation, fitted, zero = state.mutation, state.cross_entropy, jnp.int32(0)
        model = None if state.model is None else Surrogate(*others(*state.model))
        points, score = others(mutation.points, mutation.score)
        elite, level = others(fitted.elite, fitted.score)
        left = state._replace(
            mutation=mutation._replace(points=points, score=score, verdicts=zero, stale=zero),
            cross_entropy=fitted._replace(elite=elite, score=level, stale=zero),
            model=model,
        )
        return choose(jnp.any(new), left, state)._replace(kinds=kinds), common

    def _learn(
        self, state: PortfolioState, cube: Cube, observations: Observations, common: Observations
    ) -> PortfolioState:
        """Tell the members, and count what the one that proposed a point has gained."""
        batch = len(observations.rho)
        member = self._members(state.rows, batch)
        # A gain is a point among the best, once there are enough of them. A descent that began at
        # one of these, as all do among many choices, has to be better than all.
        limit = state.mutation.score[AMONG - 1]
        known = jnp.isfinite(limit)
        if not self._descends_first(cube):
            limit = jnp.where(member == GRADIENT, state.mutation.score[0], limit)
        gained = known & ((common.score < limit) | (common.score == 0)) & common.usable
        proposed = jnp.arange(batch) < jnp.sum(state.rows)
        is_member = (member[None] == jnp.arange(4)[:, None]) & proposed[None]
        spent = jnp.sum(is_member, axis=1) * jnp.where(state.differentiates, 2.0, 1.0)
        total = jnp.sum(spent)
        kept = DISCOUNT**total
        share = self._shares(state, cube, batch)
        credit = state.credit + share * total - spent
        credit = jnp.where(state.opening, state.credit, credit)
        mutation = Mutation().tell(state.mutation, cube, common)
        # Boxes of several sizes around a point are one gain.
        descents = batch if state.gradient is None else len(state.gradient.fresh)
        limits = np.array([descents, batch, batch, batch])
        # Mutations begin when enough is explored, whatever descents have seen.
        descended = jnp.sum(common.usable & is_member[GRADIENT]).astype(jnp.int32)
        early, model = state.opening, state.model
        if model is not None:
            early |= ~known
            model = model.learned(common.u, common.score)
            # Where mutations begin again, elsewhere, so do the models.
            again = known & jnp.isinf(mutation.score[0])
            model = choose(again, Surrogate.nothing(cube.dim), model)
        state = state._replace(
            mutation=mutation._replace(verdicts=jnp.maximum(mutation.verdicts - descended, 0)),
            cross_entropy=self._cross_entropy(batch).tell(state.cross_entropy, cube, common),
            model=model,
            # What it gains while it goes first says nothing about what it will.
            gains=jnp.where(
                early,
                state.gains,
                kept * state.gains + jnp.minimum(jnp.sum(is_member & gained[None], axis=1), limits),
            ),
            costs=jnp.where(early, state.costs, kept * state.costs + spent),
            # Nobody saves, or owes, more than a few rounds.
            credit=jnp.clip(credit, -4.0 * batch, 4.0 * batch).astype(jnp.float32),
        )
        if state.gradient is None:
            return state
        own = observations._replace(valid=observations.valid & (member == GRADIENT))
        updated = self._gradient(cube).tell(state.gradient, cube, own)
        turn = state.rows[GRADIENT] > 0
        return self._offer(state, cube, choose(turn, updated, state.gradient), turn)

    def _offer(
        self, state: PortfolioState, cube: Cube, updated: GradientState, turn: Bool[Array, ""]
    ) -> PortfolioState:
        """Offer the best points where no descent began or ended as every second start."""
        before, n = state.gradient, len(updated.fresh)
        assert before is not None
        begins = before.fresh & before.given & state.differentiates & turn
        ends = updated.fresh & ~before.fresh & turn
        index = jnp.cumsum(begins | ends) - 1
        index = jnp.where(begins | ends, index, TAKEN)
        latest = jnp.where(begins[:, None], before.offered, before.point)
        count = jnp.sum(begins | ends)
        taken = jnp.roll(state.taken, count, axis=0).at[index].set(latest, mode="drop")
        points, score = state.mutation.points, state.mutation.score
        free = not_taken(points, score, taken)
        best = jnp.argsort(~free, stable=True)[:n]
        later = updated.starts + jnp.arange(n)
        turns = (later > OPENING) & (later % 2 == 1) | (not self._descends_first(cube))
        offers = updated.fresh & free[best] & turns
        near = jnp.where(offers, score[best], jnp.inf)
        gradient = updated._replace(offered=points[best], near=near)
        return state._replace(gradient=gradient, taken=taken)

    def warm_start(
        self, state: PortfolioState, cube: Cube, observations: Observations
    ) -> PortfolioState:
        common, gradient = Wants().only(observations), state.gradient
        if gradient is not None:
            gradient = self._gradient(cube).warm_start(gradient, cube, common)
        ce = self._cross_entropy(len(observations.rho))
        model = None if state.model is None else state.model.learned(common.u, common.score)
        return state._replace(
            model=model,
            gradient=gradient,
            mutation=Mutation().tell(state.mutation, cube, common),
            cross_entropy=ce.tell(state.cross_entropy, cube, common),
        )

    def _shares(self, state: PortfolioState, cube: Cube, batch: int) -> Float[Array, " members"]:
        prior = self._prior_gains(cube, batch)
        rate = (state.gains + 0.1 * prior) / (state.costs + 0.1 * PRIOR_COSTS)
        # Descents move the continuous coordinates alone, and are in vain where a choice is wrong.
        moved = len(cube.continuous) / max(cube.dim, 1)
        power = IN_VAIN[state.model is not None]
        rate = rate.astype(jnp.float32).at[GRADIENT].multiply(moved**power)
        descends = state.gradient is not None and not len(cube.discrete)
        if state.model is not None or (batch >= FILLED and not (descends or cube.signals)):
            others = prior[MUTATION:]
            rate = rate.at[MUTATION:].set(others / np.sum(others) * jnp.sum(rate[MUTATION:]))
        if state.gradient is None:
            dead, smallest = jnp.array(True), 0.0
        else:
            dead = state.gradient.useless >= 2
            smallest = jnp.where(dead, 0.02, MIN_SHARE)
        rate = rate.at[GRADIENT].multiply(jnp.where(dead, 0.0, 1.0))
        min_share = jnp.full(4, MIN_SHARE, jnp.float32).at[GRADIENT].set(smallest)
        if state.model is None:
            rate, min_share = rate.at[MODEL].set(0.0), min_share.at[MODEL].set(0.0)
        share = rate / jnp.maximum(jnp.sum(rate), 1e-9)
        share = jnp.maximum(share, min_share)
        return (share / jnp.sum(share)).astype(jnp.float32)

    def _members(self, rows: Int[Array, " members"], batch: int) -> Int[Array, " batch"]:
        row = jnp.arange(batch)
        return jnp.sum(row[:, None] >= jnp.cumsum(rows[:-1]), axis=1).astype(jnp.int32)


@dataclass(frozen=True)
class PortfolioStage(Wrapper[PortfolioState]):
    """Some members of a portfolio, with the state of the whole portfolio.

    **Arguments:**
    - `search`: the whole portfolio.
    - `descends`: whether short descents, and those into the interior, take part.
    """

    search: Search[PortfolioState]
    descends: bool

    @property
    def wants(self) -> Wants:
        return replace(self.search.wants, clause_gradients=self.descends)

    def stage(self, state: PortfolioState | None, cube: Cube, batch: int) -> Search[PortfolioState]:
        return self

    def tell(self, state: PortfolioState, cube: Cube, observations: Observations) -> PortfolioState:
        learned = super().tell(state, cube, observations)
        if state.interior is None:
            return learned
        rows = jnp.sum(state.rows)
        simulated = jnp.arange(len(observations.rho)) < rows
        score = without_clauses(observations).score
        spent = rows * jnp.where(state.differentiates, 2.0, 1.0)
        waiting = wait(state.interior, jnp.where(simulated, score, jnp.inf), spent)
        return learned._replace(interior=waiting)

    def inner_state(self, state: PortfolioState) -> PortfolioState:
        """Return the state of the members that take part."""
        return state._replace(interior=None, gradient=state.gradient if self.descends else None)

    def with_inner_state(self, state: PortfolioState, inner: PortfolioState) -> PortfolioState:
        """Return the state after a round; members that took no part are unchanged."""
        gradient = inner.gradient if self.descends else state.gradient
        return inner._replace(interior=state.interior, gradient=gradient)
