"""All applicable analyses of a run, each with a short text.

found = analyze(run)
print(found)
found["rules"]                      the result of one of them; None if it was skipped
found.plot("overview.png")
found.save("report")                report.md and a picture of each
"""

import html
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from verifai_jax.addons.analysis._coverage import coverage
from verifai_jax.addons.analysis._frequent_patterns import frequent_patterns
from verifai_jax.addons.analysis._importance import importance
from verifai_jax.addons.analysis._pca import pca
from verifai_jax.addons.analysis._rules import rules
from verifai_jax.addons.analysis.clustering.clusters import clusters
from verifai_jax.addons.analysis.data.samples import Samples
from verifai_jax.addons.analysis.data.verdicts import standing
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.messages.text import format_features, one_line, printable
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.falsification.no_rate import why_no_rate
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.table import ErrorTable

MIN_FAILURES = 4
MAX_TO_CLUSTER = 2000
MAX_NAMED = 6
TITLES = {
    "failures": "Failures",
    "rules": "Where it fails",
    "importance": "What it depends on",
    "clusters": "Kinds of failures",
    "pca": "Directions in which failures vary",
    "frequent_patterns": "Frequent patterns of failures",
    "coverage": "Coverage of the space",
}


@dataclass(frozen=True, eq=False)
class Part:
    """One analysis: `name`, text `words`, `result`; None if it was skipped."""

    name: str
    words: str
    result: Any = None

    @property
    def title(self) -> str:
        """Heading of the part in a report."""
        return TITLES[self.name]


@dataclass(frozen=True, eq=False)
class Analysis(Drawn):
    """All analyses of the error table of a run.

    **Fields:** `name` of the run; `parts` in the order of the report; `samples`: the rows with a
    verdict, None if there are none.
    """

    _picture = "verifai_jax.addons.analysis.pictures.overview", "plot_overview"
    """The failures over the two most important features, with the boxes of the rules, the
    representatives of clusters, and the importances as bars."""
    name: str
    parts: tuple[Part, ...]
    samples: Samples | None

    def __getitem__(self, name: str) -> Any:
        """Return the result of an analysis by name; None if it was skipped.

        **Raises:** `UnknownNameError` for a name that is not one of the parts'.
        """
        for part in self.parts:
            if part.name == name:
                return part.result
        raise unknown_name("analysis", name, [part.name for part in self.parts])

    @property
    def representatives(self) -> list[int]:
        """Row numbers of failures that each represent a cluster, the largest cluster first."""
        found = self["clusters"] if self.samples is not None else None
        if found is None:
            return []
        column = "representative_" if "representative_" in found.table else "representative"
        return [int(row) for row in found.table[column][found.table.index >= 0]]

    @property
    def table(self) -> pd.DataFrame:
        """One row for each feature: its importance, range over the failures, and cells covered."""
        return _features(self)

    def save(self, folder: str | Path) -> Path:
        """Write `report.md` and pictures to a folder; return the path of the report.

        **Raises:** `OSError` if the file system refuses, such as when a file has the folder's name.
        """
        path = Path(folder)
        lines = [f"# {html.escape(one_line(self.name))}", ""]
        if self.samples is not None:
            self.plot(path / "overview.png")
            lines += ["![overview](overview.png)", ""]
        for part in self.parts:
            # Names of features and values are text of others: nothing in it ends the block.
            words = printable(part.words)
            fence = "`" * max(3, 1 + max(map(len, re.findall("`+", words)), default=0))
            lines += [f"## {part.title}", "", f"{fence}text", words, fence, ""]
            if hasattr(part.result, "plot"):
                part.result.plot(path / f"{part.name}.png")
                lines += [f"![{part.title.lower()}]({part.name}.png)", ""]
        report = path / "report.md"
        with replacing(report) as partial:
            partial.write_text("\n".join(lines))
        return report

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        lines = [self.name]
        for part in self.parts:
            lines += ["", part.title, *(f"  {line}" for line in part.words.splitlines())]
        return printable("\n".join(lines))

    def _repr_html_(self) -> str:
        parts = [f"<h3>{html.escape(self.name)}</h3>"]
        for part in self.parts:
            words = html.escape(part.words).replace("\n", "<br>")
            parts.append(f"<h4>{html.escape(part.title)}</h4><p>{words}</p>")
            table = getattr(part.result, "table", None)
            if table is not None and len(table):
                parts.append(table.head(10).to_html(float_format=lambda x: f"{x:z.3g}"))
        return "\n".join(parts)


