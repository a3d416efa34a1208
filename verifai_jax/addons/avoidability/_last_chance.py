"""`last_chance`: the last instant at which a failure could still have been avoided."""

from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.avoidability.means import Controls, OtherPolicy, Surroundings
from verifai_jax.addons.avoidability.proof import first_proved
from verifai_jax.addons.avoidability.result import Escape, LastChance
from verifai_jax.addons.avoidability.search import EscapeSearch, Programs, escaping
from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import suggests_options, unknown_name
from verifai_jax.core.values.trace import Trace
from verifai_jax.counterexamples.fixed_key import note_on_key
from verifai_jax.counterexamples.selection import Row, problem_of, select_row
from verifai_jax.evaluation.replay import Replay, replay
from verifai_jax.falsification.run import Run
from verifai_jax.mtl.blame import broken_at
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.actions import Action
from verifai_jax.systems.base import System

INSTANTS = 16
"""Instants that are searched at once."""
FURTHER = (0, 1, 3, 7)
"""Instants after the bracket, as their distance from its end, that are searched once more."""
MAX_ESCAPES = 4
"""Escapes that a result keeps."""
PROGRAMS: Slot[tuple[Any, ...], Programs] = Slot("escapes")


@suggests_options
@shows_progress("looking for the last chance in", "simulations")
def last_chance(
    run: Run | Problem,
    row: Row = None,
    *,
    by: str | System = "controller",
    actions: Action | tuple[Any, Any] | None = None,
    features: Iterable[str] = (),
    forks: int = 2048,
    rounds: int = 12,
    gradients: bool = True,
    proof_seconds: float = 20.0,
    seed: int = 0,
    progress: bool | None = None,
) -> LastChance:
    """Find the last instant at which a failure could still have been avoided, as a bracket.

    Forks of the failing simulation begin at many instants and go on with other actions. The result
    says until when there is an escape, which is simulated again alone, and from when on none was
    found. An escape from an instant is one from all earlier ones, because the simulation may go on
    as it did until then. That none was found says nothing of other instants, so later ones are
    searched, too. An escape keeps all formulas; the random key stays that of the row.

    **Arguments:**
    - `run`: a run with a counterexample, or a problem.
    - `row`: the number of a counterexample or its row, by default the worst; for a problem, the
      features of a failing simulation.
    - `by`: who avoids it: `"controller"`, with any actions within their bounds, for a while or to
      the end; `"environment"`, with other features from an instant on; or a system that differs
      from the problem's in its policy, which takes over with its initial memory.
    - `actions`: the lowest and the highest action `(low, high)`, numbers or arrays in the form of
      an action, whole numbers for choices; by default those of the policy or the environment.
    - `features`: the features that the environment may change; by default all that vary.
    - `forks`: number of forks simulated at once; `rounds`: batches for each refinement.
    - `gradients`: whether to search along gradients, too; of MuJoCo they take long to compile.
    - `proof_seconds`: seconds for a proof that no action avoids the failure; 0 for none.
    - `seed`: the seed of the search; `progress`: as in `falsify`.
    **Returns:** a `LastChance`.
    **Raises:** `ValueError` for a row that does not fail, a system that cannot fork, and actions
    without bounds; `UnknownNameError` for another `by`, and for features that do not exist.
    """
    check_count("forks", forks)
    check_count("rounds", rounds)
    if not isinstance(by, System) and by not in ("controller", "environment"):
        raise unknown_name("by", by, ("controller", "environment"))
    number, key, precision = None, run_keys(0)[1], "float32"
    if isinstance(run, Problem):
        if not isinstance(row, Mapping):
            raise ValueError(f"row must be the features of a failing simulation; got {row!r}")
        problem, entry = run, row
    else:
        problem, (number, entry) = problem_of(run), select_row(run, row)
        key, precision = run_keys(run.seed)[1], run.precision
    for name in problem.system.backends:
        if not problem.system.can_fork:
            problem = problem.on_backend(name)
    if not problem.system.can_fork:
        raise ValueError(
            f"the system of problem {problem.name!r} cannot fork: last_chance needs one made by "
            "vj.ode, mujoco (backend mjx), brax, gymnax or playground, or with a rollout of its own"
        )
    with in_precision(precision):
        failing = replay(problem, entry, key, number, precision)
        if not failing.violated:
            raise ValueError(
                f"{'the simulation' if number is None else f'row {number}'} of {problem.name!r} "
                f"does not fail when simulated again: {str(failing).splitlines()[0]}"
            )
        given = jax.tree.map(jnp.asarray, failing.features)
        names = (features,) if isinstance(features, str) else tuple(features)

        def make() -> Programs:
            if isinstance(by, System):
                return Programs(problem, OtherPolicy(problem, by))
            if by == "environment":
                return Programs(problem, Surroundings(problem, names))
            trace = jax.eval_shape(problem.system, given, failing.key)
            return Programs(problem, Controls(problem, trace.length, trace.dt or 1.0, actions))

        programs = problem.programs.get(PROGRAMS, (by, repr(actions), names, precision), make)
        course = programs.course(given, failing.key)
        search = EscapeSearch(programs, course, forks, rounds, seed)
        search.climbs &= gradients
        bracket = _Bracket(search, failing)
        return bracket.result(precision, proof_seconds)


