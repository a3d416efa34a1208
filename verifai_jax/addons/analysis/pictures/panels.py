"""Samples over two features, with the boxes of rules, and names of points."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.transforms import Bbox

from verifai_jax.addons.analysis._rules import Rule, Rules
from verifai_jax.addons.analysis.data.columns import Column
from verifai_jax.addons.analysis.data.samples import Samples
from verifai_jax.core.display.figure import Axes, Figure
from verifai_jax.pictures.style import (
    BOUND,
    FAILING,
    SAFE,
    new_figure,
    renderer_of,
    show_or_save,
    tidy,
)  # fmt: skip

Positions = Float[np.ndarray, " n"]

DOTS = 3000
"""Rows drawn of each verdict."""
JITTER = 0.25
"""Spread of unordered values around their place."""
MAX_LABELS = 12
"""Choices that an axis names."""


def plot_rules(rules: Rules, path: str | Path | None = None) -> Figure:
    """Draw samples over the features that the rules use most, with the boxes of the rules."""
    samples = rules.samples
    used = [c.feature for rule in rules.rules for c in rule.conditions]
    across, up = two_features(samples, used)
    figure = new_figure(figsize=(6.4, 4.9))
    axes = figure.subplots()
    draw_samples(axes, samples, across, up)
    for number, rule in enumerate(rules.rules, 1):
        draw_rule(axes, samples, rule, across, up, number)
    lines = [f"{i}  {rule}" for i, rule in enumerate(rules.rules[:3], 1)]
    title = "\n".join(_wrapped(line) for line in lines or [str(rules)])
    figure.suptitle(title, fontsize=8, x=0.02, ha="left")
    return show_or_save(figure, path)


def two_features(samples: Samples, preferred: list[str]) -> tuple[str, str]:
    """Return the first two features, starting with `preferred`; a single one twice."""
    names = list(dict.fromkeys([*preferred, *samples.names]))
    return names[0], names[1] if len(names) > 1 else names[0]


def draw_samples(axes: Axes, samples: Samples, across: str, up: str, size: float = 9) -> None:
    """Draw safe rows (green), then failing ones (red) over two features, at most 3000 of each.

    Unordered values are spread slightly around their position.
    """
    columns = {column.name: column for column in samples.columns}
    x, y = cells(samples, across, up)
    for part, color, dot in (
        (~samples.failing, SAFE, size * 0.6),
        (samples.failing, FAILING, size),
    ):
        shown = _thinned(part)
        axes.scatter(x[shown], y[shown], c=color, s=dot, alpha=0.55, linewidths=0)
    axes.set_xlabel(across)
    axes.set_ylabel(up if up != across else "robustness" if np.any(y) else "")
    tidy(axes)
    drawn = [(across, axes.xaxis), (up, axes.yaxis)][: 1 + (up != across)]
    for name, axis in drawn:
        column = columns[name]
        if not column.ordered:
            step = -(-len(column.choices) // MAX_LABELS)
            ticks = np.arange(0, len(column.choices), max(step, 1))
            axis.set_ticks(ticks, [str(column.choices[i])[:16] for i in ticks])
        elif column.integer:
            axis.get_major_locator().set_params(integer=True)


def cells(
    samples: Samples, across: str, up: str
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the positions of rows; with a single feature the robustness is the other axis."""
    columns = {column.name: column for column in samples.columns}
    x = _positions(samples, columns[across], seed=0)
    if up != across:
        return x, _positions(samples, columns[up], seed=1)
    return x, samples.rho if np.isfinite(samples.rho).any() else np.zeros(len(samples))


def draw_rule(
    axes: Axes, samples: Samples, rule: Rule, across: str, up: str, number: int, noun: str = ""
) -> None:
    """Draw the boxes of a rule over two features, dashed if it has conditions on others.

    The labels of four consecutive boxes are inside different corners, since boxes may share
    corners.
    """
    from matplotlib.patches import Rectangle

    features = {condition.feature for condition in rule.conditions}
    projected = bool(features - {across, up})
    if not features & {across, up}:
        return
    limits = axes.get_xlim(), axes.get_ylim()
    first = True
    for x0, x1 in _spans(samples, rule, across, limits[0]):
        rows = [limits[1]] if up == across else _spans(samples, rule, up, limits[1])
        for y0, y1 in rows:
            axes.add_patch(
                Rectangle(
                    (x0, y0),
                    x1 - x0,
                    y1 - y0,
                    fill=False,
                    edgecolor=BOUND,
                    linewidth=1.6,
                    linestyle="--" if projected else "-",
                )
            )
            if first:
                right, down = number % 2 == 0, number % 4 in (0, 3)
                axes.annotate(
                    f"{noun}{number}",
                    (x1 if right else x0, y0 if down else y1),
                    xytext=(-4 if right else 4, 4 if down else -4),
                    textcoords="offset points",
                    ha="right" if right else "left",
                    va="bottom" if down else "top",
                    color=BOUND,
                )
                first = False
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])


