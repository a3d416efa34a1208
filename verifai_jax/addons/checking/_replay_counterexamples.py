"""Replay of a corpus of counterexamples on the present problem.

result = replay_counterexamples(problem, "counterexamples", rename={"mass": "payload"})
result.failing, result.fixed, result.invalid
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from verifai_jax.addons.checking.corpus import (
    SavedCounterexample,
    is_elsewhere,
    read_corpus,
    renamed,
)
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.messages.text import format_error, one_line, printable
from verifai_jax.core.user_code.sources import Change, Sources
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.confirmer import Confirmer
from verifai_jax.evaluation.resimulate import HostReplays, Replays
from verifai_jax.features import FeatureSpace
from verifai_jax.features.given import given_features
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd
FAILING, FIXED, WITHOUT_VERDICT = "failing", "fixed", "without a verdict"
INVALID, OTHER = "no longer valid", "of another problem"
"""What may be said of a file."""
CLOSE = 1e-4
"""Share of a feature's value by which a point of the space may differ from it, for rounding."""


@dataclass(frozen=True)
class ReplayedCounterexample:
    """One file of a corpus, replayed.

    - `path`: the path of the file.
    - `state`: `"failing"`, `"fixed"`, `"without a verdict"`, `"no longer valid"` or `"of another
      problem"`.
    - `robustness`: the least robustness now; NaN without a verdict.
    - `before`: the least robustness when the file was saved.
    - `note`: a text on changes or errors.
    - `changed`: whether the model has changed since the file was saved.
    """

    path: Path
    state: str
    robustness: float
    before: float
    note: str = ""
    changed: bool = False


@dataclass(frozen=True, eq=False)
class CorpusReplay(InNotebook):
    """The result of replaying a corpus against a problem, as `replay_counterexamples` returns it.

    - `problem`: the name of the problem.
    - `folder`: the folder or file.
    - `replayed`: a `ReplayedCounterexample` for each file.
    """

    problem: str
    folder: Path
    replayed: tuple[ReplayedCounterexample, ...]

    def of(self, state: str) -> tuple[ReplayedCounterexample, ...]:
        """Return the files in this state."""
        return tuple(one for one in self.replayed if one.state == state)

    @property
    def failing(self) -> tuple[ReplayedCounterexample, ...]:
        """Files whose simulation still breaks a formula."""
        return self.of(FAILING)

    @property
    def fixed(self) -> tuple[ReplayedCounterexample, ...]:
        """Files whose simulation now keeps all formulas."""
        return self.of(FIXED)

    @property
    def invalid(self) -> tuple[ReplayedCounterexample, ...]:
        """Files whose features do not fit the problem any more, or that cannot be read."""
        return self.of(INVALID)

    @property
    def passed(self) -> bool:
        """True if every file of this problem was simulated and is fixed."""
        return all(one.state in (FIXED, OTHER) for one in self.replayed)

    @property
    def table(self) -> "pd.DataFrame":
        """One row for each file."""
        import pandas as pd

        columns = ("path", "state", "robustness", "before", "note")
        return pd.DataFrame({c: [getattr(one, c) for one in self.replayed] for c in columns})

    def __str__(self) -> str:
        count = len(self.replayed) - len(self.of(OTHER))
        states = (FAILING, FIXED, WITHOUT_VERDICT, INVALID)
        counts = ", ".join(f"{len(self.of(state))} {state}" for state in states if self.of(state))
        plural = "s" * (count != 1)
        lines = [f"{self.problem}: {count} counterexample{plural} in {self.folder}"]
        lines[0] += f": {counts}" if count else ""
        if changed := sum(one.changed for one in self.replayed):
            lines.append(f"  the model has changed since {changed} of them were saved")
        for one in self.replayed:
            if one.state == OTHER:
                continue
            robustness = "" if np.isnan(one.robustness) else f", robustness {one.robustness:z.4g}"
            was = "unknown" if np.isnan(one.before) else f"{one.before:z.4g}"
            before = f" (was {was})" if robustness else ""
            note = f": {one.note}" if one.note else ""
            lines.append(f"  {one.path.name}  {one.state}{robustness}{before}{note}")
        if others := len(self.of(OTHER)):
            lines.append(f"  {others} more file{'s' * (others != 1)} of other problems")
        return printable("\n".join(lines))

    __repr__ = __str__


