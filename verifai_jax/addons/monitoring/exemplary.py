"""Traces that illustrate a formula: one satisfies it, one barely does, one breaks it.

    found = examples("always[0, 5] (x > 1 -> eventually[0, 2] y > 3)")
    found.satisfying, found.barely, found.breaking
    found.plot("examples.png")

Signals are free: a search over piecewise constant signals finds a satisfying and a violating trace,
and the gradient of the smooth robustness moves them away from the limit and smooths them. Between
the two lies the trace that barely satisfies the formula.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from verifai_jax.addons.monitoring.free_traces import FreeTraces, Signals, states_of
from verifai_jax.addons.monitoring.normalization import normalize
from verifai_jax.addons.monitoring.recorded import Recordings, named_traces
from verifai_jax.core.compute.compilation import jit_each
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook, picture_html
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._robustness import robustness
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.formula import Formula, Interval, surface
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.mtl.semantics import smooth
from verifai_jax.mtl.setting import as_formula

STEPS, RATE = 200, 0.03
"""Steps of the gradient, and their size in units of each signal's levels: 6 levels in all."""
MARGIN = 1.5
"""Robustness that the examples come to have, in the same units."""
ROUGHNESS = 0.3
"""Weight of the jumps of the signals, so that they move no more than the formula asks for."""
FRACTIONS = 65
"""Traces between two examples in each of two steps that find where the truth changes: to a
four-thousandth, which single precision still tells from none."""


@dataclass(frozen=True)
class Examples(Drawn, InNotebook):
    """Traces that satisfy a formula, barely satisfy it, and break it; None for one not found.

    - `robustness`: the robustness of each by its name.
    """

    formula: Formula
    satisfying: Trace | None = field(repr=False)
    barely: Trace | None = field(repr=False)
    breaking: Trace | None = field(repr=False)
    robustness: dict[str, float]
    _picture = "verifai_jax.addons.monitoring.pictures", "plot_examples"

    @property
    def traces(self) -> dict[str, Trace]:
        """The traces that were found, by their names."""
        named = {"satisfying": self.satisfying, "barely": self.barely, "breaking": self.breaking}
        return {name: trace for name, trace in named.items() if trace is not None}

    def summary(self) -> str:
        """Write the robustness of each trace, and which ones were not found."""
        lines = [str(self.formula)]
        lines += [f"  {name:<12}{value:>z12.4g}" for name, value in self.robustness.items()]
        if self.satisfying is None or self.breaking is None:
            lacking = "satisfies" if self.satisfying is None else "breaks"
            lines.append(f"  no trace that was tried {lacking} it")
        return "\n".join(lines)

    __str__ = summary

    def _notebook_parts(self) -> Iterable[str]:
        yield picture_html(self.plot())


def examples(
    formula: Formula | str, like: Recordings | None = None, *, dt: float | None = None,
    duration: float | None = None, end: End = "hold", seed: int = 0,
) -> Examples:  # fmt: skip
    """Find a trace that satisfies a formula, one that barely satisfies it, and one that breaks it.

    **Arguments:**
    - `formula`: a formula, or its text.
    - `like`: recordings that give the range of the signals; by default near the bounds of the
      formula.
    - `dt`, `duration`: those of the traces, in seconds; by default they follow from the windows.
    - `end`: how a trace continues after the last sample, `"hold"` or `"truncate"`.
    - `seed`: the seed of the search.
    **Raises:** `FormulaSyntaxError`; `ValueError` for windows that need too many samples, and for a
    formula without signals.
    """
    formula = as_formula(formula)
    if not formula.signals():
        raise ValueError(f"{formula} has no signal, so there are no examples")
    traces = () if like is None else tuple(named_traces(like).values())
    free = FreeTraces.of([formula], traces, dt, duration, end)
    found: dict[str, Signals | None] = {}
    # What satisfies shows how only if the left side of each implication holds at some time.
    satisfying = _example(ast.conjunction(formula, *_guards(formula, free.dt)), free, 1, seed)
    found["satisfying"] = satisfying or _example(formula, free, 1, seed)
    found["breaking"] = _example(formula, free, -1, seed)
    one, other = found["satisfying"], found["breaking"]
    found["barely"] = None if one is None or other is None else _between(formula, free, one, other)
    named, values = dict[str, Trace | None](), dict[str, float]()
    for name in ("satisfying", "barely", "breaking"):
        named[name] = None if (signals := found[name]) is None else free.trace(signals)
        if (trace := named[name]) is not None:
            values[name] = float(HostValues.of(trace, end)(formula)[0])
    return Examples(formula, **named, robustness=values)


