"""Pictures of chosen rows among all rows: clusters, a diverse subset, neighbours."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.analysis._diverse import Diverse
from verifai_jax.addons.analysis.clustering.clusters import Clusters
from verifai_jax.addons.analysis.neighbours import Neighbours
from verifai_jax.addons.analysis.pictures.rows import (
    PALETTE,
    draw_rows,
    name_axes,
    pair,
    positions,
    two_columns,
)
from verifai_jax.core.display.figure import Figure
from verifai_jax.pictures.style import (
    BOUND,
    FAILING,
    WITHOUT_VERDICT,
    new_figure,
    show_or_save,
    tidy,
)

DOTS = 4000
"""Rows drawn at most, over all clusters."""


def plot_clusters(clusters: Clusters, path: str | Path | None = None) -> Figure:
    """Draw the clusters over the two columns that separate them best."""
    samples = clusters.samples
    across, up = distinguishing_columns(clusters)
    figure = new_figure(figsize=(6.2, 4.4))
    axes = figure.subplots()
    table = clusters.table
    for cluster in reversed(list(table.index)):
        color = PALETTE[cluster % len(PALETTE)] if cluster >= 0 else WITHOUT_VERDICT
        rows = clusters.rows(cluster)
        shown = samples.at(rows[:: max(1, len(samples) // DOTS)])
        name = f"cluster {cluster}" if cluster >= 0 else "noise"
        axes.scatter(
            positions(samples, across, shown),
            positions(samples, up, shown),
            c=color,
            s=10,
            alpha=0.6 if cluster >= 0 else 0.4,
            linewidths=0,
            label=f"{name}: {clusters.entry(cluster, 'size'):,}",
        )
        if cluster >= 0:
            one = samples.at([int(clusters.entry(cluster, "representative"))])
            axes.scatter(
                positions(samples, across, one), positions(samples, up, one), c=color, marker="*",
                s=190, edgecolors="white", linewidths=1.1, zorder=4,
            )  # fmt: skip
    name_axes(axes, samples, across, up)
    tidy(axes)
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(
        handles[::-1], labels[::-1], frameon=False, fontsize=8, loc="center left",
        bbox_to_anchor=(1, 0.5),
    )  # fmt: skip
    figure.suptitle(
        f"{samples.kind}: {clusters.count} cluster{'' if clusters.count == 1 else 's'} "
        f"({clusters.method}); stars are typical rows",
        fontsize=10,
    )
    return show_or_save(figure, path)


def distinguishing_columns(clusters: Clusters) -> tuple[str, str]:
    """Return the two columns whose variation the clusters explain best."""

    def explained(total: Float[np.ndarray, "n d"]) -> float:
        spread = ((total - total.mean(axis=0)) ** 2).sum()
        means = np.stack([total[clusters.assigned == c].mean(axis=0) for c in kinds])
        inner = ((total - means[np.searchsorted(kinds, clusters.assigned)]) ** 2).sum()
        return 1 - inner / spread if spread > 0 else -1.0

    kinds = np.unique(clusters.assigned)
    samples, scores = clusters.samples, {}
    matrix = iter(samples.matrix("standard").T)
    codes = iter(samples.codes().T)
    for column in samples.columns:
        if column.ordered:
            scores[column.name] = explained(next(matrix)[:, None])
        else:
            scores[column.name] = explained(np.eye(len(column.choices) + 1)[next(codes)])
    best = sorted(scores, key=lambda name: -scores[name])
    return pair(samples, best)


def plot_diverse(diverse: Diverse, path: str | Path | None = None) -> Figure:
    """Draw the chosen rows among all, and the distance of each from the earlier ones."""
    figure = new_figure(figsize=(8.6, 4.0))
    cloud, curve = figure.subplots(1, 2, width_ratios=(1.4, 1))
    across, up = two_columns(diverse.samples)
    drawn = draw_rows(
        cloud, diverse.samples, diverse.rows, FAILING, f"{len(diverse.rows)} chosen", (across, up)
    )
    for i, (x, y) in enumerate(drawn[:12]):
        if np.isfinite(x) and np.isfinite(y):
            style = {"xytext": (5, 4), "textcoords": "offset points", "fontsize": 8}
            cloud.annotate(str(i + 1), (x, y), **style)
    curve.plot(
        np.arange(2, len(diverse.rows) + 1), diverse.distances[1:], "o-", color=FAILING,
        markersize=3,
    )  # fmt: skip
    curve.set_ylim(bottom=0)
    curve.set_xlabel("rows chosen")
    curve.set_ylabel("distance of the last from those before")
    curve.xaxis.get_major_locator().set_params(integer=True)
    for axes in (cloud, curve):
        tidy(axes)
    figure.suptitle(f"{len(diverse.rows)} diverse rows, {diverse.samples.kind}", fontsize=10)
    return show_or_save(figure, path)


def plot_neighbours(neighbours: Neighbours, path: str | Path | None = None) -> Figure:
    """Draw the rows among the others, over the two features that vary most."""
    figure = new_figure(figsize=(5.2, 4.2))
    axes = figure.subplots()
    draw_rows(
        axes, neighbours.samples, neighbours.rows, color=BOUND, label=f"{len(neighbours.rows)} rows"
    )
    tidy(axes)
    figure.suptitle(f"{neighbours.how}, {neighbours.samples.kind}", fontsize=10)
    return show_or_save(figure, path)
