"""The picture of a verification: proved, broken and undecided parts, two coordinates at a time."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.verification.result import Verification
from verifai_jax.core.display.figure import Figure
from verifai_jax.pictures.style import FAILING, NOT_CLAIMED, SAFE, new_figure, show_or_save

CELLS = 160
"""Cells of a picture along each axis."""
PANELS = 3
TICKS = 8
"""Values of a discrete coordinate that are written along its axis, at most."""
COLORS = {"proved": SAFE, "broken": FAILING, "undecided": NOT_CLAIMED}


def plot_verification(
    result: Verification, path: str | Path | None = None, units: Mapping[str, str] | None = None
) -> Figure:
    """Draw each pair of the coordinates that were split most, averaged over the others."""
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    widths = np.log(np.maximum(result.boxes.high - result.boxes.low, 1e-300))
    order = np.argsort((result.boxes.mass[:, None] * widths).sum(0), kind="stable")
    chosen = sorted(order[: 2 if len(order) < 3 else 3].tolist())
    pairs = list(itertools.combinations(chosen, 2)) or [(c, c) for c in chosen]
    pairs = pairs[:PANELS] or [(-1, -1)]
    figure = new_figure(figsize=(3.4 * len(pairs) + 0.4, 3.6))
    panels = np.ravel(figure.subplots(1, len(pairs)))
    ends = np.linspace(0, 1, CELLS + 1)
    for axes, (first, second) in zip(panels, pairs, strict=True):
        across = _overlap(result, first, ends)
        up = _overlap(result, second, ends) if second != first else np.ones_like(across)
        own = np.prod(result.upper_shares - result.shares, axis=1)
        for j in {first, second} - {-1}:
            own = own / np.maximum(result.upper_shares[:, j] - result.shares[:, j], 1e-300)
        image = np.ones((CELLS, CELLS, 3))
        for verdict, color in COLORS.items():
            rows = result.verdicts == verdict
            share = up[rows].T @ (own[rows, None] * across[rows])
            image -= np.clip(share, 0, 1)[:, :, None] * (1 - np.array(to_rgb(color)))
        extent = (
            *_label(axes.xaxis, result, first, units or {}),
            *_label(axes.yaxis, result, -1 if second == first else second, units or {}),
        )
        axes.imshow(np.clip(image, 0, 1), origin="lower", extent=extent, aspect="auto")
    patches = [Patch(color=color, label=verdict) for verdict, color in COLORS.items()]
    figure.legend(handles=patches, loc="outside upper center", ncols=len(COLORS), frameon=False)
    return show_or_save(figure, path)


def _label(
    axis: Any, result: Verification, coordinate: int, units: Mapping[str, str]
) -> tuple[float, float]:
    """Label an axis with the values of a coordinate, none for -1, and return its ends."""
    if coordinate < 0:
        axis.set_ticks([])
        return 0.0, 1.0
    name, scale = result.columns[coordinate], result.scales[coordinate]
    axis.set_label_text(with_unit(name, units) + ("" if scale else ", share of its range"))
    if "edges" in scale:
        middles = np.add(scale["edges"][1:], scale["edges"][:-1]) / 2
        shown = np.unique(np.linspace(0, len(middles) - 1, TICKS).round().astype(int))
        axis.set_ticks(middles[shown], [str(scale["values"][i]) for i in shown])
        return 0.0, 1.0
    low, high = scale.get("values", (0.0, 1.0))
    return low, high


def with_unit(name: str, units: Mapping[str, str]) -> str:
    """Return the name of a coordinate with the unit of its feature, if it has one."""
    return f"{name} [{units[name]}]" if name in units else name


def _overlap(
    result: Verification, coordinate: int, ends: Float[np.ndarray, " ends"]
) -> Float[np.ndarray, "n cells"]:
    """Return the share of each cell of an axis that each box covers."""
    if coordinate < 0:
        return np.ones((len(result.boxes), CELLS))
    low, high = result.shares[:, [coordinate]], result.upper_shares[:, [coordinate]]
    covered = np.minimum(high, ends[1:]) - np.maximum(low, ends[:-1])
    return np.clip(covered, 0, None) * CELLS
