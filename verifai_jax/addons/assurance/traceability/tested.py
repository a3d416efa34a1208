"""Tests of problems, their results in files of JUnit, and what was edited since they were run.

tests = [*tests_in(["tests"])]
cases = read_cases(["junit.xml"])                   # pytest --junitxml=junit.xml
"""

import inspect
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from verifai_jax.addons.assurance.traceability.result import (
    ERROR,
    MET,
    NOT_RUN,
    SKIPPED,
    VIOLATED,
    Result,
)
from verifai_jax.addons.checking._test import MARK, source_hash, tested_problem
from verifai_jax.core.messages.text import counted, one_line
from verifai_jax.core.store.foreign_files import read_bytes, read_xml
from verifai_jax.core.user_code.targets import NothingDefined, definitions, values_in
from verifai_jax.problem.model_digest import digest_of_model
from verifai_jax.problem.problem import Problem

Location = str | Path
SETTINGS = {"budget": "vj_budget", "seed": "vj_seed"}
"""Settings of a test that its results record, with the names of their properties."""
LIMIT = "vj_max_failure_probability"


class Tested(NamedTuple):
    """A test: its label, its problem, and the function, None for a problem of `vj_specs`."""

    label: str
    problem: Problem
    function: Any = None

    @property
    def skipped(self) -> str:
        """The mark of pytest by which it is skipped; empty if it is not."""
        marks = [*getattr(self.function, "pytestmark", ())]
        inner = inspect.unwrap(self.function) if self.function else None
        there = getattr(inner, "__globals__", {}).get("pytestmark", ())
        marks += there if isinstance(there, list | tuple) else [there]
        for each in marks:
            if each.name == "skip" or (each.name == "skipif" and any(each.args[:1])):
                return str(each.name)
        return ""


class Case(NamedTuple):
    """A result of a test in a file of JUnit: its file, dotted name, outcome and properties."""

    file: str
    name: str
    outcome: str
    text: str
    properties: Mapping[str, str]

    def is_of(self, test: Tested) -> bool:
        """Return whether it is of a test, whose path may begin elsewhere."""
        label = test.label.replace("::", ".").replace(".py.", ".").replace("/", ".").strip(".")
        one, other = self.name.partition("[")[0], label
        return f".{one}".endswith(f".{other}") or f".{other}".endswith(f".{one}")


def read_cases(paths: Sequence[Location]) -> list[Case]:
    """Read results in files of JUnit, and in `*.xml` of folders; `ValueError` for other files."""
    cases = []
    for path in map(Path, paths):
        if not path.exists():
            raise FileNotFoundError(f"there is no file of results {path}")
        for file in sorted(path.rglob("*.xml")) if path.is_dir() else [path]:
            root = read_xml(read_bytes(file), str(file))
            if root.tag not in ("testsuites", "testsuite"):
                raise ValueError(f"{file} is not of JUnit: its first element is {root.tag}")
            for case in root.iter("testcase"):
                said = {
                    str(each.get("name")): str(each.get("value")) for each in case.iter("property")
                }
                name = f"{case.get('classname', '')}.{case.get('name', '')}".strip(".")
                cases.append(Case(str(file), name, *_outcome(case, said), said))
    return cases


def _outcome(case: Any, said: Mapping[str, str]) -> tuple[str, str]:
    """Return the outcome of a case, and a sentence."""
    below = {each.tag: one_line(str(each.get("message", "")), 80) for each in case}
    done = counted(int(said["vj_simulations"]), "simulation") if "vj_simulations" in said else ""
    if "error" in below:
        return ERROR, f"it raised: {below['error']}"
    if "failure" in below:
        found = [said.get(each, "0") for each in ("vj_counterexamples", "vj_replayed_failing")]
        if any(each != "0" for each in found):
            return VIOLATED, f"it failed: {below['failure']}"
        return ERROR, f"it failed without a counterexample: {below['failure']}"
    if "skipped" in below:
        if any(each.get("type") == "pytest.xfail" for each in case):
            return VIOLATED, f"it is expected to fail, and did: {below['skipped']}"
        return SKIPPED, f"it was skipped: {below['skipped']}"
    if said.get("vj_without_verdict", "0") != "0":
        return ERROR, f"it passed, and {said['vj_without_verdict']} of {done} have no verdict"
    return MET, f"it passed{', with ' if done else ''}{done}"


def results_of(test: Tested, cases: Sequence[Case]) -> list[Result]:
    """Return what is known of a test's outcome, one result at least."""
    if test.skipped:
        return [Result("tests", test.label, SKIPPED, f"it is marked {test.skipped}")]
    own = [each for each in cases if each.is_of(test)]
    if not own:
        return [Result("tests", test.label, NOT_RUN, "no file of results has it")]
    return [Result("tests", test.label, each.outcome, each.text) for each in own]


def edits_of(
    test: Tested, name: str, formula: str, model: str, cases: Sequence[Case]
) -> Iterator[str]:
    """Yield sentences on how a test differs from the problem's formula and model, and from runs."""
    if (own := str(test.problem.formulas[name])) != formula:
        yield f"{name}: {test.label} tests {own}, and the problem has {formula}"
    digest = digest_of_model(test.problem)
    if model and digest and digest != model:
        yield f"{name}: {test.label} tests another model than that of the problem"
    check = getattr(test.function, MARK, None)
    for case in (each for each in cases if each.is_of(test)):
        said, since = case.properties, f"since {case.file}"
        now: dict[str, object] = {"vj_model": digest}
        if test.function is not None:
            now["vj_source"] = source_hash(test.function)
        if check is not None:
            now |= {each: getattr(check, key) for key, each in SETTINGS.items()}
            now[LIMIT] = check.max_failure_probability
        for key, value in now.items():
            if said.get(key) and value not in ("", None) and said[key] != str(value):
                what = key.removeprefix("vj_").replace("_", " ")
                values = "" if len(said[key]) > 20 else f": {said[key]} then, {value} now"
                yield f"{name}: the {what} of {test.label} has changed {since}{values}"
        was = json.loads(said.get("vj_formulas", "{}")).get(name, own)
        if was != own:
            yield f"{name}: the formula of {test.label} has changed {since}: {was} then, {own} now"


def tests_in(given: Sequence[Location | object]) -> Iterator[Tested]:
    """Yield tests: functions of `vj.test`, and those of files and folders, which are run."""
    for item in given:
        if not isinstance(item, str | Path):
            problem = tested_problem(item)
            if problem is None:
                raise TypeError(
                    f"tests are functions of vj.test, or files of them; got {item!r:.80}"
                )
            yield Tested(getattr(item, "__name__", "test"), problem, item)
            continue
        path = Path(item)
        patterns = ("test_*.py", "*_test.py")
        inside = sorted({file for each in patterns for file in path.rglob(each)})
        for file in inside if path.is_dir() else [path]:
            yield from _tests_of(file)


def _tests_of(file: Path) -> Iterator[Tested]:
    """Yield the tests of a file: functions, also in classes, or else its problems."""
    found = False
    for value in values_in(str(file)):
        inside = vars(value).values() if isinstance(value, type) else [value]
        for each in inside:
            if (problem := tested_problem(each)) is not None:
                found = True
                name = getattr(each, "__qualname__", "test").rpartition("<locals>.")[2]
                yield Tested(f"{file}::{name.replace('.', '::')}", problem, each)
    if found or file.name.startswith("test_") or file.stem.endswith("_test"):
        return
    try:
        yield from (Tested(f"{file}::{n}", p) for n, p in definitions(str(file), Problem).items())
    except NothingDefined:
        return
