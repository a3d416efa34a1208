"""The preference order of the rows of a sweep's table, and tables derived from it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation.simultaneous_interval import verdict_kind

if TYPE_CHECKING:
    import pandas as pd
FULL = 0.01
"""Part of the span of nominal returns within which a return counts as full."""
_WORST_FIRST = ("unsafe", "undecided")


def is_safe(table: "pd.DataFrame") -> Bool[np.ndarray, " rows"]:
    """Return True for rows with the verdict `safe@p`."""
    return (table["verdict"].astype(str).map(verdict_kind) == "safe").to_numpy(bool)


def preference_order(table: "pd.DataFrame") -> Int[np.ndarray, " certified"]:
    """Return the indices of the rows with a certificate, ordered by preference.

    Safe policies come first, by their nominal return; the others by the upper end of their failure
    probability. Ties are broken by the lower failure rate, then by fewer environment steps.
    """
    safe, high = is_safe(table), table["failure_high"].to_numpy(np.float64)
    returned = np.nan_to_num(table["nominal_return"].to_numpy(np.float64), nan=-np.inf)
    rate = np.nan_to_num(table["failure_rate"].to_numpy(np.float64), nan=np.inf)
    first, second = np.where(safe, -returned, high), np.where(safe, high, -returned)
    order = np.lexsort((table["steps"].to_numpy(np.float64), second, rate, first, ~safe))
    return order[np.isfinite(high)[order]]


def on_pareto_front(table: "pd.DataFrame") -> Bool[np.ndarray, " rows"]:
    """Return True for rows with a return and a certificate that no other such row dominates.

    Rows are compared by nominal return, the upper end of the failure probability, and environment
    steps.
    """
    columns = (-table["nominal_return"], table["failure_high"], table["steps"])
    points = np.stack([np.asarray(column, np.float64) for column in columns], axis=1)
    known = points[~np.isnan(points).any(axis=1)]

    def stays(point: Float[np.ndarray, " 3"]) -> bool:
        dominating = (known <= point).all(axis=1) & (known < point).any(axis=1)
        return not np.isnan(point).any() and not dominating.any()

    return np.array([stays(point) for point in points], bool)


def full_return_threshold(table: "pd.DataFrame") -> float:
    """Return the nominal return from which on a policy is considered to have learnt the task.

    It is the best return of the table minus one hundredth of the range; NaN without any return.
    """
    returned = table["nominal_return"].to_numpy(np.float64)
    returned = returned[np.isfinite(returned)]
    if not len(returned):
        return float("nan")
    return float(returned.max() - FULL * np.ptp(returned))


def last_checkpoints(table: "pd.DataFrame") -> "pd.DataFrame":
    """Return the rows at the last checkpoint of each training."""
    last = table.groupby(["configuration", "seed"])["steps"].transform("max")
    return table.loc[table["steps"] == last]


def group_by_configuration(table: "pd.DataFrame", hyperparameters: Sequence[str]) -> "pd.DataFrame":
    """Return one row for each configuration, combining its trainings at their last checkpoints."""
    import pandas as pd

    names = [name for name in hyperparameters if name != "steps"]
    rank_of = {int(i): rank for rank, i in enumerate(table.index[preference_order(table)])}
    rows: list[dict[str, Any]] = []
    for number, part in table.groupby("configuration", sort=True):
        last = last_checkpoints(part)
        ranked = [int(i) for i in part.index if int(i) in rank_of]
        best = min(ranked, key=rank_of.__getitem__, default=-1)
        rows.append(
            {
                "configuration": number, "steps": last["steps"].max(),
                **{name: last[name].iloc[0] for name in names}, "seeds": len(last),
                "seeds_safe": int(is_safe(last).sum()), "verdict": _worst_verdict(last),
                "nominal_return": last["nominal_return"].mean(),
                "failure_rate": last["failure_rate"].mean(),
                "failure_rate_worst": last["failure_rate"].max(),
                "failure_high": last["failure_high"].max(skipna=False),
                "training_seconds": last["training_seconds"].sum(),
                "status": ", ".join(dict.fromkeys(str(status) for status in last["status"])),
                "best_row": best, "best_steps": table.loc[best, "steps"] if best >= 0 else -1,
                "best_verdict": table.loc[best, "verdict"] if best >= 0 else "",
            }
        )  # fmt: skip
    return pd.DataFrame(rows).set_index("configuration") if rows else pd.DataFrame()


def return_safety_correlation(table: "pd.DataFrame") -> float:
    """Return Spearman's correlation of nominal return and safety, which is 1 - failure rate.

    NaN for fewer than three rows that have both, or if one of them is constant.
    """
    pairs = table.loc[:, ["nominal_return", "failure_rate"]].dropna()
    if len(pairs) < 3 or (pairs.nunique() < 2).any():
        return float("nan")
    ranks = pairs.rank()
    return -float(np.corrcoef(ranks["nominal_return"], ranks["failure_rate"])[0, 1])


def _worst_verdict(rows: "pd.DataFrame") -> str:
    verdicts: Any = rows["verdict"].astype(str)
    for verdict in _WORST_FIRST:
        if (verdicts == verdict).any():
            return verdict
    if is_safe(rows).all():
        return str(verdicts.iloc[0])
    # A seed without a certificate leaves the configuration undecided.
    return "undecided" if is_safe(rows).any() else ""
