"""Verdicts of the rows of a table: a counterexample, safe, not claimed, or none."""

import numpy as np
import pandas as pd
from jaxtyping import Bool

from verifai_jax.evaluation.confirmations import NOT_CLAIMED


def verdicts(table: pd.DataFrame) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return the counterexamples and the rows that keep the property.

    A violating row that closer replays did not confirm (column `verdict`) is in neither.
    """
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
    return ended & violated & ~unconfirmed(table), ended & ~violated


def unconfirmed(table: pd.DataFrame) -> Bool[np.ndarray, " n"]:
    """Return the rows that violate the property but are not claimed as counterexamples."""
    if "verdict" not in table:
        return np.zeros(len(table), bool)
    return np.asarray(table["verdict"].isin(NOT_CLAIMED), bool)


def select_rows(table: pd.DataFrame, which: str) -> Bool[np.ndarray, " n"]:
    """Select rows: `"counterexamples"`, `"safe"`, `"failed"` or `"all"` with a verdict."""
    violating, safe = verdicts(table)
    if which == "counterexamples":
        return violating
    if which == "safe":
        return safe
    if which == "all":
        return violating | safe
    return ~(violating | safe | unconfirmed(table))


def explain_empty(table: pd.DataFrame, which: str) -> str:
    """Explain why a selection of rows is empty."""
    if not len(table):
        return "the table is empty: there are no simulations to analyse"
    violating, safe = (int(part.sum()) for part in verdicts(table))
    doubtful = int(unconfirmed(table).sum())
    more = f"{doubtful:,} not claimed, " if doubtful else ""
    what = {"safe": "safe rows", "failed": "rows without a verdict", "all": "rows with a verdict"}
    return (
        f"no {what.get(which, which)} among {len(table):,} simulations ({violating:,} "
        f"counterexamples, {safe:,} safe, {more}{len(table) - violating - safe - doubtful:,} "
        "without a verdict); "
        "which=... looks at other rows"
    )
