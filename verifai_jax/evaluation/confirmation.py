"""Confirmation of counterexamples: each is replayed more finely than it was found.

    confirmer = Confirmer(problem, precision="float32", seed=0)
    checked = confirmer(rows, numbers)                  # columns [n] of the table, row numbers [n]
    checked.verdict                                     # [n]: "confirmed", "fragile", ...
    checked.rho["quarter_step"]                         # [n], robustness at a quarter of the step

A search simulates in single precision at the model's step; both may break a property that the
model keeps. A counterexample is claimed only if it fails in double precision, at half and at a
quarter of the step, there in single precision too, and with features that are one rounding away;
and if it fails by more than the finer step has moved it, and by far more than rounding has.
What runs on the host and has no finer step is simulated once more, with the same features and the
same key: what fails then too is confirmed, and what does not is fragile, since the system remembers
earlier simulations or draws numbers that do not come from its key.
`confirmation_verdicts.py` has the verdicts and their words.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from verifai_jax.core.errors import check_names
from verifai_jax.core.executors import Executor
from verifai_jax.core.keys import run_keys
from verifai_jax.core.precision import in_precision
from verifai_jax.core.text import format_error
from verifai_jax.core.trace import Trace
from verifai_jax.evaluation.confirmation_verdicts import (
    FINER,
    NOT_CLAIMED,
    RAISED,
    SINGLE,
    Checked,
    came_otherwise,
    describe_checks,
    describe_disagreement,
)
from verifai_jax.evaluation.executor_replays import ExecutorReplays
from verifai_jax.evaluation.replays import ONE_BY_ONE, HostReplays, Replays
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import System

AMPLIFIED = 4.0
"""Times by which a row must fail beyond what rounding has moved it: a chaotic system turns
roundings into any of its outcomes, and two or three programs may agree by chance."""
MOST = 256
"""Rows that are examined in any case, ..."""
COST = 4096
"""... or as many as cost so many simulations, where these are more: 15 a row with finer steps."""
LIMIT = 1024
"""Rows that a falsification examines at most, ..."""
SHARE = 128
"""... or one for so many simulations, where that is more."""
REPEATED = 32
"""Rows that a falsification of a host system without finer steps simulates again at most, ..."""
SHARE_REPEATED = 25
"""... or one for so many simulations, where that is more: 4 % of the budget, which leaves another
hundredth for rows that are worse than all before. `LIMIT` and `SHARE` hold once a row came again
otherwise."""
MORE = 3
"""Further repetitions of rows that fail again, once another row of the run did not: a system that
fails at every seventh call fails in the first repetition of every seventh row, too."""
SAFE = 10.0
"""Further rows stay unexamined if they are so many times farther from zero than replays have moved
any row."""
BLOCK = 512
"""Rows examined between two looks at whether the rest may stay unexamined."""
BESIDE = ONE_BY_ONE
"""Rows examined beside one that is worse than all examined before, so that no other program is
compiled for it."""


class Confirmer:
    """Checks rows of a run's table; what it compiles is kept with the problem.

    **Arguments:**

    - `problem`: on the backend that it ran on.
    - `precision`: of the run.
    - `seed`: of the run; a simulation gets the random key that it had.
    - `simulator`: another system for the same features and signals, or a problem with one, that
      has to agree.
    - `most`: how many rows are examined whatever comes; by default 256, and more where a row takes
      few replays: 2048 where the step stays. Of more, those nearest to zero are, and
      further ones until the rest is ten times farther from zero than any replay has moved a row;
      these stay `unexamined`. Only where rows have a column `rho`. A row that is worse than all
      examined before is examined whatever else was.
    - `executor`, `target`: whose workers simulate a host system again, and how they find the
      problem; this process when left out.

    Once rows were examined, `checked` says which checks a confirmed row has passed, `raised`
    what a replay raised first, if any did. `wavers` is whether a row gave another robustness when
    a host system simulated it again, and `flips` whether one did not fail again.

    **Raises:** what `Problem.check` does, for a simulator that does not fit.
    """

    def __init__(
        self,
        problem: Problem,
        precision: str = "float32",
        seed: int = 0,
        *,
        simulator: System | Callable[..., Trace] | Problem | str | None = None,
        most: int | None = None,
        executor: Executor | None = None,
        target: str | None = None,
    ) -> None:
        if most is not None and (
            isinstance(most, bool) or not isinstance(most, int | np.integer) or most < 1
        ):
            raise ValueError(f"most must be a positive integer; got {most!r}")
        in_precision(precision)
        self.problem, self.precision, self.seed, self.most = problem, precision, seed, most
        self.executor, self.target = executor, target
        self.other = None if simulator is None else _other(problem, simulator)
        self.examined, self.band, self.worst = 0, 0.0, np.inf
        self.wavers = self.flips = self._works = False
        self.checked = ""
        self.raised: tuple[str, ...] = ()
        self._plan: _Plan | None = None

    def prepare(self) -> None:
        """Trace what replays a row before there is one, while something else compiles.

        What cannot be traced is told once there are rows.
        """
        if self._plan is not None or self.problem.black_box or self.other is not None:
            return
        with suppress(Exception):
            self._plan = _make_plan(self)

    def __call__(
        self,
        rows: Mapping[str, Any],
        numbers: Sequence[int] | np.ndarray,
        limit: int | None = None,
    ) -> Checked:
        """Check these rows of the table.

        **Arguments:**

        - `rows`: columns `[n]` by name, as the table has them: those of the features, and `rho`.
        - `numbers`: `[n]`, of the rows, which decide on their random keys.
        - `limit`: rows that are examined in all calls together; no limit when left out. Of more,
          the worst row and those nearest to zero are. A worse row than all before, with some
          beside it, is examined beyond the limit, which is 1024 at least where the system wavers.

        **Raises:** as `FeatureSpace.from_row`, for columns that are no rows of this problem.
        """
        numbers = np.asarray(numbers, int)
        rows = {name: np.asarray(column) for name, column in rows.items()}
        if not len(numbers):
            return Checked(np.empty(0, object), {}, np.zeros(0), [], ())
        run = np.asarray(rows["rho"], np.float64) if "rho" in rows else None
        if self._plan is None:
            self._plan = _make_plan(self)
        if not self.checked:
            self.checked = describe_checks(self._plan.checks, self.problem.system.exact_step)
        most = max(MOST, COST // self._plan.cost) if self.most is None else self.most
        order = np.arange(len(numbers)) if run is None else _order(run)
        parts: list[tuple[np.ndarray, _Decision]] = []
        while len(order):
            free = most - self.examined
            if run is None:
                free = len(order)
            size = free if free > 0 else BLOCK
            if run is not None and free <= 0 and self.far(float(np.min(np.abs(run[order])))):
                size = 0
            if limit is not None:
                size = min(size, limit - self.examined)
            if size <= 0:
                if run is None or run[order[0]] >= self.worst:
                    break
                size = 1 if self.problem.black_box else 1 + BESIDE
            block, order = np.split(order, [size])
            taken = {name: column[block] for name, column in rows.items()}
            found = self._examine(self._plan, taken, numbers[block], taken.get("rho"))
            parts.append((block, found))
            self.examined += len(block)
            if run is not None:
                self.worst = min(self.worst, float(np.min(run[block])))
            lost = np.flatnonzero(found.verdict == "raised")
            if len(lost) and not self.raised:
                self.raised = (f"not confirmed: {found.why[lost[0]]}",)
            self.band = max(self.band, float(np.max(found.band)))
            if self.wavers and limit is not None:
                limit = max(limit, LIMIT)
        return self._join(parts, order, run)

    @property
    def compile_seconds(self) -> float:
        """Seconds that its replays have spent compiling."""
        if self._plan is None:
            return 0.0
        replays = {id(check.replays): check.replays for check in self._plan.checks.values()}
        return sum(each.compile_seconds for each in replays.values())

    def limit(self, simulations: int) -> int:
        """Return how many rows a falsification of so many simulations examines at most.

        To simulate a black box again takes as long as to simulate it: 4 % of the simulations, or 32
        of them, unless a row did not come again, or the simulator has finer steps of its own.
        """
        if self.problem.black_box and not self.wavers:
            if self._plan is None:
                self._plan = _make_plan(self)
            if self._plan.plain:
                return max(REPEATED, simulations // SHARE_REPEATED)
        return max(LIMIT, simulations // SHARE)

    def far(self, rho: float) -> bool:
        """Return whether a robustness is so far from zero that no replay will have another sign.

        That is ten times as far as any replay has moved a row so far.
        """
        return bool(abs(rho) > SAFE * self.band)

    def _examine(
        self,
        plan: "_Plan",
        rows: Mapping[str, np.ndarray],
        numbers: np.ndarray,
        run: np.ndarray | None,
    ) -> "_Decision":
        features: dict[str, Any] = {}
        together: dict[tuple[int, int], list[str]] = {}
        for name, check in plan.checks.items():
            check.replays.begin_compiling(check.factor, len(numbers))
            if check.precision not in features:
                features[check.precision] = self.problem.space.features_of(rows, check.precision)
            # What one program replays at one step fills its lanes.
            together.setdefault((id(check.replays), check.factor), []).append(name)
        found: dict[str, Verdicts] = {}
        for names in together.values():
            check = plan.checks[names[0]]
            values = features[check.precision]
            each = [self.problem.space.nudged(values) if n == "nudged" else values for n in names]
            found |= dict(zip(names, check.replays(check.factor, each, numbers), strict=True))
        # In the order of the plan, in which they are told.
        found = {name: found[name] for name in plan.checks}
        if self.problem.black_box and "again" in found:
            values = features[plan.checks["again"].precision]
            found["again"] = self._insist(plan, values, numbers, found["again"], run)
            self._works = self._works or bool(np.any(found["again"].proper))
        decision = _decide(
            len(numbers),
            found,
            run,
            plan,
            by_far=not plan.plain or self.flips,
            came_again=plan.plain and self._works,
        )
        if self.problem.black_box and "verdict" in rows:
            _remember(decision, rows, plan.plain)
        return decision

    def _insist(
        self,
        plan: "_Plan",
        features: Any,
        numbers: np.ndarray,
        again: Verdicts,
        run: np.ndarray | None,
    ) -> Verdicts:
        """Simulate rows that fail again more often, where the system is known to waver.

        **Returns:** of each row the repetition of greatest robustness.
        """

        def notice(rows: np.ndarray, seen: Verdicts) -> None:
            held = bool(np.any(~seen.violated & ~np.isin(seen.status, RAISED)))
            self.flips = self.flips or held
            moved = run is not None and np.any(came_otherwise(run[rows], seen.least))
            self.wavers = self.wavers or held or bool(moved)

        notice(np.arange(len(numbers)), again)
        replays = plan.checks["again"].replays
        for _ in range(MORE if self.wavers else 0):
            left = np.flatnonzero(again.violated)
            if not len(left):
                break
            own = jax.tree.map(lambda leaf, left=left: leaf[left], features)
            [more] = replays.anew(own, numbers[left])
            notice(left, more)
            again = _least_failing(again, more, left)
        return again

    def _join(
        self, parts: list[tuple[np.ndarray, "_Decision"]], rest: np.ndarray, run: np.ndarray | None
    ) -> Checked:
        """Join the rows of all parts in their order, and those that were left out."""
        count = sum(len(block) for block, _ in parts) + len(rest)
        verdict = np.full(count, "unexamined", object)
        assert self._plan is not None
        checks, said = self._plan.checks, self._plan.notes
        rho = {name: np.full(count, np.nan) for name in checks}
        band, why, notes = np.full(count, np.nan), [""] * count, list(said)
        for block, found in parts:
            verdict[block], band[block] = found.verdict, found.band
            for name in rho:
                rho[name][block] = found.replayed[name].least
            for place, reason in zip(block.tolist(), found.why, strict=True):
                why[place] = reason
        if len(rest):
            assert run is not None
            nearest = float(np.min(np.abs(run[rest])))
            note = f"{len(rest)} of {count} were not replayed"
            if self.far(nearest):
                note += (
                    f": {nearest:z.3g} or more from zero, where none of {self.examined} replays "
                    f"moved a row by more than {self.band:z.2g}"
                )
            else:
                note += f", as {self.examined} rows of this run were before"
            notes.append(note)
            for place in rest.tolist():
                why[place] = note
        return Checked(verdict, rho, band, why, tuple(notes))


class _Check(NamedTuple):
    """One kind of replay: of features in one precision, with a `factor` times smaller step."""

    replays: Any
    factor: int
    precision: str


class _Plan(NamedTuple):
    """The checks that are made.

    - `checks`: by name.
    - `notes`: on those left out.
    - `finer`: whether any simulates more finely than the run, so that it may refute a row.
    - `plain`: whether all that is done is to simulate a host system once more.
    - `raised`: what raised already when it was traced; empty where nothing did.
    """

    checks: dict[str, _Check]
    notes: tuple[str, ...]
    finer: bool
    plain: bool
    raised: str = ""

    @property
    def cost(self) -> int:
        """Simulations at the run's step that the replays of a row cost."""
        return max(1, sum(check.factor for check in self.checks.values()))


