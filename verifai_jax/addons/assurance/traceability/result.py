"""The matrix of requirements and their evidence, with missing and suspect links.

matrix = vj.trace_matrix("specs/brake.py", tests=["tests"], runs=["runs"])
matrix.complete; matrix.missing; matrix.suspect
matrix.table; matrix.to_csv("trace.csv"); matrix.report("trace.html")
"""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from verifai_jax.addons.reports.markup import Child, element, paragraph, table
from verifai_jax.addons.reports.page import Page, Section, write_page
from verifai_jax.addons.reports.provenance import chained
from verifai_jax.addons.reports.sections import chain_table
from verifai_jax.core.display.notebook import Tabular
from verifai_jax.core.messages.text import counted, listed, shorten
from verifai_jax.core.user_code.sources import Source

if TYPE_CHECKING:
    import pandas as pd
SHOWN = 3
"""Results of a row that the summary lists."""
LINKS = ("tests", "runs", "claims", "reports")
"""Links of the chain after the problem, each with a column of its own."""
VIOLATED, ERROR, SKIPPED, NOT_RUN, MET = "violated", "error", "skipped", "not run", "met"
OUTCOMES = (VIOLATED, ERROR, SKIPPED, NOT_RUN, MET)
"""What a test or a run may have found, the worst first."""


class Result(NamedTuple):
    """A finding of a test or a run (`link`), with its `name` or folder, on a requirement.

    - `outcome`: one of `OUTCOMES`; `"error"` if simulations, or the test, came to no verdict.
    - `text`: a sentence on the outcome.
    """

    link: str
    name: str
    outcome: str
    text: str


class Gap(NamedTuple):
    """A link that is missing, or not reliable any more.

    - `kind`: `"missing"` or `"suspect"`.
    - `link`: the kind of the link, such as `"tests"`.
    - `subject`: identifier of the requirement, or the name of an object without one.
    - `text`: a sentence that describes the gap.
    """

    kind: Literal["missing", "suspect"]
    link: str
    subject: str
    text: str


class TraceRow(NamedTuple):
    """A requirement with one problem that has its formula.

    - `requirement`, `text`: its identifier and its sentence; empty for a formula without one.
    - `formula`, `problem`: their names; empty if not written yet.
    - `tests`, `runs`, `claims`, `reports`: names of functions, folders and files.
    - `results`: what its tests and runs found.
    """

    requirement: str
    text: str
    formula: str
    problem: str
    tests: tuple[str, ...] = ()
    runs: tuple[str, ...] = ()
    claims: tuple[str, ...] = ()
    reports: tuple[str, ...] = ()
    results: tuple[Result, ...] = ()

    @property
    def outcome(self) -> str:
        """The worst outcome of its tests and runs; not run without any."""
        found = {each.outcome for each in self.results} or {NOT_RUN}
        return next(each for each in OUTCOMES if each in found)


