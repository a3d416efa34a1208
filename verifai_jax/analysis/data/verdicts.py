"""Which rows of a table violate the property, which keep it, and which have no verdict."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

if TYPE_CHECKING:
    import pandas as pd


def verdicts(table: "pd.DataFrame") -> tuple[np.ndarray, np.ndarray]:
    """Which rows violate the property, and which keep it."""
    judged = np.ones(len(table), bool)
    if "status" in table:
        judged = np.asarray(table["status"] == "ok", bool)
    if "violated" in table:
        violated = np.asarray(table["violated"], bool)
    elif "rho" in table:
        rho = np.asarray(table["rho"], np.float64)
        judged = judged & ~np.isnan(rho)
        violated = rho < 0
    else:
        violated = np.ones(len(table), bool)
    return judged & violated, judged & ~violated


def chosen(table: "pd.DataFrame", which: str) -> Bool[np.ndarray, " n"]:
    """Which rows are `"counterexamples"`, `"safe"`, `"failed"` or `"all"` with a verdict."""
    violating, safe = verdicts(table)
    if which == "counterexamples":
        return violating
    if which == "safe":
        return safe
    return violating | safe if which == "all" else ~(violating | safe)


def nothing(table: "pd.DataFrame", which: str) -> str:
    """What to say when no row is chosen."""
    if not len(table):
        return "the table is empty: there are no simulations to analyse"
    violating, safe = (int(part.sum()) for part in verdicts(table))
    what = {"safe": "safe rows", "failed": "rows without a verdict", "all": "rows with a verdict"}
    return (
        f"no {what.get(which, which)} among {len(table):,} simulations ({violating:,} "
        f"counterexamples, {safe:,} safe, {len(table) - violating - safe:,} without a verdict); "
        "which=... looks at other rows"
    )
