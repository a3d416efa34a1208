"""A problem as a test function, for pytest or for a direct call.

@vj.test(problem, budget=2000)
def test_balance(): ...

@vj.test("specs/cartpole.py:balance", budget=5000, max_failure_probability=0.01)
def test_balance_is_rarely_lost(run):
    assert run.best["rho"] > -0.5                    # further demands on the run
"""

import contextlib
import functools
import hashlib
import inspect
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from verifai_jax.addons.checking.check import BUDGET, Check, CheckOutcome, CounterexampleFound
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.user_code.targets import definitions, load_target
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.silent_mistakes import formula_notes
from verifai_jax.search import Search

MARK = "verifai_jax_check"
"""Attribute of a test function by which the pytest plugin knows it."""
TESTED = "verifai_jax_problem"
"""Attribute of a test function with its problem, or the problem's name."""


@suggests_options
def test(
    problem: Problem | str,
    *,
    budget: int = BUDGET,
    max_failure_probability: float | None = None,
    seed: int = 0,
    search: str | Search = "portfolio",
    confidence: float = 0.95,
    corpus: str | Path | None = None,
    rename: Mapping[str, str] | None = None,
) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Make a test function of a problem: it replays the corpus, then searches with the budget.

    It fails if a saved counterexample is not fixed, or if a new one is found, which is then shrunk
    and added to the corpus. Under pytest the options `--vj-budget` and `--vj-seed` take precedence.

    **Arguments:**
    - `problem`: the problem, or `FILE.py:NAME`; each file is loaded once for all tests.
    - `budget`: maximum number of simulations.
    - `max_failure_probability`: accept failures up to this probability; the test passes only if
      independent samples show that it is not exceeded. When left out, no counterexample is
      accepted.
    - `seed`: the seed of the search and the samples.
    - `search`: the search for counterexamples.
    - `confidence`: the confidence of statements about the failure probability.
    - `corpus`: folder of saved counterexamples, from the root of the project; by default
      `counterexamples`, or pytest's setting `vj_corpus`.
    - `rename`: new names of features, for older files of the corpus.
    **Returns:** a decorator for a test function, which is called after the test has passed; a
    parameter `run` receives the `Run`, all others are pytest's fixtures.
    **Raises:** `TypeError` for an object that is not a problem; `ValueError` for numbers out of
    range, and for a budget with which no test could pass.
    """
    if not isinstance(problem, Problem | str):
        raise TypeError(
            "vj.test needs a Problem or the name of one, FILE.py:NAME, as in @vj.test(problem); "
            f"got {type(problem).__name__}"
        )
    check = Check(budget, max_failure_probability, seed, search, confidence, dict(rename or {}))

    def decorate(function: Callable[..., Any]) -> Callable[..., None]:
        signature = inspect.signature(function)
        wants_run = "run" in signature.parameters

        @functools.wraps(function)
        def run_test(*arguments: Any, **fixtures: Any) -> None:
            __tracebackhide__ = True
            found = load(problem) if isinstance(problem, str) else problem
            outcome = run_check(found, check, corpus)
            if wants_run:
                fixtures["run"] = outcome.run
            function(*arguments, **fixtures)

        others = [p for name, p in signature.parameters.items() if name != "run"]
        setattr(run_test, "__signature__", signature.replace(parameters=others))  # noqa: B010
        setattr(run_test, MARK, check)
        setattr(run_test, TESTED, problem)
        return run_test

    return decorate


# It is no test itself, though its name is like that of one.
setattr(test, "__test__", False)  # noqa: B010


def run_check(problem: Problem, check: Check, corpus: str | Path | None = None) -> CheckOutcome:
    """Test a problem in the present session, and print the outcome.

    **Raises:** `CounterexampleFound` if it failed.
    """
    __tracebackhide__ = True
    now = current_session()
    outcome = now.settings(check).run(problem, now.corpus_folder(corpus))
    now.outcomes.append(outcome)
    if outcome.failed:
        raise CounterexampleFound(outcome)
    for note in formula_notes(problem):  # What a test that passes prints is seen by nobody.
        warnings.warn(f"{problem.name}: {note}", stacklevel=2)
    if outcome.replayed is not None:
        print(outcome.replayed)
    print(outcome)
    return outcome


def tested_problem(function: object) -> Problem | None:
    """Return the problem that a test function tests; None for any other object."""
    problem = getattr(function, TESTED, None)
    return load(problem) if isinstance(problem, str) else problem


def source_hash(function: object) -> str:
    """Return the SHA-256 of a test function's text, with its decorators; empty without a file."""
    try:
        return hashlib.sha256(inspect.getsource(function).encode()).hexdigest()  # pyright: ignore
    except (OSError, TypeError):
        return ""


@functools.cache
def problems_of(path: str) -> dict[str, Problem]:
    """Return the problems that a file defines, by name; the file is run once for all tests."""
    return definitions(path, Problem)


@functools.cache
def load(target: str) -> Problem:
    """Return the problem named by `FILE.py:NAME`, the same object for all tests."""
    path, colon, name = target.rpartition(":")
    problems = problems_of(path if colon else target)
    if colon and name in problems:
        found = problems[name]
    elif not colon and len(problems) == 1:
        found = next(iter(problems.values()))
    else:
        found = load_target(target, Problem)
    return replace(found, target=target)


CORPUS = "counterexamples"
"""Usual folder of the corpus, below the root of the project."""


@dataclass(frozen=True)
class Session:
    """The settings of a test session, given by the test runner.

    - `root`: the folder that contains the corpus.
    - `corpus`: folder of the corpus, relative to `root`.
    - `budget`, `seed`: values that replace those of the tests, if given.
    - `outcomes`: the outcomes of the tests, in order.
    """

    root: Path = field(default_factory=Path)
    corpus: str = CORPUS
    budget: int | None = None
    seed: int | None = None
    outcomes: list[CheckOutcome] = field(default_factory=list)

    def settings(self, check: Check) -> Check:
        """Return the settings of a test, with the session's values where given."""
        budget = check.budget if self.budget is None else self.budget
        seed = check.seed if self.seed is None else self.seed
        return replace(check, budget=budget, seed=seed)

    def corpus_folder(self, corpus: str | Path | None) -> Path:
        """Return the folder of a corpus: the test's own, or the usual one."""
        path = self.root / (self.corpus if corpus is None else corpus)
        # What is printed and typed again is the path from where one stands.
        return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


_SESSION: ContextVar[Session | None] = ContextVar("verifai_jax_session", default=None)


@contextlib.contextmanager
def session(settings: Session) -> Iterator[Session]:
    """Make checks inside the block take their settings from this session."""
    token = _SESSION.set(settings)
    try:
        yield settings
    finally:
        _SESSION.reset(token)


def current_session() -> Session:
    """Return the session, or default settings when a test is called as a plain function."""
    return _SESSION.get() or Session()
