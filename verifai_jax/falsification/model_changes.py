"""Changes of a run's model since it ran, and rows whose replay gives another number.

    sources_of_row(run.sources, 417)                    # what row 417 was simulated with
    finding_of(seen, stored, several=False)             # "" where a replay gives the row's number

A run records its model for each part that was simulated without interruption.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.core.user_code.sources import Change, Sources, list_changes
from verifai_jax.core.values.trace import Status
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    from verifai_jax.evaluation.replay import Replay
ROUNDING = 1e-4
"""Share of the signals by which a replay may differ where JAX compiles it: alone it rounds
otherwise than in a batch, and some systems make that grow."""
EXACT = 1e-6
"""The same for a black box, which runs the same code; its numbers are stored as float32."""
NEAR = 1e-3
"""The same for a replay in another precision; above it, the run's own precision is tried."""
EVEN = "even_if_changed=True (--even-if-changed) continues regardless, and notes it in the record"
"""Advice on continuing with another model."""


class SourcesWhenAsked(Sequence[Mapping[str, Any]]):
    """The record of the model of a run without a folder, made when somebody asks for it.

    Modules are hashed as they were imported, and declared files as they were read, so it is the
    same then.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem

    @cached_property
    def _parts(self) -> tuple[Mapping[str, Any], ...]:
        return (self._problem.sources().to_json(),)

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: Any) -> Any:
        return self._parts[index]


def sources_of_row(recorded: Sequence[Mapping[str, Any]], row: int) -> Sources | None:
    """Return the files that a row of a run was simulated with; None if they are not recorded."""
    parts = [Sources.from_json(part) for part in recorded]
    return next((part for part in reversed(parts) if part.first <= row), None)


def model_changes(
    recorded: Sequence[Mapping[str, Any]], now: Sources | None, row: int | None = None
) -> tuple[Change, ...]:
    """Return the files of a result's model that have changed.

    **Arguments:**
    - `recorded`: the files recorded by the run or the sweep.
    - `now`: the present files of the model; without it the files on disk are read.
    - `row`: the row of a run; if None, every model that the run was simulated with.
    **Returns:** the changes; empty if nothing is recorded.
    """
    parts = [Sources.from_json(part) for part in recorded]
    if row is not None:
        parts = [part for part in parts if part.first <= row][-1:]
    if not parts:
        return ()
    return tuple(dict.fromkeys(change for part in parts for change in part.changes(now)))


def continued_with(
    name: str, recorded: Sequence[Mapping[str, Any]], problem: Problem, rows: int,
    even_if_changed: bool,
) -> tuple[tuple[Mapping[str, Any], ...], str]:  # fmt: skip
    """Return the models' record for a continued run, and a note if the model has changed.

    **Arguments:**
    - `name`: the name of the run.
    - `recorded`: the record of the run.
    - `problem`: the problem with which the run goes on.
    - `rows`: number of rows that the run has.
    - `even_if_changed`: whether a changed model is accepted.
    **Raises:** `ValueError` for a changed model that is not accepted.
    """
    now = problem.sources(first=rows)
    if not recorded:
        # Nobody knows what the rows before were made of, and these are not to be taken for it.
        return (now.to_json(),) if not rows else (), ""
    before = Sources.from_json(recorded[-1])
    changes = before.changes(now)
    if changes and not even_if_changed:
        raise ValueError(
            f"the run of {name!r} cannot go on: its model has changed since it ran: "
            f"{list_changes(changes)}. Begin a new run, or restore the files; {EVEN}"
        )
    versions = before.other_versions(now)
    if not changes and not versions:
        return tuple(recorded), ""
    parts = [f"another model: {list_changes(changes)}"] if changes else []
    parts += [f"other versions: {', '.join(versions)}"] if versions else []
    kept = [part for part in recorded if int(part["first"]) < rows]
    return (*kept, now.to_json()), f"from row {rows} on with {' and '.join(parts)}"


def has_several_models(recorded: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether rows of a run come from several models, so that they sample no single one."""
    if len(recorded) < 2:
        return False
    parts = [Sources.from_json(part) for part in recorded]
    return any(before.changes(after) for before, after in pairwise(parts))


def changed_since(changes: Sequence[Change], row: int | None, what: str = "the run") -> str:
    """Describe how the model has changed; empty if it has not."""
    if not changes:
        return ""
    when = what if row is None else f"row {row} was simulated"
    return f"The model has changed since {when}: {list_changes(changes)}."


def finding_of(
    seen: "Replay", stored: Mapping[str, Any], several: bool, near: float | None = None
) -> str:
    """Describe how a replay differs from its row; empty if it does not.

    **Arguments:**
    - `seen`: the replay, in the precision of the run unless `near` is given.
    - `stored`: the row of the table.
    - `several`: whether the problem has several formulas.
    - `near`: share of the signals by which the number may differ; by default that of rounding.
    """
    before = str(stored.get("status", "ok"))
    now = seen.status.name.lower()
    if before != now:
        return f"Row {seen.row} does not end as it did: {now} here, {before} in the table"
    if seen.status != Status.OK:
        return ""
    verbs = {True: "violates", False: "keeps"}
    violated = bool(stored["violated"]) if "violated" in stored else seen.violated
    usual = EXACT if seen.problem.black_box else ROUNDING
    rounding = (usual if near is None else near) * _scale(seen)
    for name, rho in seen.rho.items():
        was = float(stored[f"rho.{name}"] if several else stored["rho"])
        # Infinite where a formula says nothing of the trace.
        if rho != was and not abs(rho - was) <= rounding:
            return (
                f"Row {seen.row} does not give its number again: robustness {rho:z.6g} here, "
                f"{was:z.6g} in the table"
            )
    if violated != seen.violated:
        return (
            f"Row {seen.row} does not give its verdict again: it {verbs[seen.violated]} the "
            f"property here, and {verbs[violated]} it in the table, both by less than rounding"
        )
    return ""


def _scale(seen: "Replay") -> float:
    """Return the greatest number in the formulas' signals, to which rounding is relative."""
    values = [np.asarray(seen.trace.signals[n]) for n in seen.problem.monitored]
    values += [np.asarray(list(seen.rho.values()))]
    greatest = [np.max(np.abs(each[np.isfinite(each)]), initial=0.0) for each in values]
    return float(max(greatest, default=0.0))