@dataclass(frozen=True)
class TraceMatrix(Tabular):
    """The chain requirement, formula, problem, tests, runs, claims, report.

    **Fields:** `rows`, one for each requirement and problem; `gaps`; `asked`, the requested kinds
    of links, from `LINKS`; `inputs`, the files of evidence with their hashes. `str()` writes the
    summary.
    """

    rows: tuple[TraceRow, ...]
    gaps: tuple[Gap, ...]
    asked: tuple[str, ...] = field(default=LINKS)
    inputs: tuple[Source, ...] = field(default=(), repr=False)

    @property
    def missing(self) -> tuple[Gap, ...]:
        """The missing links."""
        return tuple(gap for gap in self.gaps if gap.kind == "missing")

    @property
    def suspect(self) -> tuple[Gap, ...]:
        """The links whose ends do not agree any more."""
        return tuple(gap for gap in self.gaps if gap.kind == "suspect")

    @property
    def complete(self) -> bool:
        """True if no link is missing and none is suspect."""
        return not self.gaps

    @property
    def unmet(self) -> tuple[TraceRow, ...]:
        """The rows that some test or run did not find to be met, or that none did."""
        return tuple(row for row in self.rows if row.outcome != MET)

    @property
    def table(self) -> "pd.DataFrame":
        """A row for each requirement and problem, as texts, with its outcome, results and gaps."""
        import pandas as pd

        return pd.DataFrame(self._cells(), columns=self._heads())

    def _heads(self) -> list[str]:
        said = ("outcome", "results", "gaps")
        return ["requirement", "text", "formula", "problem", *self.asked, *said]

    def _cells(self) -> list[list[str]]:
        rows = []
        for row in self.rows:
            links = [", ".join(getattr(row, name)) for name in self.asked]
            subject = row.requirement or row.problem
            gaps = dict.fromkeys(f"{g.kind}: {g.link}" for g in self.gaps if g.subject == subject)
            results = "; ".join(f"{each.name}: {each.outcome}, {each.text}" for each in row.results)
            rows.append([*row[:4], *links, row.outcome, results, "; ".join(gaps)])
        return rows

    def summary(self) -> str:
        """Return the matrix as text: what each requirement has, and every gap in a sentence."""
        known = {row.requirement for row in self.rows if row.requirement}
        lines = [f"{counted(len(known), 'requirement')}: {self._verdict()}", ""]
        width = max((len(row.requirement or "(none)") for row in self.rows), default=0)
        for row in self.rows:
            counts = [counted(len(getattr(row, n)), n.removesuffix("s")) for n in self.asked]
            has = f"{row.problem}: {', '.join(counts)}" if row.problem else "no formula"
            name, text = row.requirement or "(none)", shorten(row.text, 50)
            lines.append(f"  {name:{width}}  {text}".rstrip())
            lines.append(f"  {'':{width}}  {has}")
            worst = [each for each in row.results if each.outcome == row.outcome][:SHOWN]
            said = "; ".join(f"{each.name}: {each.text}" for each in worst)
            lines.append(f"  {'':{width}}  {row.outcome}{': ' if said else ''}{said}")
        for kind, gaps in (("Missing", self.missing), ("Suspect", self.suspect)):
            lines += ["", f"{kind}:", *(f"  {gap.text}" for gap in gaps)] if gaps else []
        return "\n".join(lines)

    def _verdict(self) -> str:
        found = Counter(row.outcome for row in self.rows)
        outcomes = listed([f"{found[each]:,} {each}" for each in OUTCOMES if found[each]])
        counts = [(len(self.missing), "missing"), (len(self.suspect), "suspect")]
        verbs = {True: "is", False: "are"}
        links = [f"{counted(n, 'link')} {verbs[n == 1]} {word}" for n, word in counts if n]
        about = listed(links) or "every link is there, and fits"
        return f"{about}; {outcomes or 'nothing was asked'}"

    def __str__(self) -> str:
        return self.summary()

    def report(self, path: str | Path) -> Path:
        """Write the matrix as one HTML file; return its path."""
        cells: list[list[Child]] = []
        for requirement, text, formula, problem, *others in self._cells():
            code = element("code", formula) if formula else ""
            cells.append([requirement or f"(none: {problem})", text, code, problem, *others])
        gaps: list[list[Child]] = [[gap.subject, gap.kind, gap.link, gap.text] for gap in self.gaps]
        found = paragraph("Every link is there, and what it joins has not changed since.")
        if gaps:
            found = table(["subject", "kind", "link", "what it is"], gaps)
        links = tuple(chained(self.inputs))
        sound = self.complete and not self.unmet
        broken = any(row.outcome == VIOLATED for row in self.rows)
        page = Page(
            title="From requirement to report",
            headline=f"{self._verdict()[:1].upper()}{self._verdict()[1:]}.",
            tone="fails" if broken else "holds" if sound else "open",
            sections=(
                Section("matrix", "The chain of each requirement", (table(self._heads(), cells),)),
                Section("gaps", "Links that are missing or suspect", (found,)),
                Section("inputs", "Files of evidence", (chain_table(links),)),
            ),
            claims={"inputs_sha256_chain": links[-1].chain if links else ""},
        )
        write_page(page, path)
        return Path(path)
