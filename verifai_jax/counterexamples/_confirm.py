"""The confirmation of counterexamples by finer replays.

    print(confirm(run, run.best))                       # one row, in words
    confirm(run).table                                  # all of them, a row each
    confirm(run, 12, simulator="native")                # also by another simulator

`verifai_jax.evaluation.confirmation` says what is checked.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias, overload

import numpy as np
import pandas as pd
from jaxtyping import Float

from verifai_jax.core.errors import suggests_options
from verifai_jax.core.notebook import InNotebook
from verifai_jax.core.progress import shows_progress
from verifai_jax.counterexamples.selection import Row
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.confirmation import Confirmer
from verifai_jax.evaluation.confirmation_verdicts import (
    IN_WORDS,
    MEANING,
    VERDICTS,
    Checked,
    Repetitions,
)
from verifai_jax.falsification.run import Run
from verifai_jax.problem.problem import Problem

BLOCK = 128
"""Rows of a run that are checked at once; what is finished survives Ctrl-C."""
SHOWN = 5
"""Reasons of doubtful rows listed in words."""

Simulator: TypeAlias = Callable[..., Any] | Problem | str | None
"""A system, a problem with one, or the name of a backend."""


@dataclass(frozen=True, repr=False)
class Confirmation(InNotebook):
    """The verdict of finer replays on one counterexample.

    **Fields:**

    - `name`: of the problem.
    - `row`: its number in the table; None for features without one.
    - `verdict`: `"confirmed"`, `"refuted"`, `"fragile"` or `"raised"`.
    - `rho`: robustness `as_run`, NaN where that is not known, and of each check by name.
    - `band`: how far the robustness moved between the replays.
    - `why`: the reason of the verdict, in words.
    - `notes`: checks that could not be made, and why.
    - `precision`: of the run.
    - `changed`, `finding`: as in `Replay`, of the row simulated again in the run's precision; the
      second is looked for where the model has changed or the verdict is not `"confirmed"`.
    """

    name: str
    row: int | None
    verdict: str
    rho: dict[str, float]
    band: float
    why: str
    notes: tuple[str, ...]
    precision: str = "float32"
    changed: str = ""
    finding: str = ""

    @property
    def confirmed(self) -> bool:
        """True where the counterexample failed in every replay."""
        return self.verdict == "confirmed"

    def __str__(self) -> str:
        which = f"row {self.row} of {self.name}" if self.row is not None else f"{self.name}"
        text = f"{which}: {self.verdict}, {MEANING[self.verdict]}"
        if self.why and self.why not in self.notes:
            text += f": {self.why}"
        words = {"as_run": f"as run ({self.precision})", **IN_WORDS}
        values = [f"{rho:z.4g} {words[n]}" for n, rho in self.rho.items() if not np.isnan(rho)]
        text += f". Robustness {', '.join(values)}" if values else ""
        text = ". ".join([text, *(note[0].upper() + note[1:] for note in self.notes)]) + "."
        return "\n".join([*(each for each in (self.changed, self.finding) if each), text])

    __repr__ = __str__


@dataclass(frozen=True, eq=False)
class Confirmations(InNotebook):
    """The verdicts of finer replays on all counterexamples of a run.

    **Fields:**

    - `name`: of the problem.
    - `table`: a row each, indexed by row number: `verdict`, `rho` as run, `rho.NAME` of each check,
      `band`, `why`.
    - `notes`: checks that could not be made, and why.
    - `checked`: the checks that a confirmed row has passed, in words.
    - `changed`, `finding`: as in `Confirmation`, of the worst row that is not confirmed, or the
      worst of all.
    - `wavering`: whether and how a host system did not give the numbers of the run again, in words;
      the first of `notes`, where it is one.
    """

    name: str
    table: pd.DataFrame = field(repr=False)
    notes: tuple[str, ...]
    checked: str = ""
    changed: str = ""
    finding: str = ""
    wavering: tuple[str, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows with each verdict that occurs."""
        counted = Counter(self.table["verdict"])
        return {verdict: counted[verdict] for verdict in VERDICTS if counted[verdict]}

    @property
    def confirmed(self) -> pd.DataFrame:
        """The rows that fail in every replay."""
        return self.table.loc[self.table["verdict"] == "confirmed"]

    def __len__(self) -> int:
        return len(self.table)

    def __str__(self) -> str:
        warnings = [text for text in (self.changed, self.finding) if text]
        if not len(self):
            return "\n".join([*warnings, f"{self.name}: no counterexample to confirm"])
        counts = ", ".join(
            f"{count} {verdict}{f' {self.checked}' if verdict == 'confirmed' else ''}"
            for verdict, count in self.counts.items()
        )
        lines = [*warnings, f"{self.name}: of {_counted(len(self))}, {counts}"]
        doubtful = self.table.loc[~self.table["verdict"].isin(["confirmed", "unexamined"])]
        reasons = [
            (rows.index, str(verdict), str(why))
            for (verdict, why), rows in doubtful.groupby(["verdict", "why"], sort=False)  # pyright: ignore[reportGeneralTypeIssues]
        ]
        for rows, verdict, why in reasons[:SHOWN]:
            more = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
            lines.append(f"  row {rows[0]}{more} {verdict}: {why}")
        if len(reasons) > SHOWN:
            rest = sum(len(rows) for rows, _, _ in reasons[SHOWN:])
            lines.append(f"  and {rest} more: see .table")
        lines += [f"  note: {note}" for note in self.notes]
        if len(self.confirmed):
            worst = self.confirmed["rho"].idxmin()
            lines.append(
                f"  the worst confirmed is row {worst}, robustness "
                f"{self.confirmed.loc[worst, 'rho']:z.4g}: run.replay({worst}) shows it"
            )
        return "\n".join(lines)

    __repr__ = __str__


