"""Reports as files: one HTML file, and its claims as JSON next to it.

write_report(run, "balance.html")               # balance.html and balance.claims.json
write_report(sweep, "sweep.html")               # a sweep, an estimate, a comparison
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from verifai_jax.addons.reports.assessment import with_assessment
from verifai_jax.addons.reports.claims import PAGE, sealed
from verifai_jax.addons.reports.page import Page, render
from verifai_jax.addons.reports.run_question import About
from verifai_jax.addons.reports.run_report import run_page
from verifai_jax.addons.reports.sections import with_files
from verifai_jax.core.display.figure import Reported
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.user_code.sources import Source, file_hash, hashed_files
from verifai_jax.falsification.run import Run
from verifai_jax.problem.problem import Problem


@runtime_checkable
class AddedSection(Protocol):
    """A section of a report: an error budget, a covered design domain, one of yours."""

    def on_page(self, page: Page) -> Page:
        """Return the page with the section."""
        ...


@runtime_checkable
class DesignDomain(Protocol):
    """An operational design domain, as `vj.read_odd` reads it."""

    @property
    def units(self) -> Mapping[str, str]:
        """The units of its attributes."""
        ...

    @property
    def reasons(self) -> Mapping[str, str]:
        """The reasons for the ranges of its attributes."""
        ...

    @property
    def files(self) -> Sequence[Source]:
        """The files that it was read from, with their hashes."""
        ...

    def coverage(self, source: Any) -> AddedSection:
        """Return the part of the domain that a run covers."""
        ...


@shows_progress("writing the report on")
def write_report(
    result: Any,
    path: str | Path,
    *,
    units: Mapping[str, str] | None = None,
    reasons: Mapping[str, str] | None = None,
    traces: int | None = None,
    studies: bool | None = None,
    modes: int | None = None,
    problem: Problem | None = None,
    errors: AddedSection | None = None,
    odd: DesignDomain | None = None,
    assessment: bool = False,
    files: Sequence[str | Path] = (),
    sections: Sequence[AddedSection] = (),
    progress: bool | None = None,
) -> Path:
    """Write the evidence report on a result as one HTML file, and its claims as JSON next to it.

    **Arguments:**
    - `result`: a run, a sweep, an estimate, a verification, a comparison, a transfer, a failure
      table or a judgement. The failures of a run with its problem are simulated again.
    - `path`: the path of the HTML file; the claims go to the same name with the ending
      `.claims.json`.
    - `units`: the units of features, by name.
    - `reasons`: the reasons for the ranges of features, by name.
    - `traces`: maximum number of rows of a run that are simulated for the report; 24 by default, 5
      for a slow black box.
    - `studies`: whether to explain and shrink the worst failure of a run; by default unless the
      system is a slow black box.
    - `modes`: number of simulations for the modes of failure of a run and their probabilities, as
      in `vj.modes`; none when left out.
    - `problem`: the problem of an estimate, of a verification, or of a failure table without a
      failure, or the baseline of a comparison; the report shows its property and prior.
    - `errors`: a result of `vj.error_budget`, for a section and a claim on the error of the number.
    - `odd`: the operational design domain, from `vj.read_odd`; adds a section on the part of it
      that a run covers. Features without their own units and reasons take those of the domain.
    - `assessment`: whether to add sections for an assessor: the claims as a tree, the nine steps of
      credibility with boxes to fill in, and a page to sign.
    - `files`: further files that the report rests on; it lists them with their hashes, as it does
      those of `odd`.
    - `sections`: further sections, such as those of other packages: objects with
      `on_page(page) -> page`.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Raises:** `UnknownNameError` for a unit or a reason of a feature that does not exist;
    `ValueError` for an invalid number of simulations, and for a run whose rows have changed since
    they were written; `TypeError` for an object that is not a result.
    """
    path = Path(path)
    own = ({}, {}) if odd is None else (odd.units, odd.reasons)
    about = About({**own[0], **(units or {})}, {**own[1], **(reasons or {})})
    if modes is not None:
        check_count("modes", modes)
    if isinstance(result, Run):
        if result.table.changed:
            raise ValueError(
                f"no report can be written on the run of {result.name!r}, because its rows "
                f"are the evidence: {result.damage}"
            )
        about.check(result.problem.space if result.problem else None, result.table.features)
        apart = errors is not None or odd is not None
        words = None if apart else " --assessment" * assessment
        page = run_page(result, about, traces, studies, modes, words)
    elif isinstance(result, Reported):
        page = lazy_import(*result._report)(result, about, problem)
    else:
        raise TypeError(
            "a report is on a run, a sweep, an estimate, a verification, a comparison, a "
            "transfer, a failure table, a judgement or another result with a report; got "
            f"{type(result).__name__}"
        )
    if errors is not None:
        page = errors.on_page(page)
    if odd is not None:
        if not isinstance(result, Run):
            raise TypeError(f"odd= is for a report on a run; got {type(result).__name__}")
        page = odd.coverage(result).on_page(page)
    read = [*hashed_files(map(Path, files), "the result"), *(() if odd is None else odd.files)]
    if read:
        page = with_files(page, read)
    for section in sections:
        page = section.on_page(page)
    if assessment:
        page = with_assessment(page)
    with replacing(path) as made, replacing(claims_path(path)) as claimed:
        made.write_text(render(page), encoding="utf-8", newline="\n")
        claims = sealed({**page.claims, PAGE: file_hash(made)})
        text = json.dumps(claims, indent=2, allow_nan=False)
        claimed.write_text(text + "\n", encoding="utf-8", newline="\n")
    return path


def claims_path(path: Path) -> Path:
    """Return the path of the claims of a report."""
    return path.with_suffix(".claims.json")
