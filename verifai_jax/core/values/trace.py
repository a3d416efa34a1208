"""The trace of a simulation: named signals on one clock.

    Trace({"x": xs, "theta": thetas}, dt=0.02)
    Trace({"x": xs}, times=ts)                              # a recording, not evenly sampled
    Trace({"x": xs}, dt=0.02, valid=k)                      # ended early: k samples count
    Trace.from_dataframe(frame)                             # a column `time`, one column a signal

A trace is a pytree, so `jax.vmap` over a system gives a batch of traces.
"""

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.errors import TracerArrayConversionError
from jaxtyping import Array, Bool, Int, Real

from verifai_jax.core.display.extensions import verb
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_count, check_name, is_number
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.core.values.gaps import has_truths, known_times, with_gaps

if TYPE_CHECKING:
    import pandas as pd
Samples: TypeAlias = (
    Real[Array | np.ndarray | jax.ShapeDtypeStruct, "time *k"]
    | Bool[Array | np.ndarray | jax.ShapeDtypeStruct, "time *k"]
)
"""A signal or its form, one row a sample; a truth value is the number 1 or 0."""
Leaf: TypeAlias = Array | np.ndarray | jax.ShapeDtypeStruct | np.integer | int | None
"""A part of a trace."""


class Status(enum.IntEnum):
    """The end of a simulation; only `OK` rows carry a verdict."""

    OK = 0
    NONFINITE = 1
    ERROR = 2
    TIMEOUT = 3


