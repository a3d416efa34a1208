"""Failures of many kinds: a search that is kept away from its earlier failures.

    Diverse(CrossEntropy())
    Diverse(Gradient(), radius=0.3, capacity=100)
    Diverse(Portfolio(), by="behaviour")
    Diverse.count(state), Diverse.archive(state)        # how many distinct failures, and where

An archive holds failures that are farther than a radius from each other. The wrapped search
observes points near an archived failure as worse than safe, with a robustness that rises towards
the failure if it is differentiated (deflation, as in Farrell, Birkisson and Funke, Deflation
techniques for finding distinct solutions of nonlinear partial differential equations, SIAM Journal
on Scientific Computing 37(4), 2015). After an archived failure the search restarts from the best
points elsewhere, since its state would lead back to that failure. Without progress towards a new
failure the radius shrinks, so that first the modes are found and then filled.

With `by="behaviour"` the distance is that of outcomes (`behaviour.py`), for any inputs. If
all safe points have the same robustness, the search observes a value that rises with the
familiarity of their behaviour (novelty search: Lehman, Stanley, Abandoning objectives: evolution
through the search for novelty alone, Evolutionary Computation 19(2), 2011).
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from verifai_jax.addons.searches.behaviour import SeenBehaviour, is_known
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.values.clauses import OUTCOME
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Observations, Search, Wants, check_options
from verifai_jax.search.clause_values import NOTHING
from verifai_jax.search.distances import apart
from verifai_jax.search.portfolio import Portfolio
from verifai_jax.search.wrapper import Learn, Wrapper

AT_ONCE = 16
"""Maximum number of failures archived in a round, each by one step of a loop, and the default size
of a round."""
EITHER = (
    "Diverse looks for failures far from each other, and Likeliest for the likeliest one; "
    "leave out one of them"
)
MOVES = ("inputs", "behaviour")
"""What failures can be far from each other in."""


class DiverseState(NamedTuple):
    inner: PyTree
    key: Key[Array, ""]
    round: Int[Array, ""]
    archive: Float[Array, "capacity d"]
    count: Int[Array, ""]
    radius: Float[Array, ""]
    idle: Int[Array, ""]  # rounds without a new failure and without coming nearer to one
    level: Float[Array, ""]  # the lowest raised robustness since the search began afresh
    size: Float[Array, ""]  # sum of the sizes of robustness seen
    verdicts: Float[Array, ""]  # and how many there were
    points: Float[Array, "batch d"]  # the best points away from the archive, to begin afresh from,
    rho: Float[Array, " batch"]  # with their own robustness; infinite where there is none
    seen: SeenBehaviour | None  # by behaviour alone


class Points(NamedTuple):
    """Points, and the outcomes at them if `by` is behaviour."""

    u: Float[Array, "n d"]
    happened: Float[Array, "n outcome"] | None


@dataclass(frozen=True)
class Diverse(Wrapper[DiverseState]):
    """A wrapper that keeps another search away from earlier failures.

    **Arguments:**
    - `search`: the wrapped search; it may not look for likely failures.
    - `radius`: initial minimum distance of distinct failures: root mean square over the unit
      coordinates, in which two random points are 0.41 apart; choices differ by 0 or 1.
    - `min_radius`: minimum radius.
    - `shrink`: factor by which the radius shrinks, and the search restarts, after
    - `patience` rounds without a new failure or progress towards one.
    - `capacity`: size of the archive, the maximum number of distinct failures. A run that stops
      after more failures gets more.
    - `by`: the distance that separates failures: `"inputs"`, or `"behaviour"`, for which the radius
      is a share of the possible difference (`behaviour.SeenBehaviour.unlike`).
    **Raises:** `TypeError` for anything that is not a search; `ValueError` for values out of range.
    """

    search: Search = field(default_factory=Portfolio)
    radius: float = 0.25
    min_radius: float = 0.01
    shrink: float = 0.8
    patience: int = 8
    capacity: int = 256
    by: Literal["inputs", "behaviour"] = "inputs"
    learns: ClassVar[bool] = True  # Its archive does, whatever is inside.

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.search.wants.likelihood:
            raise ValueError(EITHER)
        check_options(self, {"patience": 1, "capacity": 1}, ["radius", "min_radius", "shrink"])
        if self.by not in MOVES:
            raise unknown_name("way of being diverse", self.by, MOVES)
        if self.min_radius > self.radius:
            raise ValueError(
                f"min_radius must be at most radius, {self.radius}; got {self.min_radius}"
            )

    @property
    def wants(self) -> Wants:
        inner = self.search.wants
        outcomes = inner.outcomes or self.by == "behaviour"
        # A model of the traces knows nothing of archived failures, and would lead back to them.
        batch = min(inner.max_batch, AT_ONCE)
        return replace(inner, outcomes=outcomes, traces=None, max_batch=batch)

    @staticmethod
    def count(state: DiverseState) -> Int[Array, ""]:
        """Return the number of distinct failures so far."""
        return state.count

    @staticmethod
    def archive(state: DiverseState) -> Float[np.ndarray, "k d"]:
        """Return the distinct failures `[k, d]`, in the order of their discovery."""
        return np.asarray(state.archive)[: int(state.count)]

    def distinct(self, state: DiverseState) -> Int[Array, ""]:
        return state.count

    def counting(self, failures: int) -> "Diverse":
        return replace(self, capacity=max(self.capacity, failures))

    def inner_state(self, state: DiverseState) -> PyTree:
        return state.inner

    def with_inner_state(self, state: DiverseState, inner: PyTree) -> DiverseState:
        return state._replace(inner=inner)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> DiverseState:
        own, its = jax.random.split(key)
        return DiverseState(
            inner=self.search.init(its, cube, batch),
            key=own,
            round=jnp.int32(0),
            archive=jnp.full((self.capacity, cube.dim), 0.5, jnp.float32),
            count=jnp.int32(0),
            radius=jnp.float32(self.radius),
            idle=jnp.int32(0),
            level=jnp.float32(jnp.inf),
            size=jnp.float32(0),
            verdicts=jnp.float32(0),
            points=jnp.full((batch, cube.dim), 0.5, jnp.float32),
            rho=jnp.full(batch, jnp.inf, jnp.float32),
            seen=SeenBehaviour.nothing(self.capacity, batch) if self.by == "behaviour" else None,
        )

    def learn(
        self, learn: Learn, state: DiverseState, cube: Cube, observations: Observations
    ) -> DiverseState:
        usable = observations.usable
        u = jnp.where(usable[:, None], observations.u, 0.5)
        size = jnp.sum(jnp.where(usable, jnp.abs(observations.rho), 0.0))
        before = state.count
        happened = observations.outcomes
        seen = state.seen
        if seen is not None:
            if happened is None:
                happened = jnp.full((len(u), OUTCOME), jnp.nan, jnp.float32)
            happened = jnp.where(usable[:, None], happened, jnp.nan)
            safe = usable & (observations.rho >= 0)
            seen = seen.widened(happened, jnp.where(safe, observations.rho, jnp.nan))
            # How well it is known from the rounds before this one.
            known = jnp.where(safe, seen.familiarity(happened, state.radius), 0.0)
            known = jnp.where(seen.level, known, 0.0)
            state = state._replace(seen=seen.recorded(happened))
            rho = observations.rho + self._scale(state) * known
            observations = observations._replace(rho=rho, outcomes=happened)
            if observations.clauses is not None:
                # These have no unit.
                there = observations.clauses > NOTHING
                clauses = observations.clauses + jnp.where(there, known[:, None], 0.0)
                observations = observations._replace(clauses=clauses)
        state = state._replace(
            round=state.round + 1,
            size=state.size + size.astype(jnp.float32),
            verdicts=state.verdicts + jnp.sum(usable),
        )
        points = Points(u, happened if seen is not None else None)
        state = self._archive(state, cube, points, usable & (observations.rho < 0))
        discovered = state.count > before
        rho = jnp.where(usable, observations.rho, jnp.inf)
        raised = self._raise(state, cube, points, rho)
        nearest = jnp.min(raised, initial=jnp.inf).astype(jnp.float32)
        progress = discovered | (nearest < 0.98 * state.level) | ~jnp.isfinite(state.level)
        idle = jnp.where(progress, 0, state.idle + 1).astype(jnp.int32)
        tired = idle >= self.patience
        smaller = jnp.maximum(self.shrink * state.radius, self.min_radius)
        state = state._replace(
            idle=jnp.where(tired, 0, idle),
            radius=jnp.where(tired, smaller, state.radius).astype(jnp.float32),
            level=jnp.where(discovered | tired, jnp.inf, jnp.minimum(state.level, nearest)),
        )
        state = self._remember(state, cube, points, rho)
        # The best points of a fruitless period lead nowhere.
        state = state._replace(rho=jnp.where(tired, jnp.inf, state.rho))
        raised = self._deflate(state, cube, observations)
        inner = learn(state.inner, cube, raised)
        if self.search.learns and self.search.total(cube) is None:
            inner = jax.lax.cond(
                discovered | tired, lambda: self._restart(state, cube), lambda: inner
            )
        return state._replace(inner=inner)

    def _archive(
        self, state: DiverseState, cube: Cube, points: Points, failing: Bool[Array, " n"]
    ) -> DiverseState:
        """Archive the failures beyond the radius of all archived ones, the farthest first."""
        (u, happened), seen = points, state.seen
        kept = jnp.zeros((self.capacity, 0)) if seen is None else seen.archive
        if seen is not None and happened is not None:
            failing &= is_known(happened)

        def add(
            _: Int[Array, ""], carry: tuple[Array, Array, Array, Array]
        ) -> tuple[Array, Array, Array, Array]:
            archive, kept, count, far = carry
            index = jnp.argmax(jnp.where(failing, far, -1.0))
            fresh = failing[index] & (far[index] > state.radius) & (count < self.capacity)
            slot = jnp.minimum(count, self.capacity - 1)
            archive = jnp.where(fresh, archive.at[slot].set(u[index]), archive)
            if seen is None or happened is None:
                between = apart(cube, u, u[index][None])
            else:
                kept = jnp.where(fresh, kept.at[slot].set(happened[index]), kept)
                between = seen.unlike(happened, happened[index][None])
            closer = jnp.minimum(far, between[:, 0])
            return archive, kept, count + fresh.astype(count.dtype), jnp.where(fresh, closer, far)

        far = jnp.min(self._distances(state, cube, points), axis=1)
        max_new = min(AT_ONCE, len(u))
        start = (state.archive, kept, state.count, far)
        archive, kept, count, _ = jax.lax.fori_loop(0, max_new, add, start)
        if seen is not None:
            seen = seen._replace(archive=kept)
        return state._replace(archive=archive, count=count, seen=seen)

    def _distances(
        self, state: DiverseState, cube: Cube, points: Points
    ) -> Float[Array, "n capacity"]:
        """Return distances to all archived failures; infinite for empty rows of the archive."""
        known = jnp.arange(self.capacity) < state.count
        if state.seen is None or points.happened is None:
            return jnp.where(known, apart(cube, points.u, state.archive), jnp.inf)
        return jnp.where(known, state.seen.unlike(points.happened, state.seen.archive), jnp.inf)

    def _nearness(
        self, state: DiverseState, cube: Cube, points: Points
    ) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
        """Return 1 at an archived failure, 0 from one and a half radii on; and its index."""
        far = self._distances(state, cube, points)
        nearest = jnp.argmin(far, axis=1)
        distance = jnp.min(far, axis=1)
        return jnp.clip(1 - distance / (1.5 * state.radius), 0.0, 1.0), nearest

    def _scale(self, state: DiverseState) -> Float[Array, ""]:
        return 2.0 * state.size / jnp.maximum(state.verdicts, 1.0) + 1e-6

    def _raise(
        self, state: DiverseState, cube: Cube, points: Points, rho: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """Raise robustness near archived failures to that of safe points and beyond."""
        near, _ = self._nearness(state, cube, points)
        return jnp.where(near > 0, jnp.maximum(rho, 0.0) + self._scale(state) * near, rho)

    def _deflate(self, state: DiverseState, cube: Cube, observations: Observations) -> Observations:
        usable = observations.usable
        u = jnp.where(usable[:, None], observations.u, 0.5)
        points = Points(u, observations.outcomes if state.seen is not None else None)
        near, nearest = self._nearness(state, cube, points)
        inside = usable & (near > 0)
        raised = self._raise(state, cube, points, observations.rho)
        rho = jnp.where(inside, raised, observations.rho)
        changed = observations._replace(rho=rho)
        if observations.gradient is None and observations.clauses is None:
            return changed
        offset = jnp.where(np.array(cube.levels) == 0, u - state.archive[nearest], 0.0)
        length = apart(cube, u, state.archive)[jnp.arange(len(u)), nearest]
        # Of the root mean square over the coordinates.
        away = offset / (max(cube.dim, 1) * jnp.maximum(length, 1e-6))[:, None]
        falls = -away / (1.5 * state.radius)
        if observations.gradient is not None:
            own = jnp.where((observations.rho > 0)[:, None], observations.gradient, 0.0)
            raised = own + self._scale(state) * falls
            changed = changed._replace(
                gradient=jnp.where(inside[:, None], raised, observations.gradient)
            )
        if observations.clauses is not None:
            # These have no unit, and of clauses that do not exist the values stay very low.
            there = inside[:, None] & (observations.clauses > NOTHING)
            lifted = jnp.maximum(observations.clauses, 0.0) + near[:, None]
            changed = changed._replace(clauses=jnp.where(there, lifted, observations.clauses))
            gradients = observations.clause_gradients
            if gradients is not None:
                own = jnp.where((observations.clauses > 0)[:, :, None], gradients, 0.0)
                # Zero where the round asked for none.
                asked = there & jnp.any(gradients != 0)
                own = jnp.where(asked[:, :, None], own + falls[:, None, :], gradients)
                changed = changed._replace(clause_gradients=own)
        return changed

    def _remember(
        self, state: DiverseState, cube: Cube, points: Points, rho: Float[Array, " n"]
    ) -> DiverseState:
        """Update the best points so far that are away from the archive."""
        values = jnp.concatenate([rho.astype(jnp.float32), state.rho])
        seen, happened = state.seen, points.happened
        if seen is not None and happened is not None:
            happened = jnp.concatenate([happened, seen.best])
        both = Points(jnp.concatenate([points.u, state.points]), happened)
        score = jnp.where(jnp.isfinite(values), self._raise(state, cube, both, values), jnp.inf)
        _, best = jax.lax.top_k(-score, len(state.rho))
        if seen is not None and happened is not None:
            state = state._replace(seen=seen._replace(best=happened[best]))
        return state._replace(points=both.u[best], rho=values[best])

    def _restart(self, state: DiverseState, cube: Cube) -> PyTree:
        """Start the search inside afresh, from the remembered points alone."""
        batch = len(state.rho)
        inner = self.search.init(jax.random.fold_in(state.key, state.round), cube, batch)
        known = jnp.isfinite(state.rho)
        happened = None if state.seen is None else state.seen.best
        rho = jnp.where(known, state.rho, 1.0)
        raised = self._raise(state, cube, Points(state.points, happened), rho)
        observed = Observations(state.points, raised, known, outcomes=happened)
        return self.search.warm_start(inner, cube, observed)
