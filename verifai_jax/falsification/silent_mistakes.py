"""Notes on likely mistakes, before a search starts and after it, from its table.

    notes_before(problem, search)                       # nothing compiles
    nominal_note(problem, evaluate)                     # one simulation, on the run's own engine
    notes_after(rounds.table, rounds.tally, run.formulas, search)

Each is a true sentence about the run, for its `notes` and its summary.
"""

import math
from collections.abc import Mapping
from typing import cast

import numpy as np

from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.engine import Engine
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.falsification.counts import Tally
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.mtl.rewriting import asked_at_once
from verifai_jax.mtl.sampled import sampled_in
from verifai_jax.problem.dependence import has_gradient
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.silent_mistakes import is_quick, silent_mistakes
from verifai_jax.problem.tracing import traced_by_default
from verifai_jax.search import Search

ENOUGH = 32
"""Minimum number of simulations with a verdict for a note on a common property."""
MAX_SAMPLES = 5_000_000
"""Maximum samples of a batch that is simulated for the nominal features alone."""
NEARLY_ALL = 0.9
"""Share of the prior that violates the property, from which on that is hardly meant."""
HARDLY_MOVES = 0.05
"""Range of the robustness, as a share of its least value, that counts as no change."""


def notes_before(problem: Problem, search: Search) -> tuple[str, ...]:
    """Return likely mistakes in a problem and a search, before anything compiles.

    Given features are simulated as they are and get no note.
    """
    if search.origin == "given":
        return ()
    # What a system finds out while it is traced is among them.
    notes = silent_mistakes(problem)
    notes = (*problem.system.notes, *notes)
    if search.needs_derivatives and traced_by_default(problem.system) and not has_gradient(problem):
        notes += (
            f"search {search!r} follows gradients and there are none: the robustness is constant "
            "between jumps; use 'cross_entropy' or another search without gradients",
        )
    sampled = sampled_in(*problem.formulas.values()) if search.needs_derivatives else ()
    if steps := [each for each in sampled if len(each.counted) == len(each.operands)]:
        notes += (f"search {search!r} follows gradients, and that of {steps[0]} is zero",)
    return notes


def nominal_note(problem: Problem, evaluate: Evaluator, search: Search) -> tuple[str, ...]:
    """Return a note if the nominal features fail; simulated once for each problem.

    Nothing is simulated if the problem has no nominal features, or if it could take long: an engine
    would have to simulate a full batch, and MuJoCo compiles for each number of rows.

    **Arguments:**
    - `problem`: the problem of the run.
    - `evaluate`: the compiled evaluator of the run.
    - `search`: the search of the run.
    """
    if problem.nominal is None or problem.system.backends or search.origin == "given":
        return ()
    precision = evaluate.engine.precision
    return problem.programs.get(NOMINAL, precision, lambda: _nominal_note(problem, evaluate))


NOMINAL: Slot[str, tuple[str, ...]] = Slot("nominal")
"""The note on the nominal features, or none, by precision."""


def _nominal_note(problem: Problem, evaluate: Evaluator) -> tuple[str, ...]:
    engine = evaluate.engine
    if problem.black_box:
        from verifai_jax.evaluation.host_engine import HostEngine

        # One of its own: the journal of the run keeps rows of its table only.
        monitor = engine.monitor if isinstance(engine, HostEngine) else None
        engine = HostEngine(problem, engine.precision, monitor=monitor)
    elif not is_quick(problem) or (
        cast(Trace, problem.form()).length * cast(Engine, engine).padded > MAX_SAMPLES
    ):
        return ()
    space = problem.space
    nominal = space.completed(problem.nominal or {})
    varied = {name: nominal[name] for name, domain in space.root.fields if domain.size}
    # By the program that a shrinking needs, too.
    u = np.asarray(space.point_of(space.coerce(varied)), np.float32)
    # The engine may be one of rows that carry given features.
    rows = u[None] if problem.black_box else evaluate.rows_of(u[None])
    verdict = engine.evaluate(rows, evaluate.key, 0)
    if not verdict.violated[0]:
        return ()
    return (
        f"the nominal features fail themselves, with robustness {verdict.lowest[0]:z.4g}: "
        "are the formula and its units right?",
    )


def notes_after(
    table: ErrorTable, tally: Tally, formulas: Mapping[str, str], search: Search, warm: bool = False
) -> tuple[str, ...]:
    """Return likely mistakes that all simulations of a run show together.

    **Arguments:**
    - `table`: the table of the run.
    - `tally`: the counts over its rows.
    - `formulas`: texts by name.
    - `search`: the search of the run.
    - `warm`: whether the search started from the rows of an earlier run.
    """
    count = len(table) - tally.without_verdict
    if count < ENOUGH or search.origin == "given":
        return ()
    if tally.violating == count:
        if warm:
            return ()
        return (
            f"all {count} simulations with a verdict violate the property: are the formula and "
            "its units right?",
        )
    if search.samples_prior and tally.violating >= NEARLY_ALL * count:
        return (
            f"{tally.violating} of {count} simulations with a verdict violate the property, "
            "nearly all of the prior: are the formula and its units right?",
        )
    if len(formulas) == 1:
        # The least robustness is known: most tables need not be read for it.
        ranges = {"the property": _range(table, "rho")} if tally.lowest > 0 else {}
    else:
        ranges = {f"formula {name!r}": _range(table, f"rho.{name}") for name in formulas}
    return tuple(note for which, ends in ranges.items() for note in _never_near(which, ends, count))


def note_on_time_0(formulas: Mapping[str, Formula], trace: Trace) -> tuple[str, ...]:
    """Return a note if a trace violates formulas already at its first sample."""
    values = HostValues.of(trace)
    early = [name for name, f in formulas.items() if (values.truth(asked_at_once(f))[0] < 0).any()]
    which = "the property" if len(formulas) == 1 else f"formula {', '.join(map(repr, early))}"
    said = f"{which} is violated already at time 0: does the start satisfy it?"
    return (said,) if early else ()


def cut_short_note(search: Search, total: int | None, simulated: int) -> tuple[str, ...]:
    """Return a note on the simulated share of a finite search, such as a grid.

    **Arguments:**
    - `search`: the search of the run, which has more points to propose.
    - `total`: number of points of the whole search; None if it never ends.
    - `simulated`: number of its points that were simulated.
    """
    if total is None or search.origin == "given" or simulated >= total:
        return ()
    which, order = search.sequence
    return (
        f"{which} cut short: {simulated} of its {total} points were simulated "
        f"({100 * simulated / total:z.2g} %), {order}; budget={total} simulates all",
    )


def _range(table: ErrorTable, column: str) -> tuple[float, float]:
    """Return the least and the greatest robustness of all rows with a verdict."""
    low, high = math.inf, -math.inf
    for block in table.blocks((column, "status")):
        values = block[column].to_numpy()[block["status"].to_numpy() == "ok"]
        if len(values):
            # Not that of Python, which drops what is not a number.
            low, high = float(np.minimum(low, values.min())), float(np.maximum(high, values.max()))
    return low, high


def _never_near(which: str, ends: tuple[float, float], count: int) -> list[str]:
    low, high = ends
    # A constant one counts whole things, or tells how far a truth value is from the other.
    if not 0 < low < high < math.inf or high - low > HARDLY_MOVES * low:
        return []
    return [
        f"{which} was never near being violated: its robustness lay between {low:z.4g} and "
        f"{high:z.4g} in all {count} simulations; are its bounds and units right?"
    ]
