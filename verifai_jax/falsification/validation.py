"""Checks of the options of `falsify` and `resume`, before anything compiles."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from verifai_jax import search as searches
from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.core.store.locks import LOCK, write_lock
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.run_folder import RECORD
from verifai_jax.features.given import Rows, given_features, given_rows
from verifai_jax.problem.dependence import has_gradient, without_derivative
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.search.contract import check_contract
from verifai_jax.systems.base import System

if TYPE_CHECKING:
    from verifai_jax.core.compute.executors import Executor
    from verifai_jax.statistics.stopping import StoppingRule
MAX_AT_ONCE = 131_072
"""Simulations of a round at most, by default. A million cart-poles take 0.77 of the processor time
that rounds of 32 768 take, as less is confirmed; larger rounds were not tried."""


def usual_batch(search: Search, budget: int, after: int | None = None, whole: bool = False) -> int:
    """Return the default batch: at least twenty rounds for a search that learns.

    It is a power of two, so that there are few shapes. It is small if the run stops at few
    counterexamples, because such a run is likely to end in its first round. A search that does not
    learn has at most a thousand rounds.

    **Arguments:**
    - `search`: the search of the run.
    - `budget`: number of simulations of the run.
    - `after`: number of counterexamples that ends the run, or None.
    - `whole`: whether only the budget can end the run. A search that does not learn then has eight
      rounds, or more if these would be too large.
    """
    if not search.learns and after is not None:
        few = 1 << (min(search.wants.max_batch, 16 * after).bit_length() - 1)
        return max(
            few, min(search.wants.max_batch, 1 << (max(int(budget) // 512, 1).bit_length() - 1))
        )
    if not search.learns:
        eighth = 1 << max(0, (int(budget) // 8).bit_length() - 1)
        return max(search.wants.max_batch, min(MAX_AT_ONCE, eighth) if whole else 0)
    maximum = search.wants.max_batch if after is None else min(search.wants.max_batch, 16 * after)
    return min(1 << (maximum.bit_length() - 1), 1 << max(3, (int(budget) // 20).bit_length() - 1))


def check_search(problem: object, search: object) -> Search:
    """Return the search, given by name or as an object, if it can work on this problem.

    **Raises:** `TypeError` for anything that is not a problem or a search; `ValueError` for a
    search that cannot work on it.
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"falsify needs a Problem; got {type(problem).__name__}")
    if isinstance(search, str):
        search = searches.named(search)
    if not isinstance(search, Search):
        raise TypeError(f"search must be a name or a search like CrossEntropy(); got {search!r}")
    if not problem.system.backends:
        check_gradient(problem, search)
    problem.space.check_where()
    search.check(problem.space.cube)
    check_contract(search, problem.space.cube)
    return search


def _why_not_traced(system: System) -> str:
    """Return which of a system's backends JAX traces, or why none is; empty without backends."""
    if not system.backends:
        return ""
    if "mjx" in system.backends:
        return ", or the backend 'mjx', which has gradients"
    return f". It does not run on mjx: {system.why_not('mjx')}"


def check_gradient(problem: Problem, search: Search) -> None:
    """Refuse a search that needs gradients if the system has none.

    **Raises:** `ValueError`.
    """
    needs = search.needs_derivatives
    if needs and problem.rulebook is not None and search.wants.clauses:
        raise ValueError(
            f"search {search!r} descends on clauses and ignores priorities; problem "
            f"{problem.name!r} has a priority. Use 'portfolio' or 'cross_entropy'"
        )
    if problem.black_box and needs:
        why = _why_not_traced(problem.system)
        raise ValueError(
            f"the system of problem {problem.name!r} is a black box, which has no gradient, and "
            f"search {search!r} needs one; use one that does not, such as 'cross_entropy'{why}"
        )


def check_guide(problem: Problem, search: Search) -> None:
    """Refuse a guide for a search that does not learn, where it has no effect.

    **Raises:** `ValueError`.
    """
    if problem.guide is None or search.learns or search.origin == "given":
        return
    raise ValueError(
        f"problem {problem.name!r} has a guide, which steers searches that learn, and search "
        f"{search!r} does not: results do not influence its points. Use one that learns, such as "
        "'portfolio', or dataclasses.replace(problem, guide=None)"
    )


