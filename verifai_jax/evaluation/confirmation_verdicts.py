"""Verdicts of closer replays of counterexamples, and what they are in words.

checked = confirmer(rows, numbers)                  # as `confirmation.py` makes it
checked.verdict                                     # [n]: "confirmed", "fragile", ...
refused, told = checked.refuse(rho)                 # which rows are not claimed
describe_checks(checked.rho)                        # "in double precision and at a half ..."
"""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.core.trace import Status
from verifai_jax.evaluation.verdicts import Verdicts

VERDICTS = ("confirmed", "refuted", "fragile", "raised", "unchecked", "unexamined")
"""Verdicts of closer replays; see `Checked`."""
UNDECIDED = ("fragile", "raised", "unchecked", "unexamined")
"""Verdicts that leave open whether the failure is the system's or the simulation's."""
NOT_CLAIMED = ("fragile", "refuted")
"""Verdicts of rows that violate the property as simulated, and do not when looked at closely."""
MEANING = {
    "confirmed": "it fails in every replay",
    "refuted": "an artefact of the simulation",
    "fragile": "closer replays disagree",
    "raised": "it could not be replayed",
    "unchecked": "there is nothing finer to check it with",
    "unexamined": "it was not replayed",
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

    - `verdict`: `confirmed`: it fails in every check, at least one of which is finer than the run,
      and by more than replays move it; `refuted`: none of the finer checks fails (half and quarter
      of the step and the other simulator, or where the step stays, double precision); `fragile`:
      the checks disagree, one of them gave no robustness, or it fails by less than that; `raised`:
      a check raised, and the others fail; `unchecked`: there was nothing finer to check with;
      `unexamined`: left out, see `Confirmer`.
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
) -> str:
    """Say why a row is not confirmed.

    **Arguments:**

    - `i`: place of the row.
    - `found`: the replays of all rows, by check.
    - `rho`: robustness of the row in the finest replay.
    - `band`: how much it moved between replays.
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
    if len(holds) == len(found):
        return "it holds in every replay"
    if holds:
        fails = [name for name in found if name not in holds]
        few = len(holds) <= len(fails)
        return f"it holds {_and(holds)}" if few else f"it fails only {_and(fails)}"
    return f"its robustness {rho:.3g} moves by {band:.2g} between replays"


def _and(names: Sequence[str]) -> str:
    words = [IN_WORDS[name] for name in names]
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
