"""One simulation: its signals, the bounds they must keep, and the instant that decided."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from verifai_jax.core.figure import Axes, Figure
from verifai_jax.core.trace import Trace
from verifai_jax.evaluation.replay import Replay
from verifai_jax.mtl import Formula, explain, robustness_signal
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.expression import Arithmetic, Component, Number, Signal
from verifai_jax.mtl.formula import Predicate
from verifai_jax.plotting.style import BOUND, FAILING, SAFE, new_figure, show_or_save, tidy

MOST_PANELS = 6
"""Signals drawn at most, unless more are monitored."""


def plot_replay(replay: Replay, path: str | Path | None = None) -> Figure:
    """Draw the signals over time, the monitored first, with bounds, violations and the instant.

    **Arguments:**

    - `replay`: what `run.replay` returned.
    - `path`: of a picture to write; none when left out.

    **Returns:** the figure.
    """
    trace = replay.trace
    name = replay.worst
    formula = replay.problem.formulas[name]
    monitored = [signal for signal in formula.signals() if signal in trace.signals]
    others = [signal for signal in trace.signals if signal not in monitored]
    shown = (monitored + others)[: max(MOST_PANELS, len(monitored))]
    clock = np.asarray(trace.clock())
    decisive = decisive_instant(formula, trace, replay.problem.end)

    figure = new_figure(figsize=(8, 1.2 + 1.45 * len(shown)))
    panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False).ravel()
    for axes, signal in zip(panels, shown, strict=True):
        values = np.asarray(trace.signals[signal])
        color = BOUND if signal in monitored else "#8d99ae"
        axes.plot(clock, values, color=color, linewidth=1.6 if signal in monitored else 1.1)
        axes.set_ylabel(signal)
        tidy(axes)
        for predicate, bounds in _bounds(formula, signal):
            _draw_bounds(axes, clock, values, predicate, bounds, trace, replay.problem.end)
        if decisive is not None:
            axes.axvline(clock[decisive[1]], color=FAILING, linewidth=1, linestyle=":")
    if decisive is not None and decisive[0] in shown:
        _mark(panels[shown.index(decisive[0])], trace, *decisive)
    panels[-1].set_xlabel("time [s]")
    verdict = "violated" if replay.violated else replay.status.name.lower()
    where = replay.describe_features()
    figure.suptitle(
        f"{formula}\nrobustness {replay.rho[name]:.4g} ({verdict}) at {where}"[:400],
        fontsize=9,
        color=FAILING if replay.violated else BOUND,
        wrap=True,
    )
    return show_or_save(figure, path)


def decisive_instant(formula: Formula, trace: Trace, end: End = "hold") -> tuple[str, int] | None:
    """Return the signal and the sample that decide the verdict; None where there are none.

    A predicate over several signals is marked on the first.
    """
    if not all(np.all(np.isfinite(np.asarray(trace.signals[n]))) for n in formula.signals()):
        return None
    why = explain(formula, trace, end=end)
    named = why.predicate.signals()
    if not named:
        return None
    clock = np.asarray(trace.clock())
    return named[0], int(np.argmin(np.abs(clock - why.time)))


def _bounds(formula: Formula, signal: str) -> list[tuple[Predicate, list[float]]]:
    """Return predicates that compare this signal, or its absolute value, with a number."""
    bounds = []
    for part in dict.fromkeys(formula.subformulas()):
        if isinstance(part, Predicate) and isinstance(part.right, Number):
            limit = part.right.value
            inner = part.left
            if isinstance(inner, Arithmetic) and inner.name == "abs":
                inner, limits = inner.arguments[0], [limit, -limit]
            else:
                limits = [limit]
            if isinstance(inner, Component):
                inner = inner.vector
            if inner == Signal(signal):
                bounds.append((part, limits))
    return bounds


def _draw_bounds(
    axes: Axes,
    clock: Float[np.ndarray, " t"],
    values: Float[np.ndarray, "t *vector"],
    predicate: Predicate,
    limits: list[float],
    trace: Trace,
    end: End,
) -> None:
    reach = max(float(np.nanmax(np.abs(values))), 1e-9)
    for limit in limits:
        # A bound far away would squeeze the signal into a flat line.
        if abs(limit) <= 4 * reach:
            axes.axhline(limit, color=BOUND, linewidth=0.9, linestyle="--", alpha=0.8)
    margin = np.asarray(robustness_signal(predicate, trace, end=end))
    axes.fill_between(
        clock,
        0,
        1,
        where=margin < 0,
        transform=axes.get_xaxis_transform(),
        color=FAILING,
        alpha=0.13,
        linewidth=0,
        step="mid",
    )
    axes.annotate(
        str(predicate),
        (0.0, 1.0),
        xycoords="axes fraction",
        ha="left",
        va="bottom",
        fontsize=7,
        color=SAFE if (margin >= 0).all() else FAILING,
    )


def _mark(axes: Axes, trace: Trace, signal: str, sample: int) -> None:
    time = float(np.asarray(trace.clock())[sample])
    value = np.asarray(trace.signals[signal])[sample]
    if np.ndim(value):
        value = value[int(np.argmax(np.abs(value)))]
    axes.plot([time], [value], "o", color=FAILING, markersize=6)
    right = sample > trace.length / 2
    low, high = axes.get_ylim()
    axes.annotate(
        f"{signal} = {value:.4g} at {time:.4g} s",
        (time, value),
        textcoords="offset points",
        xytext=(-12 if right else 12, -12 if value > (low + high) / 2 else 8),
        ha="right" if right else "left",
        fontsize=8,
        color=FAILING,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5},
    )