def check_objective(problem: Problem, search: Search) -> None:
    """Refuse a search for likely failures if another order exists or the prior has no density.

    **Raises:** `ValueError`.
    """
    if not search.wants.likelihood:
        return
    other = "a guide" if problem.guide is not None else "a priority"
    if problem.guide is not None or problem.rulebook is not None:
        raise ValueError(
            f"problem {problem.name!r} has {other}, which orders simulations, and the likelihood "
            f"that {search!r} looks for is another order; leave out one of them"
        )
    from verifai_jax.features.improbability import Improbability

    Improbability(problem.space)


def check_same_guide(run: Run, problem: Problem) -> None:
    """Refuse to resume a run under another guide.

    **Raises:** `ValueError`.
    """
    now = None if problem.guide is None else problem.guide.to_json()
    if run.guide != now:
        raise ValueError(
            f"the run of {run.name!r} was steered by {_guide_text(run.guide)}, and the given "
            f"problem by {_guide_text(now)}"
        )


def _guide_text(guide: Mapping[str, Any] | None) -> str:
    return "no guide" if guide is None else f"the guide {dict(guide)}"


def adapt_search(
    problem: Problem, search: Search, executor: "Executor | None" = None
) -> tuple[Search, tuple[str, ...]]:
    """Return the search, or its fallback if the problem lacks what it needs, and a note on that.

    **Raises:** `ValueError` for a search that needs gradients if a step of the system has no
    derivative.
    """
    lacking = without_derivative(problem) if search.needs_derivatives else None
    if lacking is not None:
        raise ValueError(
            f"search {search!r} follows gradients, and the system of problem {problem.name!r} has "
            f"none: {lacking} has no derivative. Use a search that needs none, such as 'portfolio' "
            "or 'cross_entropy', or give the operation a derivative by jax.custom_jvp"
        )
    if problem.rulebook is not None:
        search = search.staying()  # Where a lesser rule is broken a graver one may be, too.
    fallback = search.fallback
    if fallback is None or not (search.wants.derivatives or search.wants.traces):
        return search, ()
    if search.wants.traces is not None:
        why = _why_no_traces(problem, executor)
        return (search, ()) if why is None else (fallback, (f"search {_label(fallback)}: {why}",))
    why = _why_no_derivatives(problem)
    if why is None:
        return search, ()
    return fallback, (f"{_label(search)} without gradients: {why}",)


def _label(search: Search) -> str:
    """Return the name of a search, or its text where it has none."""
    return str((searches.to_json(search) or {}).get("name", search))


def _why_no_derivatives(problem: Problem) -> str | None:
    """Return the reason why a search cannot use derivatives on this problem; None if it can."""
    if problem.black_box:
        return "the system is a black box"
    if problem.rulebook is not None:
        return "a priority has no gradient"
    if not len(problem.space.cube.continuous):
        return "all features are discrete"
    if (lacking := without_derivative(problem)) is not None:
        return f"{lacking} has no derivative"
    if problem.guide is None and not has_gradient(problem):
        return "the robustness is constant almost everywhere"
    return None


def _why_no_traces(problem: Problem, executor: "Executor | None") -> str | None:
    """Return the reason why a search cannot learn from this problem's traces; None if it can."""
    if executor is not None:
        return "workers of an executor send no traces, which trace_surrogate learns from"
    if problem.rulebook is not None:
        return "trace_surrogate knows no priority"
    return None


AUTO = "auto"
"""The default search, which depends on the seconds of a simulation."""
SLOW = 0.5
"""Seconds of a simulation from which on a surrogate pays."""
FEW_DIMENSIONS = 20
"""Maximum dimension in which a Gaussian process needs no trust region."""


def can_be_slow(problem: Problem, executor: "Executor | None") -> bool:
    """Return whether the time of a simulation decides which search is the default.

    It does not in three cases: a system that JAX traces is quick; a system that simulates many rows
    in a call needs as long for one row; with an executor, simulation is not the only cost.
    """
    if problem.system.backends or problem.system.can_simulate_batch:
        return False
    return problem.black_box and executor is None and problem.space.dim > 0


def slow_search(problem: Problem, seconds: float) -> tuple[Search, str] | None:
    """Return the default search for simulations that take this long, and a note with the reason.

    None if they are quick enough for the portfolio.
    """
    if seconds < SLOW:
        return None
    if _why_no_traces(problem, None) is None:
        name = "trace_surrogate"
    else:
        name = "turbo" if problem.space.dim > FEW_DIMENSIONS else "bayes"
    why = f"a simulation takes {seconds:z.2g} s"
    if name in searches.names():
        return searches.named(name), f"search {name}: {why}; search= sets another"
    note = f"search portfolio: {why}, but {name}, which needs fewer of them, is not installed"
    return searches.Portfolio(gradients=False), note


