"""The links from requirement to formula, problem, tests, runs, claims and report, and broken ones.

print(vj.trace_matrix("specs/brake.py", tests=["tests"], runs=["runs"]))
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from verifai_jax.addons.assurance.traceability.evidence import claims_in, model_now, runs_in
from verifai_jax.addons.assurance.traceability.result import (
    LINKS,
    Gap,
    Result,
    TraceMatrix,
    TraceRow,
)
from verifai_jax.addons.assurance.traceability.tested import (
    edits_of,
    read_cases,
    results_of,
    tests_in,
)
from verifai_jax.addons.monitoring.requirement_files import read_requirements
from verifai_jax.core.user_code.sources import hashed_files
from verifai_jax.core.user_code.targets import definitions, load_target
from verifai_jax.falsification.run_folder import RECORD
from verifai_jax.mtl.requirements import Requirement
from verifai_jax.problem.model_digest import digest_of_model
from verifai_jax.problem.problem import Problem

Location = str | Path
MISSING_LINK = {
    "tests": "nothing tests",
    "runs": "no run has simulated",
    "claims": "no claim is about",
    "reports": "no report is on",
}
"""What is said of a requirement without a link of a kind."""


def trace_matrix(
    problems: Problem | Location | Sequence[Problem | Location],
    *,
    requirements: Location | Iterable[Requirement] | None = None,
    tests: Sequence[Location | object] | None = None,
    runs: Sequence[Location] | None = None,
    reports: Sequence[Location] | None = None,
    results: Sequence[Location] = (),
) -> TraceMatrix:
    """Follow each requirement to its formula, problem, tests, runs, claims and reports.

    A link is missing if there is nothing to link to, and suspect if something has changed since:
    the formula, the content of the requirement, the model, the test, the run that claims refer to,
    or a file that was edited. Each test and run has a result: met, violated, not run, skipped, or
    an error; the worst is the outcome of the requirement.

    **Arguments:**
    - `problems`: problems, or files `FILE.py` and names `FILE.py:NAME`, which are run.
    - `requirements`: a file, or its content; by default those of the problems.
    - `tests`: test functions of `vj.test`, files, and folders whose files `test_*.py` are run; a
      file of problems without such functions, as in pytest's `vj_specs`, tests all of them.
    - `runs`: folders of runs, and folders of such folders.
    - `reports`: files and folders of reports; those in the folders of the runs are always included.
      A kind of link given as None is not required.
    - `results`: files of JUnit, which `pytest --junitxml=FILE` writes, and folders of them. A test
      that is in none was not run.
    **Returns:** the matrix.
    **Raises:** `TargetError` for a file that cannot be run; `ValueError` for a damaged record,
    claims of another form, and two problems of one name.
    """
    known = list(_problems(problems))
    names = [problem.name for problem in known]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise ValueError(
            f"two problems are called {twice!r}, so that runs and claims cannot be told apart: "
            "rename one, or name the problem that is meant, FILE.py:NAME"
        )
    given = {
        "tests": tests,
        "runs": runs,
        "claims": reports if runs is None else runs,
        "reports": reports,
    }
    asked = tuple(name for name in LINKS if given[name] is not None)
    demanded = _demanded(known, requirements)
    tested, cases, gaps = [*tests_in(tests or ())], read_cases(results), list[Gap]()
    for each in tested:
        if each.problem.name not in names:
            text = f"{each.label} tests {each.problem.name!r}, which has no requirement among "
            gaps.append(Gap("missing", "requirement", each.label, f"{text}the problems"))
    evidence = [*runs_in(runs or ())]
    evidence += claims_in([*(each.folder for each in evidence), *(reports or ())])
    for case in cases:
        if case.properties.get("vj_problem") in names and not any(map(case.is_of, tested)):
            text = f"{case.file} has a result of {case.name}, which is not one of the tests"
            gaps.append(Gap("suspect", "tests", case.name, text))
    rows: list[TraceRow] = []
    for problem in known:
        own = [each for each in evidence if each.problem == problem.name]
        model, digest = model_now(problem, own), digest_of_model(problem)
        for name in problem.formulas:
            about, formula = demanded.get(name), str(problem.formulas[name])
            links: dict[str, tuple[str, ...]] = {}
            found_by: list[Result] = []
            for test in tested:
                if test.problem.name == problem.name and name in test.problem.formulas:
                    links["tests"] = (*links.get("tests", ()), test.label)
                    found_by += results_of(test, cases)
                    edits = edits_of(test, name, formula, digest, cases)
                    gaps += [Gap("suspect", "tests", name, text) for text in edits]
            for each in own:
                if name in each.formulas:
                    for kind, label in each.links():
                        links[kind] = (*links.get(kind, ()), label)
                    found = each.suspicions(name, formula, about, model)
                    gaps += [Gap("suspect", each.kind, name, text) for text in found]
                    gaps += [Gap("suspect", k, name, f"{name}: {text}") for k, text in each.edited]
                    if name in each.outcomes:
                        found_by.append(Result(each.kind, each.name, *each.outcomes[name]))
            demand = ("", "") if about is None else (name, about.text)
            ends = [links.get(kind, ()) if kind in asked else () for kind in LINKS]
            row = TraceRow(*demand, formula, problem.name, *ends, results=tuple(found_by))
            gaps += _gaps_of(problem, name, about, row, asked)
            rows.append(row)
    for each in demanded.values():
        if all(each.id not in problem.formulas for problem in known):
            rows.append(TraceRow(each.id, each.text, each.entry().get("formula", ""), ""))
            lacks = "has a formula" if each.formula is None else "has the formula"
            text = f"no problem {lacks} of requirement {each.id}"
            gaps.append(Gap("missing", "formula", each.id, text))
    for each in evidence:
        if each.problem not in names:
            text = f"{each.name} is about {each.problem!r}, which is not one of the problems"
            gaps.append(Gap("missing", "problem", each.name, text))
    order = {name: index for index, name in enumerate(demanded)}
    rows.sort(key=lambda row: order.get(row.requirement, len(order)))
    files = [Path(case.file) for case in cases]
    for each in evidence:
        files += [each.folder / RECORD] if each.kind == "runs" else [Path(each.name), each.page]
    inputs = tuple(hashed_files(files, "evidence"))
    return TraceMatrix(tuple(rows), tuple(dict.fromkeys(gaps)), asked, inputs)


def _gaps_of(
    problem: Problem, name: str, about: Requirement | None, row: TraceRow, asked: Sequence[str]
) -> Iterator[Gap]:
    """Yield the faults of a formula and its row, except changed evidence."""
    where = f"in problem {problem.name!r}"
    if about is None:
        text = f"formula {name!r} {where} stands for no requirement"
        yield Gap("missing", "requirement", name, text)
    elif about.formula is not None and str(about.formula) != row.formula:
        text = f"{name}: its formula {where} is {row.formula}, in {about.file} {about.formula}"
        yield Gap("suspect", "formula", name, text)
    for kind in asked:
        if not getattr(row, kind):
            yield Gap("missing", kind, name, f"{MISSING_LINK[kind]} {name} {where}")


def _problems(given: Problem | Location | Sequence[Problem | Location]) -> Iterator[Problem]:
    items = [given] if isinstance(given, Problem | str | Path) else given
    for item in items:
        if isinstance(item, Problem):
            yield item
        elif isinstance(item, str | Path) and ".py:" in str(item):
            yield load_target(str(item), Problem)
        elif isinstance(item, str | Path):
            yield from definitions(str(item), Problem).values()
        else:
            raise TypeError(
                f"trace_matrix needs problems, or files that define them; got {str(item)[:80]!r}"
            )


def _demanded(
    problems: Sequence[Problem], given: Location | Iterable[Requirement] | None
) -> dict[str, Requirement]:
    """Return the requirements by identifier."""
    if isinstance(given, str | Path):
        given = read_requirements(given, need_formulas=False)
    if given is None:
        given = [each for problem in problems for each in problem.requirements]
    found: dict[str, Requirement] = {}
    for each in given:
        if found.setdefault(each.id, each).entry() != each.entry():
            raise ValueError(
                f"two requirements {each.id!r} differ, in {found[each.id].file or 'the problems'} "
                f"and {each.file or 'the problems'}: rename one"
            )
    return found
