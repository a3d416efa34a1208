"""Fuzzing with a model: a feature space describes possible inputs, and coverage guides the search.

    run = fuzz(problem, budget=20_000)                  # in addition to the formulas: finite, ended
    run = fuzz(space=space, system=simulate, ranges={"speed": (0, 60)})       # without any formula
    print(run); run.coverage; run.corpus; vj.shrink(run)

It is a falsification with `search.Coverage`, which mutates simulations that covered something new:
transitions of an `Automaton`, pairs of transitions, cells of signals, or another clause of the
formulas as the one nearest to breaking.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

from verifai_jax.addons.fuzzing.implicit import with_implicit
from verifai_jax.addons.fuzzing.run import FuzzRun, as_made
from verifai_jax.addons.searches.coverage import Coverage
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.falsification import Start, falsify
from verifai_jax.features import Domain, FeatureSpace
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.statistics.stopping import Stop


@suggests_options
@shows_progress("fuzzing")
def fuzz(
    problem: Problem | None = None,
    budget: int = 10_000,
    *,
    space: FeatureSpace | Mapping[str, Domain] | None = None,
    system: Callable[..., Trace] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    cells: Mapping[str, tuple[float, float, int]] | None = None,
    search: str | Search | Start | None = None,
    batch: int | None = None,
    seed: int = 0,
    stop: Stop | None = None,
    folder: str | Path | None = None,
    confirm: bool = True,
    precision: str = "float32",
    run_on: RunOn | None = None,
    progress: bool | None = None,
) -> FuzzRun:
    """Look for failures by covering the possible behaviour, with or without formulas.

    **Arguments:**
    - `problem`: a problem with formulas; without one give `space` and `system`.
    - `budget`: simulations at most.
    - `space`, `system`: the feature space and the system, if there is no formula. A simulation then
      fails if it raises, hangs, or has a signal that is not finite or outside its range.
    - `ranges`: signal -> `(low, high)`: the range in which it must stay.
    - `cells`: signal -> `(low, high, how many)`: cells of behaviour to cover, of all these signals
      together. The default is the problem's `behaviour`, or, if few signals have ranges, four cells
      for each of these.
    - `search`: the search; `search.Coverage` when left out.
    - all other arguments: as in `falsify`.

    With formulas, a simulation that raises or hangs has a status and no verdict, as in `falsify`;
    `run.failures` includes these rows.

    **Returns:** the run: `run.coverage` says how much was covered, `run.corpus` has the rows that
    extended the coverage, and `run.problem` includes the implicit properties.
    **Raises:** `ValueError` for invalid ranges or cells, and unless either a problem or a space
    with a system is given; the errors of `falsify`.
    """
    checked = with_implicit(problem, space, system, ranges or {}, cells, "fuzz")
    run = falsify(
        checked, Coverage() if search is None else search, budget,
        batch=batch, seed=seed, stop=stop, folder=folder, confirm=confirm, precision=precision,
        run_on=run_on, progress=progress,
    )  # fmt: skip
    return as_made(run)