def check_rule(search: Search, rule: "StoppingRule | None") -> None:
    """Refuse a stopping rule that does not fit the samples of this search.

    **Raises:** `ValueError`.
    """
    if rule is not None and not search.samples_prior:
        raise ValueError(
            f"Stop(when=) needs independent samples of the space, which search {search!r} does not "
            "give; use search='uniform'"
        )


def points_of(problem: Problem, rows: Rows, precision: str) -> Float[np.ndarray, "n row"]:
    """Return given features as rows that an engine simulates with exactly these numbers."""
    return given_rows(problem.space, given_features(problem.space, rows, precision))


def check_first(
    problem: Problem, first: "Rows | Float[np.ndarray, 'n row'] | None",
    rule: "StoppingRule | None", precision: str,
) -> Float[np.ndarray, "n row"]:  # fmt: skip
    """Return the rows that are simulated before the search begins; empty if none are given.

    **Raises:** the errors of `points_of`; `ValueError` together with a rule that needs independent
    samples.
    """
    if first is None:
        return rows_of_first([], problem)
    # `simulate` has made rows of them already.
    rows = first if isinstance(first, np.ndarray) else points_of(problem, first, precision)
    if rule is not None and len(rows):
        raise ValueError(
            "Stop(when=) needs independent samples of the space, which given rows are not"
        )
    return rows


def rows_of_first(first: Sequence[Sequence[float]], problem: Problem) -> np.ndarray:
    """Return the rows that a run recorded as its first ones, `[n, row]`."""
    if not len(first):
        return np.zeros((0, problem.space.dim), np.float32)
    return np.asarray(first, np.float64)


def space_as_data(problem: Problem) -> dict[str, Any] | None:
    """Return the feature space as plain data; None if that is impossible."""
    try:
        return problem.space.to_json()
    except ValueError:
        return None  # It has domains that only the user knows.


def recorded_search(run: Run) -> Search:
    """Return the search that is recorded with a run.

    **Raises:** `ValueError` if the record describes none.
    """
    try:
        return searches.from_json(run.search_data or {})
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise ValueError(
            f"the record of the run of {run.name!r} describes no search "
            f"({one_line(format_error(error))}); give it: resume(..., search=)"
        ) from error


def check_same_space(run: Run, problem: Problem) -> None:
    """Refuse to resume a run in another space.

    **Raises:** `ValueError` that names the first difference.
    """
    data = space_as_data(problem)
    if run.space_data is None or data is None or run.space_data == data:
        return
    was, now = dict(run.space_data["features"]), dict(data["features"])
    for name in now:
        if was.get(name) != now[name]:
            raise ValueError(
                f"the run of {run.name!r} was over another space: its feature {name!r} was "
                f"{one_line(str(was.get(name)))}, that of the given problem is "
                f"{one_line(str(now[name]))} (a run with --only is "
                "resumed with the same --only)"
            )
    # The name of a constraint may change with the line it is written in.
    if list(was) != list(now) or bool(run.space_data["where"]) != bool(data["where"]):
        raise ValueError(
            f"the run of {run.name!r} was over a space with another order or constraint"
        )


@contextmanager
def new_folder(folder: str | Path | None) -> Iterator[Path | None]:
    """Make the folder for a new run, and lock it for this process.

    **Raises:** `ValueError` for a folder that is not empty, cannot be made, or is locked by another
    process.
    """
    if folder is None:
        yield None
        return
    folder = Path(folder)
    if not (folder / LOCK).exists():  # The lock says who writes there.
        _check_empty(folder)
    with write_lock(folder):
        _check_empty(folder)  # Another run may have begun in it, and ended, since.
        yield folder


def _check_empty(folder: Path) -> None:
    # A process that dies before its first record leaves a part of one.
    leftover = {f".{RECORD}.part", LOCK}
    if folder.exists() and (not folder.is_dir() or {p.name for p in folder.iterdir()} - leftover):
        if (folder / RECORD).is_file():
            raise ValueError(
                f"folder {str(folder)!r} exists and is not empty: it holds a run, which vj.resume "
                f"or verifai-jax falsify --resume {folder} continues; a new run needs another "
                "folder"
            )
        raise ValueError(f"folder {str(folder)!r} exists and is not empty; a run needs a new one")