@suggests_options
@shows_progress("replaying the counterexamples of", "replays")
def replay_counterexamples(
    problem: Problem, folder: str | Path, *, rename: Mapping[str, str] | None = None,
    progress: bool | None = None,
) -> CorpusReplay:  # fmt: skip
    """Simulate the counterexamples of a corpus again, all in one batch.

    Each is simulated with its features and its random key. A file whose features no longer fit the
    space is reported as no longer valid, with the reason. If its formulas have changed it is judged
    by the present ones, with a note. Files of problems with other names, and of those of the same
    name in another file or variable, are only counted.

    **Arguments:**
    - `problem`: the present problem.
    - `folder`: the folder that `run.save_counterexamples` wrote into, or one file of it.
    - `rename`: a dictionary from old names of features to new ones.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Raises:** `FileNotFoundError` for a path that does not exist; `TypeError` for anything that is
    not a `Problem`.
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"replay_counterexamples needs a Problem; got {type(problem).__name__}")
    entries, damaged = read_corpus(folder)
    results: _Replayed = {}
    for path, reason in damaged.items():
        results[path] = ReplayedCounterexample(path, INVALID, np.nan, np.nan, reason)
    batches: dict[tuple[int, str, str | None], _Batch] = {}
    for path, entry in entries.items():
        if entry.problem != problem.name or is_elsewhere(entry, problem):
            results[path] = ReplayedCounterexample(path, OTHER, np.nan, _lowest(entry))
            continue
        columns = renamed(entry.features, rename or {})
        reason = _misfit(problem.space, columns)
        if reason:
            results[path] = ReplayedCounterexample(path, INVALID, np.nan, _lowest(entry), reason)
            continue
        together = (entry.seed, entry.precision, entry.backend)
        batches.setdefault(together, []).append((path, entry, columns))
    for (seed, precision, backend), batch in batches.items():
        replay = partial(_replay_batch, problem, seed, precision, backend)
        results |= _replay_each(problem, replay, batch)
    ordered = tuple(results[path] for path in sorted(results))
    return CorpusReplay(problem.name, Path(folder), ordered)


_Batch: TypeAlias = list[tuple[Path, SavedCounterexample, Any]]
"""Files that are replayed together, with their entries and columns."""
_Replayed: TypeAlias = dict[Path, ReplayedCounterexample]


def _replay_each(
    problem: Problem, replay: Callable[[_Batch], _Replayed], batch: _Batch
) -> _Replayed:
    """Replay counterexamples together; where that fails one by one, to name those that fail."""
    try:
        return replay(batch)
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        problem.check()  # What is wrong with the problem is no fault of a file.
        if len(batch) == 1:
            ((path, entry, _),) = batch
            reason = one_line(format_error(error))
            return {path: ReplayedCounterexample(path, INVALID, np.nan, _lowest(entry), reason)}
    results: _Replayed = {}
    for each in batch:
        results |= _replay_each(problem, replay, [each])
    return results


def _replay_batch(
    problem: Problem, seed: int, precision: str, backend: str | None, batch: _Batch
) -> _Replayed:
    """Replay counterexamples of one seed, precision and backend."""
    problem = resolved(problem, wanted=backend).problem
    rows = {
        name: np.array([np.nan if c[name] is None else c[name] for _, _, c in batch])
        for name in problem.space.columns
    }
    features = problem.space.features_of(rows, precision)
    key = run_keys(seed)[1]
    if problem.black_box:
        replays: Replays | HostReplays = HostReplays(problem, precision, key)
    else:
        replays = Replays(problem, precision, key)
    numbers = np.array([entry.row for _, entry, _ in batch], np.int32)
    [verdicts] = replays(1, [features], numbers)
    failing = np.flatnonzero(verdicts.violated)
    rho = {**rows, "rho": verdicts.lowest}
    found = Confirmer(problem, precision, seed)(
        {name: column[failing] for name, column in rho.items()}, numbers[failing]
    )
    refused = {
        int(i): str(why)
        for i, why, lost in zip(failing, found.why, found.refuse()[0], strict=True)
        if lost
    }
    formulas = {name: str(formula) for name, formula in problem.formulas.items()}
    now = problem.sources()
    results = {}
    for i, (path, entry, _) in enumerate(batch):
        status = Status(int(verdicts.status[i]))
        notes = []
        changes = _changes(entry, now)
        if entry.formulas != formulas:
            notes.append(f"the formulas were {one_line(', '.join(entry.formulas.values()))}")
        state, robustness = WITHOUT_VERDICT, np.nan
        if status == Status.OK:
            robustness = float(np.min(verdicts.rho[i]))
            state = FAILING if bool(verdicts.violated[i]) else FIXED
            if entry.formulas == formulas:
                notes += _not_again(path, entry, changes, robustness)
            if i in refused:
                state = WITHOUT_VERDICT
                notes.append(f"closer replays do not confirm it: {refused[i]}")
        else:
            message = "" if verdicts.messages is None else verdicts.messages[i]
            notes.append(message or status.name.lower())
        results[path] = ReplayedCounterexample(
            path, state, robustness, _lowest(entry), "; ".join(notes), bool(changes)
        )
    return results


def _changes(entry: SavedCounterexample, now: Sources) -> tuple[Change, ...] | None:
    """Return the changes since a counterexample was saved, or None if they are unknown."""
    recorded = entry.found.get("sources")
    try:
        return Sources.from_json(recorded).changes(now) if recorded else None
    except ValueError:
        return None  # Somebody has edited it.


def _not_again(
    path: Path, entry: SavedCounterexample, changes: tuple[Change, ...] | None, robustness: float
) -> list[str]:
    """Say that the same model gives another number than when a counterexample was saved."""
    before = _lowest(entry)
    near = abs(robustness - before) <= CLOSE * max(1.0, abs(before))
    if changes is None or changes or near or np.isnan(before):
        return []
    if path.name != entry.name:  # Its name says by a digest what was saved.
        return ["it does not give its number again: the file was edited or renamed since"]
    return [
        "it does not give its number again, though no file of its model has changed: the system "
        "has memory, chance or state of its own, or reads what is not recorded"
    ]


def _lowest(entry: SavedCounterexample) -> float:
    values = [value for value in entry.robustness.values() if isinstance(value, int | float)]
    return float(min(values, default=np.nan))


def _misfit(space: FeatureSpace, columns: Mapping[str, Any]) -> str:
    """Return why the space has no place for a counterexample; empty if it has."""
    try:
        return _why_not_in(space, columns)
    except (ValueError, TypeError, KeyError, OverflowError, AttributeError) as error:
        # Such as a text where the space has a number.
        return one_line(format_error(error))


def _why_not_in(space: FeatureSpace, columns: Mapping[str, Any]) -> str:
    missing = [name for name in space.columns if name not in columns]
    unknown = [name for name in columns if name not in space.columns]
    if missing or unknown:
        parts = [f"the space has no feature {', '.join(unknown)}"] if unknown else []
        parts += [f"the file has no {', '.join(missing)}"] if missing else []
        advice = ""
        if len(missing) == len(unknown) == 1:
            advice = f"; if it was renamed, rename={{{unknown[0]!r}: {missing[0]!r}}}"
        return " and ".join(parts) + advice
    row = {name: np.nan if columns[name] is None else columns[name] for name in space.columns}
    try:
        # Exactly what was simulated, where no point of the cube is it.
        given_features(space, row)
        return ""
    except ValueError:
        pass  # Said with the nearest features that there are.
    try:
        # Some domains go on beyond the cube.
        u = np.clip(np.asarray(space.point_of(space.from_row(row))), 0.0, 1.0)
        there = space.rows(space.features_at(u[None]))
    except (ValueError, TypeError, KeyError) as error:
        return format_error(error)
    for name, value in row.items():
        back = there[name][0]
        if isinstance(value, str) or isinstance(back, str):
            same = value == back
        else:
            same = bool(np.isclose(float(value), back, rtol=CLOSE, atol=CLOSE, equal_nan=True))
        if not same:
            return f"{name} = {value} is not in the space any more; the nearest there is {back}"
    if space.constraint is not None and not bool(space.constraint(u[None])[0]):
        return "the constraint of the space refuses its features"
    return ""
