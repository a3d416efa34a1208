"""The form of modelled traces: their signals, their clock, and the samples for the monitor.

    form = TraceForm.of(signals, dt, length, formulas)
    form.flat(trace)                                    # the modelled samples of a real trace
    form.trace(flat)                                    # and back, for the monitor

A few hundred samples of a signal are modelled, however short the step of the simulator is.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float

from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.formula import Formula

SAMPLES = 256
"""Samples of a signal that are modelled; those between are interpolated."""


@dataclass(frozen=True)
class TraceForm:
    """The form of the modelled traces.

    - `signals`: names and components (0 for a plain signal) in order; -1 and less, -1 of them for
      a plain signal, where they are truth values.
    - `dt`: sampling period in seconds.
    - `length`: number of samples.
    - `stride`: step between the samples of a modelled trace that the monitor reads.
    """

    signals: tuple[tuple[str, int], ...]
    dt: float
    length: int
    stride: int = 1

    @classmethod
    def of(
        cls, signals: tuple[tuple[str, int], ...], dt: float, length: int,
        formulas: Iterable[Formula],
    ) -> "TraceForm":  # fmt: skip
        """Return the form with the largest stride that the formulas allow.

        A model's trace has no more detail than its modelled samples. Monitoring it at every sample
        of a simulator, tens of thousands instead of a few hundred, gives the same result at many
        times the cost. Windows keep their bounds, and the last sample is always included.
        """
        divided = math.gcd(length - 1, *(_bounds(formulas, dt)))
        strides = range(1, max(length - 1, 1) // SAMPLES + 1)
        stride = max((n for n in strides if divided % n == 0), default=1)
        return cls(signals, dt, length, stride)

    @property
    def positions(self) -> Float[np.ndarray, " samples"]:
        """Indices of the modelled samples among all."""
        return np.linspace(0, self.length - 1, min(self.length, SAMPLES))

    def fits(self, trace: Trace) -> bool:
        """Return whether a trace has these signals and this clock; its length may differ."""
        names = [name for name, _ in self.signals]
        same = all(name in trace.signals for name in names)
        same = same and signals_of(trace, names) == self.signals
        return same and bool(np.isclose(trace.dt or 0.0, self.dt))

    def flat(self, trace: Trace) -> Float[np.ndarray, " values"]:
        """Return the modelled samples of a trace as one vector, signal by signal."""
        own, parts = np.arange(self.length), []
        for name, _ in self.signals:
            signal = np.asarray(trace.signals[name])
            signal = signal.reshape(len(signal), -1)
            # A shorter one stays as it ended.
            signal = signal[np.minimum(own, len(signal) - 1)]
            parts += [np.interp(self.positions, own, column) for column in signal.T]
        return np.concatenate(parts).astype(np.float32)

    def held(self, row: Float[np.ndarray, " values"]) -> Float[np.ndarray, "signals time"]:
        """Interpolate modelled samples linearly to every sample."""
        own = np.arange(self.length)
        columns = row.reshape(-1, len(self.positions))
        return np.stack([np.interp(own, self.positions, column) for column in columns])

    def trace(self, flat: Float[Array, " values"]) -> Trace:
        """Return the trace of modelled samples at the form's stride; traced by JAX."""
        positions, own = self.positions, np.arange(0, self.length, self.stride)
        left = own * (len(positions) - 1) // max(self.length - 1, 1)
        left = np.minimum(left, max(len(positions) - 2, 0))
        right = np.minimum(left + 1, len(positions) - 1)
        gap = np.maximum(positions[right] - positions[left], 1e-9)
        weight = ((own - positions[left]) / gap).astype(np.float32)
        columns = flat.reshape(-1, len(positions))
        columns = columns[:, left] * (1 - weight) + columns[:, right] * weight
        signals, first = {}, 0
        for name, number in self.signals:
            components = max(number, -1 - number)
            signal = columns[first : first + max(components, 1)]
            signals[name] = signal.T if components else signal[0]
            first += max(components, 1)
        truths = frozenset(name for name, number in self.signals if number < 0)
        return Trace(signals, self.dt * self.stride, finite=tuple(signals), truths=truths)


def signals_of(trace: Trace, names: list[str]) -> tuple[tuple[str, int], ...]:
    """Return the components of these signals of a trace, as `TraceForm` has them."""
    shapes = [(name, np.shape(trace.signals[name])) for name in names]
    numbers = {name: int(np.prod(s[1:])) if len(s) > 1 else 0 for name, s in shapes}
    return tuple((name, -1 - k if trace.is_truth(name) else k) for name, k in numbers.items())


def _bounds(formulas: Iterable[Formula], dt: float) -> list[int]:
    """Return the finite bounds of all windows in samples; for "next", those of one sample."""
    bounds = []
    for formula in formulas:
        for part in formula.subformulas(valued=True):
            bounds.extend(round(bound / dt) for bound in part.span(dt) if math.isfinite(bound))
    return bounds
