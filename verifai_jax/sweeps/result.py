"""The result of a sweep: which configurations train policies that are safe, and how sure that is.

sweep.summary()                      how many reach full return, how many of those are safe
sweep.table, sweep.safe, sweep.best  rows are policies
sweep.policy(12).act(observation)
vj.falsify(sweep.problem(12))        the closed loop with that policy
sweep.save("sweeps/mine"); load_sweep("sweeps/mine", study)
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.core.errors import suggests_options
from verifai_jax.core.trace import Trace
from verifai_jax.falsification._falsify import falsify
from verifai_jax.features import FeatureSpace
from verifai_jax.mtl import Formula
from verifai_jax.problem.problem import Problem
from verifai_jax.rl.policy import Policy
from verifai_jax.search import Search
from verifai_jax.sweeps.curves import check_curve, curve_trace, judge_curve
from verifai_jax.sweeps.importance import HyperparameterImportance, hyperparameter_importance
from verifai_jax.sweeps.ranking import by_configuration, chosen_first, is_safe, pareto_fronts
from verifai_jax.sweeps.record import SweepRecord

if TYPE_CHECKING:
    import pandas as pd

    from verifai_jax.sweeps.study import Study

ALGORITHM = "algorithm"
"""The hyper-parameter that says which of the others have a meaning."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """What `sweep` returns.

    **Fields:** `record`: all that was trained and certified, as plain data; `study`: what was
    swept, None for a loaded sweep without it; `space` of the hyper-parameters, the study's if left
    out, None where it is not known; `folder` on disk, if it was loaded; `failing`: what each row
    failed with, row -> DataFrame, of a loaded sweep, which has no certificates to ask; `used`:
    the hyper-parameters that each algorithm has, by its name; empty where all have all.
    """

    record: SweepRecord
    study: "Study | None" = None
    space: FeatureSpace | None = None
    folder: Path | None = None
    failing: "Mapping[int, pd.DataFrame]" = field(default_factory=dict, repr=False)
    used: Mapping[str, tuple[str, ...]] = field(default_factory=dict, repr=False)
    _problems: dict[int, Problem] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.space is None and self.study is not None:
            object.__setattr__(self, "space", self.study.space)
        if not self.used and self.study is not None:
            object.__setattr__(self, "used", _used(self.study))

    @property
    def name(self) -> str:
        """Of the study."""
        return self.record.study

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """Names of the columns that were swept."""
        return self.record.hyperparameters

    def applies(self, name: str, algorithm: Any) -> bool:
        """Whether the algorithm of this name has the hyper-parameter; None has all."""
        return name in self.used.get(str(algorithm), (name,))

    @cached_property
    def table(self) -> "pd.DataFrame":
        """One row a policy: a configuration, trained with a seed up to a snapshot.

        `steps` are environment steps; `training_return` the mean return of the last episodes with
        exploration, `nominal_return` that of the policy's likeliest actions on the task itself;
        `failures` of `simulations` fresh samples of the problem's features, and the
        `failure_rate` with the ends of its interval; `worst_robustness` over everything that was
        simulated; `curve_robustness` of the formula over the learning curve.
        """
        import pandas as pd

        columns = {name: np.asarray(column) for name, column in self.record.columns.items()}
        return pd.DataFrame(columns, index=pd.RangeIndex(self.record.rows, name="row"))

    @property
    def safe(self) -> "pd.DataFrame":
        """The rows whose verdict is `safe@p`, the best nominal return first."""
        order = chosen_first(self.table)
        return self.table.iloc[order[is_safe(self.table)[order]]]

    @property
    def best(self) -> "pd.Series":
        """The row to choose: the best nominal return among the safe ones.

        Where none is safe it is the one whose failure probability has the lowest upper end; its
        `verdict` says so.

        **Raises:** `ValueError` where no policy was certified at all.
        """
        order = chosen_first(self.table)
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
        """One row a configuration, over its training seeds at their last snapshot.

        `nominal_return` and `failure_rate` are means over the seeds, `failure_rate_worst` and
        `failure_high` the greatest, `verdict` the worst of them, `seeds_safe` how many are safe.
        `best_row` is the row of the table to choose among all seeds and snapshots, -1 for none.
        """
        return by_configuration(self.table, self.hyperparameters)

    def policy(self, i: int) -> Policy:
        """The policy of row `i` of the table: `sweep.policy(i).act(observation)`.

        **Raises:** `IndexError` for a row that is not in the table; `ValueError` for one that has
        no policy, saying why.
        """
        policy = self.record.policies[i := self._row(i)]
        if policy is None:
            raise ValueError(f"row {i} has no policy: {self.table.loc[i, 'status']}")
        return policy

    def problem(self, i: int) -> Problem:
        """The verification problem with the policy of row `i` in the loop.

        Ready for `falsify`, `estimate`, `synthesize`. The same object each time, so that it keeps
        what it compiles.

        **Raises:** as `policy`; `ValueError` for a sweep that was loaded without its study.
        """
        policy = self.policy(i)
        if self.study is None:
            target = self.record.options.get("target")
            given = repr(target) if target else "study"
            raise ValueError(
                f"the sweep of {self.name!r} was loaded without its study, which has the "
                f"verification problem; give it: load_sweep(path, {given})"
            )
        i = self._row(i)
        if i not in self._problems:
            self._problems[i] = self.study.problem(policy)
        return self._problems[i]

    def _row(self, i: int) -> int:
        if isinstance(i, bool) or not isinstance(i, int | np.integer):
            raise TypeError(f"a row is named by its number in the table; got {i!r}")
        if not 0 <= i < self.record.rows:
            raise IndexError(f"row {i} is not in the table of {self.record.rows} rows")
        return int(i)

    def pareto(self) -> "pd.DataFrame":
        """The rows that no other row outdoes, the lowest failure probability first.

        Compared by nominal return, the upper end of the failure probability, and environment
        steps; see `pareto.py`.
        """
        front = self.table.loc[pareto_fronts(self.table) == 0]
        return front.sort_values(
            ["failure_high", "nominal_return", "steps"], ascending=[True, False, True]
        )

    @suggests_options
    def importance(self, *, repeats: int = 5, seed: int = 0) -> HyperparameterImportance:
        """Which hyper-parameters matter for safety and for return; see `importance.py`.

        Nothing is trained or simulated. With too few configurations it says so.
        """
        table = self.table
        if self.used:
            # What an algorithm lacks cannot matter to it.
            for name in self.hyperparameters:
                has = [self.applies(name, algorithm) for algorithm in table[ALGORITHM]]
                table = table.assign(**{name: table[name].where(np.array(has, bool))})
        return hyperparameter_importance(
            table,
            self.hyperparameters,
            self.space,
            name=self.name,
            repeats=repeats,
            seed=seed,
        )

    @suggests_options
    def counterexamples(
        self,
        i: int | None = None,
        *,
        simulations: int = 0,
        search: str | Search = "portfolio",
        seed: int = 0,
    ) -> "pd.DataFrame":
        """Features with which the policy of row `i` fails, the worst first; of the best by default.

        - `simulations`: that the `search` may take to find more than the sweep itself met, which
          needs the study.

        Columns are the problem's features and `rho`. None found does not mean that there are none:
        that is what the certificate is about.

        **Raises:** as `problem` and `best`.
        """
        import pandas as pd

        i = int(self.best.name) if i is None else self._row(i)  # pyright: ignore[reportArgumentType]
        parts = [self.met(i)]
        if simulations:
            problem = self.problem(i)
            run = falsify(problem, search, budget=simulations, seed=seed, progress=False)
            more: Any = run.table.counterexamples[[*problem.space.columns, "rho"]]
            parts.append(more)
        found = pd.concat([part for part in parts if len(part)] or parts[-1:])
        return found.sort_values("rho", kind="stable").reset_index(drop=True)

    def met(self, i: int) -> "pd.DataFrame":
        """Features with which the policy of row `i` failed during the sweep, and `rho`."""
        import pandas as pd

        i = self._row(i)
        certificates: Any = self.record.certificates
        if certificates is not None and i in self.record.certified:
            return certificates.counterexamples(self.record.certified.index(i))
        if i in self.failing:
            return self.failing[i]
        worst, rho = self.record.worst[i], float(self.record.columns["worst_robustness"][i])
        found = pd.DataFrame([{**(worst or {}), "rho": rho}])
        return found if rho < 0 and worst is not None else found.iloc[:0]

    def curve(self, i: int) -> Trace:
        """The learning curve up to the policy of row `i`, a trace over environment steps.

        Signal `return`: the mean return of the episodes that ended in each update, exploration
        included; an update in which none did keeps the value before it.

        **Raises:** `IndexError` as `policy`; `ValueError` where no episode ended.
        """
        return curve_trace(*self._points(self._row(i)))

    def judge_curves(self, formula: Formula | str) -> "pd.Series":
        """Robustness of a formula on the learning curve up to each row; see `judge_curve`.

        **Raises:** as `judge_curve`.
        """
        import pandas as pd

        formula = check_curve(formula)
        judged = {i: judge_curve(formula, *self._points(i)) for i in self.table.index}
        return pd.Series(judged, name=str(formula), dtype=float)

    def _points(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Steps and returns of the updates behind a row; empty where it never trained."""
        row = self.table.loc[i]
        curve = self.record.curves.get((int(row["configuration"]), int(row["seed"])))
        if curve is None:
            return np.zeros(0, np.int64), np.zeros(0)
        count = int(np.searchsorted(curve.steps, row["steps"])) + 1
        return np.asarray(curve.steps)[:count], np.asarray(curve.mean_return)[:count]

    @property
    def p(self) -> float | None:
        """The failure probability below which a policy was called safe, where it is known."""
        p = self.record.options.get("p", None if self.study is None else self.study.p)
        return None if p is None else float(p)

    def summary(self) -> str:
        """How many learn the task and how many of those are safe, the best, and its price."""
        from verifai_jax.sweeps.summary import summary

        return summary(self)

    def __str__(self) -> str:
        return self.summary()

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        from verifai_jax.sweeps.summary import as_html

        return as_html(self)

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw return against failure probability, learning curves and importances.

        Returns the figure, which is also written where a `path` is given.
        """
        from verifai_jax.plotting.sweep import plot_sweep

        return plot_sweep(self, path)

    def save(self, path: str | Path) -> Path:
        """Write the sweep to a folder: table, policies, curves, record; returns the folder.

        Numbers and text only; `load_sweep` reads it. The policies are files that `rl.load_policy`
        reads too.
        """
        from verifai_jax.sweeps.storage import save_sweep

        return save_sweep(self, path)

    def to_optuna(self, storage: Any = None, name: str | None = None) -> Any:
        """An Optuna study with one trial a configuration, for its plots and its dashboard.

        - `storage`: where Optuna keeps it, such as `"sqlite:///sweep.db"`; in memory if left out.
        - `name` of the study there; the sweep's own if left out.

        Values are the upper end of the failure probability, to minimise, and the nominal return,
        to maximise.

        **Raises:** `MissingExtra` without the package.
        """
        from verifai_jax.sweeps.to_optuna import to_optuna

        return to_optuna(self, storage, name)


def _used(study: Any) -> dict[str, tuple[str, ...]]:
    """Which of the hyper-parameters each algorithm of a study has."""
    names = study.space.columns
    if ALGORITHM not in names or not hasattr(study, "trainer"):
        return {}
    return {
        algorithm: study.trainer.uses({**dict.fromkeys(names), ALGORITHM: algorithm})
        for algorithm in study.trainer.by_name
    }