class _Bracket:
    """The refinement of the bracket, in numbers of decisions."""

    def __init__(self, search: EscapeSearch, failing: Replay) -> None:
        self.search, self.means, self.failing = search, search.means, failing
        self.tried: set[int] = set()
        self.alone: dict[int, tuple[Trace, float]] = {}
        # A decision at the last sample changes nothing.
        self.count = -(-(failing.trace.length - 1) // self.means.period)

    def result(self, precision: str, proof_seconds: float) -> LastChance:
        """Search, prove, and return the result."""
        last, following = self.refined()
        search, means, problem = self.search, self.means, self.failing.problem
        proved, notes = None, [*note_on_key(problem, self.failing.row or 0), *search.notes]
        if isinstance(means, Controls):
            if proof_seconds > 0 and following < self.count:
                ends = (following, self.count)
                proved, why = first_proved(search, means, *ends, precision, proof_seconds)
                notes += [why] if why else []
            own, slack = means.own(search.forks)[: self.count], 1e-3 * (means.high - means.low)
            if np.any((own < means.low - slack) | (own > means.high + slack)):
                notes.append("the policy's own actions leave the bounds of the actions")
        formula = problem.formulas[self.failing.worst]
        broken = broken_at(formula, self.failing.trace, problem.end).values()
        first = min((int(np.argmax(at)) for at in broken), default=self.failing.trace.length - 1)
        return LastChance(
            self.failing.row, means.who, float(np.asarray(self.failing.trace.clock())[first]),
            None if last < 0 else self.time(last), self.time(following),
            None if proved is None else self.time(proved),
            tuple(self.escape(i) for i in sorted(self.alone, reverse=True)[:MAX_ESCAPES]),
            tuple(map(self.time, sorted(self.tried))), search.simulations, self.failing,
            tuple(notes),
        )  # fmt: skip

    def time(self, instant: int) -> float:
        return round(instant * self.means.period * float(self.failing.trace.dt or 1.0), 9)

    def refined(self) -> tuple[int, int]:
        """Return the last instant with an escape, -1 without one, and the next one tried."""
        low, high = -1, self.count
        while True:
            while high - low > 1:
                count = INSTANTS if self.means.shape[1] else self.count
                spread = np.linspace(low + 1, high - 1, min(count, high - low - 1))
                tried = np.unique(spread.round().astype(int)).tolist()
                low = max([low, *self.explored(tried)])
                high = min((i for i in tried if i > low), default=high)
            # No escape at one instant says nothing of later ones: search some again, longer.
            later = [high + by for by in FURTHER if high + by < self.count]
            if not self.means.shape[1] or not self.explored(later, 2):
                return low, high
            low = max(self.alone)
            high = min((i for i in self.tried if i > low), default=self.count)

    def explored(self, instants: list[int], effort: int = 1) -> list[int]:
        """Return the instants with an escape that a simulation alone confirms."""
        self.tried.update(instants)
        found = self.search.found
        for instant in self.search.explore(instants, effort):
            for escape in (self._shortened(instant), found[instant]):
                verdict, trace = self.search.programs.alone(self.search.forks, escape)
                rho, kept = escaping(*(np.asarray(part)[None] for part in verdict))
                if kept[0]:
                    found[instant] = escape
                    self.alone[instant] = jax.tree.map(np.asarray, trace), float(rho[0])
                    break
            else:
                del found[instant]
                note = f"an escape from {self.time(instant):zg} s failed when simulated alone"
                self.search.notes.append(note)
        return [i for i in instants if i in self.alone]

    def _shortened(self, instant: int) -> Any:
        """Return an escape with the earliest stop, after which the policy goes on."""
        found = self.search.found[instant]
        stops = np.arange(instant + 1, int(found.stop) + 1) if self.means.ends else np.zeros(0, int)
        if not len(stops):
            return found
        numbers = np.repeat(np.asarray(found.numbers)[None], len(stops), axis=0)
        escaped = self.search.judge(np.full(len(stops), instant), numbers, stops)[1]
        return found._replace(stop=np.int32(stops[np.argmax(escaped)])) if escaped.any() else found

    def escape(self, instant: int) -> Escape:
        """Return an escape as a result shows it."""
        found, means, details = self.search.found[instant], self.means, {}
        stop, numbers = int(found.stop), np.asarray(found.numbers)
        if isinstance(means, Controls):
            details["actions"] = means.actions(numbers, np)[instant:stop]
            details["own"] = means.own(self.search.forks)[instant:stop]
            details["bounds"] = means.low, means.high
        elif isinstance(means, Surroundings):
            new = means.space.rows(jax.tree.map(np.asarray, means.space.features_at(found.numbers)))
            old = self.failing.columns()
            details["features"] = {n: (v[0], old[n]) for n, v in new.items() if v[0] != old[n]}
        ends = means.ends and stop < means.shape[0]
        trace, rho = self.alone[instant]
        return Escape(self.time(instant), self.time(stop) if ends else None, rho, trace, **details)