def _make_plan(confirmer: Confirmer) -> _Plan:
    problem, run = confirmer.problem, confirmer.precision
    checks: dict[str, _Check] = {}
    own = _replays(problem, confirmer)
    base, precision, notes, raised = own.replays, own.precision, list(own.notes), own.raised
    refined = False
    if base is not None:
        name = "float64" if precision == "float64" else "again"
        checks[name] = _Check(base, 1, precision)
        reason = base.refiner.why_not(FINER.values())
        refined = reason is None
        if refined:
            for name, factor in FINER.items():
                checks[name] = _Check(base, factor, precision)
            if precision != run:
                single = Replays(problem, run, base.key)
                checks[SINGLE] = _Check(single, FINER["quarter_step"], run)
        else:
            notes.append(f"not checked at a finer step: {reason}")
        if not problem.black_box:
            checks["nudged"] = _Check(base, FINER["quarter_step"] if refined else 1, precision)
    if confirmer.other is not None:
        other = _replays(confirmer.other, confirmer)
        notes += [f"the other simulator: {note}" for note in other.notes]
        raised = raised or (other.raised and f"the other simulator: {other.raised}")
        if other.replays is not None:
            checks["simulator"] = _Check(other.replays, 1, other.precision)
    finer = refined or "simulator" in checks or ("float64" in checks and run != "float64")
    plain = problem.black_box and set(checks) == {"again"}
    return _Plan(checks, tuple(notes), finer, plain, raised)


