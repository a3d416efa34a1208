"""Rows along their principal components."""

from pathlib import Path

import numpy as np

from verifai_jax.addons.analysis._pca import Components
from verifai_jax.core.display.figure import Figure
from verifai_jax.core.messages.text import format_percent
from verifai_jax.pictures import style

DOTS = 3000
"""Rows drawn at most, of each verdict."""


def plot_components(components: Components, path: str | Path | None = None) -> Figure:
    """Draw the rows along the first two components, and the loadings of the first three."""
    samples, names, directions = components.samples, components.names, components.directions
    shown = np.argsort(-np.abs(directions[:3]).max(axis=0, initial=0), kind="stable")[:12]
    figure = style.new_figure(figsize=(8.4, max(3.4, 1.2 + 0.27 * len(shown))))
    cloud, bars = figure.subplots(1, 2, width_ratios=(1.25, 1))
    projected = components.project().to_numpy()
    along = [projected[:, i] if i < len(directions) else np.zeros(len(samples)) for i in (0, 1)]
    for part, color in ((~samples.failing, style.SAFE), (samples.failing, style.FAILING)):
        indices = np.flatnonzero(part)
        indices = indices[:: max(1, len(indices) // DOTS)]
        cloud.scatter(along[0][indices], along[1][indices], c=color, s=9, alpha=0.55, linewidths=0)
    for i, axis in ((0, cloud.xaxis), (1, cloud.yaxis)):
        share = " (none)"
        if i < len(directions):
            chance = "" if i < components.telling else ", no more than chance"
            share = f" ({format_percent(components.shares[i])} of variance{chance})"
        axis.set_label_text(f"component {i + 1}{share}")
    style.tidy(cloud)
    height = 0.8 / max(1, min(3, len(directions)))
    for i, color in zip(
        range(min(3, len(directions))), (style.BOUND, "#31688e", "#b8b8b8"), strict=False
    ):
        position = np.arange(len(shown)) + (i - (min(3, len(directions)) - 1) / 2) * height
        bars.barh(
            position, directions[i][shown], height * 0.9, color=color, label=f"component {i + 1}"
        )
    bars.set_yticks(np.arange(len(shown)), [style.wrap_name(names[j]) for j in shown])
    bars.invert_yaxis()
    bars.axvline(0, color=style.BOUND, linewidth=0.8)
    bars.set_xlim(-1.05, 1.05)
    bars.set_xlabel("loading")
    style.tidy(bars)
    if len(directions):
        figure.legend(frameon=False, fontsize=8, loc="outside lower right", ncols=3)
    left = f"; {len(names) - len(shown)} columns not drawn" if len(names) > len(shown) else ""
    figure.suptitle(f"Principal components of {samples.kind}{left}", fontsize=10)
    return style.show_or_save(figure, path)
