"""The picture of a region of uncertainty, in which the error of a perception can decide."""

from pathlib import Path

import numpy as np

from verifai_jax.addons.perception.compositional.region import (
    FAILS_ANYWAY,
    NO_VERDICT,
    SAFE,
    UNCERTAIN,
)
from verifai_jax.addons.perception.compositional.result import Compositional
from verifai_jax.core.display.figure import Figure
from verifai_jax.core.messages.errors import check_names
from verifai_jax.pictures import style


def plot_region(
    result: Compositional, path: str | Path | None = None, features: tuple[str, str] | None = None
) -> Figure:
    """Draw the samples of the region by the smallest error that fails, and the confirmed failures.

    **Arguments:**
    - `features`: the columns of the two axes; by default the two on which the region depends most.
    **Raises:** `UnknownNameError` for a column that the table does not have.
    """
    region, columns = result.region, list(result.problem.space.columns)
    if features is None:
        features = _decisive_features(result)
    check_names("feature", features, columns)
    across, up = features
    figure = style.new_figure(figsize=(6.4, 4.2))
    axes = figure.subplots()
    for kind, color, marker in (
        (SAFE, style.SAFE, "o"),
        (FAILS_ANYWAY, style.FAILING, "x"),
        (NO_VERDICT, style.WITHOUT_VERDICT, "x"),
    ):
        part = region.loc[region["kind"] == kind]
        if len(part):
            label = f"{len(part):,} {kind}"
            axes.scatter(part[across], part[up], s=6, c=color, marker=marker, lw=0.8, label=label)
    part = region.loc[region["kind"] == UNCERTAIN]
    if len(part):
        points = axes.scatter(
            part[across], part[up], s=7, c=part["severity"], cmap="YlOrRd_r", vmin=0, vmax=1,
            label=f"{len(part):,} uncertain",
        )  # fmt: skip
        figure.colorbar(points, label="least error that fails (1: the worst allowed)")
    confirmed = result.confirmed
    if len(confirmed):
        axes.scatter(
            confirmed[across], confirmed[up], s=90, c=style.BOUND, marker="*", edgecolors="white",
            label=f"{len(confirmed):,} confirmed", zorder=3, clip_on=False,
        )  # fmt: skip
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    style.tidy(axes)
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    axes.set_title(f"{result.name}: where an error of the perception can decide", fontsize=10)
    return style.show_or_save(figure, path)


def _decisive_features(result: Compositional) -> tuple[str, str]:
    """Return the two columns with which the least failing error correlates most by rank.

    A sample that is safe needs more than the worst error, one that fails anyway none.
    """
    region = result.region.loc[result.region["kind"] != NO_VERDICT]
    severity = region["severity"].to_numpy(float).copy()
    severity[(region["kind"] == SAFE).to_numpy()] = 2.0
    severity[(region["kind"] == FAILS_ANYWAY).to_numpy()] = 0.0
    columns = list(result.problem.space.columns)
    numeric = [name for name in columns if np.issubdtype(region[name].to_numpy().dtype, np.number)]
    ranks = region[numeric].rank()
    rank = region.assign(severity=severity)["severity"].rank()
    strength = dict.fromkeys(numeric, 0.0)
    if len(np.unique(severity)) > 1:
        strength = {n: abs(float(np.nan_to_num(ranks[n].corr(rank)))) for n in numeric}
    ordered = sorted(numeric, key=lambda name: -strength[name]) or columns
    return ordered[0], ordered[min(1, len(ordered) - 1)]