class _Base(NamedTuple):
    """The replays of a problem's rows at its own step.

    - `replays`: None where they cannot be traced.
    - `precision`: of the replays.
    - `notes`: on what is left out.
    - `raised`: what raised when it was traced; empty where nothing did.
    """

    replays: Any
    precision: str
    notes: tuple[str, ...]
    raised: str = ""


def _replays(problem: Problem, confirmer: Confirmer) -> _Base:
    """Return the replays of a problem's rows in the finest precision that it can be traced in."""
    run, key = confirmer.precision, run_keys(confirmer.seed)[1]
    if problem.black_box:
        notes = ("not checked in float64: a black box",)
        if confirmer.executor is None or problem is not confirmer.problem:
            return _Base(HostReplays(problem, run, key), run, notes)
        replays = ExecutorReplays(problem, run, key, confirmer.executor, confirmer.target)
        return _Base(replays, run, notes)
    note = "not checked in float64: in it the system would draw other random numbers"
    if run != "float64" and problem.system.can_refine:
        # It is traced in this precision in any case.
        with suppress(Exception):
            single = Replays(problem, run, key)
            if single.draws:
                return _Base(single, run, (note,))
    raised = ""
    try:
        replays = Replays(problem, "float64", key)
        if not (replays.draws and run != "float64"):
            return _Base(replays, "float64", ())
    except Exception as error:
        raised = f"the replay in float64 raised: {format_error(error)}"
        note = f"not checked in float64: {format_error(error)}"
        if run == "float64":
            return _Base(None, run, (note,), raised)
    try:
        replays = Replays(problem, run, key)
        return _Base(replays, run, (note,), raised)
    except Exception as error:
        again = f"not simulated again: {format_error(error)}"
        raised = raised or f"the replay raised: {format_error(error)}"
        return _Base(None, run, (note, again), raised)