def _spans(
    samples: Samples, rule: Rule, name: str, limits: tuple[float, float]
) -> list[tuple[float, float]]:
    """Return the intervals of an axis that a rule allows, inside its limits."""
    inset = 0.006 * (limits[1] - limits[0])
    low, high = limits[0] + inset, limits[1] - inset
    for j, column in enumerate(samples.ordered):
        if column.name == name:
            # A whole number is drawn as wide as the step to the next one.
            step = 0.5 * column.integer
            above, upto = rule.region.above[j] + step, rule.region.upto[j] + step
            return [(max(low, above), min(high, upto))]
    for j, column in enumerate(samples.unordered):
        allowed = rule.region.allowed[j] if column.name == name else None
        if allowed is not None:
            return [(i - 1.5 * JITTER, i + 1.5 * JITTER) for i in sorted(allowed)]
    return [(low, high)]


def _positions(samples: Samples, column: Column, seed: int) -> Float[np.ndarray, " n"]:
    if column.ordered:
        values = samples.frame[column.name].to_numpy(np.float64)
        if not column.integer:
            return values
    else:
        values = column.codes(samples.frame[column.name]).astype(np.float64)
    generator = np.random.default_rng(seed)
    return values + generator.uniform(-JITTER, JITTER, len(values))


def _thinned(part: Bool[np.ndarray, " n"]) -> np.ndarray:
    rows = np.flatnonzero(part)
    if len(rows) <= DOTS:
        return rows
    return rows[np.linspace(0, len(rows) - 1, DOTS).astype(int)]


def _wrapped(line: str, width: int = 100) -> str:
    import textwrap

    return textwrap.fill(line, width, subsequent_indent="    ")


def name_points(
    axes: Axes, names: Sequence[str], x: Positions, y: Positions, low: Positions, high: Positions
) -> None:
    """Write names next to points without overlaps; call it after the limits are set.

    A name without room at its point is moved up or down, and joined to it by a line.

    **Arguments:**
    - `names`: the names of the points at `x` and `y`, in the units of the data.
    - `low`, `high`: ends of a horizontal bar at each point that no name may cover.
    """
    figure: Any = axes.figure
    figure.draw_without_rendering()
    renderer = renderer_of(figure)
    points = axes.transData.transform(np.column_stack([x, y]))
    ends = [axes.transData.transform(np.column_stack([at, y])) for at in (low, high)]
    taken = [Bbox([[a - 4, h - 2], [b + 4, h + 2]]) for (a, h), (b, _) in zip(*ends, strict=True)]
    taken += [Bbox.from_bounds(px - 4, py - 4, 8, 8) for px, py in points]
    middle = axes.bbox.x0 + 0.6 * axes.bbox.width
    for name, (px, py) in sorted(zip(names, points.tolist(), strict=True), key=lambda n: -n[1][1]):
        left = px > middle
        text = axes.annotate(
            name, (px, py), xycoords="figure pixels", fontsize=8, ha="right" if left else "left",
            va="center", textcoords="offset pixels", xytext=(-8 if left else 8, 0),
        )  # fmt: skip
        box = text.get_window_extent(renderer)
        text.remove()
        step = 0.55 * box.height
        for shift in sorted((k * step for k in range(-40, 41)), key=abs):
            if py + shift < axes.bbox.y0 + step or py + shift > axes.bbox.y1 - step:
                continue
            away = 8 if abs(shift) < step else 18
            x0 = px - away - box.width if left else px + away
            area = Bbox.from_bounds(x0, py + shift - box.height / 2, box.width, box.height)
            if not area.count_overlaps(taken):
                break
        else:
            continue
        taken.append(area)
        # In the units of the data, so that it stays there in a picture of another size.
        at = axes.transData.inverted().transform((px, py))
        scale = 72 / figure.dpi
        axes.annotate(
            name, tuple(at), fontsize=8, ha="right" if left else "left", va="center",
            textcoords="offset points", xytext=((-away if left else away) * scale, shift * scale),
            arrowprops=None if away == 8 else {"arrowstyle": "-", "color": BOUND, "linewidth": 0.5},
        )  # fmt: skip
