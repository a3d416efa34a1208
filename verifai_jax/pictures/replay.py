"""One simulation: its signals, their bounds, and the deciding instant."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Shaped

from verifai_jax.core.display.figure import Axes, Figure
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import format_seconds, shorten
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.core.values.waveform import HELD, is_waveform
from verifai_jax.evaluation.replay import Replay
from verifai_jax.mtl import Expression, Formula
from verifai_jax.mtl.blame import broken_at
from verifai_jax.mtl.bounds import predicates_of, signal_bounds
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.expression import constant_value
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.pictures.style import (
    BOUND,
    FAILING,
    INPUT,
    SAFE,
    new_figure,
    show_or_save,
    tidy,
    wrap_name,
)

MAX_PANELS = 6
"""Signals drawn at most, unless more are monitored."""
MAX_INPUTS = 3
"""Features that are functions of time drawn at least, however many signals are monitored."""
MAX_BOUNDS = 4
"""Predicates named above a panel at most."""
WIDEST_NAME = 18
"""Characters of a signal's name in one line."""
LONGEST_PREDICATE = 100
"""Characters of a predicate above a panel."""
LONGEST_FORMULA = 240
"""Characters of the formula in the title."""
LONGEST_TITLE = 500
"""Characters of the title."""


def plot_replay(
    replay: Replay, path: str | Path | None = None, signals: Sequence[str] | None = None
) -> Figure:
    """Draw the signals over time with the bounds of all formulas, violations and the instant.

    The signals of formulas come first, then the features that are functions of time (`vj.Signal`),
    then other signals as far as there is room.

    **Arguments:**
    - `signals`: the signals and Signal features to draw, in this order; by default a selection.
    **Raises:** `UnknownNameError` for a signal that does not exist; `ValueError` for an empty list.
    """
    trace, formulas = replay.trace, replay.problem.formulas
    if isinstance(signals, str):
        raise TypeError(f"signals is a list of names, such as [{signals!r}]; got {signals!r}")
    curves = {name: np.asarray(values) for name, values in trace.signals.items()}
    inputs = {n: values for n, values in _input_signals(replay).items() if n not in curves}
    monitored = list(dict.fromkeys(s for f in formulas.values() for s in f.signals()))
    monitored = [signal for signal in monitored if signal in curves]
    others = telling_signals(
        [signal for signal in curves if signal not in monitored], curves, monitored
    )
    curves |= inputs
    ordered = [*monitored, *inputs, *others]
    if signals is not None:
        check_names("signal", signals, ordered)
        if not signals:
            raise ValueError("signals must name at least one signal to draw; got none")
    needed = len(monitored) + min(len(inputs), MAX_INPUTS)
    shown = list(signals or ordered[: max(MAX_PANELS, needed)])
    name = replay.worst
    clock = np.asarray(trace.clock())
    decisive = decisive_instant(formulas[name], trace, replay.problem.end)
    broken, held = _broken(replay), _held(replay)
    values_of = HostValues.for_verdict(trace, replay.problem.end)
    figure = new_figure(figsize=(8, 1.2 + 1.45 * len(shown)))
    panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False).ravel()
    for axes, signal in zip(panels, shown, strict=True):
        values = curves[signal]
        color, width = ("#8d99ae", 1.1)
        if signal in monitored or signal in inputs:
            color, width = (BOUND if signal in monitored else INPUT), 1.6
        steps = "steps-post" if signal in held or is_held(values) else "default"
        axes.plot(clock, values, color=color, linewidth=width, drawstyle=steps)
        _name_signal(axes, f"{signal} (input)" if signal in inputs else signal)
        tidy(axes)
        # A power of ten above the axis, as matplotlib writes it, would cover the predicates there.
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:z.10g}".replace("-", "\u2212"))
        named = {}
        said = "" if decisive is None or decisive[0] != signal else _mark(axes, trace, *decisive)
        for predicate, limits in _bounds(replay, signal, shown).items():
            margin = values_of(predicate)
            _draw_limits(axes, trace, values, limits)
            color = BOUND if (margin < 0).any() else SAFE
            if predicate in broken:
                color = FAILING
                _shade(axes, clock, broken[predicate])
            named[str(predicate)] = (color, float(margin.min()))
        _name_bounds(axes, named, said)
        if decisive is not None:
            axes.axvline(clock[decisive[1]], color=FAILING, linewidth=1, linestyle=":")
    left_out = _left_out([signal for signal in ordered if signal not in shown])
    panels[-1].set_xlabel("time [s]" + left_out, wrap=True)
    figure.align_ylabels(panels)
    worst = f"robustness {replay.rho[name]:z.4g}"
    verdict = f"{worst} ({'violated' if replay.violated else 'ok'})"
    if replay.status != Status.OK:
        verdict = f"no verdict ({replay.status.name.lower()})"
    where = replay.describe_features()
    figure.suptitle(
        shorten(
            f"{shorten(str(formulas[name]), LONGEST_FORMULA)}\n{verdict} at {where}", LONGEST_TITLE
        ),
        fontsize=9,
        color=FAILING if replay.violated else BOUND,
        wrap=True,
    )
    return show_or_save(figure, path)


