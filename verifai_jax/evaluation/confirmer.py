"""Confirmation of counterexamples by replays that are more precise than the search.

    confirmer = Confirmer(problem, precision="float32", seed=0)
    found = confirmer(rows, numbers)                    # columns [n] of the table, row numbers [n]
    found.verdict                                       # [n]: "confirmed", "fragile", ...
    found.rho["quarter_step"]                           # [n], robustness at a quarter of the step

A search simulates in single precision at the model's step; both can cause false violations. A
counterexample is claimed only if it was replayed, and fails in double precision, at a third and at
a quarter of the step (there also in single precision), and with features changed by one rounding.
It also has to fail by more than the finer step changed its robustness, and by far more than
rounding did. A host system without a finer step is simulated once more with the same features and
key: a row that fails again is confirmed. Otherwise it is fragile, since the system remembers
earlier simulations or draws numbers that do not come from its key. The results are of
`confirmations.py`.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Float, Int

from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.messages.text import listed
from verifai_jax.evaluation.backends import Engines, engines_for
from verifai_jax.evaluation.confirmations import (
    EXACT_STEP,
    FINER,
    RAISED,
    REFUSED,
    SINGLE,
    Confirmations,
    came_otherwise,
    describe_check,
    engines_of,
)
from verifai_jax.evaluation.resimulate import ONE_BY_ONE, HostReplays, Replays, finest_replays
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    from verifai_jax.core.compute.executors import Executor
LIMIT, SHARE = 1024, 128
"""Rows that a falsification replays at most, or one for so many simulations where that is more."""
REPEATED, SHARE_REPEATED = 32, 25
"""The same where all that can be done is to simulate a host system once more, as long as each row
comes again: 4 % of the budget."""
MORE = 3
"""Further repetitions of rows that fail again, once another row of the run did not: a system that
fails at every seventh call fails in the first repetition of every seventh row, too."""
AMPLIFIED = 4.0
"""Times by which a row must fail beyond what rounding has moved it: a chaotic system turns
roundings into any of its outcomes, and two or three programs may agree by chance."""
REMAINING = 3.0
"""Error left at a quarter of the step by a method of order 1, as a multiple of the change since a
third of it."""
CHECKPOINT = "confirmer"
"""Entry of a checkpoint: rows examined, the worst row, whether one came again otherwise, and
whether one did not fail again."""
Check: TypeAlias = tuple[Replays | HostReplays, int]
"""One kind of replay: in the precision of these replays, with a so many times smaller step."""


class Confirmer:
    """Checks rows of a run's table; compiled programs are cached with the problem.

    **Arguments:**
    - `problem`: the problem on the backend on which it ran.
    - `precision`: the precision of the run.
    - `seed`: the seed of the run; each simulation gets its original random key.
    - `engines`: engines that have to agree, as in `engines_for`.
    - `executor`: an executor whose workers simulate a host system again; this process when left
      out.

    After rows were examined, `check_names` names the checks that a confirmed row has passed, and
    `raised` is a note on the first replay that raised, if any. `wavers` is true if a host system
    gave a row another robustness when it simulated it again, `flips` if a row did not fail again.

    **Raises:** the errors of `Problem.check` for a simulator that does not fit.
    """

    def __init__(
        self, problem: Problem, precision: str = "float32", seed: int = 0, *,
        engines: Engines = None, executor: "Executor | None" = None,
    ) -> None:  # fmt: skip
        in_precision(precision)
        self.problem, self.precision, self.seed = problem, precision, seed
        self.executor = executor
        self.others = engines_for(problem, engines)
        self.examined, self.worst = 0, np.inf
        self.wavers = self.flips = self._came_again = False
        self.check_names: tuple[str, ...] = ()
        self.raised: tuple[str, ...] = ()
        self._checks: dict[str, Check] = {}
        self._notes: tuple[str, ...] = ()
        self._untraceable = ""
        self._planned = False

    def prepare(self) -> None:
        """Trace the replay programs in advance, while something else compiles.

        An error in tracing is reported when there are rows.
        """
        if self.problem.black_box or self.others:
            return
        with suppress(Exception):
            self._plan()

    def __call__(
        self, rows: Mapping[str, Any], numbers: Sequence[int] | np.ndarray, limit: int | None = None
    ) -> Confirmations:
        """Check these rows of the table.

        **Arguments:**
        - `rows`: columns `[n]` by name, as the table has them: those of the features, and `rho`.
        - `numbers`: `[n]`, of the rows, which decide on their random keys.
        - `limit`: rows that are examined in all calls together; no limit when left out. The worst
          row comes first, and the others in their order. Beyond the limit a row that is worse than
          all before is examined, and 1024 rows in all where the system wavers.
        **Raises:** as `FeatureSpace.from_row`, for columns that are no rows of this problem.
        """
        numbers = np.asarray(numbers, int)
        rows = {name: np.asarray(column) for name, column in rows.items()}
        run = np.asarray(rows["rho"], np.float64) if "rho" in rows else None
        found = Confirmations.blank(self.problem.name, numbers, run)
        if not len(numbers):
            return found
        self._plan()
        self.check_names = tuple(self._checks)
        if self.problem.system.exact_step:
            self.check_names += (EXACT_STEP,)
        found.rho.update({name: np.full(len(numbers), np.nan) for name in self._checks})
        rest = np.arange(len(numbers))
        if run is not None:
            rest = np.argsort(rest != np.argmin(run), kind="stable")  # The worst comes first.
        while size := self._room(rest, run, limit):
            block, rest = np.split(rest, [size])
            taken = {name: column[block] for name, column in rows.items()}
            found.put(block, self._examine(taken, numbers[block]))
            if self.wavers and limit is not None:
                limit = max(limit, LIMIT)
        notes = list(self._notes)
        if len(rest):
            notes.append(
                f"{len(rest)} of {len(found)} were not replayed, and are not claimed: "
                f"{self.examined} rows of this run were"
            )
            found.why[rest] = notes[-1]
        return replace(found, notes=tuple(notes), checks=self.check_names)

    def check_round(
        self, columns: Mapping[str, np.ndarray], first: int, wanted: int = 0
    ) -> tuple[Int[np.ndarray, " violating"], Confirmations]:
        """Check the violating rows among a run's new rows, at most `limit` of them.

        **Arguments:**
        - `columns`: the columns of all new rows, as in the table.
        - `first`: number of the first new row in the run.
        - `wanted`: number of confirmed rows that the run still waits for, whatever the limit.
        **Returns:** which of the new rows violate the property, and their verdicts.
        """
        violating = np.flatnonzero(columns["violated"])
        taken = {name: column[violating] for name, column in columns.items()}
        limit = None
        if len(violating):
            limit = max(self.limit(first + len(columns["rho"])), self.examined + wanted)
        return violating, self(taken, first + violating, limit)

    @property
    def compile_seconds(self) -> float:
        """Seconds that its replays have spent compiling."""
        replays = {id(each): each for each, _ in self._checks.values()}
        return sum(each.compile_seconds for each in replays.values())

    def limit(self, simulations: int) -> int:
        """Return the maximum number of rows to examine in a falsification of this many simulations.

        Simulating a black box again takes as long as the first time. So the limit is 4 % of the
        simulations, or 32, unless a row was not reproduced, or the simulator has finer steps of its
        own.
        """
        self._plan()
        once = self._only_repeats and not self.wavers
        rows, share = (REPEATED, SHARE_REPEATED) if once else (LIMIT, SHARE)
        return max(rows, simulations // share)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return the state that decides which rows are examined next, for a checkpoint."""
        numbers = [self.examined, self.worst, self.wavers, self.flips]
        return {CHECKPOINT: np.array(numbers, np.float64)}

    def restore(self, checkpoint: Mapping[str, Any]) -> None:
        """Continue from a checkpoint."""
        if CHECKPOINT in checkpoint:
            examined, worst, wavers, flips = checkpoint[CHECKPOINT]
            self.examined, self.worst = int(examined), float(worst)
            self.wavers, self.flips = bool(wavers), bool(flips)

    def _plan(self) -> None:
        """Choose the checks that can be made, once; trace what they simulate."""
        if self._planned:
            return
        problem, run = self.problem, self.precision
        checks: dict[str, Check] = {}
        key = run_keys(self.seed)[1]
        base, notes, raised = finest_replays(problem, run, key, self.executor)
        if base is not None and raised:
            self.raised, raised = tuple(notes), ""
        if base is not None:
            checks["float64" if base.precision == "float64" else "again"] = base, 1
            reason = base.refiner.why_not(FINER.values())
            if reason is None:
                checks |= {name: (base, factor) for name, factor in FINER.items()}
                if base.precision != run:
                    checks[SINGLE] = Replays(problem, run, base.key), FINER["quarter_step"]
            else:
                notes.append(f"not checked at a finer step: {reason}")
            if not problem.black_box:
                checks["nudged"] = base, FINER["quarter_step"] if reason is None else 1
        for name, other in self.others.items():
            replays, of_other, raised_too = finest_replays(other, run, key)
            notes += [f"{describe_check(name)}: {note}" for note in of_other]
            if replays is not None:
                checks[name] = replays, 1
            elif raised_too:
                raised = raised or f"{describe_check(name)}: {raised_too}"
        self._checks, self._notes, self._untraceable = checks, tuple(notes), raised
        self._planned = True

    @property
    def _only_repeats(self) -> bool:
        """Whether all that is done is to simulate a host system once more."""
        return self.problem.black_box and set(self._checks) == {"again"}

    def _room(
        self, rest: Int[np.ndarray, " rest"], run: Float[np.ndarray, " n"] | None, limit: int | None
    ) -> int:
        """Return how many of the rows that are left are examined next; 0 to leave them."""
        room = len(rest) if limit is None else min(len(rest), limit - self.examined)
        if room > 0 or not len(rest) or run is None or run[rest[0]] >= self.worst:
            return max(room, 0)
        # With others, so that no other program is compiled for it.
        return 1 if self.problem.black_box else min(len(rest), 1 + ONE_BY_ONE)

    def _examine(
        self, rows: Mapping[str, np.ndarray], numbers: Int[np.ndarray, " n"]
    ) -> Confirmations:
        """Replay rows by all checks, and decide."""
        run = rows.get("rho")
        replayed = self._replay(rows, numbers, run)
        found = Confirmations.blank(self.problem.name, numbers, run, "raised")
        self._decide(found, replayed, run)
        if self.problem.black_box and "verdict" in rows:
            _hold_to_run(found, replayed, rows, self._only_repeats)
        self.examined += len(numbers)
        if run is not None:
            self.worst = min(self.worst, float(np.min(run)))
        lost = np.flatnonzero(found.verdict == "raised")
        if len(lost) and not self.raised:
            self.raised = (f"not confirmed: {found.why[lost[0]]}",)
        return found

    def _replay(
        self, rows: Mapping[str, np.ndarray], numbers: Int[np.ndarray, " n"],
        run: Float[np.ndarray, " n"] | None,
    ) -> dict[str, Verdicts]:  # fmt: skip
        """Simulate rows again by each check."""
        space = self.problem.space
        precisions = dict.fromkeys(replays.precision for replays, _ in self._checks.values())
        features = {name: space.features_of(rows, name) for name in precisions}
        together: dict[tuple[int, int], list[str]] = {}
        for name, (replays, factor) in self._checks.items():
            # What one program replays at one step fills its lanes.
            together.setdefault((id(replays), factor), []).append(name)
        for names in together.values():
            replays, factor = self._checks[names[0]]
            replays.begin_compiling(factor, numbers, len(names))
        replayed: dict[str, Verdicts] = {}
        for names in together.values():
            replays, factor = self._checks[names[0]]
            values = features[replays.precision]
            each = [space.nudged(values) if n == "nudged" else values for n in names]
            replayed |= dict(zip(names, replays(factor, each, numbers), strict=True))
        again = self._checks.get("again")
        if again is not None and isinstance(again[0], HostReplays):
            values = features[again[0].precision]
            replayed["again"] = self._insist(again[0], values, numbers, replayed["again"], run)
            self._came_again = self._came_again or bool(np.any(replayed["again"].proper))
        # In the order of the plan, in which messages name them.
        return {name: replayed[name] for name in self._checks}

    def _insist(
        self, replays: HostReplays, features: Any, numbers: Int[np.ndarray, " n"], again: Verdicts,
        run: Float[np.ndarray, " n"] | None,
    ) -> Verdicts:  # fmt: skip
        """Simulate rows that fail again more often, where the system is known to waver.

        **Returns:** of each row the repetition of greatest robustness.
        """

        def notice(rows: np.ndarray, seen: Verdicts) -> None:
            held = bool(np.any(~seen.violated & ~np.isin(seen.status, RAISED)))
            self.flips = self.flips or held
            moved = run is not None and np.any(came_otherwise(run[rows], seen.lowest))
            self.wavers = self.wavers or held or bool(moved)

        notice(np.arange(len(numbers)), again)
        for _ in range(MORE if self.wavers else 0):
            left = np.flatnonzero(again.violated)
            if not len(left):
                break
            own = jax.tree.map(lambda leaf, left=left: leaf[left], features)
            [more] = replays.anew(own, numbers[left])
            notice(left, more)
            with np.errstate(invalid="ignore"):
                less = np.flatnonzero(~more.violated | ~(more.lowest <= again.lowest[left]))
            taken = np.arange(len(numbers))
            taken[left[less]] = len(numbers) + less
            again = Verdicts.concatenate([again, more]).rows(taken)
        return again

    def _decide(
        self, found: Confirmations, replayed: Mapping[str, Verdicts],
        run: Float[np.ndarray, " n"] | None,
    ) -> None:  # fmt: skip
        """Decide on rows from their replays, in place; all of them have the verdict `raised`."""
        rho = {name: verdicts.lowest for name, verdicts in replayed.items()}
        found.rho.update(rho)
        base = next((name for name in ("float64", "again") if name in replayed), "")
        engines = engines_of(replayed)
        finest = next((n for n in ("quarter_step", base, *engines) if n in replayed), "")
        step = rounding = np.zeros(len(found))
        if "quarter_step" in replayed:
            step = REMAINING * _moved(rho["third_step"], rho["quarter_step"])
        for name in (SINGLE, "nudged"):
            if name in replayed:
                rounding = np.maximum(rounding, _moved(rho[name], rho[finest]))
        if run is not None and base:
            rounding = np.maximum(rounding, _moved(run, rho[base]))
        found.band[:] = np.maximum(step, rounding)
        if not replayed:
            found.why[:] = self._untraceable
            return
        deciding = [name for name in (*FINER, SINGLE) if name in replayed] or [base]
        deciding = [name for name in (*deciding, *engines) if name in replayed]
        failing = {name: verdicts.violated for name, verdicts in replayed.items()}
        holding = {name: v.proper & ~v.violated for name, v in replayed.items()}
        raised = {name: np.isin(v.status, RAISED) for name, v in replayed.items()}
        clear = np.abs(rho[finest]) >= np.maximum(step, AMPLIFIED * rounding)
        if self._only_repeats and not self.flips:
            # Of a host system that is simulated once more, and fails each time, that says all.
            clear = np.ones(len(found), bool)
        # Only a check that simulates more finely than the run may refute a row.
        finer = "quarter_step" in replayed or bool(engines)
        finer |= "float64" in replayed and self.precision != "float64"
        fails = np.all(list(failing.values()), axis=0)
        refuted = np.all([holding[name] for name in deciding], axis=0) & finer
        refuted &= deciding[0] != "again"
        lost = np.any(list(raised.values()), axis=0) | bool(self._untraceable)
        lost &= np.all([failing[name] | raised[name] for name in replayed], axis=0)
        if self._only_repeats and self._came_again:
            # Other rows could be simulated again: an error means that this failure did not recur.
            lost[:] = False
        found.verdict[:] = np.select(
            [lost, fails & clear, refuted], ["raised", "confirmed", "refuted"], "fragile"
        )
        for i in np.flatnonzero(found.verdict != "confirmed").tolist():
            if found.verdict[i] == "raised" and self._untraceable:
                found.why[i] = self._untraceable
            else:
                moved = f"its robustness {rho[finest][i]:z.3g} moves by {found.band[i]:z.2g}"
                then = "" if run is None else f", and {run[i]:z.4g} in the run"
                found.why[i] = _disagreement(i, replayed, then) or f"{moved} between replays"


