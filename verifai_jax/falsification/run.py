"""The result of a falsification: its table, its statistics, and how to see a row again."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.user_code.sources import Change
from verifai_jax.evaluation.confirmations import describe_checks
from verifai_jax.falsification.model_changes import (
    NEAR,
    ROUNDING,
    changed_since,
    finding_of,
    has_several_models,
    model_changes,
    sources_of_row,
)
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.rulebook import Rulebook

if TYPE_CHECKING:
    import pandas as pd

    from verifai_jax.evaluation.replay import Replay
    from verifai_jax.statistics.binomial import Rate


@dataclass(frozen=True, eq=False)
class Run(InNotebook):
    """The result of a falsification: its table, its record, and what follows from them.

    - `name`: the name of the problem.
    - `formulas`: their texts by name.
    - `table`, `search`: one row a simulation, and the repr of what proposed them.
    - `seed`, `batch`, `budget`: as given to `falsify`.
    - `stopped`: `"budget"`, `"max_seconds"`, `"stop_after"`, `"stop_when"`, `"exhausted"` (a finite
      search came to its end), `"interrupted"`, the error that ended it, or `"running"` for one that
      was cut off.
    - `compile_seconds`, `confirm_seconds`, `run_seconds`: time of all parts of the run spent
      compiling, in closer replays, and in everything else.
    - `search_seconds`: the part of `run_seconds` that proposals and suggestions took, and learning
      from what came of them.
    - `simulate_seconds`: the part of `run_seconds` that simulations took, and their rows to be put
      into the table. What is left is that of callbacks and checkpoints.
    - `version`: the version of verifai_jax.
    - `prior`: whether the rows are independent samples of the feature space.
    - `origin`: why the rows are no such samples: `"first"` (given rows came first), `"given"` (all
      were given), `"sequence"` (of points that spread), `"coverage"`, `"learned"` (by the search).
    - `folder`: on disk; None for a run in memory.
    - `target`: the problem's name on the command line.
    - `problem`: None for a run that was loaded without it.
    - `search_data`, `space_data`: search and space as plain data; None for one of the user's own.
    - `acceptance`: share of proposed points that the constraint accepted; None without one.
    - `checkpoint`: the checkpoint that `resume` goes on from.
    - `precision`: `"float32"` or `"float64"`, of the simulations.
    - `backend`: the engine that simulated; None for a system that has one only.
    - `engine`: `"xla"`, `"native"` for rows from the 513th on, or `"host"` for a black box;
      `"auto"` before it is decided.
    - `notes`: decisions that were made without the user.
    - `lasting_notes`: those of `notes` that are still true when the run goes on.
    - `confirm`: whether violations were replayed more finely before they were claimed.
    - `checks`: names of the checks that a confirmed row has passed; empty if none was made.
    - `first`: points of the unit cube that were simulated before the search began.
    - `guide`: the term that steered the search, as plain data; None without one.
    - `sources`: what the model was made of when the run began, and again where it went on with
      another one: files with their hashes, and versions, as plain data; empty if that is not
      recorded.
    - `derived`: what a verb made of the problem, as plain data; None if nothing.
    - `requirements`: what the requirements of its formulas said, by identifier, as plain data.
    - `model`: a hash of what was simulated, of a problem with requirements.
    - `damage`: what of its files could not be read; such a run cannot be resumed.
    """

    _internal = frozenset((
        "changed_since", "changes", "checkpoint", "checks", "compared", "damage",
        "has_several_models", "lasting_notes", "model", "origin", "search_data", "space_data",
        "table_path", "verdict_counts",
    ))  # fmt: skip
    name: str
    formulas: dict[str, str]
    table: ErrorTable
    search: str
    seed: int
    batch: int
    stopped: str
    compile_seconds: float
    run_seconds: float
    version: str
    prior: bool
    folder: Path | None = None
    target: str | None = None
    problem: Problem | None = None
    budget: int = 0
    search_data: Mapping[str, Any] | None = None
    space_data: Mapping[str, Any] | None = None
    acceptance: float | None = None
    checkpoint: Mapping[str, Any] | None = None
    precision: str = "float32"
    backend: str | None = None
    engine: str = "xla"
    notes: Sequence[str] = ()
    lasting_notes: Sequence[str] = ()
    confirm: bool = False
    confirm_seconds: float = 0.0
    search_seconds: float = 0.0
    simulate_seconds: float = 0.0
    checks: Sequence[str] = ()
    first: Sequence[Sequence[float]] = ()
    guide: Mapping[str, Any] | None = None
    sources: Sequence[Mapping[str, Any]] = ()
    damage: str = ""
    origin: str = ""
    derived: Mapping[str, Any] | None = None
    requirements: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    model: str = ""

    @property
    def checked(self) -> str:
        """The checks that a confirmed row has passed, as the end of a sentence; often empty."""
        return describe_checks(self.checks)

    @property
    def simulations(self) -> int:
        """Simulations in the table."""
        return len(self.table)

    @property
    def table_path(self) -> Path | None:
        """File of the table on disk, or folder of a long one: `pandas.read_parquet` opens both.

        None for a run in memory.
        """
        if self.folder is None or self.table.path is None:
            return None
        return self.folder / self.table.path.name

    @property
    def best(self) -> "pd.Series":
        """The row with the least robustness among the counterexamples, or among all that ended.

        **Raises:** `ValueError` when no simulation ended properly.
        """
        number = self.table.counts.best
        if number is None:
            raise ValueError(
                f"run of {self.name!r} has no simulation with a verdict: "
                f"none of {self.simulations} ended properly"
            )
        return self.table.row(number)

    @property
    def failure_rate(self) -> "Rate | None":
        """Failures per simulation with a 95 % interval.

        It is the rate as simulated, whatever closer replays say of single rows. Clopper-Pearson
        where the number of simulations was not decided by their outcomes, else one that holds
        whenever sampling stops. A simulation without a verdict is taken for safe at the lower end
        of the interval and for failing at the upper end. None unless the rows are independent
        samples of the feature space and at least one of them has a verdict: an active search may
        refute, it never certifies. None too where the run went on with another model.
        """
        return self._rate(self.table.counts.violating, 0)

    @property
    def confirmed_failure_rate(self) -> "Rate | None":
        """Confirmed failures per simulation with a 95 % interval; as `failure_rate`.

        Refuted rows are taken for safe. Those that closer replays left undecided, or did not reach,
        are taken for safe at the lower end of the interval and for failing at the upper end. None
        where no row was decided.
        """
        counts = self.verdict_counts
        if not any(counts.get(verdict) for verdict in ("confirmed", "refuted", "fragile")):
            return None
        confirmed = counts.get("confirmed", 0)
        return self._rate(confirmed, sum(counts.values()) - confirmed - counts.get("refuted", 0))

    def _rate(self, failures: int, undecided: int) -> "Rate | None":
        if not self.prior or self.has_several_models or self.table.changed:
            return None
        without = self.table.counts.without_verdict
        if self.simulations == without:
            return None
        stopped_by_outcomes = self.stopped in ("stop_after", "stop_when")
        if stopped_by_outcomes:
            from verifai_jax.statistics.confidence_sequences import anytime_interval as interval
        else:
            from verifai_jax.statistics.binomial import clopper_pearson as interval
        return interval(failures, self.simulations, undecided=undecided + without)

    @property
    def verdict_counts(self) -> dict[str, int]:
        """Number of violating rows by the verdict of closer replays; empty without `confirm`."""
        return dict(self.table.counts.verdicts)

    @property
    def front(self) -> "pd.DataFrame":
        """The counterexamples that no other one outdoes: with several formulas, the Pareto set.

        Compared by how much each formula is broken, in the order of the problem's priority;
        without one no formula makes up for another. With one formula: the worst row.

        **Raises:** `ValueError` for a run loaded without its problem.
        """
        if self.problem is None:
            raise ValueError(
                f"the run of {self.name!r} was loaded without its problem, which has the priority "
                "of its formulas; give it: vj.load(path, problem)"
            )
        failing = self.table.counterexamples
        names = [f"rho.{name}" for name in self.formulas] if len(self.formulas) > 1 else ["rho"]
        broken = np.maximum(-failing[names].to_numpy(np.float64), 0.0)
        rulebook = self.problem.rulebook or Rulebook(self.formulas)
        return failing.loc[rulebook.front(broken)] if len(failing) else failing

    @property
    def has_several_models(self) -> bool:
        """True where the run went on although its model had changed."""
        return has_several_models(self.sources)

    def changes(self, row: int | None = None) -> tuple[Change, ...]:
        """Return the files of the model that are others by now, with both hashes.

        The model of now is that of the run's problem; of a run without it, what lies on the disk.

        - `row`: the row that is asked about; all rows when left out.
        """
        now = None if self.problem is None else self.problem.sources()
        return model_changes(self.sources, now, row)

    def changed_since(self, row: int | None = None) -> str:
        """Say in a sentence which files of the model are others by now; empty if none is."""
        return changed_since(self.changes(row), row)

    def compared(self, seen: "Replay") -> "Replay":
        """Return a replay of a row in the run's precision, with what speaks against taking it so.

        Its `changed` says which files of the model are others by now, and its `finding` that it
        does not give the number of its row.
        """
        if seen.row is None:
            return seen
        changed = self.changed_since(seen.row)
        finding = finding_of(seen, self.table.row(seen.row).to_dict(), self._several)
        if finding and not changed:
            finding += f"; {self._why_not_again(seen.row)}"
        return replace(seen, changed=changed, finding=f"{finding}." if finding else "")

    @property
    def _several(self) -> bool:
        return len(self.formulas) > 1

    def _why_not_again(self, row: int) -> str:
        """Say what may be the reason where no file has changed."""
        then = sources_of_row(self.sources, row)
        if then is None or self.problem is None:
            return "what its model was made of is not recorded, so that it may be another one"
        if versions := then.other_versions(self.problem.sources()):
            return f"no file of its model has changed, and versions have: {', '.join(versions)}"
        why = "the system has memory, chance or state of its own, or reads what is not recorded"
        if self.engine == "native":
            why = "native code rounds otherwise, which a chaotic system makes grow"
        return f"no file of its model has changed: {why}"

    def improbability(self, rows: "pd.DataFrame | None" = None) -> "pd.DataFrame":
        """Return how improbable the prior makes rows of the table: a failure that is never met.

        **Arguments:**
        - `rows`: the rows of the table, all counterexamples when left out.
        **Returns:** by the numbers of the rows `log_density`, the natural logarithm of the prior's
        density (of a constrained space without the share that is accepted), and for each column
        with a distribution `tail.NAME`, the probability of a value at least as far out. The
        density is NaN where a feature has none, such as an automaton.
        **Raises:** `ValueError` for a run of which neither the problem nor the space is known, and
        for a row outside the space.
        """
        import pandas as pd

        from verifai_jax.features.density import NoDensityError, log_density, tails

        rows = self.table.counterexamples if rows is None else rows
        space = self.space
        columns = {str(name): rows[name].to_numpy() for name in rows}
        try:
            density = log_density(space, columns)
        except NoDensityError:
            density = np.full(len(rows), np.nan)
        found = {f"tail.{name}": tail for name, tail in tails(space, columns).items()}
        return pd.DataFrame({"log_density": density, **found}, index=rows.index)

    @property
    def space(self) -> FeatureSpace:
        """The feature space, of the problem or as it was recorded.

        **Raises:** `ValueError` where neither is known.
        """
        if self.problem is not None:
            return self.problem.space
        if self.space_data is None or self.space_data.get("where") is not None:
            raise ValueError(
                f"the run of {self.name!r} was loaded without its problem, and its record does not "
                "describe its space; give it: vj.load(path, problem)"
            )
        return FeatureSpace.from_json(self.space_data)

    def analyze(self, **options: Any) -> Any:
        """Analyse the table: rules, importance, clusters, coverage; see `analysis.analyze`."""
        return lazy_import("verifai_jax.analysis", "analyze")(self, **options)

    def replay(
        self, row: "int | np.integer | pd.Series | Mapping[str, Any]", precision: str | None = None
    ) -> "Replay":
        """Simulate a row of the table again and keep its trace.

        - `row`: a row number, or a row of `table.all` (its index is the row number), or any
          mapping with the feature columns.
        - `precision`: `"float32"` or `"float64"`; that of the run when left out.

        A row that MJX simulated is replayed in native MuJoCo where that gives its number, within
        rounding; its `engine` says so then.

        **Returns:** the replay; its `changed` says that the model is another one by now, and its
        `finding` that it does not give the number of its row, which its text begins with.
        **Raises:** `ValueError` for a run without its problem; `IndexError` for a row that is not
        in the table.
        """
        if self.problem is None:
            raise ValueError(
                f"the run of {self.name!r} was loaded without its problem; "
                "give it: vj.load(path, problem)"
            )
        number, values = self.table.entry(row)
        precision = self.precision if precision is None else precision
        if number is None or not 0 <= number < self.simulations:
            return self._replayed(self.problem, values, number, precision)
        stored = self.table.row(number).to_dict()
        own = isinstance(row, int | np.integer) or all(
            values[name] == stored[name] or values[name] != values[name]
            for name in self.table.features
        )
        if own and precision == self.precision and (seen := self._natively(number, values, stored)):
            return replace(seen, changed=self.changed_since(number))
        seen = self._replayed(self.problem, values, number, precision)
        if own and precision == self.precision:
            return self.compared(seen)
        if not own or not finding_of(seen, stored, self._several, NEAR):
            return replace(seen, changed=self.changed_since(number))
        # The other precision may be all that differs, which is not a finding.
        again = self._replayed(self.problem, values, number, self.precision)
        again = self.compared(again)
        return replace(seen, changed=again.changed, finding=again.finding)

    def _replayed(
        self,
        problem: Problem,
        values: "pd.Series | Mapping[str, Any]",
        number: int | None,
        precision: str,
    ) -> "Replay":
        replay = lazy_import("verifai_jax.evaluation.replay", "replay")
        return replay(problem, values, run_keys(self.seed)[1], number, precision)

    def _natively(
        self, number: int, values: "pd.Series | Mapping[str, Any]", stored: Mapping[str, Any]
    ) -> "Replay | None":
        """Replay a row that MJX simulated in native MuJoCo; None if that has another number.

        MJX compiles a program for it first, for half a minute where there are contacts.
        """
        problem = self.problem
        if problem is None or problem.black_box or "native" not in problem.system.backends:
            return None
        seen = self._replayed(problem.on_backend("native"), values, number, self.precision)
        if finding_of(seen, stored, self._several, ROUNDING):
            return None
        return replace(seen, engine="native MuJoCo, which gives the number of the row as MJX does")

    def save_counterexamples(self, folder: str | Path, **options: Any) -> list[Path]:
        """Write counterexamples as small files made for version control; returns their paths.

        `vj.replay_counterexamples(problem, folder)` simulates them again.

        **Arguments:**
        - `folder`: it is made where there is none.
        - `options`: the options of `counterexamples.save_counterexamples`: `max_count`, `shrink`,
          `budget`.
        **Raises:** `ValueError` for a run without its problem or without a counterexample.
        """
        return lazy_import("verifai_jax.analysis.counterexamples", "save_counterexamples")(
            self, folder, **options
        )

    def summary(self) -> str:
        """Write what failed, how often, the worst case and how to see it again."""
        return lazy_import("verifai_jax.falsification.summary", "summarize")(self)

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw the feature space with safe and failing samples; returns the figure."""
        return lazy_import("verifai_jax.reports.plotting.scatter", "plot_features")(self, path)

    def report(self, path: str | Path, **options: Any) -> Path:
        """Write the evidence report on the run: one HTML file, and its claims as JSON next to it.

        **Arguments:**
        - `path`: the path of the HTML file.
        - `options`: the options of `reports.write_report`: `units` and `reasons` of features,
          `traces`, `studies`, `modes`, `odd`, `assessment`.
        **Returns:** the path.
        """
        return lazy_import("verifai_jax.reports", "write_report")(self, path, **options)

    def explore(self) -> Any:
        """Return a view of the table for a notebook: scatter, parallel coordinates, traces.

        A row under the pointer shows its values; a clicked one is simulated again. It needs
        anywidget (extra `widget`); without it this is the picture of `plot`.
        """
        return lazy_import("verifai_jax.reports", "explore")(self)

    def save(self, path: str | Path) -> Path:
        """Write the run to a folder: its record, table and state; returns the folder.

        **Raises:** `FolderInUse` where another process writes there; `ValueError` where it is the
        run's own folder, and somebody has gone on with the run there; `OSError` for what the file
        system refuses, such as a full disk: what the folder held before stays.
        """
        return lazy_import("verifai_jax.falsification.run_folder", "save_run")(self, Path(path))

    def _notebook_parts(self) -> Iterator[str]:
        yield from self.table._notebook_parts()

    def __repr__(self) -> str:
        return self.summary()