def _input_signals(replay: Replay) -> dict[str, Float[np.ndarray, "time *k"]]:
    """Return the features that are functions of time, at the samples of the trace."""
    clock = np.asarray(replay.trace.clock())
    waveforms = {}
    leaves = jax.tree_util.tree_flatten_with_path(replay.features, is_leaf=is_waveform)[0]
    for keys, value in leaves:
        if is_waveform(value):
            known = value.duration is not None or value.times is not None
            name = jax.tree_util.keystr(keys, simple=True, separator=".")
            wave = value if known else value.over(replay.duration or 1e-9)
            # Those of a replay in double precision are of another type than JAX has here.
            waveforms[name] = replace(wave, knots=np.asarray(wave.knots, np.float32))
    if not waveforms:
        return {}
    # In one program: each operation alone would compile one.
    at_all = jax.jit(lambda waveforms, clock: {n: jax.vmap(w)(clock) for n, w in waveforms.items()})
    found = at_all(waveforms, clock)
    return {name: np.asarray(found[name]) for name in waveforms}


def _held(replay: Replay) -> set[str]:
    """Return the signals and the inputs whose value is held from each sample to the next."""
    leaves = jax.tree_util.tree_flatten_with_path(replay.features, is_leaf=is_waveform)[0]
    held = {
        jax.tree_util.keystr(keys, simple=True, separator=".")
        for keys, value in leaves
        if is_waveform(value) and value.hold in HELD
    }
    with suppress(Exception):  # A user's functions may take only what they took in the simulation.
        ask = getattr(replay.problem.system, "held_signals", lambda features: ("action",))
        named = ask(replay.features)
        held |= {n for n in replay.trace.signals if n in named or n.split(".")[0] in named}
    return held


def is_held(values: Shaped[np.ndarray, "t *vector"]) -> bool:
    """Return whether a signal keeps each of its values for two samples or more, as if held."""
    if values.dtype.kind in "biu":
        return True
    changes = (values[1:] != values[:-1]).any(axis=tuple(range(1, values.ndim)))
    return bool(changes.any() and not np.any(changes[1:] & changes[:-1]))


def telling_signals(
    names: Sequence[str], curves: Mapping[str, Shaped[np.ndarray, "t *vector"]],
    shown: Sequence[str],
) -> list[str]:  # fmt: skip
    """Return signals in order of their interest for a panel.

    Changing signals come before constant ones, and one signal of each body (`car_x` and `car_y`
    belong to one) before a second one; signals in `shown` are already drawn.
    """
    count: dict[str, int] = {}

    def turn(name: str) -> int:
        body = name.rpartition("_")[0] or name
        count[body] = count.get(body, 0) + 1
        return count[body]

    for name in shown:
        turn(name)
    still = {
        n: np.array_equal(curves[n], np.broadcast_to(curves[n][:1], curves[n].shape)) for n in names
    }
    # Each once, in their own order, before they are sorted.
    rank = {name: (still[name], 0 if still[name] else turn(name)) for name in names}
    return sorted(names, key=rank.__getitem__)


def _left_out(names: list[str]) -> str:
    """Name the signals that are not drawn, for below the last panel."""
    if not names:
        return ""
    listed = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
    return f"\nand {len(names)} more, not drawn: {listed}"


def decisive_instant(formula: Formula, trace: Trace, end: End = "hold") -> tuple[str, int] | None:
    """Return the signal and the sample that decide the verdict, or None.

    A predicate over several signals is marked on the first.
    """
    if not all(np.all(np.isfinite(np.asarray(trace.signals[n]))) for n in formula.signals()):
        return None
    values = HostValues.for_verdict(trace, end)
    decided = values.walk(formula).decision(formula)
    if decided is None or not (named := decided[0].signals()):
        return None
    return named[0], min(decided[1], values.length - 1) // values.stride