class _Decision(NamedTuple):
    """The verdicts of some rows, and their replays by check."""

    verdict: np.ndarray
    band: Float[np.ndarray, " n"]
    why: list[str]
    replayed: dict[str, Verdicts]


def _decide(
    count: int,
    found: dict[str, Verdicts],
    run: np.ndarray | None,
    plan: _Plan,
    *,
    by_far: bool,
    came_again: bool,
) -> _Decision:
    """Decide about rows from their replays.

    **Arguments:**

    - `by_far`: they have to fail by more than they moved.
    - `came_again`: others could be simulated again, so that one that raised has not come again.
    """
    base = next((name for name in ("float64", "again") if name in found), "")
    finest = next((n for n in ("quarter_step", base, "simulator") if n in found), "")
    rho = {name: replayed.least for name, replayed in found.items()}
    step = rounding = np.zeros(count)
    if "half_step" in found:
        step = _moved(rho["half_step"], rho["quarter_step"])
    for name in (SINGLE, "nudged"):
        if name in found:
            rounding = np.maximum(rounding, _moved(rho[name], rho[finest]))
    if run is not None and base:
        rounding = np.maximum(rounding, _moved(run, rho[base]))
    band = np.maximum(step, rounding)
    if not found:
        return _Decision(np.full(count, "raised", object), band, [plan.raised] * count, found)
    deciding = [name for name in (*FINER, SINGLE) if name in found] or [base]
    deciding = [name for name in (*deciding, "simulator") if name in found]
    failing = {name: replayed.violated for name, replayed in found.items()}
    holding = {name: r.proper & ~r.violated for name, r in found.items()}
    raised = {name: np.isin(r.status, RAISED) for name, r in found.items()}
    # Of a host system that is simulated once more, and fails each time, that it fails says all.
    clear = (not by_far) | (np.abs(rho[finest]) >= np.maximum(step, AMPLIFIED * rounding))
    fails = np.all(list(failing.values()), axis=0)
    refuted = np.all([holding[name] for name in deciding], axis=0) & plan.finer
    refuted &= deciding[0] != "again"
    lost = np.any(list(raised.values()), axis=0) | bool(plan.raised)
    lost &= np.all([failing[name] | raised[name] for name in found], axis=0) & (not came_again)
    verdict = np.select(
        [lost, fails & clear, refuted],
        ["raised", "confirmed", "refuted"],
        "fragile",
    )
    why = [""] * count
    for i in np.flatnonzero(verdict != "confirmed").tolist():
        if verdict[i] == "raised" and plan.raised:
            why[i] = plan.raised
        else:
            as_run = None if run is None else float(run[i])
            why[i] = describe_disagreement(i, found, float(rho[finest][i]), float(band[i]), as_run)
    return _Decision(verdict.astype(object), band, why, found)


