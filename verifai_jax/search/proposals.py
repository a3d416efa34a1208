"""Proposals of a search that satisfy the constraint of the space.

    proposals = Proposals(search, space.cube, batch=1024, key=key, accepts=space.constraint)
    points = proposals.next(1024)                       # [m, d], m <= 1024
    proposals.tell(rho, valid, gradient)                # of these points
    proposals.differentiate, proposals.temperature      # the derivatives that the search wants

A constraint (`where=`) refuses points; only accepted ones are simulated. A search that does not
learn is asked until there are enough points, so that the accepted points are a subsequence of its
sequence for any batch size. A search that learns is asked again only for the refused rows, so each
row has its distribution conditional on acceptance; rows that stay refused are not valid when it
learns. A point that was simulated before is not simulated again (`repetition`).
"""

from collections.abc import Callable, Mapping
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from verifai_jax.core.compute.compilation import Compilation, pad_rows
from verifai_jax.core.values.clauses import ABSENT, CLAUSES
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Observations, Plan, Search
from verifai_jax.search.contract import check_points, is_user_defined
from verifai_jax.search.repetition import Repetition
from verifai_jax.search.search_program import compiled_search, compiled_start

TRIES = 32
"""Maximum number of asks in one round until every row of a search that learns is accepted. Where
one point in ten is allowed, 32 asks leave a row refused in one of thirty cases."""
MAX_REFUSED = 2000
"""Asks in a row without a single accepted point, after which a run ends: in rounds of 16 these
are 32 000 points, among which one allowed in ten thousand would be met."""
FILLERS = {
    "gradient": 0.0, "clauses": 0.0, "clause_gradients": 0.0, "coverage_ids": -1, "outcomes": np.nan
}  # fmt: skip
"""Entries of observations that say nothing, by the name of the part."""


class ConstraintError(ValueError):
    """An error for a search whose proposals the constraint of the space keeps refusing."""