def _hold_to_run(
    found: Confirmations, replayed: Mapping[str, Verdicts], rows: Mapping[str, np.ndarray],
    only_repeats: bool,
) -> None:  # fmt: skip
    """Keep the run's verdict on rows of a host system that the present replays do not contradict.

    A failure that the run could not reproduce stays unconfirmed, whatever happens now; one that
    fails every time stays confirmed, however far its robustness moved.
    """
    fails = np.all([verdicts.violated for verdicts in replayed.values()], axis=0)
    still = (rows["verdict"] == "confirmed") & fails & only_repeats
    found.verdict[still], found.why[still] = "confirmed", ""
    refused = np.isin(rows["verdict"], REFUSED) & np.isin(found.verdict, ("confirmed", "raised"))
    for i in np.flatnonzero(refused).tolist():
        found.verdict[i] = "fragile"
        again = float(rows["rho_again"][i]) if "rho_again" in rows else float("nan")
        then = "" if np.isnan(again) else f", with robustness {again:z.4g}"
        found.why[i] = f"it did not come again when the run simulated it again{then}"


def _disagreement(i: int, found: Mapping[str, Verdicts], in_run: str) -> str:
    """Explain which replays of row `i` do not confirm it; empty if it fails in all of them."""
    lost = [name for name in found if not found[name].proper[i]]
    raised = [name for name in lost if found[name].status[i] in RAISED]
    if raised:
        messages = [m[i] for name in raised if (m := found[name].messages)]
        message = next(filter(None, messages), "out of time")
        return f"the replay {_and(raised)} raised: {message}"
    if lost:
        return f"the replay {_and(lost)} is not finite"
    holds = [name for name, replayed in found.items() if not replayed.violated[i]]
    fails = [name for name in found if name not in holds]
    if holds == ["again"]:
        rho = found["again"].lowest[i]
        return f"it holds when simulated again: robustness {rho:z.4g}{in_run}"
    if holds and not fails:
        return "it holds in every replay"
    if len(holds) > len(fails):
        return f"it fails only {_and(fails)}"
    return f"it holds {_and(holds)}" if holds else ""


def _and(names: Sequence[str]) -> str:
    return listed(list(map(describe_check, names)))


def _moved(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return by how much a robustness moved: infinitely where one of the two is missing."""
    with np.errstate(invalid="ignore"):
        return np.nan_to_num(np.where(a == b, 0.0, np.abs(a - b)), nan=np.inf)
