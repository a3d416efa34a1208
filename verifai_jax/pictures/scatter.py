"""The feature space with its safe and failing samples, two features in each panel."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd

from verifai_jax.core.display.figure import Figure
from verifai_jax.core.messages.errors import check_names
from verifai_jax.falsification.run import Run
from verifai_jax.pictures import style

DOTS = 3000
"""Rows drawn of each verdict."""
MANY = 500
"""Rows of a verdict that are seen as a cloud; dots of fewer are larger."""
LARGE = 30
"""Area of a dot, in points squared, from which it has an edge."""


def plot_features(
    run: Run, path: str | Path | None = None, features: list[str] | None = None, maximum: int = 4
) -> Figure:
    """Draw safe (green) and failing (red) samples over pairs of features.

    Violations that closer replays did not confirm are amber triangles; rows without a verdict are
    grey crosses.

    **Arguments:**
    - `features`: names; by default the `maximum` features that best separate failures.
    - `maximum`: maximum number of features, if they are not named.
    **Raises:** `UnknownNameError` for a feature that is not in the table.
    """
    table = run.table.all
    if features is None:
        features = distinguishing_features(run)[:maximum]
    else:
        check_names("feature", features, run.table.features)
    if not features:
        figure = style.new_figure(figsize=(4, 1))
        figure.text(0.5, 0.5, f"{run.name}: no feature varies", ha="center", va="center")
        return style.show_or_save(figure, path)
    if len(features) == 1:
        features = [features[0], features[0]]
    pairs = list(combinations(features, 2))
    columns = min(3, len(pairs))
    rows = -(-len(pairs) // columns)
    figure = style.new_figure(figsize=(3.6 * columns + 0.4, 3.2 * rows + 0.5))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    claimed = run.table.counterexamples
    groups = [
        (f"{len(part):,} {name}", part, color, size, marker)
        for name, part, color, size, marker in (
            ("safe", run.table.safe, style.SAFE, 5, "o"),
            ("without a verdict", run.table.failed, style.WITHOUT_VERDICT, 12, "x"),
            ("not claimed", run.table.unconfirmed, style.NOT_CLAIMED, 12, "^"),
            ("claimed" if run.confirm else "failing", claimed, style.FAILING, 9, "o"),
        )
        if len(part)
    ]
    groups = [
        (
            label,
            part,
            color,
            size if color == style.SAFE else _visible_size(size, len(part)),
            marker,
        )
        for label, part, color, size, marker in groups
    ]
    for axes, (across, up) in zip(panels, pairs, strict=False):
        for label, part, color, size, marker in groups:
            shown = part.iloc[np.unique(np.linspace(0, len(part) - 1, DOTS).astype(int))]
            axes.scatter(
                _positions(table, shown, across),
                _positions(table, shown, up),
                c=color,
                s=size,
                marker=marker,
                alpha=0.9 if size >= LARGE else 0.55,
                linewidths=0.8 if marker == "x" or size >= LARGE else 0,
                edgecolors=None if marker == "x" else "white",
                label=label,
            )
        axes.set_xlabel(across)
        axes.set_ylabel("" if across == up else up)
        style.tidy(axes)
    for axes in panels[len(pairs) :]:
        axes.set_visible(False)
    rate = run.failure_rate
    by_search = f"search {run.search.split('(')[0]}"
    by_search = "rows that were given" if run.origin == "given" else by_search
    source = by_search if rate is None else f"failure rate {rate} as simulated"
    violating = len(run.table.violating)
    figure.suptitle(
        f"{run.name}: {violating:,} of {run.simulations:,} simulations violate the property\n"
        f"{source}",
        fontsize=10,
    )
    handles, labels = panels[0].get_legend_handles_labels()
    if handles:
        figure.legend(
            handles, labels, loc="outside lower center", ncols=len(handles), fontsize=8,
            frameon=False, markerscale=2,
        )  # fmt: skip
    return style.show_or_save(figure, path)


def distinguishing_features(run: Run) -> list[str]:
    """Return feature columns ordered by their difference between failing and safe rows.

    The difference is the Kolmogorov-Smirnov distance; without failing rows, the rank correlation
    with the robustness.
    """
    table = run.table.all
    # Items that do not exist have no value, which differs from all other values.
    varying = [name for name in run.table.features if len(table[[name]].drop_duplicates()) > 1]
    numeric = [n for n in varying if np.issubdtype(table[n].to_numpy().dtype, np.number)]
    failing, safe = run.table.counterexamples, run.table.safe
    if len(failing) and len(safe):

        def score(name: str) -> float:
            return _distance(failing[name].dropna().to_numpy(), safe[name].dropna().to_numpy())
    else:
        proper = table.loc[table["status"] == "ok"]
        if len(np.unique(proper["rho"].to_numpy())) < 2:
            return varying or list(run.table.features)
        rho = proper["rho"].rank()

        def score(name: str) -> float:
            return abs(float(proper[name].rank().corr(rho)))

    ranked = sorted(numeric, key=score, reverse=True)
    return ranked or list(run.table.features)


def _visible_size(size: float, count: int) -> float:
    """Return the area of a dot, larger where there are so few that one would be overlooked."""
    return size * float(np.clip(np.sqrt(MANY / count), 1.0, 6.0))


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    if not len(a) or not len(b):
        return 0.0
    # In order, so that each search begins near the last one's end, in the processor's cache.
    points = np.sort(np.concatenate([a, b]))
    below_a = np.searchsorted(np.sort(a), points, side="right") / len(a)
    below_b = np.searchsorted(np.sort(b), points, side="right") / len(b)
    return float(np.max(np.abs(below_a - below_b)))


def _positions(table: pd.DataFrame, part: pd.DataFrame, name: str) -> np.ndarray:
    if np.issubdtype(table[name].to_numpy().dtype, np.number):
        return part[name].to_numpy(float)
    return part[name].astype(str).to_numpy()