@shows_progress("analyzing")
def analyze(
    source: Run | ErrorTable | pd.DataFrame, *, seed: int = 0, progress: bool | None = None
) -> Analysis:
    """Apply every analysis that fits the error table, and say why others do not.

    **Arguments:**
    - `source`: a run, its table, or a DataFrame with feature columns.
    - `seed`: the seed of all random draws.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Returns:** an `Analysis`.

    The analyses are: failures, rules, importance of features, clusters, principal components,
    frequent patterns, coverage; nothing is simulated. If there are more than 2000 failures, 2000
    drawn by `seed` are clustered.

    **Raises:** `TypeError` for another source.
    """
    name = source.name if isinstance(source, Run) else "table"
    try:
        samples = Samples.of(source, "all")
    except ValueError as error:
        words = f"nothing to analyse: {error}"
        return Analysis(name, (Part("failures", words),), None)
    failures = int(samples.failing.sum())
    parts = [Part("failures", _describe_failures(source, samples))]
    for analysis, reason, found in (
        ("rules", _too_few(failures), lambda: rules(source, seed=seed)),
        ("importance", "", lambda: importance(source, seed=seed)),
        ("clusters", _too_few(failures), lambda: clusters(_thinned(samples, seed), seed=seed)),
        ("pca", _too_few(failures), lambda: pca(_failing(samples))),
        ("frequent_patterns", _no_choices(samples), lambda: frequent_patterns(_failing(samples))),
        ("coverage", "", lambda: coverage(source, seed=seed)),
    ):
        parts.append(_part(analysis, reason, found))
    return Analysis(name, tuple(parts), samples)


def _part(name: str, reason: str, analysis: Callable[[], Any]) -> Part:
    if reason:
        return Part(name, f"skipped: {reason}")
    try:
        result = analysis()
    except ValueError as error:
        # Every analysis says what it lacks; here that is a line of the report.
        return Part(name, f"skipped: {error}")
    return Part(name, str(result), result)


def _describe_failures(source: object, samples: Samples) -> str:
    rows, failures = len(samples.table), int(samples.failing.sum())
    _, doubtful, left = (int(part.sum()) for part in standing(samples.table)[0])
    lines = [f"{failures + doubtful:,} of {rows:,} simulations violate the property"]
    if doubtful:
        lines[0] += f"; {doubtful:,} of them are not claimed, as closer replays disagree"
    if left:
        lines[0] += f"; {left:,} are not claimed, as they were not replayed"
    if len(samples) + doubtful < rows:
        lines[0] += f"; {rows - len(samples) - doubtful:,} have no verdict"
    if isinstance(source, Run):
        rate = source.failure_rate
        lines.append(
            f"failure rate {rate} as simulated"
            if rate is not None
            else f"failure rate not given: {why_no_rate(source)}"
        )
    if np.isfinite(samples.rho).any():
        index = samples.worst
        row = samples.frame.iloc[index]
        where = format_features({name: row[name] for name in samples.names[:MAX_NAMED]})
        more = ", ..." if len(samples.names) > MAX_NAMED else ""
        lines.append(
            f"{'worst' if failures else 'nearest'}: row {samples.rows[index]}, "
            f"robustness {samples.rho[index]:z.4g} at {where}{more}"
        )
    return "\n".join(lines)


def _failing(samples: Samples) -> Samples:
    return samples.others("counterexamples")


def _thinned(samples: Samples, seed: int) -> Samples:
    from dataclasses import replace

    failing = _failing(samples)
    if len(failing) <= MAX_TO_CLUSTER:
        return failing
    generator = np.random.default_rng(seed)
    kept = np.sort(generator.choice(len(failing), MAX_TO_CLUSTER, replace=False))
    return replace(failing, frame=failing.frame.iloc[kept])


def _too_few(failures: int) -> str:
    if not failures:
        return "no row fails"
    if failures >= MIN_FAILURES:
        return ""
    return f"only {failures} rows fail" if failures > 1 else "only one row fails"


def _no_choices(samples: Samples) -> str:
    if not samples.unordered:
        return "no feature is a choice without an order"
    return "" if samples.failing.any() else "no row fails"


def _features(found: Analysis) -> pd.DataFrame:
    names = [] if found.samples is None else list(found.samples.names)
    table = pd.DataFrame(index=pd.Index(names, name="feature"))
    if (weighed := found["importance"] if names else None) is not None:
        for column in weighed.scores:
            table[column] = weighed.table[column]
        table = table.loc[weighed.ranked]
    if found.samples is not None and found.samples.failing.any():
        failing = found.samples.frame.loc[found.samples.failing]
        for column in found.samples.ordered:
            table.loc[column.name, "min_failing"] = failing[column.name].min()
            table.loc[column.name, "max_failing"] = failing[column.name].max()
    if names and (covered := found["coverage"]) is not None:
        table["occupied"] = covered.table["occupied"]
    return table