def _bounds(replay: Replay, signal: str, shown: Sequence[str]) -> dict[Formula, list[Expression]]:
    """Return the predicates of all formulas that belong to a panel, with their limits in it.

    One that cannot be solved for a signal is named above the first of its signals that is shown.
    """
    bounds: dict[Formula, list[Expression]] = {}
    for formula in replay.problem.formulas.values():
        for part in predicates_of(formula):
            drawn = [name for name in shown if name in part.signals()]
            if any(signal_bounds(part, name) for name in drawn):
                bounds |= dict(signal_bounds(part, signal))
            elif drawn and drawn[0] == signal:
                bounds[part] = []
    return bounds


def _broken(replay: Replay) -> dict[Formula, Bool[np.ndarray, " t"]]:
    """Return the instants at which predicates break a formula, of all formulas together."""
    found: dict[Formula, Bool[np.ndarray, " t"]] = {}
    for name, formula in replay.problem.formulas.items():
        rho = replay.rho[name]
        if rho < 0 or (rho == 0 and replay.violated):
            for part, at in broken_at(formula, replay.trace, replay.problem.end).items():
                # A trace that ended early stays as it is.
                at = np.pad(at, (0, replay.trace.length - len(at)))
                found[part] = found.get(part, at) | at
    return found


def _draw_limits(
    axes: Axes, trace: Trace, values: Shaped[np.ndarray, "t *vector"], limits: list[Expression]
) -> None:
    """Draw what a predicate compares a signal with, where that is not far from it."""
    finite = values[np.isfinite(values)].astype(float)
    if not finite.size or values.dtype == bool:
        return
    reach = max(float(np.abs(finite).max()), 1e-9)
    style: dict[str, Any] = {"color": BOUND, "linewidth": 0.9, "linestyle": "--", "alpha": 0.8}
    for limit in limits:
        constant = constant_value(limit)
        course: Any = constant
        if constant is None:
            course = HostValues.for_verdict(trace, "hold")(limit >= 0)[:: trace.stride]
        # A bound far away would squeeze the signal into a flat line, unless it is one.
        if np.min(np.abs(course)) > 4 * reach and np.ptp(finite) > 0:
            continue
        if constant is None:
            axes.plot(trace.clock(), course, **style)
        else:
            axes.axhline(constant, **style)


def _shade(axes: Axes, clock: Float[np.ndarray, " t"], fails: Bool[np.ndarray, " t"]) -> None:
    """Shade the instants at which a predicate fails."""
    edges = np.concatenate([clock[:1], (clock[1:] + clock[:-1]) / 2, clock[-1:]])
    # From edge to edge, so that a single instant is seen, too.
    axes.fill_between(
        np.repeat(edges, 2)[1:-1], 0, 1, where=np.repeat(fails, 2).tolist(),
        transform=axes.get_xaxis_transform(), color=FAILING, alpha=0.13, linewidth=0,
    )  # fmt: skip


def _name_signal(axes: Axes, name: str) -> None:
    """Write a name next to its panel, across: panels are less high than names are long."""
    axes.set_ylabel(
        wrap_name(name, WIDEST_NAME, 4), rotation=0, ha="right", va="center", fontsize=9
    )


def _name_bounds(axes: Axes, predicates: dict[str, tuple[str, float]], decided: str) -> None:
    """Write the predicates of a panel above it, one a line, first those that break a formula.

    - `predicates`: by their text, each with its colour and its least margin.
    - `decided`: what decided there, for a line above them; empty for nothing.
    """
    ranks = [FAILING, BOUND, SAFE]
    rank = {text: (ranks.index(color), lowest) for text, (color, lowest) in predicates.items()}
    ranked = sorted(predicates, key=rank.__getitem__)
    named, others = ranked[:MAX_BOUNDS], ranked[MAX_BOUNDS:]
    lines = [(text, predicates[text][0]) for text in named]
    if others:
        lines.append((f"and {len(others)} more", predicates[others[0]][0]))
    if decided:
        lines.insert(0, (decided, FAILING))
    for number, (text, color) in enumerate(reversed(lines)):
        axes.annotate(
            shorten(text, LONGEST_PREDICATE),
            (0.0, 1.0),
            xycoords="axes fraction",
            xytext=(0, 9 * number),
            textcoords="offset points",
            ha="left",
            va="bottom",
            fontsize=7,
            color=color,
        )


def _mark(axes: Axes, trace: Trace, signal: str, sample: int) -> str:
    """Mark the instant that decided; return what is said of it, above the curves."""
    time = float(trace.clock()[sample])
    value = np.asarray(trace.signals[signal])[sample]
    if np.ndim(value):
        value = value[int(np.argmax(np.abs(value)))]
    axes.plot([time], [value], "o", color=FAILING, markersize=6, clip_on=False)
    return f"decided by {signal} = {value:z.4g} at {format_seconds(time, 4)}"
