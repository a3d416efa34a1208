"""Clusters of rows over the two columns that tell them apart best."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from verifai_jax.analysis.clustering.clusters import Clusters
from verifai_jax.core.figure import Figure
from verifai_jax.plotting.rows import PALETTE, name_axes, pair, positions
from verifai_jax.plotting.style import WITHOUT_VERDICT, new_figure, show_or_save, tidy

DOTS = 4000
"""Rows drawn at most, over all clusters."""


def plot_clusters(clusters: Clusters, path: str | Path | None = None) -> Figure:
    """Draw the clusters over the two columns that tell them apart best.

    **Arguments:**

    - `clusters`: what `analysis.clusters` returned.
    - `path`: file that the picture is written to, if given.

    **Returns:** the figure.
    """
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
                positions(samples, across, one),
                positions(samples, up, one),
                c=color,
                marker="*",
                s=190,
                edgecolors="white",
                linewidths=1.1,
                zorder=4,
            )
    name_axes(axes, samples, across, up)
    tidy(axes)
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(
        handles[::-1],
        labels[::-1],
        frameon=False,
        fontsize=8,
        loc="center left",
        bbox_to_anchor=(1, 0.5),
    )
    figure.suptitle(
        f"{samples.kind}: {clusters.count} cluster{'' if clusters.count == 1 else 's'} "
        f"({clusters.method}); stars are typical rows",
        fontsize=10,
    )
    return show_or_save(figure, path)


def distinguishing_columns(clusters: Clusters) -> tuple[str, str]:
    """Return the two columns of which the clusters explain most of the variation."""

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
