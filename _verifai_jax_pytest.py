"""The pytest plugin of verifai_jax: problems as tests, and what JUnit is told of them.

    [tool.pytest.ini_options]
    vj_specs = ["specs/*.py"]                           # every problem there is a test

It stands beside the package, since importing the package claims all cores for JAX: a project that
has verifai_jax installed and does not use it shall not notice (as Hypothesis' plugin does). It
imports pytest and nothing else until a test of a problem is collected.
"""

import shlex
import sys
from collections.abc import Generator, Iterator
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest

_SPECS = pytest.StashKey[frozenset[Path]]()
_MARK = "verifai_jax_check"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options and settings of tests of problems."""
    group = parser.getgroup("verifai_jax", "tests of problems (verifai_jax)")
    group.addoption(
        "--vj-budget", type=int, metavar="N", help="Simulations of each test of a problem."
    )
    group.addoption("--vj-seed", type=int, metavar="N", help="Seed of each test of a problem.")
    parser.addini("vj_specs", "Python files whose problems are tests, as patterns.", "args", [])
    parser.addini("vj_budget", "Simulations of a problem of these files.", default="")
    parser.addini(
        "vj_max_failure_probability", "Failure probability that these may have.", default=""
    )
    parser.addini("vj_rename", "New names of features, OLD=NEW, for older files.", "args", [])
    parser.addini("vj_corpus", "Folder of saved counterexamples.", default="counterexamples")


def pytest_configure(config: pytest.Config) -> None:
    """Find the files that hold problems; they are collected without being named again."""
    files: set[Path] = set()
    for pattern in config.getini("vj_specs"):
        if Path(pattern).is_absolute():
            raise pytest.UsageError(f"vj_specs: give a path from {config.rootpath}, not {pattern}")
        found = [path.resolve() for path in config.rootpath.glob(pattern) if path.is_file()]
        if not found:
            raise pytest.UsageError(f"vj_specs: no file in {config.rootpath} is {pattern}")
        files.update(found)
    config.stash[_SPECS] = frozenset(files)
    if files and config.args_source is not pytest.Config.ArgsSource.ARGS:
        places = [(config.invocation_params.dir / one).resolve() for one in config.args]
        config.args += [
            str(file)
            for file in sorted(files)
            if not any(file.is_relative_to(place) for place in places)
        ]


@pytest.hookimpl(wrapper=True)
def pytest_collect_file(
    file_path: Path, parent: pytest.Collector
) -> Generator[None, list[pytest.Collector], list[pytest.Collector]]:
    """Collect a file of problems as such; as a module of tests too where its name says so."""
    found = yield
    if file_path.resolve() not in parent.config.stash[_SPECS]:
        return found
    patterns = parent.config.getini("python_files")
    kept = found if any(fnmatch(file_path.name, pattern) for pattern in patterns) else []
    return [*kept, SpecFile.from_parent(parent, path=file_path)]


class SpecFile(pytest.File):
    """A file of problems."""

    def collect(self) -> Iterator[pytest.Item]:
        """Yield a test for each problem of the file."""
        from verifai_jax.addons.checking._test import problems_of

        place = _place(self)
        for name, problem in problems_of(place).items():
            yield ProblemItem.from_parent(
                self, name=name, problem=replace(problem, target=f"{place}:{name}")
            )

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Write an error of loading the file in its one line."""
        from verifai_jax.core.user_code.targets import TargetError

        if isinstance(excinfo.value, TargetError):
            return _clean(str(excinfo.value))
        return super().repr_failure(excinfo)


