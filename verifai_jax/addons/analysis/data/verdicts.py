"""Verdicts of the rows of a table: failing, safe, refused by closer replays, or none."""

import numpy as np
import pandas as pd
from jaxtyping import Bool

from verifai_jax.evaluation.confirmations import Standing


def verdicts(table: pd.DataFrame) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return the failing rows and the rows that keep the property.

    What the failing rows have in common shows in those, too, that were not replayed. A violating
    row that closer replays refused is in neither.
    """
    stands, safe = standing(table)
    return stands.claimed | stands.not_replayed, safe


def standing(table: pd.DataFrame) -> tuple[Standing, Bool[np.ndarray, " n"]]:
    """Return the standing of the rows that violate the property, and the rows that keep it."""
    ended = np.ones(len(table), bool)
    if "status" in table:
        ended = np.asarray(table["status"] == "ok", bool)
    if "violated" in table:
        violated = np.asarray(table["violated"], bool)
    elif "rho" in table:
        rho = np.asarray(table["rho"], np.float64)
        ended = ended & ~np.isnan(rho)
        violated = rho < 0
    else:
        violated = np.ones(len(table), bool)
    verdict = table["verdict"].to_numpy(object) if "verdict" in table else None
    return Standing.of(ended & violated, verdict), ended & ~violated


def select_rows(table: pd.DataFrame, which: str) -> Bool[np.ndarray, " n"]:
    """Select rows: failing `"counterexamples"`, `"safe"`, `"failed"` or `"all"` with a verdict."""
    violating, safe = verdicts(table)
    if which == "counterexamples":
        return violating
    if which == "safe":
        return safe
    if which == "all":
        return violating | safe
    return ~(violating | safe | standing(table)[0].refused)


def explain_empty(table: pd.DataFrame, which: str) -> str:
    """Explain why a selection of rows is empty."""
    if not len(table):
        return "the table is empty: there are no simulations to analyse"
    violating, safe = (int(part.sum()) for part in verdicts(table))
    doubtful = int(standing(table)[0].refused.sum())
    more = f"{doubtful:,} not claimed, " if doubtful else ""
    what = {"safe": "safe rows", "failed": "rows without a verdict", "all": "rows with a verdict"}
    return (
        f"no {what.get(which, which)} among {len(table):,} simulations ({violating:,} "
        f"failing, {safe:,} safe, {more}{len(table) - violating - safe - doubtful:,} "
        "without a verdict); "
        "which=... looks at other rows"
    )
