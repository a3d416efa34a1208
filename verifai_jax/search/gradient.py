"""Descent on the gradients of the clauses to violate, from many starts.

A system fails where all clauses of a goal are negative at once (`mtl.clauses`). Around a point with
known values and gradients each clause is linearised, and the next point minimises the greatest of
them: a corner of the cube or of a box around the point, or a point where two clauses are equal.
That is sequential linear programming for a minimax problem (Fletcher, Practical Methods of
Optimization, 1987, section 14.6); for one clause it is a jump along the signs of its gradient,
which often ends in a corner that fails. Unlike a plain gradient it does not stall at a maximum of
clauses, because it uses the gradients of all of them.

The first descent starts in the middle, and its box is the whole cube. It shrinks while points turn
out no better, several sizes in one batch where there is room, and grows again on success. If no
gradient points out of a corner, the coordinates with the weakest effect are flipped one at a time,
since a small derivative says little about the other end of the range. After that, or when gradients
are zero or not finite, the descent starts again elsewhere.

The descents from there on are many and short: their box is smaller, it does not grow, their
temperatures are higher, and those whose first jump is no better are given up at once. From random
starts this took fewer simulations a failure than longer descents on eight of nine requirements of
the ARCH competition (`benchmarks/RESULTS.md`), and more on CC2, which fails in corners; so every
second descent begins with the whole cube. From an offered start, which is already a good point, the
first box is even smaller.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from verifai_jax.core.messages.checks import check_positive
from verifai_jax.core.values.clauses import CLAUSES
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Plan, SlopeSearch, check_options, choose
from verifai_jax.search.clause_values import NOTHING, comparable_clauses
from verifai_jax.search.draws import draw_uniform
from verifai_jax.search.halton import halton_points
from verifai_jax.search.linear_steps import HALVINGS, flip_weakest, minimax_direction

# The first two were chosen by hand; no comparison with other values is recorded.
LITTLE = 0.9  # share of the robustness that is left after a step which is only a little better
COOLING = 0.7  # factor on the temperature with each step, after the first descent
WOBBLE = 0.1
"""Greatest share by which boxes smaller than the cube are less, in all of a run: with it all points
of a descent but its start and a corner depend on the seed."""
SIZES = 6
"""Maximum number of boxes tried at once: after the whole cube, the sixth box has a hundredth of its
side, which is less than the default `min_radius`."""
FIRST_BOX = 0.4
"""Size of the first box of short descents: beyond it gradients say little. Chosen among others from
192 to 384 random starts, by simulations a failure (`benchmarks/RESULTS.md`, "Short descents")."""
FULL_CUBE = 2
"""Of so many descents one begins with the whole cube, for failures in corners such as those of CC2.
With one of four, and twelve descents first, the landscape of ripples cost half as much again."""
OFFERED_BOX = 0.16
"""Size of the first box around a start that was offered: `FIRST_BOX` shrunk once by the
default factor."""
UNPROMISING = 0.75
"""Share of `FIRST_BOX` below which a box is not tried where no greater one was better: the first
box is tried, and the next smaller one is not."""


class GradientState(NamedTuple):
    key: Key[Array, ""]
    starts: UInt32[Array, ""]  # how many starts were made
    fresh: Bool[Array, " descents"]  # descents that take a new start
    known: Bool[Array, " descents"]  # descents that know the gradients at their point
    point: Float[Array, "descents d"]
    clauses: Float[Array, "descents clauses"]
    gradients: Float[Array, "descents clauses d"]
    radius: Float[Array, " descents"]
    flips: Int[Array, " descents"]  # coordinates of a corner that were tried the other way
    number: UInt32[Array, " descents"]  # of the start
    given: Bool[Array, " descents"]  # whose start was offered
    steps: Int[Array, " descents"]  # points that were better, since the start
    slow: Int[Array, " descents"]  # and of these, in a row, those that were little better
    temperature: Float[Array, " descents"]
    offered: Float[Array, "descents d"]  # starts from elsewhere
    near: Float[Array, " descents"]  # their robustness; infinite where there is none
    useless: Int[Array, ""]  # starts in a row whose gradients were zero or not finite
    descent: Int[Array, " batch"]  # of the last ask: whose row it is, and in which box
    box: Float[Array, " batch"]
    flipped: Bool[Array, " batch"]
    rows: Int[Array, ""]
    differentiates: Bool[Array, ""]


@dataclass(frozen=True)
class Gradient(SlopeSearch[GradientState]):
    """Sequential linear programming on the clauses; discrete coordinates keep their start's values.

    **Arguments:**
    - `descents`: maximum number of simultaneous descents; at most a quarter of the batch.
    - `shrinks`: factor on the size of the box when no point in it was better.
    - `min_radius`: size of the box below which a descent ends, after its first step.
    - `flips`: number of coordinates of a corner that are tried the other way before a descent ends.
    - `patience`: consecutive steps with little progress after which a descent ends.
    - `temperatures`: the temperatures of the smooth robustness, in units of the spread of the
      predicates. The first one is for the first descent, which halves it with every step; the
      others are for the other descents in turn, in which they fall more slowly. A single one is for
      all.
    - `coldest`: minimum temperature.
    **Raises:** `ValueError` for values out of range; in `check` also without continuous features.
    """

    descents: int = 16
    shrinks: float = 0.4
    min_radius: float = 0.02
    flips: int = 3
    patience: int = 4
    temperatures: tuple[float, ...] = (0.002, 0.05, 0.2)
    coldest: float = 0.001

    def __post_init__(self) -> None:
        counts = {"descents": 1, "flips": 0, "patience": 1}
        check_options(self, counts, ["shrinks", "min_radius"], ["coldest"])
        if self.shrinks == 1:
            raise ValueError("shrinks must be less than 1; got 1")
        object.__setattr__(self, "temperatures", tuple(self.temperatures))
        if not self.temperatures:
            raise ValueError("temperatures must have at least one entry; got none")
        for temperature in self.temperatures:
            check_positive("temperatures", temperature, finite=True)

    def at_once(self, batch: int) -> int:
        """Return the number of simultaneous descents for batches of this size."""
        return max(1, min(self.descents, batch // 4))

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> GradientState:
        n, d = self.at_once(batch), cube.dim
        return GradientState(
            key=key,
            starts=jnp.uint32(0),
            fresh=jnp.ones(n, bool),
            known=jnp.zeros(n, bool),
            point=jnp.full((n, d), 0.5, jnp.float32),
            clauses=jnp.zeros((n, CLAUSES), jnp.float32),
            gradients=jnp.zeros((n, CLAUSES, d), jnp.float32),
            radius=jnp.ones(n, jnp.float32),
            flips=jnp.zeros(n, jnp.int32),
            number=jnp.zeros(n, jnp.uint32),
            given=jnp.zeros(n, bool),
            steps=jnp.zeros(n, jnp.int32),
            slow=jnp.zeros(n, jnp.int32),
            temperature=jnp.full(n, self.temperatures[0], jnp.float32),
            offered=jnp.full((n, d), 0.5, jnp.float32),
            near=jnp.full(n, jnp.inf, jnp.float32),
            useless=jnp.int32(0),
            descent=jnp.zeros(batch, jnp.int32),
            box=jnp.ones(batch, jnp.float32),
            flipped=jnp.zeros(batch, bool),
            rows=jnp.int32(0),
            differentiates=jnp.array(False),
        )

    def ask(self, state: GradientState, cube: Cube, batch: int) -> Asked[GradientState]:
        if not cube.dim:  # One point is all that there is.
            return jnp.zeros((batch, 0), jnp.float32), state._replace(rows=jnp.int32(batch))
        n = self.at_once(batch)
        # Gradients first, once half of the descents wait for them.
        known = jnp.sum(state.known)
        differentiates = 2 * (n - known) >= n
        starts, begun = self._starts(state, cube)
        state = choose(differentiates, begun, state)
        first = jnp.argsort(jnp.where(differentiates, state.known, ~state.known), stable=True)
        there = jnp.where(differentiates, n - known, jnp.maximum(known, 1))
        row = jnp.arange(batch)
        # The largest box of each descent, then the next of each, and so on.
        descent = first[row % there]
        size = jnp.where(differentiates, 0, row // there)
        rows = jnp.where(differentiates, there, jnp.minimum(there * min(SIZES, batch // n), batch))
        box = state.radius[descent] * self.shrinks ** size.astype(jnp.float32)
        tried_box = jnp.where(box < 1, box * (1 - WOBBLE * draw_uniform(state.key, (1,))), box)
        # No more rows than these are ever simulated.
        max_rows = min(n * min(SIZES, batch // n), batch)
        tried, flipped = jax.lax.cond(
            differentiates,
            lambda: (starts[descent[:max_rows]], jnp.zeros(max_rows, bool)),
            lambda: self._boxes(
                state, cube, descent[:max_rows], size[:max_rows], tried_box[:max_rows]
            ),
        )
        tried = jnp.pad(tried, ((0, batch - max_rows), (0, 0)), constant_values=0.5)
        u = jnp.where(differentiates, starts[descent], tried)
        return u, state._replace(
            descent=descent,
            box=box,
            flipped=jnp.pad(flipped, (0, batch - max_rows)),
            rows=rows.astype(jnp.int32),
            differentiates=differentiates,
        )

    def _boxes(
        self, state: GradientState, cube: Cube, descent: Int[Array, " n"], size: Int[Array, " n"],
        box: Float[Array, " n"],
    ) -> tuple[Float[Array, "n d"], Bool[Array, " n"]]:  # fmt: skip
        """Return where the linear clauses are lowest in boxes of descents, and which are flips."""
        free = np.array(cube.levels) == 0
        clauses, gradients = state.clauses[descent], state.gradients[descent]
        point = state.point[descent]
        # A goal of a single clause needs none; it is the same for all rows.
        several = jnp.any(state.known & (state.clauses[:, 1] > NOTHING))
        halvings = jnp.where(several, HALVINGS, 0)
        solve = jax.vmap(minimax_direction, in_axes=(0, 0, 0, 0, None, None))
        tried = solve(clauses, gradients, point, box, free, halvings)
        stays = jnp.max(jnp.abs(tried - point), axis=1, initial=0.0) < 1e-6
        flip = jax.vmap(flip_weakest, in_axes=(0, 0, 0, 0, None))
        other = flip(clauses, gradients, point, state.flips[descent] + size, free)
        return jnp.where(stays[:, None], other, tried), stays

    def plan(self, state: GradientState, cube: Cube, batch: int) -> Plan:
        return Plan(state.rows, state.differentiates, state.temperature[state.descent])

    def tell(self, state: GradientState, cube: Cube, observations: Observations) -> GradientState:
        assert observations.clauses is not None, "the gradient search needs clauses"
        assert observations.clause_gradients is not None
        if not cube.dim:
            return state
        n, batch = len(state.fresh), len(observations.rho)
        mine = jnp.arange(batch) < state.rows
        usable = observations.usable & mine
        clauses = jnp.where(mine[:, None], comparable_clauses(observations), 0.0)
        merit = jnp.where(usable, jnp.max(clauses, axis=1), jnp.inf)
        owner = (state.descent[None] == jnp.arange(n)[:, None]) & mine[None]
        # For each descent the best of its rows, the first of equally good ones.
        scores = jnp.where(owner & usable[None], merit[None], jnp.inf)
        best = jnp.argmin(scores, axis=1)
        lowest = jnp.min(scores, axis=1)
        failed = jnp.any(owner & (usable & (observations.rho < 0))[None], axis=1)
        gradients = jnp.where(usable[best][:, None, None], observations.clause_gradients[best], 0.0)
        finite = jnp.all(jnp.isfinite(gradients), axis=(1, 2))
        gradients = jnp.where(finite[:, None, None], gradients, 0.0)
        # Where the greatest clause has no slope, a step lowers none that counts.
        greatest = jnp.argmax(clauses[best], axis=1)[:, None, None]
        slope = jnp.take_along_axis(gradients, greatest, axis=1)
        informative = finite & jnp.any(slope != 0, axis=(1, 2)) & jnp.isfinite(lowest)
        visited = jnp.any(owner, axis=1)
        before = jnp.max(state.clauses, axis=1)
        # With gradients: a descent goes on from where they are known, or starts elsewhere.
        begin = jnp.where(state.number % FULL_CUBE > 0, FIRST_BOX, 1.0)
        begin = jnp.where(state.given, OFFERED_BOX, begin)
        differentiated = state._replace(
            point=_rows(informative & visited, observations.u[best], state.point),
            clauses=_rows(informative & visited, clauses[best], state.clauses),
            gradients=_rows(informative & visited, gradients, state.gradients),
            known=jnp.where(visited, informative & ~failed, state.known),
            fresh=jnp.where(visited, ~informative | failed, state.fresh),
            radius=jnp.where(visited & state.fresh, begin, state.radius),
            flips=jnp.where(visited, 0, state.flips),
            steps=jnp.where(visited & state.fresh, 0, state.steps),
            slow=jnp.where(visited & state.fresh, 0, state.slow),
            useless=jnp.where(
                jnp.any(informative),
                0,
                state.useless + jnp.sum(visited & jnp.isfinite(lowest) & ~informative),
            ).astype(jnp.int32),
        )
        # Without: a better point, whose gradients are wanted next, or a smaller box.
        better = lowest < before - 1e-4 * jnp.abs(before)
        smallest = jnp.min(jnp.where(owner, state.box[None], jnp.inf), axis=1)
        turned = state.flipped[best] & visited
        flips = state.flips + jnp.sum(owner, axis=1).astype(jnp.int32)
        # The first descent goes on for long; of the others the first jumps are worth the most.
        long = (state.number == 0) & ~state.given
        grown = jnp.minimum(1.0, jnp.where(long, 2.0, 1.0) * state.box[best])
        radius = jnp.where(better, grown, smallest * self.shrinks)
        limit = min(self.flips, len(cube.continuous))
        early = ~long & ~state.given & (state.steps == 0)
        min_radius = jnp.where(early, UNPROMISING * FIRST_BOX, self.min_radius)
        over = failed | (~better & jnp.where(turned, flips >= limit, radius < min_radius))
        slow = jnp.where(lowest > LITTLE * before, state.slow + 1, 0)
        over |= better & (slow >= self.patience)
        goes_on = visited & ~over
        cooling = jnp.where(long, 0.5, COOLING)
        colder = jnp.maximum(cooling * state.temperature, self.coldest)
        undifferentiated = state._replace(
            point=_rows(goes_on & better, observations.u[best], state.point),
            clauses=_rows(goes_on & better, clauses[best], state.clauses),
            known=jnp.where(visited, ~over & ~better, state.known),
            fresh=jnp.where(visited, over, state.fresh),
            radius=jnp.where(goes_on & (better | ~turned), radius, state.radius),
            flips=jnp.where(
                goes_on, jnp.where(better, 0, jnp.where(turned, flips, 0)), state.flips
            ),
            temperature=jnp.where(goes_on & better, colder, state.temperature),
            steps=jnp.where(visited & better, state.steps + 1, state.steps),
            slow=jnp.where(visited & better, slow, state.slow).astype(jnp.int32),
        )
        return choose(state.differentiates, differentiated, undifferentiated)

    def _starts(
        self, state: GradientState, cube: Cube
    ) -> tuple[Float[Array, "descents d"], GradientState]:
        """Return the points to differentiate: starts of fresh descents, the middle first."""
        number = state.starts + jnp.cumsum(state.fresh).astype(jnp.uint32) - 1
        points = halton_points(number, cube.dim, state.key)
        free = np.array(cube.levels) == 0
        middle = jnp.where(free, 0.5, points)
        points = jnp.where((number == 0)[:, None], middle, points)
        given = jnp.isfinite(state.near)
        points = jnp.where(given[:, None], state.offered, points)
        first, *others = self.temperatures
        hot = jnp.asarray(others or [first], jnp.float32)[number % max(len(others), 1)]
        hot = jnp.where((number == 0) & ~given, jnp.float32(first), hot)
        starts = jnp.where(state.fresh[:, None], points, state.point)
        return starts, state._replace(
            starts=state.starts + jnp.sum(state.fresh).astype(jnp.uint32),
            temperature=jnp.where(state.fresh, hot, state.temperature),
            number=jnp.where(state.fresh, number, state.number),
            given=jnp.where(state.fresh, given, state.given),
            near=jnp.where(state.fresh, jnp.inf, state.near),
        )


def _rows(chosen: Bool[Array, " n"], new: Array, old: Array) -> Array:
    return jnp.where(chosen.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
