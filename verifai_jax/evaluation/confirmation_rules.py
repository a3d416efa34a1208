"""Rules that decide about counterexamples from their closer replays.

found = decide(Confirmations.blank(name, numbers, rho), replayed, rho, ...)
replayed["quarter_step"]                            # Verdicts of the rows, for each check
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from verifai_jax.core.messages.text import listed
from verifai_jax.evaluation import confirmations
from verifai_jax.evaluation.verdicts import Verdicts

AMPLIFIED = 4.0
"""Times by which a row must fail beyond what rounding has moved it: a chaotic system turns
roundings into any of its outcomes, and two or three programs may agree by chance."""

REMAINING = 3.0
"""Error left at a quarter of the step by a method of order 1, as a multiple of the change since a
third of it."""


def decide(
    found: confirmations.Confirmations,
    replayed: Mapping[str, Verdicts],
    run: Float[np.ndarray, " n"] | None,
    *,
    untraceable: str,
    may_refute: bool,
    by_far: bool,
    came_again: bool,
) -> confirmations.Confirmations:
    """Decide on rows from their replays.

    **Arguments:**
    - `found`: the rows, all with verdict `raised`; completed in place.
    - `run`: robustness of the rows in the run, if known.
    - `untraceable`: the error raised when a check was traced; empty if there was none.
    - `may_refute`: whether some check simulates more finely than the run.
    - `by_far`: whether rows have to fail by more than the change of their robustness.
    - `came_again`: whether other rows could be simulated again, so that an error now means that the
      failure was not reproduced.
    """
    rho = {name: verdicts.lowest for name, verdicts in replayed.items()}
    found.rho.update(rho)
    base = next((name for name in ("float64", "again") if name in replayed), "")
    engines = confirmations.engines_of(replayed)
    finest = next((n for n in ("quarter_step", base, *engines) if n in replayed), "")
    step = rounding = np.zeros(len(found))
    if "quarter_step" in replayed:
        step = REMAINING * _moved(rho["third_step"], rho["quarter_step"])
    for name in (confirmations.SINGLE, "nudged"):
        if name in replayed:
            rounding = np.maximum(rounding, _moved(rho[name], rho[finest]))
    if run is not None and base:
        rounding = np.maximum(rounding, _moved(run, rho[base]))
    found.band[:] = np.maximum(step, rounding)
    if not replayed:
        found.why[:] = untraceable
        return found
    deciding = [
        name for name in (*confirmations.FINER, confirmations.SINGLE) if name in replayed
    ] or [base]
    deciding = [name for name in (*deciding, *engines) if name in replayed]
    failing = {name: verdicts.violated for name, verdicts in replayed.items()}
    holding = {name: v.proper & ~v.violated for name, v in replayed.items()}
    raised = {name: np.isin(v.status, confirmations.RAISED) for name, v in replayed.items()}
    # Of a host system that is simulated once more, and fails each time, that it fails says all.
    clear = (not by_far) | (np.abs(rho[finest]) >= np.maximum(step, AMPLIFIED * rounding))
    fails = np.all(list(failing.values()), axis=0)
    refuted = np.all([holding[name] for name in deciding], axis=0) & may_refute
    refuted &= deciding[0] != "again"
    lost = np.any(list(raised.values()), axis=0) | bool(untraceable)
    lost &= np.all([failing[name] | raised[name] for name in replayed], axis=0) & (not came_again)
    found.verdict[:] = np.select(
        [lost, fails & clear, refuted], ["raised", "confirmed", "refuted"], "fragile"
    )
    for i in np.flatnonzero(found.verdict != "confirmed").tolist():
        if found.verdict[i] == "raised" and untraceable:
            found.why[i] = untraceable
        else:
            as_run = None if run is None else float(run[i])
            at, band = float(rho[finest][i]), float(found.band[i])
            found.why[i] = describe_disagreement(i, replayed, at, band, as_run)
    return found


def hold_to_run(
    found: confirmations.Confirmations,
    replayed: Mapping[str, Verdicts],
    rows: Mapping[str, np.ndarray],
    only_repeats: bool,
) -> None:
    """Keep the run's verdict on rows of a host system that the present replays do not contradict.

    A failure that the run could not reproduce stays unconfirmed, whatever happens now; one that
    fails every time stays confirmed, however far its robustness moved.
    """
    fails = np.all([verdicts.violated for verdicts in replayed.values()], axis=0)
    still = (rows["verdict"] == "confirmed") & fails & only_repeats
    found.verdict[still], found.why[still] = "confirmed", ""
    refused = np.isin(rows["verdict"], confirmations.REFUSED)
    refused &= np.isin(found.verdict, ("confirmed", "raised"))
    for i in np.flatnonzero(refused).tolist():
        found.verdict[i] = "fragile"
        again = float(rows["rho_again"][i]) if "rho_again" in rows else float("nan")
        then = "" if np.isnan(again) else f", with robustness {again:z.4g}"
        found.why[i] = f"it did not come again when the run simulated it again{then}"


def lowest_failing(again: Verdicts, more: Verdicts, at: np.ndarray) -> Verdicts:
    """Return the repetitions; of two, the one that fails by less.

    **Arguments:**
    - `again`: the repetitions of all rows.
    - `more`: a further repetition of the rows at indices `at`.
    """
    with np.errstate(invalid="ignore"):
        less = ~more.violated | ~(more.lowest <= again.lowest[at])
    rho, status, violated = again.rho.copy(), again.status.copy(), again.violated.copy()
    taken = at[less]
    rho[taken], status[taken] = more.rho[less], more.status[less]
    violated[taken] = more.violated[less]
    messages = again.messages
    if messages is not None and more.messages is not None:
        messages = list(messages)
        for i in np.flatnonzero(less).tolist():
            messages[int(at[i])] = more.messages[i]
    return again._replace(rho=rho, status=status, violated=violated, messages=messages)


def describe_disagreement(
    i: int, found: Mapping[str, Verdicts], rho: float, band: float, as_run: float | None = None
) -> str:
    """Explain why a row is not confirmed.

    **Arguments:**
    - `i`: index of the row.
    - `found`: the replays of all rows, by check.
    - `rho`: robustness of the row in the finest replay.
    - `band`: the change of the robustness between replays.
    - `as_run`: its robustness in the run, if known.
    """
    lost = [name for name in found if not found[name].proper[i]]
    if lost:
        raised = [name for name in lost if found[name].status[i] in confirmations.RAISED]
        if raised:
            messages = [m[i] for name in raised if (m := found[name].messages)]
            message = next(filter(None, messages), "out of time")
            return f"the replay {_and(raised)} raised: {message}"
        return f"the replay {_and(lost)} is not finite"
    holds = [name for name, replayed in found.items() if not replayed.violated[i]]
    if holds == ["again"]:
        run = "" if as_run is None else f", and {as_run:z.4g} in the run"
        return f"it holds when simulated again: robustness {found['again'].lowest[i]:z.4g}{run}"
    if len(holds) == len(found):
        return "it holds in every replay"
    if holds:
        fails = [name for name in found if name not in holds]
        few = len(holds) <= len(fails)
        return f"it holds {_and(holds)}" if few else f"it fails only {_and(fails)}"
    return f"its robustness {rho:z.3g} moves by {band:z.2g} between replays"


def _and(names: Sequence[str]) -> str:
    return listed(list(map(confirmations.describe_check, names)))


def _moved(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return by how much a robustness moved: infinitely where one of the two is missing."""
    with np.errstate(invalid="ignore"):
        return np.nan_to_num(np.where(a == b, 0.0, np.abs(a - b)), nan=np.inf)
