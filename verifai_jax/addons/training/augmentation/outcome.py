"""The numbers of an augmentation: means over seeds, and paired differences of arms."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from verifai_jax.addons.training.paired import PairedDifference, paired_difference

BASE = "base"
"""Name of the base network among the arms of a table."""
TRAINED, NOT_FINITE = "trained", "not finite"
"""Status of a network."""
SHARES = ("error", "precision", "recall", "hard_error")
"""Metrics that are shares of a test."""


class Outcome(NamedTuple):
    """The numbers for a summary.

    The fields are those of `Augmentation`; `name` is the name of the task.
    """

    name: str
    arms: tuple[str, ...]
    table: pd.DataFrame
    error_tables: Mapping[int, pd.DataFrame]
    options: Mapping[str, Any]
    confidence: float
    complete: bool

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the base and the arms, in the order of the table."""
        return tuple(map(str, self.table["arm"].unique()))

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the columns that measure a network."""
        columns = [str(name) for name in self.table.columns]
        return tuple(columns[columns.index("rendered") + 1 : columns.index("why")])

    @property
    def means(self) -> pd.DataFrame:
        """Means over the seeds whose predictions are finite, a row for each arm."""
        finite = self.table.loc[self.table["status"] == TRAINED]
        columns = ["added", "wrong_added", "rendered", *self.metrics]
        groups: Any = finite.groupby("arm")
        found = groups[columns].mean().reindex([*self.rows])
        return found.assign(seeds=groups.size().reindex([*self.rows], fill_value=0))

    def values(self, arm: str, metric: str) -> np.ndarray:
        """Return a metric of an arm for each seed; NaN if unknown."""
        table: Any = self.table.pivot(index="seed", columns="arm", values=metric)
        return table[arm].to_numpy(np.float64)

    def compare(self, metric: str, reference: str) -> dict[str, PairedDifference]:
        """Compare all arms with one of them, paired by seed.

        **Arguments:**
        - `metric`: the column to compare.
        - `reference`: the arm that is subtracted.
        **Returns:** the mean difference of each other arm, over the seeds in which both are finite.
        """
        other = self.values(reference, metric)
        return {
            arm: paired_difference(self.values(arm, metric), other, self.confidence)
            for arm in self.rows
            if arm not in (reference, BASE)
        }
