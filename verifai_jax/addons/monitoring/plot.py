"""The picture of an explanation: the formula's tree, and next to it each part over time.

    draw(explain(formula, trace), path="why.png")

Each row is a sub-formula: green where it holds, red where it fails. Predicates show their signal
and its bound. The line from the top joins the deciding instants, down to the deciding predicate.
"""

import itertools
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from verifai_jax.core.display.figure import Axes, Figure, new_figure
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.mtl._explain import Explanation, Node, heading
from verifai_jax.mtl.formula import Term
from verifai_jax.mtl.semantics import hard
from verifai_jax.mtl.setting import evaluator_of, prepare

HOLDS, FAILS, PATH, QUIET = "#0a8f6a", "#cf3f21", "#1b2a41", "#7b8794"
_MAX_ROWS = 14
"""Rows of a picture: more of them are too low to be read on one page."""


def draw(explanation: Explanation, path: str | Path | None = None) -> Figure:
    """Draw an explanation; returns the matplotlib figure, and saves it to `path` if given."""
    from matplotlib.patches import ConnectionPatch

    rows = _rows(explanation.tree)
    heights = [1.0 if node.children else 2.6 for _, node in rows]
    title = textwrap.wrap(str(explanation.formula), 105)
    if len(title) > 3:
        title = [*title[:3], "..."]
    head = 0.95 + 0.23 * (len(title) - 1)
    size = (11.0, 0.38 * sum(heights) + 0.12 * len(rows) + head + 0.6)
    figure = new_figure(figsize=size, facecolor="white")
    top, bottom = 1 - head / size[1], 0.5 / size[1]
    grid = figure.add_gridspec(
        len(rows), 1, height_ratios=heights, left=0.34, right=0.9, top=top, bottom=bottom,
        hspace=0.22,
    )  # fmt: skip
    verdict = "holds" if explanation.holds else "fails"
    decided = (
        f"{verdict} with robustness {explanation.robustness:z.4g}: decided by  "
        f"{explanation.predicate}  at {format_seconds(explanation.time)}"
    )
    above, below = 1 - 0.15 / size[1], 1 - (head - 0.5) / size[1]
    color = HOLDS if explanation.holds else FAILS
    figure.text(0.02, above, "\n".join(title), fontsize=12, weight="bold", va="top", color=PATH)
    figure.text(0.02, below, _shortened(decided, 130), fontsize=11, va="top", color=color)
    figure.text(
        0.02, 0.14 / size[1], "green: holds   red: fails   dashed: bound", fontsize=9, color=QUIET
    )
    clock = np.asarray(explanation.trace.clock())
    ticks = []
    axes = []
    for k, (depth, node) in enumerate(rows):
        axis = figure.add_subplot(grid[k])
        axes.append(axis)
        y = (
            _predicate(axis, explanation, node, clock)
            if not node.children
            else _strip(axis, node, clock)
        )
        _label(figure, axis, depth, node, size[0])
        _dress(axis, clock, last=k == len(rows) - 1)
        if node.decides:
            ticks.append((axis, node.time, y))
    for (upper, t0, y0), (lower, t1, y1) in itertools.pairwise(ticks):
        figure.add_artist(
            ConnectionPatch(
                (t0, y0),
                (t1, y1),
                "data",
                "data",
                axesA=upper,
                axesB=lower,
                color=PATH,
                lw=1.4,
                arrowstyle="-|>",
                mutation_scale=11,
                shrinkA=3,
                shrinkB=5,
                zorder=20,
            )
        )
    for n, (axis, t, y) in enumerate(ticks):
        final = n == len(ticks) - 1
        axis.plot(
            [t], [y], "o", ms=9 if final else 5, zorder=21, clip_on=False,
            mfc=(HOLDS if explanation.holds else FAILS) if final else "white", mec=PATH, mew=1.4,
        )  # fmt: skip
    if path is not None:
        with replacing(path) as partial:
            figure.savefig(partial, dpi=130)
    return figure


def _rows(tree: Node) -> list[tuple[int, Node]]:
    """Choose the nodes to show: all, or the deciding path with its neighbours if too many."""
    rows = tree.flat()
    if len(rows) <= _MAX_ROWS:
        return rows

    def near(node: Node, depth: int) -> list[tuple[int, Node]]:
        kept = [(depth, node)]
        if node.decides:
            for child in node.children:
                kept += near(child, depth + 1)
        return kept

    return near(tree, 0)


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 3] + "..."


