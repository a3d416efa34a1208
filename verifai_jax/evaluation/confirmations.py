"""Results of the closer replays of counterexamples: verdicts, and their texts.

found = confirmer(rows, numbers)                    # as `confirmer.py` makes it
found.verdict                                       # [n]: "confirmed", "fragile", ...
refused, learned = found.refuse()                   # which rows are no failures
describe_checks(found.checks)                       # "in double precision and at a third ..."
"""

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.text import listed
from verifai_jax.core.values.trace import Status

if TYPE_CHECKING:
    import pandas as pd
VERDICTS = ("confirmed", "refuted", "fragile", "raised", "unexamined")
"""Verdicts of closer replays; see `Confirmations`."""
UNDECIDED = ("fragile", "raised", "unexamined")
"""Verdicts that leave open whether the failure is the system's or the simulation's."""
REFUSED = ("fragile", "refuted")
"""Verdicts of rows that violate the property as simulated, and do not when looked at closely."""
MEANING = {
    "confirmed": "it fails in every replay",
    "refuted": "an artefact of the simulation",
    "fragile": "replays disagree",
    "raised": "it could not be replayed",
    "unexamined": "it was not replayed",
}
"""Each verdict as people read it."""
FINER = {"third_step": 3, "quarter_step": 4}
"""Checks at a finer step, and how many times finer. What is periodic and looks constant at one of
them does not at the other, unless its frequency is a multiple of twelve times that of the steps:
halving the step twice would keep every alias of the quarter."""
RAISED = (Status.ERROR, Status.TIMEOUT)
"""Ends of a simulation that gave no trace."""
SINGLE = "quarter_step_float32"
"""Name of the check at the finest step in single precision."""
CHECK_TEXTS = {
    "float64": "in float64",
    "again": "simulated again",
    "third_step": "at a third of the step",
    "quarter_step": "at a quarter of the step",
    SINGLE: "at a quarter of the step in float32",
    "nudged": "one rounding of the features away",
}
"""Each check as people read it, engines apart."""
PASSED_TEXTS = {
    "float64": "in double precision",
    "again": "when simulated again",
    "quarter_step": "at a third and a quarter of the step",
    "nudged": CHECK_TEXTS["nudged"],
}
"""Checks that a row has passed as people read them; the last step implies the others."""
ENGINE = "engine."
"""Beginning of the names of checks by other engines, before the name of the engine."""
EXACT_STEP = "exact_step"
"""Stands among the names of checks for one that is not needed: the step belongs to the system."""
ROUNDED = 1e-4
"""Share of a robustness by which rounding may change it between two simulations, such as of
threads that add up in any order, or of a batch of another size."""
SMALLEST_KEPT = 1e-6
"""Smallest robustness that a search learns of a row that is refused, positive since it holds;
also the size below which two robustnesses of about zero are taken for equal."""
SHOWN = 5
"""Reasons of doubtful rows that are printed; the rest are counted, since `table` has them."""


class Standing(NamedTuple):
    """The standing of rows that violate the property as simulated: one of three for each.

    - `claimed`: `[n]`, rows that every closer replay confirmed; of a run that was asked not to
      replay, all that violate the property.
    - `refused`: `[n]`, rows that closer replays refuted, or do not agree on.
    - `not_replayed`: `[n]`, rows that were left out, or could not be replayed.
    """

    claimed: Bool[np.ndarray, " n"]
    refused: Bool[np.ndarray, " n"]
    not_replayed: Bool[np.ndarray, " n"]

    @classmethod
    def of(cls, violated: Bool[np.ndarray, " n"], verdict: np.ndarray | None) -> "Standing":
        """Return the standing of rows, given which violate the property, and their verdicts."""
        none = np.zeros(len(violated), bool)
        if verdict is None:
            return cls(violated, none, none)
        claimed, refused, rows = none, none.copy(), np.flatnonzero(violated)
        claimed[rows] = verdict[rows] == "confirmed"
        refused[rows] = np.isin(verdict[rows].astype(str), REFUSED)
        return cls(claimed, refused, violated & ~claimed & ~refused)