@overload
def confirm(
    run: Run,
    row: None = None,
    *,
    simulator: Simulator = None,
    most: int | None = None,
    progress: bool | None = None,
) -> Confirmations: ...
@overload
def confirm(
    run: Run,
    row: int | np.integer | pd.Series | Mapping[str, Any],
    *,
    simulator: Simulator = None,
    most: int | None = None,
    progress: bool | None = None,
) -> Confirmation: ...
@suggests_options
@shows_progress("confirming", "replays")
def confirm(
    run: Run,
    row: Row = None,
    *,
    simulator: Simulator = None,
    most: int | None = None,
    progress: bool | None = None,
) -> Confirmation | Confirmations:
    """Replay counterexamples more finely than they were found, and decide which are real.

    **Arguments:**

    - `run`: a run of a problem.
    - `row`: a row number, a row of the table, or a mapping with its feature columns; all
      counterexamples of the table when left out.
    - `simulator`: another system for the same features and signals, a problem with one, or the
      name of another backend, that has to agree.
    - `most`: how many rows are replayed at least, by default 256, and more where a row takes few
      replays; of more, the worst and those nearest to zero, until the rest
      is far from it (see `confirmation.Confirmer`).
    - `progress`: show what is going on, in one line; by default on a terminal, in a notebook, and
      once a minute elsewhere.

    **Returns:** a `Confirmation` for a row, `Confirmations` for all; after Ctrl-C what is finished.

    **Raises:** `ValueError` for a run without its problem, a row that is no counterexample, a
    simulator that does not fit; `IndexError` for a row that is not in the table.
    """
    if not isinstance(run, Run):
        raise TypeError(f"confirm needs a Run; got {type(run).__name__}")
    if run.problem is None:
        raise ValueError(
            f"the run of {run.name!r} was loaded without its problem, which has to be simulated "
            "again; give it: vj.load(path, problem)"
        )
    # On the backend of the run, whose verdicts these are.
    problem = resolved(run.problem, wanted=run.backend).problem
    confirmer = Confirmer(problem, run.precision, run.seed, simulator=simulator, most=most)
    known = run.table.counts.repetitions
    confirmer.wavers, confirmer.flips = known.moved > 0, known.lost > 0
    if row is None:
        return _with_changes_of_all(run, _all(run, confirmer))
    return _with_changes(run, _one(run, confirmer, row))


def _with_changes(run: Run, found: Confirmation) -> Confirmation:
    """Return a confirmation that says whether the model, or the number of the row, is another."""
    if found.row is None:
        return found
    changed = run.changed_since(found.row)
    looked_at = changed or not found.confirmed
    finding = _finding(run, found.row) if looked_at else ""
    return replace(found, changed=changed, finding=finding)


def _with_changes_of_all(run: Run, found: Confirmations) -> Confirmations:
    changed = run.changed_since()
    table = found.table.loc[found.table["verdict"] != "unexamined"]
    doubtful = table.loc[table["verdict"] != "confirmed"]
    rows = doubtful if len(doubtful) else table
    looked_at = len(rows) and (changed or len(doubtful))
    finding = _finding(run, int(rows["rho"].idxmin())) if looked_at else ""  # pyright: ignore[reportArgumentType]
    return replace(found, changed=changed, finding=finding)


