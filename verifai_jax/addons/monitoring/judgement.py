"""The verdicts of many requirements on many recordings, and statistics over the fleet."""

import functools
import math
from collections.abc import Iterable, Sequence, Sized
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from verifai_jax.core.display.figure import Reported
from verifai_jax.core.display.notebook import InNotebook, frame_html
from verifai_jax.core.messages.text import counted, listed, printable, shorten
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.user_code.sources import Source
from verifai_jax.mtl.requirements import Requirement

if TYPE_CHECKING:
    import pandas as pd
SHARES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
SHOWN = 10
"""Rows of each kind that the summary lists."""
MIN_RECORDINGS = 5
"""Recordings that outliers are sought among, at least."""


class Row(NamedTuple):
    """One requirement on one recording.

    - `verdict`: `"holds"`, `"fails"`, `"depends"` on values within error bars, or empty without a
      verdict.
    - `instant`: time of the deciding sample in seconds; NaN if there is none.
    - `explanation`: the predicate that decides at that time, with its margin.
    - `error`: the reason why there is no verdict.
    - `note`: what to know of the recording and the verdict: a hole, or what the requirement says
      otherwise than it seems to, of a recording this long.
    - `unit`: unit of the robustness as recorded, or else that of the requirement.
    - `highest`: the greatest robustness of values within the error bars, of which `robustness` is
      the least; without error bars they are equal.
    """

    file: str
    requirement: str
    verdict: str = ""
    robustness: float = math.nan
    instant: float = math.nan
    explanation: str = ""
    error: str = ""
    note: str = ""
    unit: str = ""
    highest: float = math.nan


@dataclass(frozen=True)
class Judgement(Reported, InNotebook):
    """The verdicts of requirements on recordings; `str()` writes the summary.

    **Fields:** `requirements`; `rows`, one for each recording and requirement; `inputs`, the files
    of recordings and requirements with their hashes as they were read.
    """

    _report = "verifai_jax.addons.monitoring.judgement_report", "judgement_page"

    requirements: tuple[Requirement, ...]
    rows: tuple[Row, ...] = field(repr=False)
    inputs: tuple[Source, ...] = field(default=(), repr=False)

    @functools.cached_property
    def table(self) -> "pd.DataFrame":
        """A row for each recording and requirement; its columns are the fields of `Row`."""
        import pandas as pd

        return pd.DataFrame(list(self.rows), columns=list(Row._fields))

    @property
    def files(self) -> tuple[str, ...]:
        """The names of the recordings."""
        return tuple(dict.fromkeys(row.file for row in self.rows))

    @property
    def failing(self) -> tuple[Row, ...]:
        """The rows whose requirement fails, by increasing robustness."""
        rows = [row for row in self.rows if row.verdict == "fails"]
        return tuple(sorted(rows, key=lambda row: row.robustness))

    @property
    def depending(self) -> tuple[Row, ...]:
        """The rows whose verdict depends on values within error bars."""
        return tuple(row for row in self.rows if row.verdict == "depends")

    @property
    def without_verdict(self) -> tuple[Row, ...]:
        """The rows without a verdict."""
        return tuple(row for row in self.rows if not row.verdict)

    @property
    def all_hold(self) -> bool:
        """True if every requirement has a verdict on every recording and holds."""
        return all(row.verdict == "holds" for row in self.rows)

    def of(self, requirement: str) -> list[Row]:
        """Return the rows of a requirement that have a verdict."""
        return [row for row in self.rows if row.requirement == requirement and row.verdict]

    def unit_of(self, requirement: Requirement) -> str:
        """Return the unit of a requirement's robustness; empty if recordings have several."""
        units = {row.unit for row in self.of(requirement.id)} or {requirement.unit}
        return units.pop() if len(units) == 1 else ""

    @property
    def tightest(self) -> Row | None:
        """The row nearest to the limit of its requirement, or farthest beyond it.

        Requirements have different units, so each robustness is divided by the median absolute
        robustness of its requirement over the fleet. None if no robustness is finite.
        """
        best, lowest = None, math.inf
        for each in self.requirements:
            rows = [row for row in self.of(each.id) if math.isfinite(row.robustness)]
            if not rows:
                continue
            usual = float(np.median([abs(row.robustness) for row in rows])) or 1.0
            row = min(rows, key=lambda row: row.robustness)
            if row.robustness / usual < lowest:
                best, lowest = row, row.robustness / usual
        return best

    def quantiles(self, shares: Sequence[float] = SHARES) -> "pd.DataFrame":
        """Return quantiles of the robustness of each requirement over the recordings.

        **Arguments:**
        - `shares`: quantile levels, from 0 (the minimum) to 1 (the maximum).
        **Returns:** a row for each requirement: how many recordings have a verdict, how many fail,
        how many have none, and a column for each level with the robustness of the recording at that
        rank.
        """
        import pandas as pd

        table: dict[str, dict[str, Any]] = {}
        for each in self.requirements:
            rows = self.of(each.id)
            values = np.array([row.robustness for row in rows])
            none = sum(row.requirement == each.id for row in self.without_verdict)
            fails = sum(row.verdict == "fails" for row in rows)
            table[each.id] = {"verdicts": len(rows), "failing": fails, "without verdict": none}
            for share in shares:
                # No interpolation: the values of two recordings may be infinite.
                found = np.quantile(values, share, method="inverted_cdf") if rows else math.nan
                table[each.id][f"{share:z.3g}"] = float(found)
        return pd.DataFrame.from_dict(table, orient="index").rename_axis("requirement")

    def outliers(self, distance: float = 3.5) -> "pd.DataFrame":
        """Return the rows whose robustness differs much from that of the other recordings.

        The distance is the difference from the median of the requirement over the fleet, divided by
        the median absolute deviation times 1.4826, which is one standard deviation for normal
        values. At least five recordings are needed.

        **Arguments:**
        - `distance`: minimum distance of an outlier.
        **Returns:** rows of the table with their `distance`, in decreasing order.

        Source: B. Iglewicz, D. Hoaglin, "How to Detect and Handle Outliers", ASQC 1993.
        """
        import pandas as pd

        found = []
        for each in self.requirements:
            rows = [row for row in self.of(each.id) if math.isfinite(row.robustness)]
            if len(rows) < MIN_RECORDINGS:
                continue
            values = np.array([row.robustness for row in rows])
            away = values - np.median(values)
            spread = 1.4826 * float(np.median(np.abs(away)))
            # Where most are alike, whatever differs is unlike them.
            far = np.where(away == 0, 0.0, np.abs(away) / (spread or 1e-300))
            found += [(*row, d) for row, d in zip(rows, far, strict=True) if d > distance]
        table = pd.DataFrame(found, columns=[*Row._fields, "distance"])
        return table.sort_values("distance", ascending=False, ignore_index=True)

    def summary(self) -> str:
        """Return the summary as text: failures, missing verdicts, and the margins of the others."""
        failing, missing = self.failing, self.without_verdict
        asked = counted(len(self.requirements), "requirement")
        asked += f" on {counted(len(self.files), 'recording')}"
        lines = [f"{asked}: {len(failing)} of {len(self.rows) - len(missing)} verdicts fail"]
        open_ones = self.depending
        lines[0] += f", {len(open_ones)} depend on values within error bars" if open_ones else ""
        lines[0] += f", and {len(missing)} could not be given" if missing else ""
        width = max(len(each.id) for each in self.requirements)
        lines += ["", f"  {'':{width}}  {'failing':<12}{'least':>10}{'median':>12}"]
        spread = self.quantiles((0.0, 0.5))
        for each in self.requirements:
            row = spread.loc[each.id]
            share = f"{int(row['failing'])} of {int(row['verdicts'])}"
            numbers = "".join(f"{row[q]:>z12.4g}" for q in ("0", "0.5") if row["verdicts"])
            unit = self.unit_of(each)
            lines.append(f"  {each.id:{width}}  {share:<10}{numbers} {unit}".rstrip())
        lines += _listed("Failing, the worst first:", failing)
        lines += _listed("Depending on values within error bars:", open_ones)
        lines += _listed("Without a verdict:", _together(missing))
        if (tightest := self.tightest) is not None and not failing + open_ones:
            lines += ["", f"Tightest: {tightest.requirement} on {tightest.file}"]
            lines += [f"  {tightest.explanation}"] if tightest.explanation else []
        return "\n".join([*lines, *_noted(self.rows)])

    __str__ = summary

    def _notebook_parts(self) -> Iterable[str]:
        yield frame_html(self.quantiles())

    def junit(self, path: str | Path) -> Path:
        """Write the verdicts as JUnit XML: a suite for each requirement, a case for each recording.

        A requirement that fails is a failure; one without a verdict is an error.

        **Returns:** the path.
        """
        path = Path(path)
        root = ElementTree.Element("testsuites", name="requirements")
        for each in self.requirements:
            rows = [row for row in self.rows if row.requirement == each.id]
            fails = sum(row.verdict == "fails" for row in rows)
            errors = sum(row.verdict in ("", "depends") for row in rows)
            numbers = {"tests": len(rows), "failures": fails, "errors": errors}
            about = {"name": printable(each.id)} | {n: str(k) for n, k in numbers.items()}
            suite = ElementTree.SubElement(root, "testsuite", about)
            for row in rows:
                _case(suite, each, row)
        with replacing(path) as partial:
            ElementTree.ElementTree(root).write(partial, encoding="utf-8", xml_declaration=True)
        return path


