"""Pictures of an explanation and of a shrunk counterexample.

plot_explanation(explain(run), "why.png")             # what broke, when, and which features did it
plot_shrunk(shrink(run), "small.png")               # what departs from nominal, and what broke
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from verifai_jax.core.display.figure import Axes, Figure
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.core.values.waveform import (
    HELD,
    Waveform,
    acting_spans,
    control_times,
    is_waveform,
)
from verifai_jax.counterexamples._explain import Explained, Influence
from verifai_jax.counterexamples.description import format_apart, format_number
from verifai_jax.counterexamples.shrunk import Shrunk
from verifai_jax.mtl import Explanation, robustness_signal
from verifai_jax.mtl.bounds import constant_bounds
from verifai_jax.mtl.formula import formula
from verifai_jax.pictures import style

QUIET = "#8d99ae"
MAX_BARS = 12
"""Features drawn as bars."""
MAX_SIGNALS = 3
"""Input signals drawn."""


def plot_explanation(explained: Explained, path: str | Path | None = None) -> Figure:
    """Draw the deciding signal with its bound and instant, input signals, and the features."""
    features = explained.replay.features
    inputs = [i for i in explained.influences if is_waveform(features.get(i.name))][:MAX_SIGNALS]
    figure = style.new_figure(figsize=(10.5, 3.4 + 1.3 * len(inputs)))
    halves: Any = figure.subfigures(1, 2, width_ratios=(1.6, 1))
    left, right = halves
    heights = [2.2] + [1.0] * len(inputs)
    panels = left.subplots(
        1 + len(inputs), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
    ).ravel()
    draw_decision(panels[0], explained.why)
    for axes, influence in zip(panels[1:], inputs, strict=True):
        _draw_input(axes, influence, explained)
    panels[-1].set_xlabel("time [s]")
    _draw_bars(right.subplots(), explained)
    figure.suptitle(
        _short(f"{explained.replay.problem.name}, row {explained.row}: {explained.why.formula}"),
        fontsize=10,
    )
    return style.show_or_save(figure, path)


def draw_decision(axes: Axes, why: Explanation) -> None:
    """Draw the deciding predicate's left side over time, its bound, and the decisive instant."""
    trace, predicate = why.trace, why.predicate
    clock = np.asarray(trace.clock())
    # A person looks at x, not at its absolute value.
    bounded = constant_bounds(predicate)
    if bounded is None:
        values, label = (
            np.asarray(robustness_signal(predicate, trace)),
            f"robustness of {predicate}",
        )
        bounds = [0.0]
    else:
        expression, bounds = bounded
        values = np.asarray(robustness_signal(formula(expression), trace))
        label = str(expression)
    values, margin = values[: len(clock)], np.asarray(robustness_signal(predicate, trace))
    axes.plot(clock, values, color=style.BOUND, linewidth=1.7)
    if predicate.compared and not bounds:
        _, _, right = predicate.compared
        other = np.asarray(robustness_signal(formula(right), trace))[: len(clock)]
        axes.plot(clock, other, "--", color=QUIET, linewidth=1.2, label=str(right))
        axes.legend(fontsize=8, frameon=False)
    reach = max(float(np.nanmax(np.abs(values))), 1e-9)
    for bound in bounds:
        if abs(bound) <= 4 * reach:
            axes.axhline(bound, color=style.BOUND, linewidth=0.9, linestyle="--", alpha=0.8)
    axes.fill_between(
        clock, 0, 1, where=margin[: len(clock)] < 0, transform=axes.get_xaxis_transform(),
        color=style.FAILING, alpha=0.13, linewidth=0, step="mid",
    )  # fmt: skip
    decided = ""
    if np.isfinite(why.time):
        index = int(np.argmin(np.abs(clock - why.time)))
        axes.axvline(clock[index], color=style.FAILING, linewidth=1, linestyle=":")
        axes.plot([clock[index]], [values[index]], "o", color=style.FAILING, markersize=6)
        shown = format_number(float(values[index]))
        if bounds:
            nearest = min(bounds, key=lambda b: abs(b - values[index]))
            shown = format_apart(float(values[index]), nearest)[0]
        decided = f"\n{shown} at {format_seconds(clock[index], 4)}"
    axes.set_ylabel(style.wrap_name(label, 28))
    # Above the axes, where no curve runs through it.
    title = f"decides: {_short(str(predicate), 100)}{decided}"
    axes.set_title(title, fontsize=9, color=style.FAILING, loc="left")
    style.tidy(axes)


def _draw_input(axes: Axes, influence: Influence, explained: Explained) -> None:
    """Draw an input signal, its nominal value, and the parts of it that matter."""
    wave = explained.replay.features[influence.name]
    length = wave.duration or explained.replay.duration or 0.0
    knots = np.asarray(wave.knots, np.float64)
    knots = knots.reshape(len(knots), -1)
    known = wave.duration is not None or wave.times is not None
    wave = wave if known else wave.over(length)
    axes.plot(*_course(wave, knots[:, 0], length), color=style.BOUND, linewidth=1.5)
    if wave.hold not in HELD:
        times = control_times(len(knots), wave.hold, wave.times, length)
        axes.plot(times, knots[:, 0], ".", color=style.BOUND)
    if influence.nominal and knots.shape[1] == 1:
        usual = _course(wave, np.array(influence.nominal, float), length)
        axes.plot(*usual, "--", color=style.SAFE, linewidth=1, label="nominal")
        axes.legend(fontsize=7, frameon=False, loc="upper right")
    gain = np.nan_to_num(influence.each - explained.rho)
    every = [np.nan_to_num(i.each - explained.rho) for i in explained.influences]
    maximum = max((float(g.max(initial=0.0)) for g in every), default=0.0)
    for span, one in zip(influence.spans or (), gain, strict=False):
        if maximum > 0 and one > 0.02 * maximum:
            axes.axvspan(*span, color=style.FAILING, alpha=0.25 * one / maximum, linewidth=0)
    axes.set_ylabel(style.wrap_name(influence.name, 14))
    style.tidy(axes)


