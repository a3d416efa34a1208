"""The result of an augmentation: each arm against the others, over seeds.

result.compare("error", "none")         paired differences with intervals print(result)
what helps, in words
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from verifai_jax.addons.training.augmentation import examples as labelled
from verifai_jax.addons.training.augmentation.examples import Examples, Workshop
from verifai_jax.addons.training.augmentation.summary import BASE, TRAINED, summarize
from verifai_jax.addons.training.augmentation.task import SupervisedTask, Weights
from verifai_jax.addons.training.paired import PairedDifference, paired_difference
from verifai_jax.core.compute.precision import reproducible_settings
from verifai_jax.core.display.figure import Figure
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.errors import check_names, unknown_name
from verifai_jax.core.store.locks import write_lock
from verifai_jax.core.store.replacements import replacing_all

TABLE, ADDED, SUMMARY = "table.parquet", "added.parquet", "summary.txt"
"""Files of a result in a folder."""


@dataclass(frozen=True, eq=False)
class Augmentation(InNotebook):
    """The result of `augment`.

    - `task`: the name of the task.
    - `arms`: names of the arms, in the order given.
    - `table`: a row for each arm and seed, and for the base networks: `status` (`"trained"`, or
      `"not finite"` if predictions are not), `added` inputs, `wrong_added` (the share of them on
      which the base errs), `rendered` (inputs rendered to choose them), `error` (share of the
      uniform test that is wrong), `precision` and `recall` if the task has a presence,
      `hard_error`, the measures of the task, and `why` fewer inputs were added than requested.
    - `added`: features of all inputs that were added, with `arm`, `seed`, and the `wrongness` of
      the base network.
    - `error_tables`: the error table of each seed, if an arm needs one: features, `rho`,
      `violated`, `status`.
    - `weights`: the weights of each arm and seed, and of the base networks. A resumed study only
      has those stored in dictionaries, lists and tuples.
    - `options`: the numbers and the search of the call; `hard` is the size of the hard test.
    - `confidence`: the confidence of each single interval.
    - `complete`: False if it was interrupted.
    - `version`: the version of verifai_jax.
    """

    task: SupervisedTask
    arms: tuple[str, ...]
    table: pd.DataFrame
    added: pd.DataFrame
    error_tables: Mapping[int, pd.DataFrame]
    weights: Mapping[tuple[str, int], Weights]
    options: Mapping[str, Any]
    confidence: float
    complete: bool
    version: str

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the columns that measure a network."""
        columns = [str(name) for name in self.table.columns]
        return tuple(columns[columns.index("rendered") + 1 : columns.index("why")])

    def compare(
        self, metric: str = "error", reference: str = "none"
    ) -> dict[str, PairedDifference]:
        """Compare the arms with one of them, paired by seed.

        Intervals are Student's t intervals of paired differences, and each holds on its own: of
        twenty arms without any effect, one is expected to appear to have one. The base network,
        which was trained less, is not compared.

        **Arguments:**
        - `metric`: name of a column that measures a network.
        - `reference`: the arm that is subtracted, or `"base"`.
        **Returns:** the mean difference of each other arm, over the seeds in which both are finite;
        with only one such seed there is no interval.
        **Raises:** `UnknownNameError` for an arm or a metric that the table does not have.
        """
        check_names("metric", [metric], self.metrics)
        arms = [str(arm) for arm in self.table["arm"].unique()]
        check_names("arm", [reference], arms)
        values: Any = self.table.pivot(index="seed", columns="arm", values=metric).astype(float)
        return {
            arm: paired_difference(values[arm], values[reference], self.confidence)
            for arm in arms
            if arm not in (reference, BASE)
        }

    @property
    def means(self) -> pd.DataFrame:
        """Means over the seeds whose predictions are finite, a row for each arm."""
        groups: Any = self.table.loc[self.table["status"] == TRAINED].groupby("arm")
        rows = self.table["arm"].unique()
        found = groups[["added", "wrong_added", "rendered", *self.metrics]].mean().reindex(rows)
        return found.assign(seeds=groups.size().reindex(rows, fill_value=0))

    def summary(self) -> str:
        """Write which arms help and which do not; every number comes from the table."""
        return summarize(self)

    @reproducible_settings()
    def examples(self, arm: str, seed: int = 0) -> Examples:
        """Return the inputs that an arm added, rendered again.

        **Arguments:**
        - `arm`: name of the arm.
        - `seed`: number of the seed.
        **Raises:** `UnknownNameError` for an arm that is not in the table; `ValueError` for such a
        seed.
        """
        check_names("arm", [arm], self.arms)
        known = sorted({int(number) for number in self.table["seed"]})
        if seed not in known:
            raise unknown_name("seed", seed, map(str, known))
        added = self.added
        rows: Any = added.loc[(added["arm"] == arm) & (added["seed"] == seed)]
        examples = self._workshop.render(rows)
        if arm == "standard":
            key = labelled.choice_key(self.options["seed"], seed)
            return labelled.transformed(self.task, examples, key)
        return examples

    @cached_property
    def _workshop(self) -> Workshop:
        return Workshop(self.task)

    def plot(
        self, path: str | Path | None = None, metric: str = "error", reference: str = "none"
    ) -> Figure:
        """Draw a metric of each arm and its paired difference with intervals.

        **Arguments:**
        - `path`: file to which the picture is written, if given.
        - `metric`, `reference`: as in `compare`.
        **Returns:** the figure.
        **Raises:** the errors of `compare`.
        """
        draw = lazy_import("verifai_jax.addons.training.pictures.augmentation", "plot_arms")
        return draw(self, path, metric, reference)

    def montage(
        self, path: str | Path | None = None, arm: str = "counterexamples", seed: int = 0,
        count: int = 24,
    ) -> Figure:  # fmt: skip
        """Draw inputs that an arm added, for tasks whose inputs are images.

        **Arguments:**
        - `path`: file to which the picture is written, if given.
        - `arm`, `seed`: as in `examples`.
        - `count`: maximum number of images.
        **Returns:** the figure.
        **Raises:** the errors of `examples`; `ValueError` for inputs that are not images, or an arm
        that added nothing.
        """
        draw = lazy_import("verifai_jax.addons.training.pictures.augmentation", "plot_montage")
        return draw(self, path, arm, seed, count)

    def save(self, folder: str | Path) -> Path:
        """Write table, added inputs and summary to a folder.

        **Raises:** `FolderInUse` if another process writes there; `OSError` if the file system
        refuses, in which case the old content stays.
        """
        path = Path(folder)
        with write_lock(path), replacing_all(path, (ADDED, SUMMARY, TABLE)) as made:
            self.table.to_parquet(made / TABLE)
            mixed = [n for n in self.added.columns if self.added[n].dtype == object]
            self.added.astype(dict.fromkeys(mixed, str)).to_parquet(made / ADDED)
            (made / SUMMARY).write_text(f"{self.summary()}\n", encoding="utf-8")
        return path

    __str__ = __repr__ = summary
