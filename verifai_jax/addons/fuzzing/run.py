"""The result of fuzzing: a run, what it covered, and the simulations that extended coverage."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.addons.fuzzing.coverage import FuzzCoverage
from verifai_jax.addons.fuzzing.implicit import as_recorded as as_recorded
from verifai_jax.core.messages.text import printable
from verifai_jax.falsification.coverage_counts import SEEN
from verifai_jax.falsification.run import Run

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class FuzzRun(Run):
    """A run of `fuzz`: a `Run` with its coverage.

    Traces are not stored, since `run.replay(row).trace` recomputes them exactly.
    """

    @cached_property
    def coverage(self) -> FuzzCoverage:
        """The coverage: what the run covered, and how much there is to cover.

        **Raises:** `ValueError` for a run without its problem or its counts.
        """
        if self.problem is None or not self.checkpoint or not self._is_counted:
            raise ValueError(
                f"the run of {self.name!r} has no coverage: its problem or checkpoint is missing"
            )
        return FuzzCoverage.of(self.problem, np.asarray(self.checkpoint[SEEN]))

    @property
    def corpus(self) -> "pd.DataFrame":
        """The rows that extended the coverage: each covered something that no earlier row did."""
        table = self.table.all
        # A run that was interrupted before its first batch has no row, nor this column.
        return table.loc[table["new_coverage"] > 0] if len(table) else table

    @property
    def failures(self) -> "pd.DataFrame":
        """The rows that break a property, including implicit ones, or did not end properly."""
        table = self.table.all
        return table.loc[table["violated"] | (table["status"] != "ok")]

    def _more_findings(self) -> dict[str, Any]:
        parts = [
            {"of": part.where, "kind": part.what, "covered": part.covered, "total": part.total}
            for part in (self.coverage.parts if self._is_counted else ())
        ]
        return {"coverage": parts}

    @property
    def _is_counted(self) -> bool:
        return self.problem is not None and SEEN in (self.checkpoint or ())

    def summary(self) -> str:
        """Write the summary of the run and of its coverage; every number comes from its data."""
        lines = [super().summary()]
        if self._is_counted:
            covered = [f"{part.where}: {part}" for part in self.coverage.parts]
            lines += [f"  {'covered' if not i else '':<13}{text}" for i, text in enumerate(covered)]
            corpus = self.corpus
            last = f", the last of them row {corpus.index[-1]}" if len(corpus) else ""
            lines.append(f"  corpus       {len(corpus)} simulations extended coverage{last}")
        return printable("\n".join(lines))

    def __repr__(self) -> str:
        return self.summary()


def as_made(run: Run) -> FuzzRun:
    """Return a run of `fuzz` as a `FuzzRun`, with its coverage and its corpus."""
    if isinstance(run, FuzzRun):
        return run
    return FuzzRun(**{field.name: getattr(run, field.name) for field in fields(run)})