def _guards(formula: Formula, dt: float) -> list[Formula]:
    """Return that the left side of each implication holds when it is asked."""
    spans = formula.asked(dt).items()
    asked = {f: span for f, span in spans if isinstance(f, Formula) and f.operands()}
    return [
        ast.Eventually(surface(f)[1][0], Interval(max(first, 0.0), max(last, 0.0)))
        for f, (first, last) in asked.items()
        if surface(f)[0] == "implies"
    ]


def _example(formula: Formula, free: FreeTraces, sign: int, seed: int) -> Signals | None:
    """Return signals on which the formula holds (`sign` 1) or fails (-1)."""

    def on_side(values: HostValues) -> np.ndarray:
        return sign * values(formula)[0] + 1e12 * (sign * values.truth(formula)[0] > 0)

    signals, score = free.search(on_side, np.random.default_rng(seed), 1e11)
    if score < 1e11:
        return None
    moved = _moved(formula, free, signals, sign)
    values = free.values({name: signal[:, None] for name, signal in moved.items()})
    return moved if sign * float(values.truth(formula)[0, 0]) > 0 else signals


def _moved(formula: Formula, free: FreeTraces, signals: Signals, sign: int) -> Signals:
    """Return signals that the gradient has moved away from the limit, and smoothed."""
    fixed = states_of([formula])
    scales = {name: scale for name, scale in free.scales.items() if name not in fixed}
    if not scales:
        return signals
    relative = normalize(formula, {name: free.scales[name] for name in formula.signals()})
    start = {name: jnp.asarray(signals[name] / scale) for name, scale in scales.items()}
    held = {name: jnp.asarray(signal) for name, signal in signals.items() if name in fixed}
    moved = _ascended(relative, free.dt, free.end, tuple(scales.items()), start, held, float(sign))
    return signals | {name: np.asarray(own, float) * scales[name] for name, own in moved.items()}


@jit_each(4)
def _ascended(
    formula: Formula, dt: float, end: End, scales: tuple[tuple[str, float], ...],
    start: dict[str, Array], held: dict[str, Array], sign: float | Array,
) -> dict[str, Array]:  # fmt: skip
    optimizer = optax.adam(RATE)

    def loss(moving: dict[str, Array]) -> Float[Array, ""]:
        signals = {name: moving[name] * scale for name, scale in scales} | held
        rho = robustness(formula, Trace(signals, dt=dt), smooth(0.1), end)
        jumps = sum(jnp.sum(jnp.diff(own, axis=0) ** 2) for own in moving.values())
        return jax.nn.relu(MARGIN - sign * rho) + ROUGHNESS * jumps / len(moving)

    def step(_: Array, state: tuple[dict[str, Array], optax.OptState]) -> tuple[object, object]:
        moving, memory = state
        updates, memory = optimizer.update(jax.grad(loss)(moving), memory)
        return optax.apply_updates(moving, updates), memory

    return jax.lax.fori_loop(0, STEPS, step, (start, optimizer.init(start)))[0]


def _between(formula: Formula, free: FreeTraces, satisfying: Signals, breaking: Signals) -> Signals:
    """Return the last trace that satisfies on the way from one that does to one that does not."""
    states, low, high = states_of([formula]), 0.0, 1.0

    def mixed(name: str, shares: Float[np.ndarray, " lanes"]) -> np.ndarray:
        one, other = satisfying[name][:, None], breaking[name][:, None]
        # A state has no values between; it becomes that of the trace that breaks at the end.
        shares = np.floor(shares) if name in states else shares
        return one + shares.reshape((-1,) + (1,) * (one.ndim - 2)) * (other - one)

    for _ in range(2):
        shares = np.linspace(low, high, FRACTIONS)
        values = free.values({name: mixed(name, shares) for name in satisfying})
        first = int(np.argmax(values.truth(formula)[0] <= 0))
        low, high = float(shares[first - 1]), float(shares[first])
    return {name: mixed(name, np.array([low]))[:, 0] for name in satisfying}
