"""Verdicts of closer replays of counterexamples, and what they are in words.

checked = confirmer(rows, numbers)                  # as `confirmation.py` makes it
checked.verdict                                     # [n]: "confirmed", "fragile", ...
refused, told = checked.refuse(rho)                 # which rows are not claimed
describe_checks(checked.rho)                        # "in double precision and at a half ..."
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.core.trace import Status
from verifai_jax.evaluation.verdicts import Verdicts

VERDICTS = ("confirmed", "refuted", "fragile", "raised", "unexamined")
"""Verdicts of closer replays; see `Checked`."""
UNDECIDED = ("fragile", "raised", "unexamined")
"""Verdicts that leave open whether the failure is the system's or the simulation's."""
NOT_CLAIMED = ("fragile", "refuted")
"""Verdicts of rows that violate the property as simulated, and do not when looked at closely."""
MEANING = {
    "confirmed": "it fails in every replay",
    "refuted": "an artefact of the simulation",
    "fragile": "replays disagree",
    "raised": "it could not be replayed",
    "unexamined": "it is unchecked, as it was not replayed",
}
"""Each verdict as people read it."""
FINER = {"half_step": 2, "quarter_step": 4}
"""Checks at a finer step, and how many times finer."""
RAISED = (Status.ERROR, Status.TIMEOUT)
"""Ends of a simulation that gave no trace."""
SINGLE = "quarter_step_float32"
"""Name of the check at the finest step in single precision."""
IN_WORDS = {
    "float64": "in float64",
    "again": "simulated again",
    "half_step": "at half the step",
    "quarter_step": "at a quarter of the step",
    SINGLE: "at a quarter of the step in float32",
    "nudged": "one rounding of the features away",
    "simulator": "in the other simulator",
}
"""Each check as people read it."""
ROUNDED = 1e-4
"""Share of a robustness by which rounding may change it between two simulations, such as of
threads that add up in any order, or of a batch of another size."""
LEAST_TOLD = 1e-6
"""Robustness that a search is told at least of a row that is not claimed: it holds."""


def describe_checks(checks: Collection[str], exact_step: bool = False) -> str:
    """Describe the checks that a confirmed row has passed, in words.

    **Arguments:**

    - `checks`: their names, as in `Checked.rho`.
    - `exact_step`: whether the step belongs to the system, so that there is no finer one.

    **Returns:** the end of a sentence, such as `in double precision and at a half and a quarter of
    the step`; empty without a check.
    """
    parts = []
    if "float64" in checks:
        parts.append("in double precision")
    elif "again" in checks:
        parts.append("when simulated again")
    if "quarter_step" in checks:
        parts.append("at a half and a quarter of the step")
    if "nudged" in checks:
        parts.append("one rounding of the features away")
    if "simulator" in checks:
        parts.append("in the other simulator")
    words = " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)
    if words and "quarter_step" not in checks:
        words += (
            "; the step belongs to the system" if exact_step else "; no finer step could be tried"
        )
    return words


class Checked(NamedTuple):
    """Verdicts of closer replays of `n` rows.

    - `verdict`: `confirmed`: it fails in every check, and by more than replays move it (where all
      that can be done is to simulate it once more, and no row of the run held then, it is enough
      that it fails again); `refuted`: none of the finer
      checks fails (half and quarter of the step and the other simulator, or where the step stays,
      double precision); `fragile`: the checks disagree, one of them gave no robustness, it fails by
      less than that, or it did not fail when it was simulated again; `raised`: a check raised, and
      the others fail; `unexamined`: left out, see `Confirmer`.
    - `rho`: for each check made, by name, the least formula's robustness; NaN without one. Names
      are `float64` (or `again`, in the precision of the run), `half_step`, `quarter_step`,
      `quarter_step_float32`, `nudged` (at the finest step, with features one rounding of float32
      away) and `simulator`.
    - `band`: how much the robustness moved: between half and quarter of the step, which is what a
      method of order 1 is still off at the quarter (Richardson's extrapolation), or by rounding:
      between two precisions, two neighbouring features, or the run and its replay where `rho` of
      the run is known. A row is confirmed if it fails by more than the first and by four times the
      second.
    - `why`: the reason, for people; empty where confirmed.
    - `notes`: which checks could not be made, and why.
    """

    verdict: np.ndarray
    rho: dict[str, Float[np.ndarray, " n"]]
    band: Float[np.ndarray, " n"]
    why: list[str]
    notes: tuple[str, ...]

    def refuse(
        self, rho: Float[np.ndarray, " n"]
    ) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return which rows are not claimed, and the robustness to tell a search of them instead.

        - `rho` `[n]`: the robustness of the run.

        That is the greatest one of the run and its replays, and positive, so that a search does not
        stay with what is no failure; NaN where no replay was made.
        """
        refused = np.isin(self.verdict, NOT_CLAIMED)
        if not self.rho:
            return refused, np.full(len(refused), np.nan)
        greatest = np.nanmax(np.stack([*self.rho.values(), rho]), axis=0)
        return refused, np.maximum(greatest, LEAST_TOLD)


def describe_disagreement(
    i: int,
    found: Mapping[str, Verdicts],
    rho: float,
    band: float,
    as_run: float | None = None,
) -> str:
    """Say why a row is not confirmed.

    **Arguments:**

    - `i`: place of the row.
    - `found`: the replays of all rows, by check.
    - `rho`: robustness of the row in the finest replay.
    - `band`: how much it moved between replays.
    - `as_run`: its robustness in the run, where that is known.
    """
    lost = [name for name in found if not found[name].proper[i]]
    if lost:
        raised = [name for name in lost if found[name].status[i] in RAISED]
        if raised:
            messages = [m[i] for name in raised if (m := found[name].messages)]
            message = next(filter(None, messages), "out of time")
            return f"the replay {_and(raised)} raised: {message}"
        return f"the replay {_and(lost)} is not finite"
    holds = [name for name, replayed in found.items() if not replayed.violated[i]]
    if holds == ["again"]:
        run = "" if as_run is None else f", and {as_run:z.4g} in the run"
        return f"it holds when simulated again: robustness {found['again'].least[i]:z.4g}{run}"
    if len(holds) == len(found):
        return "it holds in every replay"
    if holds:
        fails = [name for name in found if name not in holds]
        few = len(holds) <= len(fails)
        return f"it holds {_and(holds)}" if few else f"it fails only {_and(fails)}"
    return f"its robustness {rho:z.3g} moves by {band:z.2g} between replays"


def _and(names: Sequence[str]) -> str:
    words = [IN_WORDS[name] for name in names]
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


@dataclass(frozen=True)
class Repetitions:
    """Counts of how a host system gave its rows again, with the same features and key.

    - `rows`: violating rows that were simulated again.
    - `moved`: those with another robustness, beyond rounding, or none.
    - `rounded`: those whose last digits alone differ.
    - `lost`: those that did not fail again.
    - `most`: how far a robustness moved.
    """

    rows: int = 0
    moved: int = 0
    rounded: int = 0
    lost: int = 0
    most: float = 0.0

    @classmethod
    def count(
        cls, rho: Float[np.ndarray, " n"], again: Float[np.ndarray, " n"], verdict: np.ndarray
    ) -> "Repetitions":
        """Count over violating rows: robustness in the run and in the repetition, and verdicts."""
        rho, again = np.asarray(rho, np.float64), np.asarray(again, np.float64)
        known = ~np.isnan(again)
        lost = (verdict == "fragile") & ~(again < 0)
        moved = lost | (known & came_otherwise(rho, again))
        differs = known & (again != rho)
        return cls(
            int(np.sum(known | lost)),
            int(np.sum(moved)),
            int(np.sum(differs & ~moved)),
            int(np.sum(lost)),
            float(np.max(np.abs(rho - again)[differs], initial=0.0)),
        )

    def joined(self, other: "Repetitions") -> "Repetitions":
        """Return the counts over the rows of both."""
        return Repetitions(
            self.rows + other.rows,
            self.moved + other.moved,
            self.rounded + other.rounded,
            self.lost + other.lost,
            max(self.most, other.most),
        )

    def __str__(self) -> str:
        """Say what that means of the system; empty where all rows came again bit for bit."""
        plural = "s" * (self.rows != 1)
        of = f"of {self.rows} violating row{plural} simulated again with the same features and seed"
        if self.moved:
            by = f" (by up to {self.most:z.2g})" if self.most else ""
            return (
                f"the system has memory or chance of its own: {of}, {self.moved} gave another "
                f"robustness{by}, and {self.lost} did not fail"
            )
        if self.rounded:
            return f"{of}, {self.rounded} have other last digits, by up to {self.most:z.2g}"
        return ""


def came_otherwise(
    rho: Float[np.ndarray, " n"], again: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return which robustnesses differ by more than rounding explains; not those without one."""
    rho, again = np.asarray(rho, np.float64), np.asarray(again, np.float64)
    with np.errstate(invalid="ignore"):
        scale = np.maximum(np.abs(rho), np.abs(again))
        return (rho != again) & (np.abs(rho - again) > ROUNDED * scale + LEAST_TOLD)
