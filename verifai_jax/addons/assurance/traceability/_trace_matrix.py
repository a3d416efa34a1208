"""The links from requirement to formula, problem, tests, runs, claims and report, and broken ones.

    print(vj.trace_matrix("specs/brake.py", tests=["tests"], runs=["runs"]))

Nothing in a folder is executed: a run is read without its problem.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from verifai_jax.addons.assurance.traceability.result import LINKS, Gap, TraceMatrix, TraceRow
from verifai_jax.addons.reports.provenance import Model, chained
from verifai_jax.addons.reports.run_report import chain_of
from verifai_jax.core.user_code.sources import Sources, list_changes
from verifai_jax.core.user_code.targets import NothingDefined, definitions, load_target, values_in
from verifai_jax.falsification.model_changes import model_changes
from verifai_jax.falsification.run_folder import RECORD, load
from verifai_jax.mtl.requirements import Requirement, read_requirements
from verifai_jax.problem.model_digest import digest_of_model
from verifai_jax.problem.problem import Problem
from verifai_jax.testing.checking._test import tested_problem

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
) -> TraceMatrix:
    """Follow each requirement to its formula, problem, tests, runs, claims and reports.

    A link is missing if there is nothing to link to, and suspect if something has changed since:
    the formula, the content of the requirement, the model, or the run that claims refer to.

    **Arguments:**
    - `problems`: problems, or files `FILE.py` and names `FILE.py:NAME`, which are run.
    - `requirements`: a file, or its content; by default those of the problems.
    - `tests`: test functions of `vj.test`, files, and folders whose files `test_*.py` are run; a
      file of problems without such functions, as in pytest's `vj_specs`, tests all of them.
    - `runs`: folders of runs, and folders of such folders.
    - `reports`: files and folders of reports; those in the folders of the runs are always included.
      A kind of link given as None is not required.
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
    tested, gaps = _tests(tests or (), names)
    evidence = [*runs_in(runs or ())]
    evidence += claims_in([*(each.folder for each in evidence), *(reports or ())])
    rows: list[TraceRow] = []
    for problem in known:
        own = [each for each in evidence if each.problem == problem.name]
        model = model_now(problem, own)
        for name in problem.formulas:
            about, links = demanded.get(name), {"tests": tested.get(problem.name, ())}
            for each in own:
                if name in each.formulas:
                    for kind, label in each.links():
                        links[kind] = (*links.get(kind, ()), label)
                    found = each.suspicions(name, str(problem.formulas[name]), about, model)
                    gaps += [Gap("suspect", each.kind, name, text) for text in found]
            row = _row(problem, name, about, {kind: links.get(kind, ()) for kind in asked})
            gaps += _gaps_of(problem, name, about, row, asked)
            rows.append(row)
    for each in demanded.values():
        if all(each.id not in problem.formulas for problem in known):
            rows.append(TraceRow(each.id, each.text, str(each.formula or ""), ""))
            lacks = "has a formula" if each.formula is None else "has the formula"
            text = f"no problem {lacks} of requirement {each.id}"
            gaps.append(Gap("missing", "formula", each.id, text))
    for each in evidence:
        if each.problem not in names:
            text = f"{each.name} is about {each.problem!r}, which is not one of the problems"
            gaps.append(Gap("missing", "problem", each.name, text))
    order = {name: index for index, name in enumerate(demanded)}
    rows.sort(key=lambda row: order.get(row.requirement, len(order)))
    return TraceMatrix(tuple(rows), tuple(dict.fromkeys(gaps)), asked)


def _row(
    problem: Problem, name: str, about: Requirement | None, links: Mapping[str, tuple[str, ...]]
) -> TraceRow:
    demand = ("", "") if about is None else (name, about.text)
    return TraceRow(*demand, str(problem.formulas[name]), problem.name, **links)


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
    """Return the requirements by identifier.

    **Raises:** `ValueError` for two that differ under one identifier.
    """
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


def _tests(
    given: Sequence[Location | object], names: Sequence[str]
) -> tuple[dict[str, tuple[str, ...]], list[Gap]]:
    """Return the names of tests by the name of their problem, and tests without a problem."""
    found: dict[str, tuple[str, ...]] = {}
    gaps = []
    for label, problem in _tested(given):
        found[problem.name] = (*found.get(problem.name, ()), label)
        if problem.name not in names:
            text = f"{label} tests {problem.name!r}, which has no requirement among the problems"
            gaps.append(Gap("missing", "requirement", label, text))
    return found, gaps


def _tested(given: Sequence[Location | object]) -> Iterator[tuple[str, Problem]]:
    for item in given:
        if not isinstance(item, str | Path):
            problem = tested_problem(item)
            if problem is None:
                raise TypeError(
                    f"tests are functions of vj.test, or files of them; got {item!r:.80}"
                )
            yield getattr(item, "__name__", "test"), problem
            continue
        path = Path(item)
        patterns = ("test_*.py", "*_test.py")
        inside = sorted({file for each in patterns for file in path.rglob(each)})
        for file in inside if path.is_dir() else [path]:
            yield from _tested_in(file)


def _tested_in(file: Path) -> Iterator[tuple[str, Problem]]:
    """Yield the tests of a file with their problems."""
    functions = [each for each in values_in(str(file)) if tested_problem(each) is not None]
    for each in functions:
        problem = tested_problem(each)
        assert problem is not None
        yield f"{file}::{getattr(each, '__name__', 'test')}", problem
    if functions or file.name.startswith("test_") or file.stem.endswith("_test"):
        return
    try:
        yield from ((f"{file}::{name}", p) for name, p in definitions(str(file), Problem).items())
    except NothingDefined:
        return


