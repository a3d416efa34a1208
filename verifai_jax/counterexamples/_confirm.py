"""The confirmation of counterexamples by finer replays.

    print(confirm(run, run.best))                       # one row
    confirm(run).table                                  # all of them, a row each
    confirm(run, engines="all").transferable            # which fail in every engine

`verifai_jax.evaluation.confirmer` describes the checks.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, overload

import numpy as np
import pandas as pd

from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.counterexamples.selection import Row
from verifai_jax.evaluation.backends import Engines, resolved
from verifai_jax.evaluation.confirmations import Confirmation, Confirmations, Repetitions
from verifai_jax.evaluation.confirmer import Confirmer
from verifai_jax.falsification.run import Run

BLOCK = 128
"""Number of rows that are checked at once; finished blocks survive Ctrl-C."""


@overload
def confirm(
    run: Run,
    row: None = None,
    *,
    engines: Engines = None,
    max_rows: int | None = None,
    progress: bool | None = None,
) -> Confirmations: ...
@overload
def confirm(
    run: Run,
    row: int | np.integer | pd.Series | Mapping[str, Any],
    *,
    engines: Engines = None,
    max_rows: int | None = None,
    progress: bool | None = None,
) -> Confirmation: ...
@suggests_options
@shows_progress("confirming", "replays")
def confirm(
    run: Run, row: Row = None, *, engines: Engines = None, max_rows: int | None = None,
    progress: bool | None = None,
) -> Confirmation | Confirmations:  # fmt: skip
    """Replay counterexamples more precisely than they were found, and decide which are real.

    **Arguments:**
    - `run`: a run of a problem.
    - `row`: a row number, a row of the table, or a mapping with its feature columns; all
      counterexamples of the table when left out.
    - `engines`: engines that have to agree: names of other backends, such as `"mjx"` or `"native"`,
      `"all"` for those that are installed, another system for the same features and signals, a
      problem with one, or several of these by name. A failure that is confirmed in each of them is
      `transferable`.
    - `max_rows`: maximum number of rows to replay, the worst and the first ones; all of them, also
      those that the run left out, by default.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Returns:** a `Confirmation` for a row, `Confirmations` for all; after Ctrl-C the finished
    ones.
    **Raises:** `ValueError` for a run without its problem, a row that is not a counterexample, or
    an engine that does not fit; `IndexError` for a row that is not in the table.
    """
    if max_rows is not None:
        check_count("max_rows", max_rows)
    if not isinstance(run, Run):
        raise TypeError(f"confirm needs a Run; got {type(run).__name__}")
    if run.problem is None:
        raise ValueError(
            f"the run of {run.name!r} was loaded without its problem, which has to be simulated "
            "again; give it: vj.load(path, problem)"
        )
    # On the backend of the run, whose verdicts these are.
    problem = resolved(run.problem, wanted=run.backend).problem
    confirmer = Confirmer(problem, run.precision, run.seed, engines=engines)
    known = run.table.counts.repetitions
    confirmer.wavers, confirmer.flips = known.moved > 0, known.lost > 0
    if row is None:
        return _with_changes_of_all(run, _all(run, confirmer, max_rows))
    return _with_changes(run, _one(run, confirmer, row))


def _with_changes(run: Run, found: Confirmation) -> Confirmation:
    """Return a confirmation that notes a changed model or a robustness that does not come again."""
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
    number, values = run.table.entry(row)
    entries = {str(name): value for name, value in values.items()}
    _check_fails(number, entries)
    columns = {name: np.asarray([value]) for name, value in entries.items()}
    found = confirmer(columns, [0 if number is None else number])
    rho = {name: float(values[0]) for name, values in found.rho.items()}
    return Confirmation(
        name=run.name,
        row=number,
        verdict=str(found.verdict[0]),
        rho={"as_run": float(found.run_rho[0]), **rho},
        band=float(found.band[0]),
        why=str(found.why[0]),
        notes=(*found.notes, *_repetitions(confirmer, found)),
        precision=run.precision,
    )


def _repetitions(confirmer: Confirmer, found: Confirmations) -> tuple[str, ...]:
    """Return a note if a host system did not give the numbers of the run again."""
    again = found.rho.get("again")
    if not confirmer.problem.black_box or again is None or np.any(np.isnan(found.run_rho)):
        return ()
    note = str(Repetitions.count(found.run_rho, again, found.verdict))
    return (note,) if note else ()


def _check_fails(number: int | None, values: Mapping[str, Any]) -> None:
    """Refuse a row of the table that did not fail."""
    if "status" not in values or "violated" not in values:
        return
    which = "this row" if number is None else f"row {number}"
    if values["status"] != "ok":
        raise ValueError(
            f"{which} is not a counterexample: its simulation has no verdict ({values['status']})"
        )
    if not values["violated"]:
        raise ValueError(
            f"{which} is not a counterexample: it keeps the property with robustness "
            f"{values['rho']:z.4g}; confirm(run) checks those that do not"
        )


def _all(run: Run, confirmer: Confirmer, limit: int | None) -> Confirmations:
    failing = run.table.not_refused
    numbers, rho = failing.index.to_numpy(), failing["rho"].to_numpy(np.float64)
    columns = {str(name): failing[name].to_numpy() for name in failing.columns}
    found = Confirmations.blank(run.name, numbers, rho)
    worst = np.argmin(rho) if len(rho) else 0
    order, done = np.argsort(np.arange(len(rho)) != worst, kind="stable"), 0
    order, left = np.split(order, [len(order) if limit is None else limit])
    notes: dict[str, None] = {}
    if len(left):
        notes[f"{len(left)} of {len(rho)} were not replayed, as max_rows is {limit}"] = None
        found.why[left] = next(iter(notes))
    try:
        for start in range(0, len(order), BLOCK):
            block = order[start : start + BLOCK]
            taken = {name: column[block] for name, column in columns.items()}
            part = confirmer(taken, numbers[block])
            found.put(block, part)
            notes |= dict.fromkeys(part.notes)
            done += len(block)
    except KeyboardInterrupt:
        stopped = f"interrupted after {done} rows"
        found.why[order[done:]] = stopped
        notes |= {stopped: None}
    wavering = _repetitions(confirmer, found)
    return replace(
        found, notes=(*wavering, *notes), checks=confirmer.check_names, wavering=wavering
    )