@dataclass(frozen=True, eq=False)
class Trace(InNotebook):
    """The signals of one simulation, with common sample times.

    **Arguments:**
    - `signals`: name -> array `[time]` or `[time, k]`; all with the same `time`.
    - `dt`: sampling period in seconds. Exactly one of `dt` and `times` is given.
    - `times`: `[time]` strictly increasing sample times in seconds.
    - `valid`: number of valid samples, `1 <= valid <= time`; all when left out. Later samples never
      influence a verdict.
    - `status`: a `Status` code; `Status.OK` when left out.
    - `held`: a promise of the producer that all samples from `valid` on repeat the last valid one,
      which saves the monitor a pass over the signals.
    - `finite`: names of signals that the producer guarantees to be finite if the status is OK,
      which saves another pass.
    - `between`: values recorded between consecutive samples, the same number after each sample: a
      trace with signals `[time * m]` or `[time * m, k]`, and sample times. `mtl.resample` stores
      there what its clock skips, and verdicts include it.
    - `notes`: messages of the producer on this simulation or recording, each with the number of its
      occurrences, `{"the solver fell back to Euler": 3}`. A run adds them up in its notes.
    - `units`: units of signals by name, from the recording; of `time` if it is not in seconds.
    - `truths`: names of the signals of numbers 1, 0 and NaN that are truth values with gaps.

    Notes and units stay on the host: JAX's transformations drop them.

    A signal with masked or missing samples (`numpy.ma`, `None`, `pandas.NA`) has gaps: they become
    NaN, and verdicts never use masked values.

    Values known when the trace is made are checked then; invalid values that JAX traces give the
    status `ERROR` of the row.

    **Raises:** `ValueError` for no signals, an empty trace, signals of different lengths, sample
    times that are missing, given twice, not positive or not finite, `valid` below 1 or beyond the
    samples, an invalid status, and masked sample times; `TypeError` for signals that are not real
    numbers, and for notes that are not counts by text.
    """

    _internal = frozenset((
        "between", "between_until", "finite", "held", "hold", "is_truth", "stride", "truths",
    ))  # fmt: skip
    signals: Mapping[str, Samples]
    dt: float | None = None
    times: Real[Array | np.ndarray, " time"] | None = None
    valid: Int[Array | np.ndarray, "*batch"] | np.integer | int | None = None
    status: Int[Array | np.ndarray, "*batch"] | np.integer | int | None = None
    held: bool = False
    finite: tuple[str, ...] = ()
    between: "Trace | None" = None
    notes: Mapping[str, int] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    truths: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if not isinstance(self.signals, Mapping):
            raise TypeError(
                f"signals must be a dictionary of arrays by name; got {type(self.signals).__name__}"
            )
        if not self.signals:
            raise ValueError("a trace needs at least one signal; got none")
        for name in self.signals:
            check_name("the name of a signal", name, lines=True)
        _check_notes(self.notes)
        signals = {name: with_gaps(name, signal) for name, signal in self.signals.items()}
        truths = set(self.truths & signals.keys())
        for name, given in self.signals.items():
            changed = isinstance(signals[name], np.ndarray) and signals[name] is not given
            if changed and signals[name].dtype.kind == "f" and has_truths(given):
                truths.add(name)
        object.__setattr__(self, "truths", frozenset(truths))
        object.__setattr__(self, "signals", signals)
        lengths = {}
        for name, signal in signals.items():
            shape = _shape(name, signal)
            if len(shape) not in (1, 2):
                wanted = "shape [time] or [time, k]"
                raise ValueError(f"signal {name!r} must have {wanted}; got {list(shape)}")
            lengths[name] = shape[0]
        if len(set(lengths.values())) > 1:
            listing = ", ".join(f"{name}: {n}" for name, n in lengths.items())
            raise ValueError(f"signals must have one length; got {listing}")
        length = next(iter(lengths.values()))
        if length == 0:
            raise ValueError("a trace needs at least one sample; got signals of length 0")
        if (self.dt is None) == (self.times is None):
            raise ValueError("a trace has either a sampling period dt or sample times; give one")
        if isinstance(self.dt, Tracer):
            raise ValueError(
                "the sampling period dt must be a plain number, the same in all simulations; got a "
                "value that JAX traces"
            )
        if self.dt is not None:
            object.__setattr__(self, "dt", check_period(self.dt))
        if self.times is not None:
            object.__setattr__(self, "times", known_times(self.times))
            if (shape := np.shape(self.times)) != (length,):
                wanted = f"shape [{length}], like the signals"
                raise ValueError(f"times must have {wanted}; got {list(shape)}")
        if self.between is not None and (
            self.between.signals.keys() != signals.keys() or self.between.length % length
        ):
            raise ValueError(
                f"between must hold the signals {', '.join(signals)}, a multiple of {length} "
                f"samples; got {self.between!r}"
            )
        self._check_codes(length)

    def _check_codes(self, length: int) -> None:
        """Refuse a count of valid samples, or a status, that is known and can be none."""
        wanted = f"how many samples count, from 1 to {length}"
        valid = check_code("valid", self.valid, wanted)
        if valid is not None and not 1 <= valid <= length:
            raise ValueError(f"valid must be {wanted}; got {valid}")
        known = f"one of {', '.join(f'{code.value} ({code.name})' for code in Status)}"
        status = check_code("status", self.status, known)
        if status is not None and status not in list(Status):
            raise ValueError(f"status must be {known}; got {status}")

    @classmethod
    def from_dataframe(
        cls, frame: "pd.DataFrame", time: str = "time", dt: float | None = None,
        time_unit: str | None = None,
    ) -> "Trace":  # fmt: skip
        """Make a trace from a `pandas.DataFrame` with a column for each signal.

        Columns `p[0]`, `p[1]`, ... make one vector signal `p`; columns without numbers are left
        out. `verifai_jax.mtl.read` can also choose columns and resample.

        **Arguments:**
        - `time`: the column of sample times in seconds, or the name of the index; dates and
          durations become seconds since the first one.
        - `dt`: the sampling period in seconds, if there is no column of times.
        - `time_unit`: the unit of the sample times, if their name does not end with it.
        **Raises:** `ValueError` for a frame without rows, numbers or sample times, and for times
        that do not increase.
        """
        return verb("recording")(frame, time=time, dt=dt, time_unit=time_unit)

    @property
    def length(self) -> int:
        """Number of samples stored (valid or not)."""
        return np.shape(next(iter(self.signals.values())))[0]

    def is_truth(self, name: str) -> bool:
        """Return whether a signal consists of truth values, which may have gaps."""
        return name in self.truths or has_truths(self.signals[name])

    def clock(self) -> Real[Array | np.ndarray, " time"]:
        """Return the sample times `[time]` in seconds, in double precision if they are concrete.

        Single precision cannot distinguish time stamps with a distant origin.
        """
        if self.dt is not None:
            return np.arange(self.length) * float(self.dt)
        if isinstance(self.times, Tracer):
            return self.times
        return np.asarray(self.times, float)

    def hold(self) -> "Trace":
        """Return the trace with all samples from `valid` on replaced by the last valid one."""
        if self.valid is None or self.held:
            return self
        index = jnp.minimum(jnp.arange(self.length), jnp.asarray(self.valid) - 1)
        signals = {name: as_array(signal)[index] for name, signal in self.signals.items()}
        return replace(self, signals=signals, held=True, between=self.between_until(self.valid))

    def between_until(self, valid: Leaf) -> "Trace | None":
        """Return `between`, held from the last valid sample on."""
        if self.between is None or valid is None:
            return self.between
        last, more = jnp.asarray(valid) - 1, self.between.length // self.length
        before = jnp.arange(self.between.length) // more < last
        held = {}
        for name, signal in self.between.signals.items():
            each = as_array(signal)
            known = before.reshape((-1,) + (1,) * (each.ndim - 1))
            held[name] = jnp.where(known, each, as_array(self.signals[name])[last])
        return replace(self.between, signals=held)

    def trim(self) -> "Trace":
        """Return only the valid part, as NumPy arrays; for display, not under `jit`."""
        n = self.length if self.valid is None else int(self.valid)
        between = self.between_until(self.valid)
        if between is not None:
            between = between._first(n * (between.length // self.length))
        return replace(self._first(n), valid=None, between=between)

    def _first(self, n: int) -> "Trace":
        """Return the first samples as NumPy arrays."""
        signals = {name: np.asarray(signal)[:n] for name, signal in self.signals.items()}
        times = None if self.times is None else np.asarray(self.times)[:n]
        return replace(self, signals=signals, times=times, between=None, valid=None)

    def finely(self) -> "Trace":
        """Return all samples in one sequence, including those between the others.

        If nothing was recorded in between, the trace itself is returned. Sample times are then
        uneven; `between` may repeat a sample so that there are equally many after each.
        """
        between = self.between
        if between is None:
            return self
        more = between.length // self.length

        def joined(own: Any, inner: Any) -> Array:
            own, inner = as_array(own), as_array(inner)
            inner = inner.reshape((self.length, more, *inner.shape[1:])).astype(own.dtype)
            both = jnp.concatenate([own[:, None], inner], axis=1)
            return both.reshape((-1, *own.shape[1:]))

        signals = {n: joined(signal, between.signals[n]) for n, signal in self.signals.items()}
        times = None
        if _is_known(between.times):
            rows = np.asarray(between.times, float).reshape(self.length, more)
            times = np.concatenate([self.clock()[:, None], rows], axis=1).reshape(-1)
        dt = self.dt if times is None else None
        valid = None if self.valid is None else (jnp.asarray(self.valid) - 1) * (more + 1) + 1
        return replace(self, signals=signals, dt=dt, times=times, valid=valid, between=None)

    @property
    def stride(self) -> int:
        """Number of samples of `finely` for each sample of this trace."""
        return 1 if self.between is None else 1 + self.between.length // self.length

    def __getitem__(self, name: str) -> Samples:
        return self.signals[name]

    def __repr__(self) -> str:
        return f"Trace({', '.join(self.signals)}; {self._span()})"

    def __str__(self) -> str:
        width = max(map(len, self.signals))
        lines = [f"trace of {self._span()}"]
        for name, signal in self.signals.items():
            unit = self.units.get(name, "")
            lines.append(f"  {name:<{width}}  {_range(signal, self.valid)} {unit}".rstrip())
        lines += [f"  note: {note}" for note in self.notes]
        return "\n".join(lines)

    def _span(self) -> str:
        """Return the number of samples, the clock, and how it ended."""
        count = f"{self.length} sample{'s' * (self.length != 1)}"
        unit = None if "time" in self.signals else self.units.get("time")
        written = format_seconds if unit is None else lambda time: f"{time:z,.10g} {unit}"
        text = count if self.dt is None else f"{count} every {written(self.dt)}"
        if self.dt is None and not isinstance(self.times, Tracer | jax.ShapeDtypeStruct):
            first, last = (written(float(self.clock()[i])) for i in (0, -1))
            text += f" from {first} to {last}"
        valid, status = (
            None if code is None or np.shape(code) or not _is_known(code) else int(code)
            for code in (self.valid, self.status)
        )
        text += "" if valid is None or valid >= self.length else f", of which {valid} count"
        return text if not status else f"{text}, status {Status(status).name.lower()}"


def _check_notes(notes: object) -> None:
    """Refuse notes that are not counts by text, or that count below zero."""
    wanted = 'notes must be counts by text, such as {"the solver fell back to Euler": 3}'
    if not isinstance(notes, Mapping):
        raise TypeError(f"{wanted}; got {type(notes).__name__}")
    for note, times in notes.items():
        if not isinstance(note, str):
            raise TypeError(f"{wanted}; got the text {note!r}")
        check_count(f"the count of note {note!r}", times, 0)


def check_code(name: str, value: Any, wanted: str) -> int | None:
    """Check that a value of a trace is an integer, or an array of integers.

    **Arguments:**
    - `name`, `wanted`: its name and its allowed values, for the message.
    **Returns:** the number if it is concrete and a single one, else None.
    **Raises:** `ValueError` for texts, fractions, truth values and lists.
    """
    if value is None:
        return None
    kind = getattr(getattr(value, "dtype", None), "kind", None)
    if kind is None:
        # An index of Python: neither a truth value nor a number that happens to be whole.
        kind = "i" if isinstance(value, int) and not isinstance(value, bool) else "O"
    if kind not in "iu":
        raise ValueError(f"{name} must be {wanted}; got {value!r}")
    return int(value) if _is_known(value) and not np.ndim(value) else None


def check_period(dt: Any) -> float:
    """Return a sampling period in a form that JAX can compute with.

    **Raises:** `TypeError` for anything that is not a number, `ValueError` for one that is too
    small or too large.
    """
    if not is_number(dt):
        if getattr(dt, "shape", None) != () or getattr(dt.dtype, "kind", "") not in "iuf":
            raise TypeError(f"the sampling period dt must be a number of seconds; got {dt!r}")
        dt = float(dt)
    if not dt > 0:
        raise ValueError(f"the sampling period dt must be positive; got {dt}")
    minimum = float(np.finfo(np.float32).tiny)
    if not minimum <= dt < math.inf:
        raise ValueError(
            f"the sampling period dt must be a finite number of seconds, at least {minimum:z.3g}, "
            f"the least in single precision; got {dt}"
        )
    return dt


def without_wrapping(signal: Samples) -> Samples:
    """Return a signal whose numbers JAX preserves: 64-bit integers of the host become floats.

    In single precision JAX would keep only the lower 32 bits of a NumPy integer; the monitor
    converts to floats of the present precision anyway.
    """
    if isinstance(signal, jax.Array | jax.ShapeDtypeStruct):
        return signal
    numbers = np.asarray(with_gaps("", signal))
    wide = numbers.dtype.kind in "iu" and numbers.dtype.itemsize > 4
    return numbers.astype(jnp.result_type(float)) if wide else numbers


def as_array(signal: Samples) -> Array:
    """Return a signal as a JAX array; its integers are not truncated to 32 bits."""
    return jnp.asarray(without_wrapping(signal))


def _shape(name: str, signal: Samples) -> tuple[int, ...]:
    if callable(signal):
        raise ValueError(
            f"signal {name!r} must be an array of samples; got the function {signal!r}: call it "
            "with the sample times"
        )
    try:
        dtype = getattr(signal, "dtype", None)
        if getattr(dtype, "kind", "") == "c":
            raise TypeError(f"signal {name!r} must hold real numbers; got {dtype}")
        return np.shape(signal)
    except TracerArrayConversionError:
        raise ValueError(
            f"signal {name!r} must be an array; got a {type(signal).__name__} of values: join them "
            "with jnp.stack"
        ) from None


def _is_known(value: Leaf) -> bool:
    """Return whether a value is a concrete one, not a placeholder of JAX."""
    plain = isinstance(value, jax.Array | np.ndarray | np.generic | int)
    return plain and not isinstance(value, Tracer)


def _range(signal: Samples, valid: Leaf) -> str:
    """Return the shape of a signal and its range where it counts, as text."""
    shape: tuple[int, ...] = signal.shape
    text = "" if len(shape) == 1 else f"[{', '.join(map(str, shape[1:]))}]  "
    if not _is_known(signal):
        return f"{text}{getattr(signal, 'dtype', '')}".strip()
    values = np.asarray(signal)
    if _is_known(valid) and not np.ndim(valid):  # pyright: ignore[reportArgumentType]
        values = values[: int(valid)]  # pyright: ignore[reportArgumentType]
    if values.dtype == bool:
        return f"{text}true in {values.mean():.0%} of the samples"
    finite = values[np.isfinite(values)]
    if not finite.size:
        return f"{text}not finite"
    low, high = float(finite.min()), float(finite.max())
    some = "" if finite.size == values.size else ", not finite in places"
    return f"{text}{f'{low:z.4g}' if low == high else f'{low:z.4g} to {high:z.4g}'}{some}"


_CHILDREN = ("times", "valid", "status", "between")


def _flatten(trace: Trace) -> tuple[list[tuple[Any, Any]], Any]:
    # The names are static and in the order written; JAX would sort a dictionary's.
    names = tuple(trace.signals)
    keys = [(jax.tree_util.DictKey(name), trace.signals[name]) for name in names]
    keys += [(jax.tree_util.GetAttrKey(name), getattr(trace, name)) for name in _CHILDREN]
    return keys, (names, trace.dt, trace.held, trace.finite, trace.truths)


def _unflatten(static: Any, children: Any) -> Trace:
    # JAX unflattens with placeholders (and with batched leaves), which the checks would refuse.
    trace = object.__new__(Trace)
    names, dt, held, finite, truths = static
    values = tuple(children)
    fields = {"signals": dict(zip(names, values, strict=False)), "dt": dt, "held": held}
    fields |= {"finite": finite, "notes": {}, "units": {}, "truths": truths}
    fields |= dict(zip(_CHILDREN, values[len(names) :], strict=True))
    for name, value in fields.items():
        object.__setattr__(trace, name, value)
    return trace


jax.tree_util.register_pytree_with_keys(Trace, _flatten, _unflatten)
