"""The result of a sweep: the certified safety of every policy that was trained.

sweep.table, sweep.safe, sweep.best  # rows are policies sweep.policy(12).act(observation)
vj.falsify(sweep.problem(12))        # the closed loop with that policy
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.addons.training.sweeps import storage
from verifai_jax.addons.training.sweeps.curves import check_curve, curve_robustness, curve_trace
from verifai_jax.addons.training.sweeps.exported import TrainedConfiguration, weights_of
from verifai_jax.addons.training.sweeps.importance import (
    HyperparameterImportance,
    hyperparameter_importance,
)
from verifai_jax.addons.training.sweeps.optuna_export import export_to_optuna, state_of
from verifai_jax.addons.training.sweeps.ranking import (
    group_by_configuration,
    is_safe,
    on_pareto_front,
    preference_order,
)
from verifai_jax.addons.training.sweeps.record import SweepRecord, TrainedPolicy, algorithm_uses
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.summary import format_headline, format_html, format_summary
from verifai_jax.addons.training.sweeps.trainer import ALGORITHM, STEPS
from verifai_jax.core.compute.devices import describe_processor
from verifai_jax.core.display.figure import Figure, Reported
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.messages.errors import check_names, suggests_options
from verifai_jax.core.user_code.sources import Change, list_changes
from verifai_jax.core.user_code.targets import load_target
from verifai_jax.core.values.trace import Trace
from verifai_jax.falsification._falsify import falsify
from verifai_jax.falsification.model_changes import changed_since, model_changes
from verifai_jax.features import FeatureSpace
from verifai_jax.features.domain import as_scalar
from verifai_jax.mtl import Formula
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search

if TYPE_CHECKING:
    import optuna
    import pandas as pd
    from optuna.storages import BaseStorage

PICTURES = {
    "overview": ("sweep", "plot_sweep"), "parallel": ("configurations", "plot_parallel"),
    "slices": ("configurations", "plot_slices"),
}  # fmt: skip
"""Modules and functions of the kinds of picture."""
CERTIFICATE = (
    "verdict", "failures", "simulations", "failure_low", "failure_high", "nominal_return"
)  # fmt: skip
"""Columns that an exported configuration has."""


@dataclass(frozen=True, eq=False)
class Sweep(Reported):
    """The policies of a sweep with their returns and certificates, as `sweep` returns them.

    **Fields:**
    - `record`: all that was trained and certified, as plain data.
    - `study`: the study; None for a sweep that was loaded without it.
    - `space`: the space of the hyper-parameters; by default the study's, None if unknown.
    - `folder`: the folder of a loaded sweep.
    - `failing`: counterexamples of each row of a loaded sweep, by its number; otherwise the
      certificates have them.
    - `used`: hyper-parameters of each algorithm, by name; empty if all algorithms have all.
    - `reuse`: by kind of work (`"train"`, `"return"`, `"certify"`), the number of entries that were
      cached before, and of all; empty for a loaded sweep.
    """

    _report = "verifai_jax.addons.training.sweep_report", "sweep_page"
    record: SweepRecord
    study: Study | None = None
    space: FeatureSpace | None = None
    folder: Path | None = None
    failing: "Mapping[int, pd.DataFrame]" = field(default_factory=dict, repr=False)
    used: Mapping[str, tuple[str, ...]] = field(default_factory=dict, repr=False)
    reuse: Mapping[str, tuple[int, int]] = field(default_factory=dict, repr=False)
    _problems: dict[int, Problem] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.space is None and self.study is not None:
            object.__setattr__(self, "space", self.study.space)
        if not self.used and self.study is not None:
            object.__setattr__(self, "used", _used_hyperparameters(self.study))

    @property
    def name(self) -> str:
        """Name of the study."""
        return self.record.study

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """Names of the hyper-parameter columns."""
        return self.record.hyperparameters

    @property
    def p(self) -> float | None:
        """Failure probability below which a policy is called safe, if known."""
        p = self.record.options.get("p", None if self.study is None else self.study.p)
        return None if p is None else float(p)

    def plot(self, path: str | Path | None = None, kind: str = "overview") -> Figure:
        """Draw the sweep.

        **Arguments:**
        - `path`: file to which the picture is written, if given.
        - `kind`: `"overview"`, the front of return and failure rate with learning curves and
          importances; `"parallel"`, parallel coordinates of the configurations; `"slices"`, the
          failure rate over each hyper-parameter.
        **Returns:** the Matplotlib figure.
        """
        check_names("kind of picture", [kind], PICTURES)
        module, function = PICTURES[kind]
        return lazy_import(f"verifai_jax.addons.training.pictures.{module}", function)(self, path)

    @cached_property
    def table(self) -> "pd.DataFrame":
        """One row for each policy: a configuration, trained with one seed up to a checkpoint.

        `steps` are environment steps. `training_return` is the mean return of the last episodes,
        with exploration; `nominal_return` that of the policy's most likely actions on the nominal
        task. `failures` is counted in `simulations` fresh samples of the problem's features;
        `failure_rate` comes with the ends of its interval. `worst_robustness` is the least of all
        simulations, `curve_robustness` that of the formula over the learning curve.
        """
        import pandas as pd

        columns = {name: np.asarray(column) for name, column in self.record.columns.items()}
        return pd.DataFrame(columns, index=pd.RangeIndex(self.record.rows, name="row"))

    @property
    def safe(self) -> "pd.DataFrame":
        """Rows with the verdict `safe@p`, by decreasing nominal return."""
        order = preference_order(self.table)
        return self.table.iloc[order[is_safe(self.table)[order]]]

    @property
    def best(self) -> "pd.Series":
        """The recommended row: the best nominal return among the safe ones.

        If none is safe it is the one whose failure probability has the lowest upper end; its
        `verdict` says so.

        **Raises:** `ValueError` if no policy was certified.
        """
        order = preference_order(self.table)
        if not len(order):
            raise ValueError(
                f"the sweep of {self.name!r} has no policy with a certificate: "
                f"{len(self.table)} rows, {self._statuses()}"
            )
        return self.table.iloc[order[0]]

    def _statuses(self) -> str:
        counts = self.table["status"].astype(str).value_counts()
        return ", ".join(f"{n} {status}" for status, n in counts.items()) or "nothing was trained"

    @cached_property
    def configurations(self) -> "pd.DataFrame":
        """One row for each configuration, combining its training seeds at their last checkpoint.

        `nominal_return` and `failure_rate` are means over the seeds, `failure_rate_worst` and
        `failure_high` the maxima, `verdict` the worst verdict, `seeds_safe` the number of safe
        seeds. `best_row` is the recommended row of the table among all seeds and checkpoints, or
        -1.
        """
        return group_by_configuration(self.table, self.hyperparameters)

    def changes(self) -> tuple[Change, ...]:
        """Return the files of the study's model that have changed since, with both hashes.

        They are compared with the study's present files; for a sweep without its study, with those
        on disk. None if the sweep did not record its files.
        """
        if not self.record.sources:
            return ()
        now = None if self.study is None else self.study.sources()
        # Certificates are of the model with which the sweep went on last.
        return model_changes(self.record.sources[-1:], now)

    def policy(self, i: int | np.integer) -> TrainedPolicy:
        """Return the policy of row `i` of the table: `sweep.policy(i).act(observation)`.

        **Raises:** `IndexError` for a row that is not in the table; `ValueError` with the reason
        for a row without a policy.
        """
        policy = self.record.policies[i := self._row(i)]
        if policy is None:
            raise ValueError(f"row {i} has no policy: {self.table.loc[i, 'status']}")
        return policy

    def problem(self, i: int | np.integer) -> Problem:
        """Return the verification problem with the policy of row `i` in the loop.

        It can be passed to `falsify`, `estimate`, `synthesize`. Each call returns the same object,
        so that its compiled programs are reused.

        **Raises:** the errors of `policy`; `ValueError` for a sweep loaded without its study.
        """
        policy = self.policy(i)
        if self.study is None:
            target = self.record.options.get("target")
            given = repr(target) if target else "study"
            raise ValueError(
                f"the sweep of {self.name!r} was loaded without its study, which has the "
                f"verification problem; give it: load_sweep(folder, {given})"
            )
        i = self._row(i)
        if i not in self._problems:
            self._problems[i] = self.study.problem(policy)  # pyright: ignore[reportArgumentType]
        return self._problems[i]

    def _row(self, i: int | np.integer) -> int:
        if isinstance(i, bool) or not isinstance(i, int | np.integer):
            raise TypeError(f"a row is named by its number in the table; got {i!r}")
        if not 0 <= i < self.record.rows:
            raise IndexError(f"row {i} is not in the table of {self.record.rows} rows")
        return int(i)

    def pareto(self) -> "pd.DataFrame":
        """Return the rows on the Pareto front, by increasing failure probability.

        Rows are compared by nominal return, the upper end of the failure probability, and
        environment steps.
        """
        front = self.table.loc[on_pareto_front(self.table)]
        return front.sort_values(
            ["failure_high", "nominal_return", "steps"], ascending=[True, False, True]
        )

    def configuration(self, i: int | np.integer | None = None) -> TrainedConfiguration:
        """Return the configuration of row `i` with its policy, by default of the best row.

        **Raises:** the errors of `policy` and `best`.
        """
        i = int(str(self.best.name)) if i is None else self._row(i)
        policy, table = self.policy(i), self.table
        row: Any = table.loc[i].to_dict()
        values = {n: as_scalar(row[n]) for n in self.hyperparameters}
        same = (table["configuration"] == row["configuration"]) & (table["seed"] == row["seed"])
        whole = int(table.loc[same, STEPS].max())
        if STEPS in values:  # The table has those of the checkpoint.
            values[STEPS] = whole
        before, number, parents = [], int(row["configuration"]), self.record.options.get("parents")
        while (parent := (parents or {}).get(str(number))) is not None:
            number, at = parent
            one: Any = table.loc[table["configuration"] == number].iloc[0]
            before.insert(0, [at, {n: as_scalar(one[n]) for n in self.hyperparameters}])
        return TrainedConfiguration(
            study=self.name, hyperparameters=values, seed=int(row["seed"]),
            steps=int(row[STEPS]),
            called=int(row[STEPS]) if self.record.options.get("halving") else whole,
            certificate={n: as_scalar(row[n]) for n in CERTIFICATE},
            weights=weights_of(policy), version=self.record.version,
            processor=describe_processor(), policy=policy, before=before,
        )  # fmt: skip

    def export(self, folder: str | Path, i: int | np.integer | None = None) -> Path:
        """Write row `i`, by default the best, to a folder: JSON, and its policy as ONNX.

        `sweeps.load_configuration` reads it.

        **Raises:** the errors of `configuration`; `MissingExtra` without the package onnx.
        """
        return self.configuration(i).export(folder)

    def trials_dataframe(self) -> "pd.DataFrame":
        """Return one row for each configuration, with the columns of Optuna's `trials_dataframe`.

        `values_0` is the upper end of the failure probability, `values_1` the nominal return;
        `state` is COMPLETE, PRUNED where halving stopped it, FAIL without one of the two.
        """
        groups: Any = self.configurations
        renamed = {name: f"params_{name}" for name in self.hyperparameters}
        values = {"failure_high": "values_0", "nominal_return": "values_1"}
        table = groups[[*values, *renamed]].rename(columns={**values, **renamed})
        table.insert(0, "number", range(len(table)))
        attributes = {name: f"user_attrs_{name}" for name in ("verdict", "status")}
        table = table.join(groups[[*attributes]].rename(columns=attributes))
        states = [*map(state_of, groups.to_dict("records"))]
        return table.assign(state=states).reset_index(drop=True)

    @suggests_options
    def importance(self, *, repeats: int = 5, seed: int = 0) -> HyperparameterImportance:
        """Measure the importance of the hyper-parameters for safety and for return.

        Nothing is trained or simulated. If there are too few configurations the result says so.

        **Arguments:**
        - `repeats`: how often folds are drawn and each column is shuffled.
        - `seed`: the seed of folds, shuffles and forests.
        """
        table = self.table
        if self.used:
            # A hyper-parameter that an algorithm lacks cannot matter to it.
            for name in self.hyperparameters:
                has = [algorithm_uses(self.used, kind, name) for kind in table[ALGORITHM]]
                table = table.assign(**{name: table[name].where(np.array(has, bool))})
        return hyperparameter_importance(
            table, self.hyperparameters, self.space, name=self.name, repeats=repeats, seed=seed
        )

    @suggests_options
    def counterexamples(
        self, i: int | np.integer | None = None, *, simulations: int = 0,
        search: str | Search = "portfolio", seed: int = 0,
    ) -> "pd.DataFrame":  # fmt: skip
        """Return features with which the policy of a row fails, the worst first.

        An empty table does not prove the absence of failures; see the certificate.

        **Arguments:**
        - `i`: number of the row; the best one when left out.
        - `simulations`: budget of a search for further failures; needs the study.
        - `search`, `seed`: the search and seed for these simulations.
        **Returns:** columns of the problem's features, and `rho`, the robustness.
        **Raises:** the errors of `problem` and `best`; `ValueError` if further failures are
        searched for and the model has changed since the sweep.
        """
        import pandas as pd

        i = int(str(self.best.name)) if i is None else self._row(i)
        parts = [self.recorded_counterexamples(i)]
        if simulations:
            problem = self.problem(i)
            if changes := self.changes():
                raise ValueError(
                    f"the model has changed since the sweep of {self.name!r}: "
                    f"{list_changes(changes)}. Failures of two models are not mixed in one table: "
                    f"counterexamples({i}) has those of the sweep, falsify(sweep.problem({i})) "
                    "searches the present model"
                )
            run = falsify(problem, search, budget=simulations, seed=seed, progress=False)
            parts.append(run.table.counterexamples.loc[:, [*problem.space.columns, "rho"]])
        failures = pd.concat([part for part in parts if len(part)] or parts[-1:])
        return failures.sort_values("rho", kind="stable").reset_index(drop=True)

    def recorded_counterexamples(self, i: int | np.integer) -> "pd.DataFrame":
        """Return features with which the policy of row `i` failed in the sweep, and `rho`."""
        import pandas as pd

        i = self._row(i)
        certificates = self.record.certificates
        if certificates is not None and i in self.record.certified:
            return certificates.counterexamples(self.record.certified.index(i))
        if i in self.failing:
            return self.failing[i]
        worst, rho = self.record.worst[i], float(self.record.columns["worst_robustness"][i])
        row = pd.DataFrame([{**(worst or {}), "rho": rho}])
        return row if rho < 0 and worst is not None else row.iloc[:0]

    def curve(self, i: int | np.integer) -> Trace:
        """Return the learning curve up to the policy of row `i`, as a trace over environment steps.

        Its signal `return` is the mean return of the episodes that ended in each update, with
        exploration; an update in which none ended keeps the previous value.

        **Raises:** the `IndexError` of `policy`; `ValueError` if no episode ended.
        """
        return curve_trace(*self.curve_points(self._row(i)))

    def curve_robustness(self, formula: Formula | str) -> "pd.Series":
        """Return the robustness of a formula on the learning curve up to each row.

        **Raises:** the errors of `sweeps.curve_robustness`.
        """
        import pandas as pd

        formula = check_curve(formula)
        values = {i: curve_robustness(formula, *self.curve_points(i)) for i in self.table.index}
        return pd.Series(values, name=str(formula), dtype=float)

    def curve_points(
        self, i: int | np.integer
    ) -> tuple[Int[np.ndarray, " updates"], Float[np.ndarray, " updates"]]:
        """Return steps and mean returns of the updates up to row `i`; empty without a training."""
        row = self.table.loc[i]
        curve = self.record.curves.get((int(row["configuration"]), int(row["seed"])))
        if curve is None:
            return np.zeros(0, np.int64), np.zeros(0)
        count = int(np.searchsorted(curve.steps, row["steps"])) + 1
        return np.asarray(curve.steps)[:count], np.asarray(curve.mean_return)[:count]

    @property
    def headline(self) -> str:
        """Number of configurations with full return, and of the safe ones among them."""
        return format_headline(self)

    def summary(self) -> str:
        """Write the findings of the sweep, the most important first.

        The summary of a loaded sweep begins with a note if its study's model has changed.
        """
        text = format_summary(self)
        if self.study is None or self.folder is None:
            return text
        changed = changed_since(self.changes(), None, "the sweep")
        return f"{changed}\n{text}" if changed else text

    __str__ = __repr__ = summary

    def _repr_html_(self) -> str:
        return format_html(self)

    def save(self, folder: str | Path) -> Path:
        """Write the sweep to a folder: table, policies, curves, record.

        The files contain numbers and text; `load_sweep` reads them, `rl.load_policy` the policies.

        **Returns:** the folder.
        """
        import pandas as pd

        rows = [self.recorded_counterexamples(i).assign(row=i) for i in range(self.record.rows)]
        nothing = [pd.DataFrame({"row": [0]})[:0]]
        failing: Any = pd.concat([part for part in rows if len(part)] or nothing)
        return storage.write_sweep(self, failing, Path(folder))

    def to_optuna(
        self, storage: "str | BaseStorage | None" = None, name: str | None = None
    ) -> "optuna.Study":
        """Make an Optuna study with one trial for each configuration.

        Its values are the upper end of the failure probability, to minimise, and the nominal
        return, to maximise.

        **Arguments:**
        - `storage`: Optuna's storage, such as `"sqlite:///sweep.db"`; in memory when left out.
        - `name`: the name of the Optuna study; by default the sweep's.
        **Raises:** `MissingExtra` without the package.
        """
        return export_to_optuna(
            self.configurations, self.hyperparameters, self.space, self.used,
            name=self.name if name is None else name, storage=storage,
        )  # fmt: skip


def load_sweep(folder: str | Path, study: Study | str | None = None) -> Sweep:
    """Read a sweep from the folder written by `Sweep.save`.

    Certificates are restored from the table and the recorded counterexamples.

    **Arguments:**
    - `folder`: the folder.
    - `study`: the study or its target, such as `"specs/cartpole_training.py:safe_training"`; it is
      needed for `.problem(i)` and further counterexamples. The files never name code to run.
    **Raises:** `FileNotFoundError` for a folder without a sweep; `SweepFileError` for a damaged
    one, one of another format, or a study of another name or with other hyper-parameters.
    """
    folder = Path(folder)
    description = storage.read_description(folder)
    if isinstance(study, str):
        study = load_target(study, Study)
    if study is not None:
        storage.check_study(description, folder, study.name, study.space.columns)
    record, space, every, used = storage.read_sweep(description, folder)
    groups: Any = every.groupby("row")
    failing = {int(i): part.drop(columns="row").reset_index(drop=True) for i, part in groups}
    return Sweep(record, study, space if study is None else None, folder, failing, used)


def _used_hyperparameters(study: Study) -> dict[str, tuple[str, ...]]:
    """Return the names of the hyper-parameters of each algorithm of a study."""
    names = study.space.columns
    if ALGORITHM not in names:
        return {}
    return {
        algorithm: study.trainer.used_hyperparameters(
            {**dict.fromkeys(names), ALGORITHM: algorithm}
        )
        for algorithm in study.trainer.by_name
    }
