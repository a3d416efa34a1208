"""The form of its traces that a simulator declares, checked for each trace, and its files."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import numpy as np

from verifai_jax.core.messages.checks import check_count, is_number
from verifai_jax.core.values.trace import Trace

SignalNames = Sequence[str] | Mapping[str, int]


@dataclass(frozen=True)
class TraceForm:
    """The required form of a simulator's traces, None without a requirement, and its files.

    **Arguments:**
    - `signals`: names of scalars, or names with their number of components (1 for a scalar).
    - `dt`: sampling period in seconds.
    - `length`: number of samples.
    - `source_files`: the files that it reads, with their hashes when they were declared.
    **Raises:** `ValueError` for requirements that no trace can meet.
    """

    signals: SignalNames | None = None
    dt: float | None = None
    length: int | None = None
    source_files: Mapping[str, str] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        signals, dt, length = self.signals, self.dt, self.length
        if signals is not None:
            named = not isinstance(signals, str) and all(isinstance(n, str) for n in signals)
            if not named or not len(signals):
                raise ValueError(f"signals must be names, such as ('x', 'theta'); got {signals!r}")
            for name, width in self.widths.items():
                if not isinstance(width, int) or width < 1:
                    raise ValueError(
                        f"signals must say how many components {name!r} has, at least 1; "
                        f"got {width!r}"
                    )
        if dt is not None and not (is_number(dt) and 0 < dt < math.inf):
            raise ValueError(f"dt must be a positive number of seconds; got {dt!r}")
        if length is not None:
            check_count("length", length)

    @property
    def widths(self) -> dict[str, int]:
        """The number of components of each signal."""
        signals = () if self.signals is None else self.signals
        return dict(signals) if isinstance(signals, Mapping) else dict.fromkeys(signals, 1)

    def abstract(self) -> Trace | None:
        """Return a trace of this form as shapes; None if the form is incomplete."""
        if self.signals is None or self.dt is None or self.length is None:
            return None
        shapes = {n: (self.length, *([] if w == 1 else [w])) for n, w in self.widths.items()}
        signals: Any = {n: jax.ShapeDtypeStruct(s, np.float32) for n, s in shapes.items()}
        return Trace(signals, dt=self.dt)

    def accept(self, trace: object) -> Trace:
        """Return a simulator's trace with NumPy signals, if it has this form.

        **Raises:** `TypeError` for anything but a trace of numbers, `ValueError` for a trace of
        another form; both name the expected and the received form.
        """
        if not isinstance(trace, Trace):
            raise TypeError(f"the system must return a Trace; it returned {type(trace).__name__}")
        for code, value in (("valid", trace.valid), ("status", trace.status)):
            shape = [] if value is None else list(np.asarray(value).shape)
            if shape:
                raise ValueError(f"{code} must be one number for a simulation; got shape {shape}")
        signals = {name: np.asarray(signal) for name, signal in trace.signals.items()}
        for name, signal in signals.items():
            if signal.dtype.kind not in "biuf":
                raise TypeError(f"signal {name!r} must hold real numbers; got {signal.dtype}")
        if self.signals is not None:
            self._check_signals(signals)
        if self.dt is not None:
            wanted = f"the trace must have the sampling period dt={self.dt}"
            if trace.dt is None:
                raise ValueError(f"{wanted}; it has sample times")
            if not math.isclose(trace.dt, self.dt, rel_tol=1e-6):
                raise ValueError(f"{wanted}; got dt={trace.dt}")
        if self.length is not None and trace.length != self.length:
            raise ValueError(f"the trace must have {self.length} samples; got {trace.length}")
        return replace(trace, signals=signals)

    def _check_signals(self, signals: Mapping[str, np.ndarray]) -> None:
        widths = self.widths
        if signals.keys() != widths.keys():
            missing = ", ".join(name for name in widths if name not in signals)
            extra = ", ".join(name for name in signals if name not in widths)
            how = [f"{missing} missing"] * bool(missing) + [f"{extra} not expected"] * bool(extra)
            raise ValueError(
                f"the trace must have the signals {', '.join(widths)}; got "
                f"{', '.join(signals)} ({'; '.join(how)})"
            )
        for name, width in widths.items():
            shape = signals[name].shape
            if shape[1:] != (() if width == 1 else (width,)):
                wanted = "[time]" if width == 1 else f"[time, {width}]"
                hint = ""
                if not isinstance(self.signals, Mapping):
                    hint = f"; declare vectors by signals={{{name!r}: {shape[1]}, ...}}"
                raise ValueError(f"signal {name!r} must be {wanted}; got {list(shape)}{hint}")