class ProblemItem(pytest.Item):
    """A problem as a test."""

    def __init__(self, *, problem: Any, **options: Any) -> None:
        super().__init__(**options)
        self.problem = problem
        if self.config.pluginmanager.hasplugin("xdist"):
            # Problems of one file share what they compile, so they stay with one worker.
            self.add_marker(pytest.mark.xdist_group(str(self.path)))

    def runtest(self) -> None:
        """Replay the corpus, then spend the budget."""
        from verifai_jax.addons.checking import Check, session
        from verifai_jax.addons.checking._test import run_check

        budget = self.config.getini("vj_budget")
        probability = self.config.getini("vj_max_failure_probability")
        chosen: dict[str, Any] = {}
        if budget:
            chosen["budget"] = _number("vj_budget", budget, int)
        if self.config.getoption("vj_budget") is not None:
            chosen["budget"] = self.config.getoption("vj_budget")
        if probability:
            chosen["max_failure_probability"] = _number(
                "vj_max_failure_probability", probability, float
            )
        pairs = [text.partition("=") for text in self.config.getini("vj_rename")]
        chosen["rename"] = {old: new for old, _, new in pairs}
        if not all(old and new for old, _, new in pairs):
            raise pytest.UsageError("vj_rename: give OLD=NEW for each feature")
        with session(_session(self)) as now:
            try:
                run_check(self.problem, Check(**chosen))
            finally:
                _tell(self, now)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Write a counterexample as the run that found it does, and how to see it again."""
        from verifai_jax.addons.checking import CounterexampleFound

        if isinstance(excinfo.value, CounterexampleFound):
            return _failure(self, excinfo.value, self.problem.target)
        return super().repr_failure(excinfo)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Return the file and the name."""
        return self.path, None, f"problem {self.name}"


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, Any, Any]:
    """Run a test that `vj.test` has made with the options of this session."""
    if getattr(pyfuncitem.obj, _MARK, None) is None:
        return (yield)
    from verifai_jax.addons.checking import CounterexampleFound, session

    with session(_session(pyfuncitem)) as now:
        try:
            return (yield)
        except CounterexampleFound as found:
            said = _failure(pyfuncitem, found, found.outcome.target)
            raise pytest.fail.Exception(said, pytrace=False) from None
        finally:
            _tell(pyfuncitem, now)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, Any, pytest.TestReport]:
    """Write what files, problems and simulators say as the command line does, for a terminal."""
    report = yield
    marked = getattr(getattr(item, "obj", None), _MARK, None) is not None
    if not marked and not isinstance(item, ProblemItem):
        return report
    # A skip is a triple, which pytest has made of its own texts.
    if report.longrepr is not None and not isinstance(report.longrepr, tuple):
        text = str(report.longrepr)
        report.longrepr = report.longrepr if _clean(text) == text else _clean(text)
    report.user_properties = [
        (name, _clean(value) if isinstance(value, str) else value)
        for name, value in report.user_properties
    ]
    return report


def _clean(text: str) -> str:
    from verifai_jax.core.messages.text import printable

    return printable(text)


def _session(item: pytest.Item) -> Any:
    from verifai_jax.addons.checking import Session

    config = item.config
    return Session(
        root=config.rootpath,
        corpus=config.getini("vj_corpus"),
        budget=config.getoption("vj_budget"),
        seed=config.getoption("vj_seed"),
    )


def _tell(item: pytest.Item, now: Any) -> None:
    """Note what came of a test where JUnit's report takes it from."""
    from verifai_jax.addons.checking._test import source_hash

    for outcome in now.outcomes:
        item.user_properties += list(outcome.properties.items())
    if now.outcomes and (function := getattr(item, "function", None)) is not None:
        item.user_properties.append(("vj_source", source_hash(function)))


def _failure(item: pytest.Item, found: Any, target: str | None) -> str:
    """Write what failed, with one line that shows it again."""
    outcome = found.outcome
    files = [str(path) for path in outcome.saved]
    if outcome.replayed is not None:
        files += [str(one.path) for one in outcome.replayed.failing]
    if target is not None and files:
        again = shlex.join(["verifai-jax", "replay-counterexamples", target, files[0]])
    else:
        words = ["pytest", item.nodeid]
        if not files:
            words += ["--vj-seed", str(outcome.check.seed), "--vj-budget"]
            words += [str(outcome.check.budget)]
        again = shlex.join(words)
    return f"{outcome}\n  reproduce    {again}"


def _place(file: pytest.File) -> str:
    """Return the path of a file as the command line would be given it."""
    here = file.config.invocation_params.dir
    root = str(file.config.rootpath)
    if root not in sys.path:
        sys.path.insert(0, root)
    return str(file.path.relative_to(here)) if file.path.is_relative_to(here) else str(file.path)


def _number(name: str, text: str, kind: Any) -> Any:
    try:
        return kind(text)
    except ValueError:
        raise pytest.UsageError(f"{name} must be a number; got {text!r}") from None