def describe_checks(checks: Collection[str], *, of_step: bool = True) -> str:
    """Describe the checks that a confirmed row has passed.

    **Arguments:**
    - `checks`: their names, as in `Confirmations.checks`.
    - `of_step`: whether to explain why no finer step was checked.
    **Returns:** the end of a sentence, such as `in double precision and at a third and a quarter of
    the step`; empty if there was no check.
    """
    parts = [text for name, text in PASSED_TEXTS.items() if name in checks]
    text = listed([*parts, *map(describe_check, engines_of(checks))])
    if text and of_step and "quarter_step" not in checks:
        exact = EXACT_STEP in checks
        text += "; the step belongs to the system" if exact else "; no finer step could be tried"
    return text


def engines_of(checks: Iterable[str]) -> list[str]:
    """Return the checks made in other engines."""
    return [name for name in checks if name.startswith(ENGINE)]


def describe_check(name: str) -> str:
    """Describe a check in English."""
    return CHECK_TEXTS.get(name) or f"in {name.removeprefix(ENGINE)}"


@dataclass(frozen=True, repr=False)
class Confirmation(InNotebook):
    """The verdict of finer replays on one counterexample.

    **Fields:**
    - `name`: the name of the problem.
    - `row`: its number in the table; None for features that are not a row.
    - `verdict`: `"confirmed"`, `"refuted"`, `"fragile"` or `"raised"`.
    - `rho`: the robustness by name: `as_run`, NaN if unknown, and that of each check.
    - `band`: the change of the robustness between the replays.
    - `why`: a sentence with the reason for the verdict.
    - `notes`: checks that could not be made, with the reasons.
    - `precision`: the precision of the run.
    - `changed`, `finding`: as in `Replay`, for the row simulated again in the run's precision;
      `finding` is only computed if the model has changed or the verdict is not `"confirmed"`.
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
        """True if the counterexample failed in every replay."""
        return self.verdict == "confirmed"

    @property
    def transferable(self) -> bool | None:
        """True if it is confirmed in all engines; None if no other engine was used."""
        return self.confirmed if engines_of(self.rho) else None

    def __str__(self) -> str:
        which = f"row {self.row} of {self.name}" if self.row is not None else f"{self.name}"
        text = f"{which}: {self.verdict}, {MEANING[self.verdict]}"
        if self.why and self.why not in self.notes:
            text += f": {self.why}"
        if self.transferable is not None:
            text += f". The failure is {'' if self.transferable else 'not '}transferable"
        words = {name: describe_check(name) for name in self.rho}
        words["as_run"] = f"as run ({self.precision})"
        values = [f"{rho:z.4g} {words[n]}" for n, rho in self.rho.items() if not np.isnan(rho)]
        text += f". Robustness {', '.join(values)}" if values else ""
        text = ". ".join([text, *(note[0].upper() + note[1:] for note in self.notes)]) + "."
        return "\n".join([*(each for each in (self.changed, self.finding) if each), text])

    __repr__ = __str__


@dataclass(frozen=True, eq=False, repr=False)
class Confirmations(InNotebook):
    """The verdicts of finer replays on `n` counterexamples.

    **Fields:**
    - `name`: the name of the problem.
    - `numbers`: `[n]`, row numbers in the table.
    - `run_rho`: `[n]`, the robustness computed in the run; NaN if unknown.
    - `verdict`: `[n]`, one of these. `confirmed`: it fails in every check, by more than replays
      move it (if it can only be simulated once more, and no row of the run was safe then, it
      suffices that it fails again). `refuted`: it fails in none of the finer checks (third and
      quarter of the step and the other engines, or double precision if the step cannot be refined).
      `fragile`: the checks disagree, one gave no robustness, the row fails by less than replays
      move it, or it did not fail when simulated again. `raised`: a check raised, and the others
      fail. `unexamined`: left out, see `Confirmer`. Empty for a row that was not to be checked.
    - `rho`: for each check, by name, the least robustness `[n]` of the formulas; NaN if there is
      none. Names are `float64` (or `again`, in the precision of the run), `third_step`,
      `quarter_step`, `quarter_step_float32`, `nudged` (at the finest step, with features moved by
      one rounding of float32), and `engine.NAME` of another engine.
    - `band`: `[n]`, the change of the robustness. Between a third and a quarter of the step three
      times the change is the remaining error of a method of order 1 at the quarter (Richardson
      extrapolation). By rounding it moves between two precisions, two neighbouring features, or the
      run and its replay if `run_rho` is known. A row is confirmed if it fails by more than the
      former and by four times the latter.
    - `why`: `[n]`, a sentence with the reason; empty if confirmed.
    - `notes`: checks that could not be made, with the reasons.
    - `checks`: names of the checks that were made, for `describe_checks`.
    - `changed`, `finding`: as in `Confirmation`, for the worst row that is not confirmed, or else
      the worst of all.
    - `wavering`: a note if a host system did not reproduce the numbers of the run; it is then also
      the first of `notes`.
    """

    _internal = frozenset(("put", "refuse", "blank"))
    name: str
    numbers: Int[np.ndarray, " n"]
    run_rho: Float[np.ndarray, " n"]
    verdict: np.ndarray
    rho: dict[str, Float[np.ndarray, " n"]]
    band: Float[np.ndarray, " n"]
    why: np.ndarray
    notes: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    changed: str = ""
    finding: str = ""
    wavering: tuple[str, ...] = ()

    @classmethod
    def blank(
        cls, name: str, numbers: Int[np.ndarray, " n"], run_rho: Float[np.ndarray, " n"] | None,
        verdict: str = "unexamined",
    ) -> "Confirmations":  # fmt: skip
        """Return rows with one verdict, none of them replayed yet; see `put`."""
        missing = np.full(len(numbers), np.nan)
        known = missing if run_rho is None else np.asarray(run_rho, np.float64)
        verdicts, texts = (np.full(len(numbers), text, object) for text in (verdict, ""))
        return cls(name, np.asarray(numbers), known, verdicts, {}, missing.copy(), texts)

    def put(self, rows: Int[np.ndarray, " some"], part: "Confirmations") -> None:
        """Store the results of replays of some of these rows, in place."""
        self.verdict[rows], self.band[rows], self.why[rows] = part.verdict, part.band, part.why
        for name, values in part.rho.items():
            self.rho.setdefault(name, np.full(len(self), np.nan))[rows] = values

    def refuse(self) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return flags of refused rows, and the robustness that a search observes for them.

        It is the largest value of the run and its replays, and positive, so that a search leaves
        points that are not failures; NaN without a replay.
        """
        refused = np.isin(self.verdict, REFUSED)
        if not self.rho:
            return refused, np.full(len(refused), np.nan)
        greatest = np.fmax.reduce(np.stack([*self.rho.values(), self.run_rho]), axis=0)
        return refused, np.maximum(greatest, SMALLEST_KEPT)

    @cached_property
    def table(self) -> "pd.DataFrame":
        """One line for each row number: `verdict`, `rho` in the run, `rho.CHECK`, `band`, `why`."""
        import pandas as pd

        columns = {"verdict": self.verdict, "rho": self.run_rho}
        columns |= {f"rho.{name}": values for name, values in self.rho.items()}
        columns |= {"band": self.band, "why": self.why}
        return pd.DataFrame(columns, index=pd.Index(self.numbers, name="row"))

    @property
    def checked(self) -> str:
        """The checks that a confirmed row has passed, as the end of a sentence."""
        return describe_checks(self.checks)

    @property
    def transferable(self) -> Bool[np.ndarray, " n"] | None:
        """True for rows confirmed in all engines; None if no other engine was used."""
        return self.verdict == "confirmed" if engines_of(self.checks) else None

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows with each verdict that occurs."""
        counted = Counter(self.verdict.tolist())
        return {verdict: counted[verdict] for verdict in VERDICTS if counted[verdict]}

    @property
    def confirmed(self) -> "pd.DataFrame":
        """The rows that fail in every replay."""
        return self.table.loc[self.table["verdict"] == "confirmed"]

    def __len__(self) -> int:
        return len(self.verdict)

    def __str__(self) -> str:
        warnings = [text for text in (self.changed, self.finding) if text]
        if not len(self):
            return "\n".join([*warnings, f"{self.name}: no counterexample to confirm"])
        counts = ", ".join(
            f"{count} {verdict}{f' {self.checked}' if verdict == 'confirmed' else ''}"
            for verdict, count in self.counts.items()
        )
        counted = "1 counterexample" if len(self) == 1 else f"{len(self)} counterexamples"
        lines = [*warnings, f"{self.name}: of {counted}, {counts}"]
        if self.transferable is not None:
            count = int(np.sum(self.transferable))
            lines.append(f"  {count} of {counted} {'is' if count == 1 else 'are'} transferable")
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


@dataclass(frozen=True)
class Repetitions:
    """Counts of how a host system reproduced its rows with the same features and keys.

    - `rows`: number of violating rows simulated again.
    - `moved`: rows whose robustness changed by more than rounding, or is missing.
    - `rounded`: rows in which only the last digits differ.
    - `lost`: rows that did not fail again.
    - `max_difference`: the largest change of a robustness.
    """

    rows: int = 0
    moved: int = 0
    rounded: int = 0
    lost: int = 0
    max_difference: float = 0.0

    @classmethod
    def count(
        cls, rho: Float[np.ndarray, " n"], again: Float[np.ndarray, " n"], verdict: np.ndarray
    ) -> "Repetitions":
        """Count over violating rows: robustness in the run and repetition, and verdicts."""
        rho, again = np.asarray(rho, np.float64), np.asarray(again, np.float64)
        known = ~np.isnan(again)
        lost = (verdict == "fragile") & ~(again < 0)
        moved = lost | (known & came_otherwise(rho, again))
        differs = known & (again != rho)
        seen, others, small, gone = (
            int(np.sum(each)) for each in (known | lost, moved, differs & ~moved, lost)
        )
        max_difference = float(np.max(np.abs(rho - again)[differs], initial=0.0))
        return cls(seen, others, small, gone, max_difference)

    def joined(self, other: "Repetitions") -> "Repetitions":
        """Return the sums of both counts."""
        return Repetitions(
            self.rows + other.rows, self.moved + other.moved, self.rounded + other.rounded,
            self.lost + other.lost, max(self.max_difference, other.max_difference),
        )  # fmt: skip

    def __str__(self) -> str:
        """Say what that means of the system; empty if all rows came again bit for bit."""
        plural = "s" * (self.rows != 1)
        of = f"of {self.rows} violating row{plural} simulated again with the same features and seed"
        if self.moved:
            by = f" (by up to {self.max_difference:z.2g})" if self.max_difference else ""
            return (
                f"the system has memory or chance of its own: {of}, {self.moved} gave another "
                f"robustness{by}, and {self.lost} did not fail"
            )
        if self.rounded:
            by = f"by up to {self.max_difference:z.2g}"
            return f"{of}, {self.rounded} have other last digits, {by}"
        return ""


def came_otherwise(
    rho: Float[np.ndarray, " n"], again: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return which robustnesses differ by more than rounding explains; NaN does not count."""
    rho, again = np.asarray(rho, np.float64), np.asarray(again, np.float64)
    with np.errstate(invalid="ignore"):
        scale = np.maximum(np.abs(rho), np.abs(again))
        return (rho != again) & (np.abs(rho - again) > ROUNDED * scale + SMALLEST_KEPT)
