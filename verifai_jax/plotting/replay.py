"""One simulation: its signals, the bounds they must keep, and the instant that decided."""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from verifai_jax.core.errors import check_names
from verifai_jax.core.figure import Axes, Figure
from verifai_jax.core.trace import Trace
from verifai_jax.core.waveform import is_waveform
from verifai_jax.evaluation.replay import Replay
from verifai_jax.mtl import Formula, explain, robustness_signal
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.expression import Arithmetic, Component, Number, Signal
from verifai_jax.mtl.formula import Predicate
from verifai_jax.mtl.setting import seconds
from verifai_jax.plotting.style import BOUND, FAILING, INPUT, SAFE, new_figure, show_or_save, tidy

MOST_PANELS = 6
"""Signals drawn at most, unless more are monitored."""
MOST_BOUNDS = 4
"""Predicates named above a panel at most."""


def plot_replay(
    replay: Replay, path: str | Path | None = None, signals: Sequence[str] | None = None
) -> Figure:
    """Draw the signals over time with the bounds of all formulas, violations and the instant.

    The signals that formulas speak of come first, then the features that are functions of time
    (`vj.Signal`), then the others, as many as there is room for.

    **Arguments:**

    - `replay`: what `run.replay` returned.
    - `path`: of a picture to write; none when left out.
    - `signals`: the signals and Signal features to draw, in this order; chosen when left out.

    **Returns:** the figure.

    **Raises:** `UnknownNameError` for a signal that there is not; `ValueError` for none.
    """
    trace, formulas = replay.trace, replay.problem.formulas
    curves = {name: np.asarray(values) for name, values in trace.signals.items()}
    inputs = {n: values for n, values in _input_signals(replay).items() if n not in curves}
    monitored = list(dict.fromkeys(s for f in formulas.values() for s in f.signals()))
    monitored = [signal for signal in monitored if signal in curves]
    others = [signal for signal in curves if signal not in monitored]
    curves |= inputs
    ordered = [*monitored, *inputs, *others]
    if signals is not None:
        check_names("signal", signals, ordered)
        if not signals:
            raise ValueError("signals names what is drawn; got none")
    shown = list(signals or ordered[: max(MOST_PANELS, len(monitored))])
    name = replay.worst
    clock = seconds(trace)
    decisive = decisive_instant(formulas[name], trace, replay.problem.end)

    figure = new_figure(figsize=(8, 1.2 + 1.45 * len(shown)))
    panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False).ravel()
    for axes, signal in zip(panels, shown, strict=True):
        values = curves[signal]
        color, width = ("#8d99ae", 1.1)
        if signal in monitored or signal in inputs:
            color, width = (BOUND if signal in monitored else INPUT), 1.6
        axes.plot(clock, values, color=color, linewidth=width)
        axes.set_ylabel(f"{signal} (input)" if signal in inputs else signal)
        tidy(axes)
        bounds = dict(pair for f in formulas.values() for pair in signal_bounds(f, signal))
        for predicate, limits in bounds.items():
            _draw_bounds(axes, clock, values, limits, _margin(replay, predicate))
        _name_bounds(axes, {str(b): float(_margin(replay, b).min()) for b in bounds})
        if decisive is not None:
            axes.axvline(clock[decisive[1]], color=FAILING, linewidth=1, linestyle=":")
    if decisive is not None and decisive[0] in shown:
        _mark(panels[shown.index(decisive[0])], trace, *decisive)
    panels[-1].set_xlabel("time [s]" + _left_out([s for s in ordered if s not in shown]))
    verdict = "violated" if replay.violated else replay.status.name.lower()
    where = replay.describe_features()
    figure.suptitle(
        f"{formulas[name]}\nrobustness {replay.rho[name]:.4g} ({verdict}) at {where}"[:400],
        fontsize=9,
        color=FAILING if replay.violated else BOUND,
        wrap=True,
    )
    return show_or_save(figure, path)


def _input_signals(replay: Replay) -> dict[str, Float[np.ndarray, "time *k"]]:
    """Return the features that are functions of time, at the samples of the trace."""
    clock = seconds(replay.trace)
    waveforms = {}
    leaves = jax.tree_util.tree_flatten_with_path(replay.features, is_leaf=is_waveform)[0]
    for keys, value in leaves:
        if is_waveform(value):
            known = value.duration is not None
            name = jax.tree_util.keystr(keys, simple=True, separator=".")
            waveforms[name] = value if known else value.over(max(float(clock[-1]), 1e-9))
    if not waveforms:
        return {}
    # In one program: each operation alone would compile one.
    at_all = jax.jit(lambda waveforms, clock: {n: jax.vmap(w)(clock) for n, w in waveforms.items()})
    found = at_all(waveforms, clock)
    return {name: np.asarray(found[name]) for name in waveforms}


def _left_out(names: list[str]) -> str:
    """Name the signals that are not drawn, for below the last panel."""
    if not names:
        return ""
    listed = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
    return f"\nand {len(names)} more, not drawn: {listed}"


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
    clock = seconds(trace)
    return named[0], int(np.argmin(np.abs(clock - why.time)))


def signal_bounds(formula: Formula, signal: str) -> list[tuple[Predicate, list[float]]]:
    """Return predicates that compare this signal, or its absolute value, with a number."""
    bounds = []
    for part in dict.fromkeys(formula.subformulas()):
        if not isinstance(part, Predicate):
            continue
        for inner, limit in ((part.left, part.right), (part.right, part.left)):
            if not isinstance(limit, Number):
                continue
            limits = [limit.value]
            if isinstance(inner, Arithmetic) and inner.name == "abs":
                inner, limits = inner.arguments[0], [limit.value, -limit.value]
            if isinstance(inner, Component):
                inner = inner.vector
            if inner == Signal(signal):
                bounds.append((part, limits))
    return bounds


def _margin(replay: Replay, predicate: Predicate) -> Float[np.ndarray, " time"]:
    """Return the robustness of a predicate at each sample."""
    return np.asarray(robustness_signal(predicate, replay.trace, end=replay.problem.end))


def _draw_bounds(
    axes: Axes,
    clock: Float[np.ndarray, " t"],
    values: Float[np.ndarray, "t *vector"],
    limits: list[float],
    margin: Float[np.ndarray, " t"],
) -> None:
    """Draw the bounds of a predicate, and shade where it fails."""
    reach = max(float(np.nanmax(np.abs(values), initial=0.0)), 1e-9)
    for limit in limits:
        # A bound far away would squeeze the signal into a flat line.
        if abs(limit) <= 4 * reach:
            axes.axhline(limit, color=BOUND, linewidth=0.9, linestyle="--", alpha=0.8)
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


def _name_bounds(axes: Axes, margins: dict[str, float]) -> None:
    """Write the predicates of a panel above it, one a line, by their least margin."""
    worst_first = sorted(margins, key=margins.__getitem__)
    named, others = worst_first[:MOST_BOUNDS], worst_first[MOST_BOUNDS:]
    lines = [(text, FAILING if margins[text] < 0 else SAFE) for text in named]
    if others:
        failing = any(margins[text] < 0 for text in others)
        lines.append((f"and {len(others)} more", FAILING if failing else SAFE))
    for number, (text, color) in enumerate(reversed(lines)):
        axes.annotate(
            text,
            (0.0, 1.0),
            xycoords="axes fraction",
            xytext=(0, 9 * number),
            textcoords="offset points",
            ha="left",
            va="bottom",
            fontsize=7,
            color=color,
        )


def _mark(axes: Axes, trace: Trace, signal: str, sample: int) -> None:
    time = float(seconds(trace)[sample])
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
