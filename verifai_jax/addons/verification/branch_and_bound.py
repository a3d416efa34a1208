"""Examination of boxes: simulations select decidable boxes, sets decide them, the rest is split."""

import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.verification.boxes import BROKEN, OPEN, OUTSIDE, PROVED, Boxes
from verifai_jax.addons.verification.enclosure import TOGETHER, Enclosure
from verifai_jax.core.compute.cores import available_cores
from verifai_jax.core.display.progress import say_done
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.problem.problem import Problem

REACH = 0.45
"""Where a box is sampled, as a share of its width from the middle: inside, not on its faces."""
NO_INFLUENCE = 1e-6
"""Change of the robustness along a coordinate, as a share of the greatest, that is no influence."""
APART = 4
"""Coordinates along which a box without bounds is halved at once: those of its halves, which would
have none either, would be looked at in vain."""
DRAW, DRAWS = 65_536, 16
"""Points that are drawn at a time from boxes that a constraint may cut, and times at most until
enough of them are accepted."""
CANDIDATES = 4096
"""Failing points that are confirmed when the budget is spent, those of the largest boxes first."""


class BranchAndBound:
    """A branch-and-bound process: the boxes, and the programs that examine them.

    `wanted` selects the boxes worth examining; by default all.
    """

    def __init__(self, problem: Problem, enclosure: Enclosure, boxes: Boxes, seed: int) -> None:
        self.wanted: Callable[[Boxes], Bool[np.ndarray, " n"]] = lambda boxes: boxes.state == OPEN
        self.problem, self.enclosure, self.boxes, self.seed = problem, enclosure, boxes, seed
        self.looked_at = self.contradicted = 0
        self.evaluator = Evaluator(problem, 4096, precision=enclosure.precision, seed=seed)

    def go_on(self, end: float | None, limit: int | None) -> str:
        """Examine boxes, the most probable first; return the reason for stopping."""
        top, count, rate = TOGETHER * available_cores(), 32, 1e6
        try:
            while True:
                now = time.perf_counter()
                open_ones = np.flatnonzero((self.boxes.state == OPEN) & self.wanted(self.boxes))
                can = self.boxes[open_ones].splittable(self.enclosure).any(1)
                new = np.isinf(self.boxes.highest[open_ones])
                open_ones = open_ones[can | new]
                if not len(open_ones):
                    return "all boxes are decided or too narrow"
                if end is not None:
                    count = min(count, max(int(rate * (end - now)), 0))
                if limit is not None:
                    count = min(count, limit - self.looked_at)
                if count < 1:
                    return "the budget is spent"
                mass = self.boxes.mass[open_ones]
                self.look_at(open_ones[np.argsort(-mass, kind="stable")[:count]])
                rate = count / (time.perf_counter() - now)
                count = min(2 * count, top)
                decided = float(self.boxes.mass[self.boxes.state != OPEN].sum())
                say_done(self.looked_at, limit, f"{100 * decided:z.3g} % decided")
        except KeyboardInterrupt:
            return "interrupted"

    def look_at(self, rows: Int[np.ndarray, " m"]) -> None:
        """Decide boxes, or split them."""
        some = self.boxes[rows]
        self.looked_at += len(rows)
        robustness, failing = self.star(some)
        proper = np.isfinite(robustness).all(1)
        # Simulations say which boxes may be decided, and only these are worth the sets.
        slope = np.abs(robustness[:, 1::2] - robustness[:, 2::2]).sum(1) / (4.2 * REACH)
        passes = proper & ~failing.any(1) & (robustness[:, 0] - slope >= 0)
        fails = proper & failing.all(1) & (robustness[:, 0] + slope <= 0)
        can = some.splittable(self.enclosure)
        worth = np.flatnonzero(passes | fails | ~proper | ~can.any(1))
        moves = np.zeros(some.low.shape)
        if len(worth):
            bounds = self.enclosure(some.low[worth], some.high[worth])
            some.lowest[worth], some.highest[worth] = bounds.low, bounds.high
            some.inside[worth] |= bounds.inside
            # Without bounds nothing is known of what moves: what simulations show decides.
            moves[worth] = bounds.moves
            state = np.where(bounds.holds, PROVED, np.where(bounds.high < 0, BROKEN, OPEN))
            # A box that the constraint cuts is split until it does so no more: its mass is unknown.
            state = np.where(bounds.inside, state, OPEN)
            state = np.where(bounds.outside, OUTSIDE, state)
            # A simulation outside of its bounds would be a mistake of this program; that of a
            # differential equation is off by the error of its steps.
            seen = np.where(self.enclosure.problem is self.problem, robustness[worth], np.nan)
            wrong = (np.nanmin(seen, 1, initial=np.inf) < bounds.low) & ~bounds.outside
            wrong |= (np.nanmax(seen, 1, initial=-np.inf) > bounds.high) & bounds.inside
            self.contradicted += int(wrong.sum())
            some.state[worth] = np.where(wrong, OPEN, state)
        some.confirmed[:] = some.state == BROKEN
        split = (some.state == OPEN) & can.any(1)
        kept = np.ones(len(self.boxes), bool)
        kept[rows[split]] = False
        for name in ("state", "lowest", "highest", "witness", "confirmed", "inside"):
            getattr(self.boxes, name)[rows] = getattr(some, name)
        order, alike = self.influence(some, robustness, moves, can)
        self.boxes = self.boxes[kept]
        wild = np.zeros(len(some), bool)
        wild[worth] = np.isinf(some.lowest[worth]) & np.isinf(some.highest[worth])
        for those, often in ((split & ~wild, 1), (split & wild, APART)):
            parts, own = some[those], np.flatnonzero(those)
            for k in range(min(often, order.shape[1])):
                cut = alike[own, k]
                halves = parts[cut].halves(order[own[cut], k], self.enclosure)
                parts = parts[~cut].with_more(halves)
                own = np.concatenate([own[~cut], own[cut], own[cut]])
            self.boxes = self.boxes.with_more(parts)

    def star(self, some: Boxes) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
        """Return robustness (or NaN) and failures at the middle of boxes and on its sides.

        The other points are on both sides along each coordinate; a failing one becomes the witness.
        """
        dim = some.low.shape[1]
        offsets = np.concatenate([np.zeros((1, dim)), *(
            REACH * sign * np.eye(dim)[j : j + 1] for j in range(dim) for sign in (1, -1)
        )])  # fmt: skip
        points = some.low[:, None] + (0.5 + offsets) * (some.high - some.low)[:, None]
        points = points.astype(np.float32)
        verdicts = self.evaluator(points.reshape(-1, dim))
        robustness = verdicts.lowest.reshape(len(some), -1).astype(float)
        failing = verdicts.violated.reshape(robustness.shape)
        if self.problem.space.where is not None:
            refused = ~np.asarray(self.problem.space.accepts_points(points.reshape(-1, dim)))
            refused = refused.reshape(robustness.shape)
            robustness, failing = np.where(refused, np.nan, robustness), failing & ~refused
        worst = np.argmin(np.where(failing, robustness, np.inf), axis=1)
        any_failing = failing.any(1)
        rows = np.flatnonzero(any_failing)
        some.witness[rows] = points[rows, worst[rows]]
        return robustness, failing

    def influence(
        self, some: Boxes, robustness: np.ndarray, moves: np.ndarray, can: np.ndarray
    ) -> tuple[Int[np.ndarray, "n dim"], Bool[np.ndarray, "n dim"]]:
        """Return the best coordinate of each box to split, and those at least half as good.

        The best one changes the robustness most. If bounds are wider than the differences between
        simulations, it is the widest coordinate that changes the robustness at all, or, if at least
        half as wide, one that moves the signals and thereby the nonlinear terms.
        """
        # What counts most is that a point has a verdict, or is accepted, and its neighbour is not.
        values = np.where(np.isnan(robustness), 1e30, np.clip(robustness, -1e29, 1e29))
        middle, up, down = values[:, :1], values[:, 1::2], values[:, 2::2]
        change = _relative(np.abs(up - down) + 2 * np.abs(up + down - 2 * middle))
        seen = values.max(1) - values.min(1) + 1e-30
        wide = np.clip(some.highest - some.lowest, 1e-30, 1e29)
        loose = np.where(moves.any(1), np.clip(1 - seen / wide, 0, 1), 0)[:, None]
        # A coordinate without influence at these points may have one between them.
        width = _relative(some.high - some.low)
        score = (1 - loose) * (change + 0.1 * width)
        score += loose * (width * np.where(change > NO_INFLUENCE, 1.0, 0.1) + _relative(moves) / 2)
        score = np.where(can, score, -1.0)
        order = np.argsort(-score, axis=1, kind="stable")
        score = np.take_along_axis(score, order, axis=1)
        return order, (score >= score[:, :1] / 2) & (score >= 0)

    def confirm(self) -> None:
        """Find out which failing points of open boxes certainly fail."""
        open_ones = (self.boxes.state == OPEN) & self.boxes.has_witness & ~self.boxes.confirmed
        rows = np.flatnonzero(open_ones)
        rows = rows[np.argsort(-self.boxes.mass[rows], kind="stable")[:CANDIDATES]]
        if len(rows):
            bounds = self.enclosure(self.boxes.witness[rows], self.boxes.witness[rows])
            self.boxes.confirmed[rows] = (bounds.high < 0) & bounds.inside

    def sample(self, count: int) -> None:
        """Draw points of open boxes from the prior, and simulate accepted ones of undecided boxes.

        Points that the constraint refuses are no samples: they only say how much of the boxes that
        it may cut is accepted. Such boxes are drawn from even if nothing is to be simulated.
        """
        boxes = self.boxes
        for counts in (boxes.drawn, boxes.accepted, boxes.samples, boxes.failures):
            counts[:] = 0
        undecided = (boxes.state == OPEN) & ~boxes.confirmed
        rows = np.flatnonzero((boxes.state == OPEN) & ~(boxes.confirmed & boxes.inside))
        cut = not boxes.inside[rows].all()
        mass, left, constraint = boxes.mass[rows], count, self.problem.space.constraint
        if not mass.sum() > 0 or not (cut or count):
            return
        random = np.random.default_rng((self.seed, len(boxes)))
        for _ in range(DRAWS if cut else 1):
            chosen = rows[random.choice(len(rows), DRAW if cut else count, p=mass / mass.sum())]
            low, high = boxes.low[chosen], boxes.high[chosen]
            points = (low + random.random(low.shape) * (high - low)).astype(np.float32)
            points = np.clip(points, low, high).astype(np.float32)
            accepted = np.ones(len(points), bool)
            if constraint is not None:
                accepted = np.asarray(constraint(points))
            np.add.at(boxes.drawn, chosen, 1)
            np.add.at(boxes.accepted, chosen, accepted)
            own = np.flatnonzero(accepted & undecided[chosen])[:left]
            if len(own):
                verdicts = self.evaluator(points[own])
                # What gives no verdict is not known to be safe.
                np.add.at(boxes.samples, chosen[own], 1)
                np.add.at(boxes.failures, chosen[own], verdicts.violated | ~verdicts.proper)
                failed = own[np.asarray(verdicts.violated)]
                boxes.witness[chosen[failed]] = points[failed]
            left -= len(own)
            if not left:
                break


def _relative(numbers: Float[np.ndarray, "n dim"]) -> Float[np.ndarray, "n dim"]:
    """Return numbers as shares of the greatest in their row."""
    return numbers / np.maximum(numbers.max(1, keepdims=True), 1e-300)