def _label(figure: Figure, axis: Axes, depth: int, node: Node, width: float) -> None:
    box = axis.get_position()
    middle = (box.y0 + box.y1) / 2
    name = str(node.formula) if not node.children else heading(node.formula)
    indent = 0.02 + 0.016 * depth
    weight = "bold" if node.decides else "normal"
    color = PATH if node.decides else QUIET
    # In two lines where one is too short; letters in bold are wider.
    room = int((0.31 - indent) * width * (10 if node.decides else 11.5))
    lines = textwrap.wrap(name, room)
    text = "\n".join([lines[0], _shortened(" ".join(lines[1:]), room)] if lines[1:] else lines)
    figure.text(indent, middle, text, va="center", fontsize=10.5, weight=weight, color=color)
    value = "" if np.isnan(node.robustness) else f"{node.robustness:+z.3g}"
    figure.text(
        0.91, middle, f"{value}\nat {format_seconds(node.time, 4)}", va="center", fontsize=9,
        weight=weight, color=HOLDS if node.robustness >= 0 else FAILS, linespacing=1.15,
    )  # fmt: skip


def _dress(axis: Axes, clock: np.ndarray, last: bool) -> None:
    margin = 0.01 * (clock[-1] - clock[0]) or 0.5
    axis.set_xlim(clock[0] - margin, clock[-1] + margin)
    for side in ("top", "right", "left", "bottom"):
        axis.spines[side].set_visible(False)
    axis.tick_params(axis="y", labelsize=8, length=0, colors=QUIET)
    axis.tick_params(axis="x", labelsize=9, colors=QUIET, labelbottom=last, length=3 if last else 0)
    if last:
        axis.set_xlabel("time (s)", fontsize=9, color=QUIET)


def _edges(clock: np.ndarray) -> np.ndarray:
    if len(clock) == 1:
        return np.array([clock[0] - 0.5, clock[0] + 0.5])
    middles = (clock[1:] + clock[:-1]) / 2
    return np.concatenate([clock[:1], middles, clock[-1:]])


def _runs(good: np.ndarray) -> list[tuple[int, int, bool]]:
    """Split into stretches of equal truth, `(first, after, truth)`."""
    changes = np.flatnonzero(np.diff(good.astype(int))) + 1
    starts, ends = np.r_[0, changes], np.r_[changes, len(good)]
    return [(int(a), int(b), bool(good[a])) for a, b in zip(starts, ends, strict=True)]


def _strip(axis: Axes, node: Node, clock: np.ndarray) -> float:
    edges = _edges(clock)
    for first, after, good in _runs(node.series >= 0):
        axis.axvspan(
            edges[first], edges[after], 0.22, 0.78, color=HOLDS if good else FAILS,
            alpha=0.75 if node.decides else 0.35, lw=0,
        )  # fmt: skip
    axis.set_ylim(0, 1)
    axis.set_yticks([])
    return 0.5


def _predicate(axis: Axes, explanation: Explanation, node: Node, clock: np.ndarray) -> float:
    """Draw the two sides of a predicate; return the height at the deciding instant."""
    setting, signals, _, _ = prepare(node.formula, explanation.trace, hard, "hold", None)
    evaluator = evaluator_of(setting, signals, None, None, 0)
    last = setting.length - 1

    def side(e: Term) -> np.ndarray:
        values = np.asarray(evaluator.expression(e, 0, last), float)
        return np.broadcast_to(values, (last + 1,))[:: setting.stride]

    edges = _edges(clock)
    for first, after, good in _runs(node.series >= 0):
        axis.axvspan(
            edges[first], edges[after], color=HOLDS if good else FAILS,
            alpha=(0.16 if good else 0.3) if node.decides else 0.1, lw=0,
        )  # fmt: skip
    # An expression by itself is compared with zero, and TRUE and FALSE have nothing to plot.
    sides = [side(term) for term in node.formula.terms()]
    main, bound = (*sides, *[np.zeros(len(clock))] * (2 - len(sides)))
    style: dict[str, Any] = {"color": PATH if node.decides else QUIET, "drawstyle": "default"}
    axis.plot(clock, main, lw=1.7, **style)
    axis.plot(clock, bound, lw=1.2, ls=(0, (4, 2)), **style)
    values = np.concatenate([main[np.isfinite(main)], bound[np.isfinite(bound)]])
    if values.size:
        low, high = values.min(), values.max()
        gap = 0.12 * (high - low) or 0.5
        axis.set_ylim(low - gap, high + gap)
    axis.locator_params(axis="y", nbins=3)
    return float(np.interp(node.time, clock, main))