def _case(suite: ElementTree.Element, requirement: Requirement, row: Row) -> None:
    names = {"name": printable(row.file), "classname": printable(requirement.id)}
    case = ElementTree.SubElement(suite, "testcase", names)
    if row.verdict == "holds":
        return
    said = printable(row.error or f"robustness {row.robustness:z.6g}; {row.explanation}")
    kind = "failure" if row.verdict == "fails" else "error"
    fault = ElementTree.SubElement(case, kind, message=said)
    about = (requirement.text, str(requirement.formula), requirement.source)
    fault.text = printable("\n".join(line for line in about if line))


def _listed(title: str, rows: Sequence[Row]) -> list[str]:
    lines = ["", title] if rows else []
    for row in rows[:SHOWN]:
        lines.append(f"  {row.requirement} on {row.file}")
        lines.append(f"    {shorten(row.explanation or row.error, 160)}".rstrip())
    return [*lines, *_more(rows)]


def _noted(rows: Sequence[Row]) -> list[str]:
    """Return each note once, with the requirements and the recordings that it is about."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        if row.note:
            found.setdefault(row.note, []).append(row)
    lines = []
    for note, own in list(found.items())[:SHOWN]:
        asked = listed(list(dict.fromkeys(row.requirement for row in own)))
        files = list(dict.fromkeys(row.file for row in own))
        where = files[0] if len(files) == 1 else counted(len(files), "recording")
        lines += ["", f"Note on {asked}, as on {where}:", f"  {note}"]
    return [*lines, *_more(found)]


def _more(rows: Sized) -> list[str]:
    left = len(rows) - SHOWN
    return [f"  and {left} more in the table"] if left > 0 else []


def _together(rows: Sequence[Row]) -> list[Row]:
    """Return rows of a recording with one error as one row, which names the requirements."""
    found: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        found.setdefault((row.file, row.error), []).append(row.requirement)
    return [Row(file, ", ".join(names), error=error) for (file, error), names in found.items()]
