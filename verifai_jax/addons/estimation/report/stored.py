"""Estimates and comparisons that a command wrote as JSON, for `verifai-jax report`."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from verifai_jax.addons.estimation.comparison.result import Compared, Comparison
from verifai_jax.addons.estimation.paired_rates import PairedRates
from verifai_jax.addons.estimation.result import METHODS, Estimate
from verifai_jax.addons.reports.stored import sources_of, values_of
from verifai_jax.features import FeatureSpace

NOT_FINITE = ("effective", "relative_error")
"""Numbers of an estimate that JSON has as null where they are not finite."""
OPTIONAL = ("probability", "method", "p0", "backend", "stopped")
"""Entries of an estimate that may be null."""


def read_estimate(file: Path, data: Mapping[str, Any], space: object) -> Estimate:
    """Return the estimate that `verifai-jax estimate --json` wrote."""
    values = values_of(Estimate, data, (*OPTIONAL, *NOT_FINITE))
    for name in NOT_FINITE:
        values[name] = math.nan if values.get(name) is None else float(values[name])
    for name in ("low", "high", "confidence", "upper_bound"):
        values[name] = float(values[name])
    if values["method"] not in (None, *METHODS):
        raise KeyError("method")
    values["notes"] = tuple(map(str, values.get("notes", ())))
    values["sources"] = sources_of(values.get("sources", {}))
    return Estimate(**values)


def read_comparison(file: Path, data: Mapping[str, Any], space: FeatureSpace | None) -> Comparison:
    """Return the comparison that `verifai-jax compare --json` wrote, without its pairs."""
    import pandas as pd

    if space is None:
        raise ValueError(
            "a comparison does not say what its features are; give a problem that was compared: "
            "--problem FILE.py:NAME"
        )
    candidates = []
    for each in data["candidates"]:
        rates = PairedRates(**values_of(PairedRates, each))
        both, margin, pairs = int(each["both_fail"]), float(each["margin"]), pd.DataFrame()
        calm = each.get("undisturbed")
        if calm is not None:
            calm_rates = PairedRates(**values_of(PairedRates, calm))
            calm = calm_rates, int(calm["baseline_fails"]), int(calm["candidate_fails"])
        name = str(each["name"])
        candidates.append(Compared(name, rates, both, margin, pairs, pairs, space, calm))
    if not candidates:
        raise KeyError("candidates")
    sources = {str(name): sources_of(each) for name, each in data.get("sources", {}).items()}
    return Comparison(
        str(data["baseline"]), tuple(candidates), int(data["simulations"]), str(data["stopped"]),
        float(data["seconds"]), int(data["seed"]), tuple(map(str, data["notes"])), sources,
    )  # fmt: skip
