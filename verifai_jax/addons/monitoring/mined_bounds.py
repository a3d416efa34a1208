"""Traces of a problem for questions about formulas: samples of its prior, and falsification.

simulated(problem)                                  # 64 traces from the prior
mine_by_search(read_parametric("always x > ?d"), problem)
distinguish_by_search(one, other, problem)
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from verifai_jax.addons.monitoring.distinguishing import Distinction, distinction
from verifai_jax.addons.monitoring.mining import Mined, mine_template
from verifai_jax.addons.monitoring.parametric import Parametric
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.values.trace import Trace
from verifai_jax.falsification import falsify
from verifai_jax.falsification.run import Run
from verifai_jax.mtl.formula import Formula
from verifai_jax.problem import Problem
from verifai_jax.statistics.stopping import Stop

SIMULATED = 64
"""Simulations from the prior that stand for recordings."""
TAKEN = 16
"""Counterexamples of one search whose traces tighten parameters: the least robust ones."""


def simulated(problem: Problem, count: int = SIMULATED, seed: int = 0) -> tuple[Trace, ...]:
    """Simulate samples of a problem's prior.

    **Returns:** at most `count` traces that have a verdict.
    **Raises:** the errors of `falsify`; `ValueError` if no simulation has a verdict.
    """
    run = falsify(problem, "uniform", count, seed=seed, confirm=False, progress=False)
    rows = np.flatnonzero(~np.isnan(run.table.all["rho"].to_numpy())).tolist()
    if not rows:
        raise ValueError(f"no simulation of problem {problem.name!r} has a verdict")
    return _traces(run, rows)


@shows_progress("mining parameters")
def mine_by_search(
    template: Parametric, problem: Problem, budget: int = 2000, seed: int = 0,
    confidence: float = 0.95, progress: bool | None = None,
) -> Mined:  # fmt: skip
    """Find the tightest parameters that no search breaks; each counterexample loosens them.

    **Arguments:**
    - `budget`: simulations in all. A search that finds nothing ends the mining.
    **Raises:** the errors of `mine` and `falsify`.
    """
    traces = list(simulated(problem, min(SIMULATED, budget), seed))
    spent, unbroken = len(traces), 0
    mined = mine_template(template, traces, 1.0, problem.end, confidence)
    while spent < budget:
        left = budget - spent
        # Half of what is left, so that the values that a search moves are searched again.
        count = left if unbroken or left <= 2 * SIMULATED else left // 2
        run = _searched(problem, {"asked": mined.formula}, count, seed=seed + spent)
        spent += run.simulations
        failing = _failing(run)
        traces += _traces(run, failing[:TAKEN])
        before, mined = mined, mine_template(template, traces, 1.0, problem.end, confidence)
        # Rounding in single precision may break what holds in double precision.
        unbroken = unbroken + run.simulations if mined.formula == before.formula else 0
    return replace(mined, searched=unbroken)


def distinguish_by_search(
    one: Formula, other: Formula, problem: Problem, budget: int = 2000, seed: int = 0
) -> Distinction:
    """Search for a simulation on which one of two formulas holds and the other does not.

    Simulations from the prior are tried first. Then `falsify` is applied to each formula implying
    the other: a counterexample distinguishes them.

    **Raises:** the errors of `falsify`.
    """
    source, end = f"a simulation of {problem.name}", problem.end
    some = simulated(problem, min(SIMULATED, budget), seed)
    found = distinction(one, other, some, source, end, len(some))
    if found or budget <= len(some):
        return found
    spec = {"forth": one >> other, "back": other >> one}
    run = _searched(problem, spec, budget - len(some), seed=seed, stop=Stop(after=1))
    traces = _traces(run, _failing(run)[:TAKEN])
    return distinction(one, other, traces, source, end, len(some) + run.simulations)


def _searched(problem: Problem, spec: Mapping[str, Formula], budget: int, **options: Any) -> Run:
    asking = replace(problem, spec=spec, priority=None)
    return falsify(asking, "auto", budget, confirm=False, progress=False, **options)


def _failing(run: Run) -> list[int]:
    """Return the rows of counterexamples, the least robust first."""
    table = run.table.all
    order = np.argsort(table["rho"].to_numpy(), kind="stable")
    return order[table["violated"].to_numpy()[order].astype(bool)].tolist()


def _traces(run: Run, rows: list[int]) -> tuple[Trace, ...]:
    return tuple(run.replay(row).trace.trim() for row in rows)
