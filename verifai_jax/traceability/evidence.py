"""Runs and claims on disk, as evidence for the requirements that they are about.

for each in runs_in(["runs"]): each.problem, each.formulas
for each in claims_in(["reports"]): each.suspicions("REQ-1", "x < 2", requirement, model)

Nothing of a folder is executed: a run is read without its problem.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from verifai_jax.core.sources import Sources, list_changes
from verifai_jax.falsification.model_changes import model_changes
from verifai_jax.falsification.run_folder import RECORD, load
from verifai_jax.mtl.requirements import Requirement
from verifai_jax.problem.model_digest import digest_of_model
from verifai_jax.problem.problem import Problem
from verifai_jax.reports.provenance import Model, chained
from verifai_jax.reports.run_report import chain_of

CLAIMS = ".claims.json"
"""Ending of the files of claims."""


class ModelNow(NamedTuple):
    """The model of a problem as it is now.

    - `digests`: the digests of what it simulates, by backend; empty texts where that cannot be
      said.
    - `sources`: its files.
    - `chains`: last hashes of the inputs that reports on its runs would have.
    - `chain`: that of a report on another result of the same files.
    """

    digests: Mapping[str | None, str]
    sources: Sources
    chains: frozenset[str]
    chain: str


@dataclass(frozen=True)
class Evidence:
    """A run, or the claims of a report.

    - `kind`: `"runs"` or `"claims"`.
    - `result`: that claims are on, `"run"` or `"estimate"`.
    - `name`: its path.
    - `problem`: the name of the problem that it is about.
    - `formulas`: their texts by name, at that time.
    - `requirements`: what these stood for.
    - `model`: hash of what was simulated; empty where it is not recorded.
    - `backend`: that simulated it.
    - `sources`: the sources of a run, as it recorded them.
    - `chain`: last hash of the chain of its inputs: as it is now of a run, as it was of claims.
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
        """The folder that it is in, or is."""
        return Path(self.name) if self.kind == "runs" else Path(self.name).parent

    @property
    def page(self) -> Path:
        """The report of claims."""
        return Path(self.name.removesuffix(CLAIMS) + ".html")

    def links(self) -> Iterator[tuple[str, str]]:
        """Yield what it is a link to: the kind, and a name."""
        yield self.kind, self.name
        if self.kind == "claims" and self.page.is_file():
            yield "reports", str(self.page)

    def suspicions(
        self, name: str, formula: str, about: Requirement | None, model: ModelNow
    ) -> Iterator[str]:
        """Yield sentences on what has changed since.

        **Arguments:**

        - `name`: the name of the formula.
        - `formula`: its text now.
        - `about`: what it stands for now.
        - `model`: the model of the problem now.
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
                yield f"{name}: the run has changed since {self.name}, or is not among those named"
            elif self.result != "run" and not self.model and self.chain != model.chain:
                yield f"{name}: the model has changed since {self.name}"
            if not self.page.is_file():
                yield f"{name}: the report of {self.name} is not there"


def _said(entry: Mapping[str, str]) -> dict[str, str]:
    """Return what a requirement says, apart from its formula, which is compared by itself."""
    return {name: text for name, text in entry.items() if name != "formula"}


def model_now(problem: Problem, about: Sequence[Evidence]) -> ModelNow:
    """Return the model of a problem as it is now, for all evidence that is about it."""
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
    """Yield the claims of reports, and of folders of reports, that say what they are about.

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