class Proposals:
    """The stream of points to simulate; see the module's docstring.

    - `proposed`: number of points that the search proposed.
    - `accepted`: number of these that the constraint accepted.
    - `stage`: the search, or the members that take part in the next round.
    - `cut`: whether the last `next` left out points proposed by a search that learns.

    `improve` may replace points of a round; the search then learns from the new ones.
    """

    def __init__(
        self, search: Search, cube: Cube, batch: int, key: Key[Array, ""],
        accepts: Callable[[Any], Bool[Array | np.ndarray, " n"]] | None = None,
        coverage_ids: int = 0,
        improve: Callable[[Any], Float[Any, "batch d"]] | None = None,
    ) -> None:  # fmt: skip
        self.search, self.batch, self.cube = search, batch, cube
        self.total = search.total(self.cube)
        self.proposed = self.accepted = 0
        self.cut = False
        self._coverage_ids = coverage_ids if search.wants.coverage_ids else 0
        self._improve = improve
        self.stage = search.stage(None, self.cube, batch)
        self._program = compiled_search(self.stage, self.cube, batch, self._coverage_ids)
        self._checked = is_user_defined(search)
        self._accepts = accepts
        if self._accepts is not None:
            # Compiled now, in the shape that it will be asked in.
            self._accepts(np.zeros((batch, self.cube.dim), np.float32))
        self._warm: Callable[..., PyTree] | None = None
        self._state = compiled_start(self.stage, self.cube, batch)(key)
        self._queue = np.zeros((0, self.cube.dim), np.float32)
        self._points: Any = self._queue  # Of the last ask of a search that learns, all rows,
        self._rows = np.zeros(0, int)  # and which of them are simulated.
        self._plan: Plan | None = None
        self._barren = 0  # Rounds without any, so far.
        self._repetition = Repetition(cube, key) if search.learns and cube.dim else None

    @property
    def exhausted(self) -> bool:
        """True when a finite search has no further point."""
        return self.total is not None and self.proposed >= self.total and not len(self._queue)

    @property
    def distinct(self) -> int | None:
        """Number of failures far from each other; None if the search does not count them."""
        count = self.search.distinct(self._state)
        return None if count is None else int(count)

    @property
    def differentiate(self) -> bool:
        """True if the search wants gradients of the clauses at the points of the last `next`."""
        return self._plan is not None and bool(self._plan.differentiate)

    @property
    def temperature(self) -> Float[Array, ""] | Float[np.ndarray, " m"] | float:
        """Temperature of the smooth robustness; only for searches with gradients.

        It is one number, or one for each of the last points if the search wants clauses.
        """
        if self._plan is None:
            return self._program.temperature(self._state)
        return np.asarray(self._plan.temperature)[self._rows]

    def next(self, max_points: int) -> Float[Array, "m d"] | Float[np.ndarray, "m d"]:
        """Return the next points; none if the constraint refuses all rows of a round.

        **Arguments:**
        - `max_points`: maximum number of points.
        **Returns:** points of the unit cube, `[m, d]`.
        **Raises:** `ConstraintError` if the constraint has refused all proposals for long.
        """
        self.begin_stage()
        points = (
            self._next_to_learn_from(max_points)
            if self.search.learns
            else self._next_of_sequence(max_points)
        )
        self.accepted += len(points)
        return points

    def tell(
        self,
        rho: Float[np.ndarray, " m"],
        valid: Bool[np.ndarray, " m"],
        gradient: Float[np.ndarray, "m d"] | None,
        clauses: Float[np.ndarray, "m clauses"] | None = None,
        clause_gradients: Float[np.ndarray, "m clauses d"] | None = None,
        coverage_ids: Int[np.ndarray, "m ids"] | None = None,
        outcomes: Float[np.ndarray, "m outcome"] | None = None,
    ) -> None:
        """Let the search learn from the simulations of the points last returned by `next`.

        **Arguments:**
        - `rho`: robustness of each point.
        - `valid`: False for simulations without a verdict.
        - `gradient`: the gradient of the smooth robustness, for a search that wants it.
        - `clauses`, `clause_gradients`: those of a search that wants clauses; see `Observations`.
        - `coverage_ids`: for a search that wants them, in the number given to the constructor.
        - `outcomes`: for a search that wants them.
        """
        if not self.search.learns:
            return
        if self.search.wants.no_verdict_rows:
            rho, valid = np.where(valid, rho, np.float32(np.nan)), np.ones(len(rho), bool)
        if self.search.wants.clauses and clauses is None:
            # Every goal has one, whose value is the robustness.
            clauses = np.full((len(rho), CLAUSES), ABSENT, np.float32)
            clauses[:, 0] = rho
        known = {
            "gradient": gradient,
            "clauses": clauses,
            "clause_gradients": clause_gradients,
            "coverage_ids": coverage_ids,
            "outcomes": outcomes,
        }
        observations = self._observed(self._points, self._rows, rho, valid, known)
        self._state = self._program.tell(self._state, observations)

    def tell_refused(self) -> None:
        """Tell the search that no row of the last round could be simulated."""
        self.tell(np.zeros(0, np.float32), np.zeros(0, bool), None)

    def warm_start(
        self, u: Float[np.ndarray, "n d"], rho: Float[np.ndarray, " n"],
        outcomes: Float[np.ndarray, "n outcome"] | None = None,
    ) -> None:  # fmt: skip
        """Let the search learn from points of an earlier table, or points that a person gave."""
        if not self.search.learns or not len(u):
            return
        if self._warm is None:
            learn = self.search.warm_start
            self._warm = jax.jit(lambda state, rows: learn(state, self.cube, rows))
        for start in range(0, len(u), self.batch):
            part = slice(start, start + self.batch)
            rows = np.arange(len(u[part]))
            points = self._spread(u[part].astype(np.float32), rows, 0.5)
            values, valid = rho[part].astype(np.float32), np.ones(len(rows), bool)
            known = {"outcomes": None if outcomes is None else outcomes[part]}
            observations = self._observed(points, rows, values, valid, known)
            self._state = self._warm(self._state, observations)

    def remember(self, u: Float[np.ndarray, "n d"]) -> None:
        """Never propose these given points, which the run has already simulated."""
        if self._repetition is not None:
            self._repetition.add(u)

    def _observed(
        self, points: Any, rows: Int[np.ndarray, " m"], rho: Float[np.ndarray, " m"],
        valid: Bool[np.ndarray, " m"], known: Mapping[str, Any],
    ) -> Observations:  # fmt: skip
        """Return the observations of a whole batch, of which these rows were simulated.

        - `known`: further parts by name, which the search gets if it wants them; None for nothing.
        """
        form = self.search.wants.form(self.cube, len(rho), self._coverage_ids)
        parts = {}
        for name, values in known.items():
            wanted = getattr(form, name)
            if wanted is not None:
                filler = FILLERS[name]
                if values is None:
                    values = np.full(wanted.shape, filler, wanted.dtype)
                parts[name] = self._spread(values, rows, filler)
        return Observations(
            points, self._spread(rho, rows, np.nan), self._spread(valid, rows, False), **parts
        )

    def begin_stage(self) -> bool:
        """Start compiling the members that take part in the next round, in the background.

        `next` does this by itself.

        **Returns:** whether they differ from those of the last round.
        """
        stage = self.search.stage(self._state, self.cube, self.batch)
        if stage == self.stage:
            return False
        self.stage = stage
        self._program = compiled_search(stage, self.cube, self.batch, self._coverage_ids)
        return True

    def wait(self) -> None:
        """Wait until the compilation started by `begin_stage` has finished."""
        for program in (self._program.ask, self._program.plan, self._program.tell):
            if isinstance(program, Compilation):
                program.result()

    def checkpoint(self) -> dict[str, np.ndarray | Array]:
        """Return the state that determines the next points; its arrays never change."""
        leaves = jax.tree.leaves(self._state)
        return {
            **{f"search.{i}": leaf for i, leaf in enumerate(leaves)},
            "queue": self._queue,
            "counts": np.array([self.proposed, self.accepted], np.int64),
            **({} if self._repetition is None else {"simulated": self._repetition.codes}),
        }

    def restore(self, checkpoint: Mapping[str, np.ndarray | Array]) -> None:
        """Continue from a checkpoint.

        **Raises:** `ValueError` for a checkpoint of another search, space or batch size.
        """
        leaves, form = jax.tree.flatten(self._state)
        restored = []
        for i, leaf in enumerate(leaves):
            saved = checkpoint.get(f"search.{i}")
            if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) and isinstance(saved, np.ndarray):
                saved = jax.random.wrap_key_data(jnp.asarray(saved), impl=jax.random.key_impl(leaf))
            if saved is None or saved.shape != leaf.shape or saved.dtype != leaf.dtype:
                raise ValueError(
                    f"the saved state is not one of search {self.search!r} on this space with "
                    f"batches of {self.batch}"
                )
            restored.append(jnp.asarray(saved))
        self._state = jax.tree.unflatten(form, restored)
        self._queue = np.asarray(checkpoint["queue"])
        self.proposed, self.accepted = (int(count) for count in checkpoint["counts"])
        if self._repetition is not None and "simulated" in checkpoint:
            self._repetition.restore(np.asarray(checkpoint["simulated"]))

    def _ask(self) -> Float[Array, "m d"]:
        points, self._state = self._program.ask(self._state)
        if self._checked:
            check_points(self.search, self.cube, points)
        if self.total is not None:
            points = points[: max(0, self.total - self.proposed)]
        return points

    def _accepted_rows(
        self, points: Float[Array, "n d"] | Float[np.ndarray, "n d"]
    ) -> Bool[np.ndarray, " n"]:
        if self._accepts is None:
            return np.ones(len(points), bool)
        return np.asarray(self._accepts(pad_rows(points, self.batch)))[: len(points)]

    def _next_of_sequence(self, max_points: int) -> Float[Array, "m d"] | Float[np.ndarray, "m d"]:
        """Return the next accepted points of a search that does not learn."""
        ready, barren = len(self._queue), 0
        parts: list[np.ndarray | Array] = [self._queue]
        while ready < max_points and not (self.total is not None and self.proposed >= self.total):
            points = self._ask()
            self.proposed += len(points)
            if self._accepts is not None:
                points = np.asarray(points)[self._accepted_rows(points)]
            barren = 0 if len(points) else barren + 1
            if barren >= MAX_REFUSED:
                self._give_up()
            parts.append(points)
            ready += len(points)
        whole = parts[-1] if ready == len(parts[-1]) else np.concatenate(parts)
        if ready <= max_points:
            # As the search gave it: a full round needs no copy.
            self._queue = np.zeros((0, self.cube.dim), np.float32)
            return whole
        whole = np.asarray(whole)
        self._queue = whole[max_points:]
        return whole[:max_points]

    def _next_to_learn_from(
        self, max_points: int
    ) -> Float[Array, "m d"] | Float[np.ndarray, "m d"]:
        """Return the points of one round of a search that learns."""
        points = self._ask()
        if self._improve is not None:
            points = self._improve(points)
        self._plan = None
        planned = len(points)
        if self.search.wants.clauses:
            plan: Plan = self._program.plan(self._state)
            self._plan, planned = plan, int(plan.rows)
        self.proposed += planned
        wanted = np.arange(len(points)) < planned
        asked = points
        points, learned = self._unrepeated(points, wanted)
        accepted = self._accepted_rows(points) & wanted
        for _ in range(TRIES - 1):
            if accepted.sum() == planned or self.total is not None:
                break
            others = self._ask()
            fresh = wanted & ~accepted
            if np.array_equal(np.asarray(others)[fresh], np.asarray(asked)[fresh]):
                break  # This search proposes the same until it learns something.
            self.proposed += int(fresh.sum())
            asked = others
            parts = zip(self._unrepeated(others, fresh), (points, learned), strict=True)
            points, learned = (jnp.where(fresh[:, None], new, old) for new, old in parts)
            accepted = accepted | (self._accepted_rows(points) & wanted)
        self._barren = 0 if accepted.any() else self._barren + 1
        if self._barren >= MAX_REFUSED:
            self._give_up()
        self._points = pad_rows(learned, self.batch) if len(learned) < self.batch else learned
        self._rows = np.flatnonzero(accepted)[:max_points]
        self.cut = int(accepted.sum()) > max_points
        simulated = points if len(self._rows) == len(points) else np.asarray(points)[self._rows]
        if self._repetition is not None and not self.cut:
            self._repetition.add(np.asarray(simulated))
        return simulated

    def _unrepeated(self, points: Any, wanted: Bool[np.ndarray, " n"]) -> tuple[Any, Any]:
        """Return the points to simulate for those of a round, and those that the search learns of.

        A search that plans its rounds learns of any point that takes the turn of a repeated one,
        but for derivatives. Others go on from the points that they proposed.
        """
        if self._repetition is None:
            return points, points
        anywhere = self._plan is not None and not bool(self._plan.differentiate)
        return self._repetition.avoid(np.asarray(points), wanted, anywhere, self.proposed)

    def _spread(self, values: np.ndarray, rows: Int[np.ndarray, " m"], filler: float) -> Any:
        """Put values of these rows into an array of all rows of the batch."""
        if len(values) == self.batch:
            return values
        whole = np.full((self.batch, *values.shape[1:]), filler, values.dtype)
        whole[rows] = values
        return whole

    def _give_up(self) -> NoReturn:
        raise ConstraintError(
            f"where refused all proposals of search {self.search!r} for {MAX_REFUSED} rounds; it "
            f"accepted {self.accepted} of {self.proposed} points in all. Make the space narrower, "
            "so that more of it is allowed, or use another search"
        )