def _course(
    wave: Waveform, knots: Float[np.ndarray, " knots"], length: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return times and values that draw a function of time through these control points."""
    count = len(knots)
    if wave.hold == "linear":
        # The first and the last value hold before and after given times.
        times = control_times(count, wave.hold, wave.times, length)
        clock = np.concatenate([[0.0], times, [max(length, float(times[-1]))]])
        return clock, np.concatenate([knots[:1], knots, knots[-1:]])
    if wave.hold == "pchip":
        clock, smooth = np.linspace(0, length, 40 * count), replace(wave, knots=knots)
        return clock, np.array([smooth(float(time)) for time in clock])
    spans = acting_spans(count, wave.hold, wave.times, wave.width, length)
    corners = [(time, value) for span, value in zip(spans, knots, strict=True) for time in span]
    if wave.hold == "pulse":
        ends = [(span[0], 0.0) for span in spans], [(span[1], 0.0) for span in spans]
        pairs = zip(ends[0], corners[::2], corners[1::2], ends[1], strict=True)
        corners = [(0.0, 0.0), *(corner for four in pairs for corner in four), (length, 0.0)]
    times, values = zip(*corners, strict=True)
    return np.array(times), np.array(values)


def _draw_bars(axes: Axes, explained: Explained) -> None:
    """Draw the robustness with each feature back at nominal; or gradients, if not known."""
    shown = explained.influences[:MAX_BARS]
    names = [i.name for i in shown]
    where = np.arange(len(shown))
    if any(np.isfinite(i.reverted) for i in shown):
        ends = np.array([i.reverted for i in shown])
        colors = [style.SAFE if i.gone else style.FAILING for i in shown]
        axes.barh(where, ends - explained.rho, left=explained.rho, color=colors, height=0.6)
        axes.axvline(0, color=style.BOUND, linewidth=0.9, linestyle="--")
        axes.axvline(explained.rho, color=style.FAILING, linewidth=1, linestyle=":")
        for y, end in zip(where, ends, strict=True):
            # Beside the axes, where no bar and no line is.
            said = format_number(float(end), 3) if np.isfinite(end) else "no verdict"
            axes.annotate(
                said, (1.02, y), xycoords=axes.get_yaxis_transform(), fontsize=8, va="center",
                annotation_clip=False,
            )  # fmt: skip
        axes.set_xlabel(f"robustness with the feature back at nominal\n(now {explained.rho:z.3g})")
        axes.set_title("what removes the failure", fontsize=9, loc="left")
    else:
        sizes = [float(np.abs(np.nan_to_num(i.gradient)).max(initial=0.0)) for i in shown]
        axes.barh(where, sizes, color=QUIET, height=0.6)
        axes.set_xlabel("change of robustness over the feature's range")
        axes.set_title("steepest features", fontsize=9, loc="left")
    axes.set_yticks(where, [style.wrap_name(name) for name in names])
    axes.set_ylim(max(len(shown), 4) - 0.4, -0.6)
    style.tidy(axes)
    axes.grid(visible=False, axis="y")


def plot_shrunk(shrunk: Shrunk, path: str | Path | None = None) -> Figure:
    """Draw the coordinates that depart from nominal, next to the signal that fails."""
    replay = shrunk.replay()
    names = list(shrunk.changed) or ["nothing departs"]
    shown = names[:24]
    figure = style.new_figure(figsize=(10.5, max(3.2, 1.2 + 0.32 * len(shown))))
    right, left = figure.subplots(1, 2, width_ratios=(1.3, 1))
    draw_decision(right, replay.explain())
    right.set_xlabel("time [s]")
    space = shrunk.problem.space
    indices = [space.coordinates.index(name) for name in shown if name in space.coordinates]
    for y, (i, name) in enumerate(zip(indices, shown, strict=False)):
        was, now = shrunk.changed[name]
        left.plot([0, 1], [y, y], color=QUIET, linewidth=3, alpha=0.25, solid_capstyle="round")
        if was is not None:
            left.plot([shrunk.nominal[i], shrunk.u[i]], [y, y], color=style.FAILING, linewidth=2)
            left.plot([shrunk.nominal[i]], [y], "o", color=style.SAFE, markersize=6)
        left.plot([shrunk.u[i]], [y], "o", color=style.FAILING, markersize=7)
        left.annotate(
            f"{'absent' if was is None else format_number(was)} to {format_number(now)}",
            (0.5, y), xytext=(0, 5), ha="center",
            textcoords="offset points", fontsize=7, color=style.BOUND,
        )  # fmt: skip
    labels = [style.wrap_name(label, 24) for label in shrunk.labels[: len(indices)]]
    left.set_yticks(range(len(indices)), labels)
    left.set_ylim(max(len(indices), 1) - 0.4, -0.8)
    left.set_xlim(-0.03, 1.03)
    left.set_xlabel("share of the range: green nominal, red failing")
    title = f"{shrunk.count} of {len(shrunk.u)} depart, by {shrunk.distance:z.3g}"
    left.set_title(title, fontsize=9, loc="left")
    style.tidy(left)
    left.grid(visible=False, axis="y")
    figure.suptitle(_short(f"{shrunk.problem.name}: the least departure that fails"), fontsize=10)
    return style.show_or_save(figure, path)


def _short(text: str, maximum: int = 110) -> str:
    return text if len(text) <= maximum else f"{text[: maximum - 3]}..."