def _finding(run: Run, row: int) -> str:
    try:
        return run.replay(row).finding
    except Exception:  # A system may raise whatever it likes; the verdict says so.
        return ""


def _one(
    run: Run, confirmer: Confirmer, row: int | np.integer | pd.Series | Mapping[str, Any]
) -> Confirmation:
    number: int | None
    if isinstance(row, (int, np.integer)):
        number, values = int(row), run.table.row(int(row))
    else:
        name = getattr(row, "name", None)
        number, values = int(name) if isinstance(name, int | np.integer) else None, row
    entries = {str(name): value for name, value in values.items()}
    _check_fails(number, entries)
    columns = {name: np.asarray([value]) for name, value in entries.items()}
    checked = confirmer(columns, [0 if number is None else number])
    rho = {"as_run": float(columns["rho"][0]) if "rho" in columns else float("nan")}
    rho |= {name: float(values[0]) for name, values in checked.rho.items()}
    as_run = np.array([rho["as_run"]])
    notes = (*checked.notes, *_own(confirmer, as_run, checked.rho, checked.verdict))
    return Confirmation(
        run.name, number, str(checked.verdict[0]), rho, float(checked.band[0]), checked.why[0],
        notes, run.precision,
    )  # fmt: skip


def _own(
    confirmer: Confirmer,
    rho: Float[np.ndarray, " n"],
    replayed: Mapping[str, Float[np.ndarray, " n"]],
    verdict: np.ndarray,
) -> tuple[str, ...]:
    """Return a note where a host system did not give the numbers of the run again."""
    if not confirmer.problem.black_box or "again" not in replayed or np.any(np.isnan(rho)):
        return ()
    note = str(Repetitions.count(rho, replayed["again"], verdict))
    return (note,) if note else ()


def _check_fails(number: int | None, values: Mapping[str, Any]) -> None:
    """Refuse a row of the table that did not fail."""
    if "status" not in values or "violated" not in values:
        return
    which = "this row" if number is None else f"row {number}"
    if values["status"] != "ok":
        raise ValueError(
            f"{which} is no counterexample: its simulation has no verdict ({values['status']})"
        )
    if not values["violated"]:
        raise ValueError(
            f"{which} is no counterexample: it keeps the property with robustness "
            f"{values['rho']:z.4g}; confirm(run) checks those that do not"
        )


def _all(run: Run, confirmer: Confirmer) -> Confirmations:
    failing = run.table.counterexamples
    numbers, rho = failing.index.to_numpy(), failing["rho"].to_numpy(np.float64)
    columns = {str(name): failing[name].to_numpy() for name in failing.columns}
    order = np.argsort(np.abs(rho), kind="stable")
    parts: list[tuple[np.ndarray, Checked]] = []
    stopped: tuple[str, ...] = ()
    try:
        for start in range(0, len(order), BLOCK):
            block = order[start : start + BLOCK]
            taken = {name: column[block] for name, column in columns.items()}
            parts.append((block, confirmer(taken, numbers[block])))
    except KeyboardInterrupt:
        stopped = (f"interrupted after {sum(len(block) for block, _ in parts)} rows",)
    count = len(order)
    frame = pd.DataFrame(
        {"verdict": np.full(count, "unexamined", object), "rho": rho}, index=failing.index
    )
    for name in parts[0][1].rho if parts else ():
        frame[f"rho.{name}"] = _placed(parts, count, lambda checked, n=name: checked.rho[n])
    frame["band"] = _placed(parts, count, lambda checked: checked.band)
    frame["why"] = np.full(count, stopped[0] if stopped else "", object)
    for block, checked in parts:
        frame.iloc[block, frame.columns.get_loc("verdict")] = checked.verdict
        frame.iloc[block, frame.columns.get_loc("why")] = np.array(checked.why, object)
    notes = tuple(dict.fromkeys(note for _, checked in parts for note in checked.notes))
    wavering: tuple[str, ...] = ()
    if "rho.again" in frame:
        again = {"again": frame["rho.again"].to_numpy(np.float64)}
        wavering = _own(confirmer, rho, again, frame["verdict"].to_numpy())
    notes = (*wavering, *notes, *stopped)
    return Confirmations(run.name, frame, notes, confirmer.checked, wavering=wavering)


def _placed(
    parts: list[tuple[np.ndarray, Checked]], count: int, column: Callable[[Checked], np.ndarray]
) -> Float[np.ndarray, " n"]:
    values = np.full(count, np.nan)
    for block, checked in parts:
        values[block] = column(checked)
    return values


def _counted(count: int) -> str:
    return "1 counterexample" if count == 1 else f"{count} counterexamples"
