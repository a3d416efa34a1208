"""The result of a falsification: its table, its statistics, and replays of its rows."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.display.extensions import verb
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
    """The result of a falsification: its table and its record, with methods to evaluate them.

    - `name`: the name of the problem.
    - `formulas`: the texts of the formulas by name.
    - `table`, `search`: one row for each simulation; the repr of the search that proposed them.
    - `seed`, `batch`, `budget`: as given to `falsify`.
    - `stopped`: `"budget"`, `"max_seconds"`, `"stop_after"`, `"stop_when"`, `"exhausted"` (a finite
      search came to its end), `"interrupted"`, the error that ended it, or `"running"` if the
      process was killed.
    - `compile_seconds`, `confirm_seconds`, `run_seconds`: time spent compiling, in closer replays,
      and in everything else, over all parts of the run.
    - `search_seconds`: the part of `run_seconds` spent on proposals and learning.
    - `simulate_seconds`: the part of `run_seconds` spent on simulations and on adding rows to the
      table. The rest went to callbacks and checkpoints.
    - `version`: the version of verifai_jax.
    - `prior`: whether the rows are independent samples of the feature space.
    - `origin`: the reason why the rows are not such samples: `"first"` (given rows came first),
      `"given"` (all were given), `"sequence"` (a low-discrepancy sequence), `"coverage"`,
      `"learned"` (by the search).
    - `folder`: the folder on disk; None for a run in memory.
    - `target`: the problem's name on the command line.
    - `problem`: the problem; None for a run that was loaded without it.
    - `search_data`, `space_data`: search and space as plain data; None for a user's own class.
    - `acceptance`: share of proposed points that the constraint accepted; None without one.
    - `checkpoint`: the checkpoint that `resume` goes on from.
    - `precision`: the precision of the simulations, `"float32"` or `"float64"`.
    - `backend`: the backend that simulated; None for a system that has only one.
    - `engine`: `"xla"`, `"native"` for rows from the 513th on, or `"host"` for a black box;
      `"auto"` before it is decided.
    - `notes`: sentences on automatic decisions and likely mistakes.
    - `lasting_notes`: the `notes` that stay true when the run is resumed.
    - `confirm`: whether violations were replayed more finely before they were claimed.
    - `checks`: names of the checks that a confirmed row has passed; empty if none was made.
    - `first`: points of the unit cube that were simulated before the search began.
    - `guide`: the term that steered the search, as plain data; None without one.
    - `sources`: the files of the model with their hashes, and versions, as plain data: recorded
      when the run began, and again when it was resumed with a changed model; empty if not recorded.
    - `derived`: how a verb derived its own problem from the user's, as plain data; None if it did
      not.
    - `requirements`: the content of the formulas' requirements, by identifier, as plain data.
    - `model`: a hash of the simulated model, for a problem with requirements.
    - `damage`: a description of unreadable parts of its files; such a run cannot be resumed.
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
        """The checks that a confirmed row has passed, as the end of a sentence; may be empty."""
        return describe_checks(self.checks)

    @property
    def simulations(self) -> int:
        """Number of simulations in the table."""
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
        """The counterexample with the least robustness, or without any the row with the least.

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

        The rate counts violations as simulated, whatever closer replays say about single rows. It
        is a Clopper-Pearson interval if outcomes did not decide the number of simulations,
        otherwise one that is valid whenever sampling stops. A simulation without a verdict counts
        as safe at the lower end of the interval and as failing at the upper end. None unless the
        rows are independent samples of the feature space and at least one has a verdict: a search
        that learns can find failures, but its rows do not estimate a rate. Also None if the run
        went on with a changed model.
        """
        return self._rate(self.table.counts.violating, 0)

    @property
    def confirmed_failure_rate(self) -> "Rate | None":
        """Confirmed failures per simulation with a 95 % interval; as `failure_rate`.

        Refuted rows count as safe. Rows that closer replays left undecided or did not reach count
        as safe at the lower end of the interval and as failing at the upper end. None if no row was
        decided.
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
        """The counterexamples that no other one dominates: with several formulas, the Pareto set.

        They are compared by how far each formula is broken, in the order of the problem's priority;
        without a priority no formula can make up for another. With one formula it is the worst row.

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
        """True if the run went on although its model had changed."""
        return has_several_models(self.sources)

    def changes(self, row: int | None = None) -> tuple[Change, ...]:
        """Return the files of the model that have changed since, with both hashes.

        The present model is that of the run's problem; for a run without it, the files on disk.

        - `row`: the row in question; all rows when left out.
        """
        now = None if self.problem is None else self.problem.sources(git=False)
        return model_changes(self.sources, now, row)

    def changed_since(self, row: int | None = None) -> str:
        """Say in a sentence which files of the model have changed since; empty if none has."""
        return changed_since(self.changes(row), row)

    def compared(self, seen: "Replay") -> "Replay":
        """Return a replay in the run's precision, with the reasons to doubt it.

        Its `changed` names the files of the model that have changed, and its `finding` says if the
        replay does not reproduce the number of its row.
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
        """Name possible reasons for a difference although no file has changed."""
        then = sources_of_row(self.sources, row)
        if then is None or self.problem is None:
            return "the files of its model were not recorded, so it may have changed"
        if versions := then.other_versions(self.problem.sources(git=False)):
            return f"no file of its model has changed, but these versions: {', '.join(versions)}"
        why = "the system has memory, chance or state of its own, or reads what is not recorded"
        if self.engine == "native":
            why = "native code rounds differently, which a chaotic system amplifies"
        return f"no file of its model has changed: {why}"

    def improbability(self, rows: "pd.DataFrame | None" = None) -> "pd.DataFrame":
        """Return how improbable rows of the table are under the prior.

        **Arguments:**
        - `rows`: the rows of the table; all counterexamples when left out.
        **Returns:** a table indexed by row number. `log_density` is the natural logarithm of the
        prior's density (in a constrained space not divided by the accepted share), NaN if a feature
        has no density, such as an automaton. For each column with a distribution `tail.NAME` is the
        probability of a value at least as extreme.
        **Raises:** `ValueError` if neither the problem nor the space of the run is known, and for a
        row outside the space.
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
        """The feature space, from the problem or from the record.

        **Raises:** `ValueError` if neither is known.
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
        return verb("analyze")(self, **options)

    def replay(
        self, row: "int | np.integer | pd.Series | Mapping[str, Any]", precision: str | None = None
    ) -> "Replay":
        """Simulate a row of the table again and return it with its trace.

        - `row`: a row number, or a row of `table.all` (its index is the row number), or any
          mapping with the feature columns.
        - `precision`: `"float32"` or `"float64"`; that of the run when left out.

        A row that MJX simulated is replayed in native MuJoCo if that gives the same number up to
        rounding; `engine` of the replay then says so.

        **Returns:** the replay. Its printed form begins with `changed`, if the model has changed
        since, and with `finding`, if the replay does not reproduce the number of its row.
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
        self, problem: Problem, values: "pd.Series | Mapping[str, Any]", number: int | None,
        precision: str,
    ) -> "Replay":  # fmt: skip
        replay = lazy_import("verifai_jax.evaluation.replay", "replay")
        return replay(problem, values, run_keys(self.seed)[1], number, precision)

    def _natively(
        self, number: int, values: "pd.Series | Mapping[str, Any]", stored: Mapping[str, Any]
    ) -> "Replay | None":
        """Replay a row of MJX in native MuJoCo; None if that gives another robustness.

        MJX compiles a program for it first, for half a minute where there are contacts.
        """
        problem = self.problem
        if problem is None or problem.black_box or "native" not in problem.system.backends:
            return None
        seen = self._replayed(problem.on_backend("native"), values, number, self.precision)
        if finding_of(seen, stored, self._several, ROUNDING):
            return None
        return replace(
            seen, engine="native MuJoCo, which reproduces the number that MJX computed for the row"
        )

    def save_counterexamples(self, folder: str | Path, **options: Any) -> list[Path]:
        """Write counterexamples as small files for version control; returns their paths.

        `vj.replay_counterexamples(problem, folder)` simulates them again.

        **Arguments:**
        - `folder`: the folder, made if there is none.
        - `options`: `max_count`, `shrink` (whether each is shrunk first), and `budget`, the
          simulations to shrink each one.
        **Raises:** `ValueError` for a run without its problem or without a counterexample.
        """
        return verb("save_counterexamples")(self, folder, **options)

    def summary(self) -> str:
        """Write what failed, how often, the worst case and how to replay it."""
        return lazy_import("verifai_jax.falsification.summary", "summarize")(self)

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw the feature space with safe and failing samples; returns the figure."""
        return lazy_import("verifai_jax.pictures.scatter", "plot_features")(self, path)

    def report(self, path: str | Path, **options: Any) -> Path:
        """Write the evidence report of the run: an HTML file, with its claims as JSON next to it.

        **Arguments:**
        - `path`: the path of the HTML file.
        - `options`: the options of `reports.write_report`: `units` and `reasons` of features,
          `traces`, `studies`, `modes`, `odd`, `assessment`.
        **Returns:** the path.
        """
        return verb("report")(self, path, **options)

    def explore(self) -> Any:
        """Return a view of the table for a notebook: scatter, parallel coordinates, traces.

        Hovering over a row shows its values; clicking on it simulates it again. It needs anywidget
        (extra `widget`); without it the result is the picture of `plot`.
        """
        return verb("explore")(self)

    def save(self, path: str | Path) -> Path:
        """Write the run to a folder: its record, table and state; returns the folder.

        **Raises:** `FolderInUse` if another process writes there; `ValueError` if it is the run's
        own folder and the run there has been continued meanwhile; `OSError` if the file system
        refuses, for example because the disk is full: the earlier content of the folder then stays.
        """
        return lazy_import("verifai_jax.falsification.run_folder", "save_run")(self, Path(path))

    def _more_findings(self) -> dict[str, Any]:
        """Return what a run of another verb has found besides, as plain data."""
        return {}

    def _notebook_parts(self) -> Iterator[str]:
        yield from self.table._notebook_parts()

    def __repr__(self) -> str:
        return self.summary()
