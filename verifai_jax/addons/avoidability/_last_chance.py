"""`last_chance`: the last instant at which a failure could still have been avoided."""

from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.avoidability.means import Controls, Means, OtherPolicy, Surroundings
from verifai_jax.addons.avoidability.result import Escape, LastChance
from verifai_jax.addons.avoidability.search import EscapeSearch, first_proved
from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import suggests_options, unknown_name
from verifai_jax.counterexamples.fixed_key import note_on_key
from verifai_jax.counterexamples.selection import Row, problem_of, select_row
from verifai_jax.evaluation.replay import Replay, replay
from verifai_jax.falsification.run import Run
from verifai_jax.mtl.blame import certain_from
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import System

MAX_ESCAPES, AT_AN_END = 4, 0.02
"""Escapes that a result keeps; and the share of its range within which an action is at a bound."""
PROGRAMS: Slot[tuple[Any, ...], Means] = Slot("escapes")


@suggests_options
@shows_progress("looking for the last chance in", "simulations")
def last_chance(
    run: Run | Problem, row: Row = None, *, by: str | System = "controller",
    actions: tuple[Any, Any] | None = None, features: Iterable[str] = (), forks: int = 2048,
    rounds: int = 12, gradients: bool = True, proof_seconds: float = 20.0, seed: int = 0,
    progress: bool | None = None,
) -> LastChance:  # fmt: skip
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
    - `proof_seconds`: processor time for proofs that no action avoids the failure; 0 for none.
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
        given, length = jax.tree.map(jnp.asarray, failing.features), failing.trace.length
        dt = float(failing.trace.dt or 1.0)
        names = (features,) if isinstance(features, str) else tuple(features)

        def make() -> Means:
            if isinstance(by, System):
                return OtherPolicy(problem, by)
            if by == "environment":
                return Surroundings(problem, names)
            # Of the longest trace: the failing one may have ended early.
            whole = jax.eval_shape(problem.system, given, failing.key).length
            return Controls(problem, whole, dt, actions)

        means = problem.programs.get(PROGRAMS, (by, repr(actions), names, precision), make)
        # A decision at the last sample changes nothing.
        decisions = -(-(length - 1) // means.period)
        course = means.course(given, failing.key)
        search = EscapeSearch(means, course, decisions, forks, rounds, seed)
        search.climbs &= gradients
        last, following = search.bracket()
        time = lambda decision: round(decision * means.period * dt, 9)  # noqa: E731
        proved, notes = None, [*note_on_key(problem, number or 0), *search.notes]
        notes += [f"an escape from {time(i):zg} s failed simulated alone" for i in search.lost]
        if isinstance(means, Controls):
            if proof_seconds > 0 and following < decisions:
                proved, why = first_proved(search, means, following, precision, proof_seconds)
                notes += [why] if why else []
            own, slack = means.own(course)[:decisions], 1e-3 * (means.high - means.low)
            if np.any((own < means.low - slack) | (own > means.high + slack)):
                notes.append("the policy's own actions leave the bounds of the actions")
        formula = problem.formulas[failing.worst]
        first = certain_from(formula, failing.trace, problem.end)
        first = length - 1 if first is None else first
        kept = sorted(search.alone, reverse=True)[:MAX_ESCAPES]
        return LastChance(
            number, means.who, float(np.asarray(failing.trace.clock())[first]),
            None if last < 0 else time(last), time(following),
            None if proved is None else time(proved),
            tuple(_escape(search, failing, i, time) for i in kept),
            tuple(map(time, sorted(search.tried))), search.simulations, failing, tuple(notes),
        )  # fmt: skip


def _escape(search: EscapeSearch, failing: Replay, instant: int, time: Any) -> Escape:
    """Return an escape as a result shows it."""
    found, means, did = search.found[instant], search.means, ["the other policy"]
    stop, (trace, rho) = int(found.stop), search.alone[instant]
    more: dict[str, Any] = {}
    if isinstance(means, Controls):
        actions = means.actions(np.asarray(found.numbers), np)[instant:stop]
        own, more = means.own(search.forks)[instant:stop].mean(0), {"actions": actions}
        names = [f"action[{i}]" for i in range(len(own))] if len(own) > 1 else ["action"]
        of_each = zip(names, map(_course, actions.T, means.low, means.high), own, strict=True)
        did = [f"{name} {what} instead of {mean:z.3g} on average" for name, what, mean in of_each]
    elif isinstance(means, Surroundings):
        new = means.space.rows(jax.tree.map(np.asarray, means.space.features_at(found.numbers)))
        old = failing.columns()
        changed = {n: (v[0], old[n]) for n, v in new.items() if v[0] != old[n]}
        did, more = (
            [f"{n} {v} instead of {o}" for n, (v, o) in changed.items()],
            {"features": changed},
        )
    ends = time(stop) if means.ends and stop < means.shape[0] else None
    return Escape(time(instant), ends, rho, trace, ", ".join(did), **more)


def _course(values: np.ndarray, low: float, high: float) -> str:
    """Describe the values of one entry of the actions."""
    said, left = [], 1.0
    for end, word in ((low, "lowest"), (high, "highest")):
        share = float(np.mean(np.abs(values - end) <= AT_AN_END * (high - low)))
        if share > 0.99:
            return f"at its {word}, {end:z.4g},"
        left -= share
        said += [f"at its {word}, {end:z.4g}, for {100 * share:z.0f} % of the time"] * (
            share >= 0.1
        )
    return ", ".join([*said, f"{values.mean():z.3g} on average"][: None if left > 0.01 else -1])
