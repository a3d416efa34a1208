"""Findings on formulas that are suspicious, as sentences and as a table."""

import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from verifai_jax.core.display.notebook import InNotebook, frame_html
from verifai_jax.core.messages.text import counted, listed
from verifai_jax.mtl.requirements import Requirement

if TYPE_CHECKING:
    import pandas as pd


class Finding(NamedTuple):
    """Something suspicious about a formula.

    - `requirement`: the identifier of the requirement.
    - `kind`: `"signal"`, `"window"`, `"vacuous"`, `"never near"`, `"never holds"`, `"until"`,
      `"units"`, `"no effect"`, `"always true"`, `"always false"`, or `"no verdict"`; of a set
      `"contradiction"`, `"duplicate"` or `"implied"`.
    - `part`: the suspicious part of the formula.
    - `sentence`: the finding as a sentence.
    - `advice`: the probable intention.
    """

    requirement: str
    kind: str
    part: str
    sentence: str
    advice: str = ""


@dataclass(frozen=True)
class Findings(InNotebook):
    """Findings on formulas; `str()` writes them, and `bool()` is False if there are none.

    - `recordings`: number of recordings that were used.
    - `unread`: signals of the recordings that no formula uses.
    - `not_searched`: pairs of formulas that were compared by proof alone, as there are many.
    """

    requirements: tuple[Requirement, ...] = field(repr=False)
    findings: tuple[Finding, ...]
    recordings: int
    unread: tuple[str, ...] = ()
    not_searched: int = 0

    def __bool__(self) -> bool:
        return bool(self.findings)

    def __iter__(self) -> Iterator[Finding]:
        return iter(self.findings)

    def __len__(self) -> int:
        return len(self.findings)

    @functools.cached_property
    def table(self) -> "pd.DataFrame":
        """A row for each finding; its columns are the fields of `Finding`."""
        import pandas as pd

        return pd.DataFrame(list(self.findings), columns=list(Finding._fields))

    def summary(self) -> str:
        """Write each finding as a sentence, grouped by formula."""
        asked = counted(len(self.requirements), "formula")
        lines = [f"{counted(len(self.findings), 'finding')} on {asked}, with "]
        lines[0] += counted(self.recordings, "recording")
        for each in self.requirements:
            own = [finding for finding in self.findings if finding.requirement == each.id]
            lines += ["", f"{each.id}  {each.formula}"] if own else []
            for finding in own:
                lines.append(f"  {finding.kind}: {finding.sentence}")
                lines += [f"    {finding.advice}"] if finding.advice else []
        if self.unread:
            lines += ["", f"No formula reads {listed(self.unread)}."]
        if self.not_searched:
            pairs = counted(self.not_searched, "pair")
            lines += ["", f"{pairs} of formulas {'was' if self.not_searched == 1 else 'were'} "
                          "compared by proof alone."]  # fmt: skip
        return "\n".join(lines)

    __str__ = summary

    def _notebook_parts(self) -> Iterable[str]:
        if self.findings:
            yield frame_html(self.table)
