"""Runs and claims as evidence for requirements, what they found, and what has changed since.

evidence = [*runs_in(["runs"]), *claims_in(["reports"])]

Nothing in a folder is executed: a run is read without its problem.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from verifai_jax.addons.assurance.traceability.result import ERROR, MET, NOT_RUN, VIOLATED
from verifai_jax.addons.reports.claims import PAGE, sealed
from verifai_jax.addons.reports.provenance import Model, chained
from verifai_jax.addons.reports.run_report import chain_of
from verifai_jax.core.messages.text import counted
from verifai_jax.core.store.foreign_files import read_json
from verifai_jax.core.user_code.sources import Sources, file_hash, list_changes
from verifai_jax.falsification.model_changes import model_changes
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.run_folder import RECORD, load
from verifai_jax.falsification.validation import space_as_data
from verifai_jax.mtl.requirements import Requirement
from verifai_jax.problem.model_digest import digest_of_model
from verifai_jax.problem.problem import Problem

CLAIMS = ".claims.json"
"""Ending of the files of claims."""


class ModelNow(NamedTuple):
    """The present model of a problem: its `space` as plain data, if possible, and `sources`.

    - `digests`: hashes of what it simulates, by backend; empty texts if unknown.
    - `chains`, `chain`: the last hashes of the chains that reports on its runs would have now, and
      of a report on another result with the same files.
    """

    space: Mapping[str, Any] | None
    digests: Mapping[str | None, str]
    sources: Sources
    chains: frozenset[str]
    chain: str


@dataclass(frozen=True)
class Evidence:
    """A run, or the claims of a report.

    - `kind`: `"runs"` or `"claims"`; `result`: what claims are about, `"run"` or `"estimate"`.
    - `name`: its path; `problem`: the name of its problem.
    - `formulas`, `requirements`: their texts and contents by name, at that time.
    - `model`, `backend`, `sources`, `space`: what was simulated, as far as it is recorded.
    - `chain`: last hash of the chain of its inputs; of a run the present one.
    - `outcomes`: what a run found of each formula: the outcome, and a sentence.
    - `edited`: sentences on what does not agree with its own hashes, with the kind of link.
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
    space: Mapping[str, Any] | None = field(default=None, repr=False)
    outcomes: Mapping[str, tuple[str, str]] = field(default_factory=dict, repr=False)
    edited: tuple[tuple[str, str], ...] = field(default=(), repr=False)

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
        """Yield sentences on changes since it was made; `about` is its present subject."""
        if (was := self.formulas[name]) != formula:
            yield f"{name}: the formula has changed since {self.name}: {was} then, {formula} now"
        now, then = _said(about.entry() if about else {}), _said(self.requirements.get(name, {}))
        if changed := [field for field in {**then, **now} if then.get(field) != now.get(field)]:
            what = ", ".join(changed)
            yield f"{name}: the requirement has changed since {self.name}: its {what}"
        if self.model and model.digests.get(self.backend):
            if self.model != model.digests[self.backend]:
                yield f"{name}: the model has changed since {self.name}"
        else:
            if changes := model_changes(self.sources, model.sources):
                yield f"{name}: the model has changed since {self.name}: {list_changes(changes)}"
            if None not in (self.space, model.space) and self.space != model.space:
                yield f"{name}: the features have changed since {self.name}"
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
    chain = links[-1].chain if links else ""
    return ModelNow(space_as_data(problem), digests, sources, chains, chain)


def runs_in(folders: Sequence[str | Path]) -> Iterator[Evidence]:
    """Yield the runs of folders, and of the folders in them; `ValueError` for a damaged one."""
    for folder in map(Path, folders):
        for record in sorted({folder / RECORD, *folder.glob(f"*/{RECORD}")}):
            if not record.is_file():
                continue
            run = load(record.parent)
            damage = [("runs", f"{record.parent}: {run.damage}")] if run.damage else []
            yield Evidence(
                "runs", "run", str(record.parent), run.name, run.formulas, run.requirements,
                run.model, run.backend, run.sources, chain_of(run), run.space_data,
                {name: outcome_of(run, name) for name in run.formulas}, tuple(damage),
            )  # fmt: skip


ENDS = ("budget", "max_seconds", "stop_after", "stop_when", "exhausted")
"""Ends of a run that were asked for."""


def outcome_of(run: Run, name: str) -> tuple[str, str]:
    """Return what a run found of one formula: the outcome, and a sentence."""
    if run.table.changed:
        return ERROR, "its rows have changed since they were written"
    counts, done = run.table.counts, counted(run.simulations, "simulation")
    broken = run.table.counterexamples
    if (column := f"rho.{name}") in broken:
        # Of a robustness of zero the table does not say whose it is that the row breaks.
        broken = broken[(broken[column] < 0) | ((broken[column] == 0) & (broken["rho"] == 0))]
    if not run.simulations:
        return NOT_RUN, "it has no simulation"
    if len(broken):
        return VIOLATED, f"violated in {len(broken):,} of {done}"
    if counts.without_verdict:
        return ERROR, f"{counts.without_verdict:,} of {done} have no verdict"
    if run.stopped not in ENDS:
        return ERROR, f"it ended early ({run.stopped}) after {run.simulations:,} of {run.budget:,}"
    return MET, f"not violated in {done}"


def claims_in(paths: Sequence[str | Path]) -> Iterator[Evidence]:
    """Yield claims of reports, and of their folders; `ValueError` for a file of another form."""
    found: dict[Path, None] = {}
    for path in map(Path, paths):
        own = path if path.name.endswith(CLAIMS) else path.with_suffix(CLAIMS)
        files = sorted(path.rglob(f"*{CLAIMS}")) if path.is_dir() else [own]
        found |= dict.fromkeys(file for file in files if file.is_file())
    for file in found:
        try:
            data = read_json(file)
            if about := data["about"]:
                yield Evidence(
                    "claims", str(about["result"]), str(file), str(data["subject"]),
                    dict(about["formulas"]), dict(about["requirements"]), str(about["model"]),
                    about["backend"], chain=str(data["inputs_sha256_chain"]),
                    edited=tuple(_edited(file, data)),
                )  # fmt: skip
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{file} holds no claims of a report: {error!r}") from None


def _edited(file: Path, data: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what is not as it was when claims were written: they, their report, files read."""
    page = Path(str(file).removesuffix(CLAIMS) + ".html")
    if sealed(data) != data:
        yield "claims", f"{file} was edited since it was written"
    if page.is_file() and file_hash(page) != data.get(PAGE):
        yield "reports", f"{page} was edited since {file} was written"
    for each in data.get("files", ()):
        name, sha256 = str(each["name"]), str(each["sha256"])
        if not Path(name).is_file():
            yield "claims", f"{name}, which {file} rests on, is not there"
        elif file_hash(Path(name)) != sha256:
            yield "claims", f"{name} was edited since {file} was written"