def _remember(decision: _Decision, rows: Mapping[str, np.ndarray], plain: bool) -> None:
    """Hold to the run's verdict on rows of a host system, where this time is no evidence against.

    What did not come again in the run stays unconfirmed, whatever it does this time; and what fails
    every time stays confirmed, by whatever it has moved.
    """
    fails = np.all([replayed.violated for replayed in decision.replayed.values()], axis=0)
    for i in np.flatnonzero((rows["verdict"] == "confirmed") & fails & plain).tolist():
        decision.verdict[i], decision.why[i] = "confirmed", ""
    known = np.isin(rows["verdict"], NOT_CLAIMED)
    known &= np.isin(decision.verdict, ("confirmed", "raised"))
    for i in np.flatnonzero(known).tolist():
        decision.verdict[i] = "fragile"
        again = float(rows["rho_again"][i]) if "rho_again" in rows else float("nan")
        then = "" if np.isnan(again) else f", with robustness {again:z.4g}"
        decision.why[i] = f"it did not come again when the run simulated it again{then}"


def _least_failing(again: Verdicts, more: Verdicts, at: np.ndarray) -> Verdicts:
    """Return the repetitions, those rows replaced that a further one shows to fail less.

    **Arguments:**

    - `again`: of all rows.
    - `more`: a further repetition of the rows `at`.
    """
    with np.errstate(invalid="ignore"):
        less = ~more.violated | ~(more.least <= again.least[at])
    rho, status, violated = again.rho.copy(), again.status.copy(), again.violated.copy()
    taken = at[less]
    rho[taken], status[taken] = more.rho[less], more.status[less]
    violated[taken] = more.violated[less]
    messages = again.messages
    if messages is not None and more.messages is not None:
        messages = list(messages)
        for i in np.flatnonzero(less).tolist():
            messages[int(at[i])] = more.messages[i]
    return again._replace(rho=rho, status=status, violated=violated, messages=messages)


def _order(run: Float[np.ndarray, " n"]) -> np.ndarray:
    """Return the rows in the order in which they are examined: the worst one, then from zero on."""
    order = np.argsort(np.abs(run), kind="stable")
    worst = int(np.argmin(run))
    return np.concatenate([[worst], order[order != worst]])


def _moved(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return by how much a robustness moved: infinitely where one of the two is missing."""
    with np.errstate(invalid="ignore"):
        return np.nan_to_num(np.where(a == b, 0.0, np.abs(a - b)), nan=np.inf)


def _other(problem: Problem, simulator: System | Callable[..., Trace] | Problem | str) -> Problem:
    """Return the problem with another system."""
    if isinstance(simulator, str):
        if not problem.system.backends:
            raise ValueError(
                f"the system of problem {problem.name!r} has no backends; simulator must be a "
                f"system or a Problem, got {simulator!r}"
            )
        other = problem.on_backend(simulator)
    else:
        system: Any = simulator.system if isinstance(simulator, Problem) else simulator
        if isinstance(simulator, Problem):
            check_names("feature of the simulator", simulator.space.columns, problem.space.columns)
            check_names("feature", problem.space.columns, simulator.space.columns)
        other = replace(problem, system=system)
    other.check()
    return other