CLAIMS = ".claims.json"
"""Ending of the files of claims."""


class ModelNow(NamedTuple):
    """The present model of a problem.

    - `digests`: hashes of what it simulates, by backend; empty texts if unknown.
    - `sources`: its files.
    - `chains`: last hashes of the chains that reports on its runs would have now.
    - `chain`: that of a report on another result with the same files.
    """

    digests: Mapping[str | None, str]
    sources: Sources
    chains: frozenset[str]
    chain: str


@dataclass(frozen=True)
class Evidence:
    """A run, or the claims of a report.

    - `kind`: `"runs"` or `"claims"`.
    - `result`: the kind of result that the claims are about, `"run"` or `"estimate"`.
    - `name`: its path.
    - `problem`: the name of its problem.
    - `formulas`: their texts by name, at that time.
    - `requirements`: the content of their requirements at that time.
    - `model`: hash of the simulated model; empty if not recorded.
    - `backend`: the backend that simulated it.
    - `sources`: the sources of a run, as it recorded them.
    - `chain`: last hash of the chain of its inputs: the present one of a run, the recorded one of
      claims.
    """

    kind: str
    result: str
    name: str
    problem: str
    formulas: Mapping[str, str]
    requirements: Mapping[str, Mapping[str, str]] = field(repr=False)
    model: str = ""
    backend: str | None = None
    sources: Sequence[Mapping[str, Any]] = field(default=(), repr=False)
    chain: str = ""

    @property
    def folder(self) -> Path:
        """The folder that contains it, or that it is."""
        return Path(self.name) if self.kind == "runs" else Path(self.name).parent

    @property
    def page(self) -> Path:
        """The report that contains the claims."""
        return Path(self.name.removesuffix(CLAIMS) + ".html")

    def links(self) -> Iterator[tuple[str, str]]:
        """Yield the links that it provides: their kind, and a name."""
        yield self.kind, self.name
        if self.kind == "claims" and self.page.is_file():
            yield "reports", str(self.page)

    def suspicions(
        self, name: str, formula: str, about: Requirement | None, model: ModelNow
    ) -> Iterator[str]:
        """Yield sentences on changes since it was made.

        **Arguments:**
        - `about`: its present subject.
        """
        if (was := self.formulas[name]) != formula:
            yield f"{name}: the formula has changed since {self.name}: {was} then, {formula} now"
        now, then = _said(about.entry() if about else {}), _said(self.requirements.get(name, {}))
        if changed := [field for field in {**then, **now} if then.get(field) != now.get(field)]:
            what = ", ".join(changed)
            yield f"{name}: the requirement has changed since {self.name}: its {what}"
        if self.model and model.digests.get(self.backend):
            if self.model != model.digests[self.backend]:
                yield f"{name}: the model has changed since {self.name}"
        elif changes := model_changes(self.sources, model.sources):
            yield f"{name}: the model has changed since {self.name}: {list_changes(changes)}"
        if self.kind == "claims":
            if self.result == "run" and self.chain not in model.chains:
                yield f"{name}: the run has changed since {self.name}, or was not given"
            elif self.result != "run" and not self.model and self.chain != model.chain:
                yield f"{name}: the model has changed since {self.name}"
            if not self.page.is_file():
                yield f"{name}: the report of {self.name} is not there"


def _said(entry: Mapping[str, str]) -> dict[str, str]:
    """Return what a requirement says, apart from its formula, which is compared by itself."""
    return {name: text for name, text in entry.items() if name != "formula"}


def model_now(problem: Problem, about: Sequence[Evidence]) -> ModelNow:
    """Return the present model of a problem, for all evidence on it."""
    digests = {}
    for backend in {each.backend for each in about if each.model}:
        digests[backend] = digest_of_model(problem.on_backend(backend) if backend else problem)
    sources = problem.sources()
    links = chained(Model.of([sources.to_json()], sources).inputs)
    chains = frozenset(each.chain for each in about if each.kind == "runs")
    return ModelNow(digests, sources, chains, links[-1].chain if links else "")


def runs_in(folders: Sequence[str | Path]) -> Iterator[Evidence]:
    """Yield the runs of folders, and of the folders in them.

    **Raises:** `ValueError` for a run that is damaged.
    """
    for folder in map(Path, folders):
        for record in sorted({folder / RECORD, *folder.glob(f"*/{RECORD}")}):
            if not record.is_file():
                continue
            run = load(record.parent)
            yield Evidence(
                "runs", "run", str(record.parent), run.name, run.formulas, run.requirements,
                run.model, run.backend, run.sources, chain_of(run),
            )  # fmt: skip


def claims_in(paths: Sequence[str | Path]) -> Iterator[Evidence]:
    """Yield the claims of reports, and of folders of reports, that name their subject.

    **Raises:** `ValueError` for a file of another form.
    """
    found: dict[Path, None] = {}
    for path in map(Path, paths):
        own = path if path.name.endswith(CLAIMS) else path.with_suffix(CLAIMS)
        files = sorted(path.rglob(f"*{CLAIMS}")) if path.is_dir() else [own]
        found |= dict.fromkeys(file for file in files if file.is_file())
    for file in found:
        try:
            data = json.loads(file.read_text(encoding="utf-8"))
            if about := data["about"]:
                yield Evidence(
                    "claims", str(about["result"]), str(file), str(data["subject"]),
                    dict(about["formulas"]), dict(about["requirements"]), str(about["model"]),
                    about["backend"], chain=str(data["inputs_sha256_chain"]),
                )  # fmt: skip
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{file} holds no claims of a report: {error!r}") from None
