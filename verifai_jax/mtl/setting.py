"""The setting of one evaluation: formula, trace and semantics, checked before anything compiles."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Real

from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.messages.text import format_seconds, format_time
from verifai_jax.core.values.trace import Samples, Trace, as_array, check_period
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.evaluate import End, Evaluator
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.sampled import sampled_in
from verifai_jax.mtl.semantics import Semantics


class HorizonError(ValueError):
    """A formula looks beyond the end of a trace; `fact` is the message without its advice."""

    def __init__(self, fact: str) -> None:
        self.fact = fact
        super().__init__(f'{fact}. Use end="hold" or end="truncate", or a longer trace')


class SamplingError(ValueError):
    """An error for a trace whose samples are not evenly spaced.

    `fact` is the message without its advice; `dt` is the usual step in seconds.
    """

    def __init__(self, fact: str, dt: float) -> None:
        self.fact, self.dt = fact, dt
        how = f'resample(trace, dt={dt:zg}, method="hold") or method="linear"'
        super().__init__(f"{fact}. Resample it first, as in {how}")


class Setting(NamedTuple):
    """All static settings of one evaluation.

    `length` counts samples. One period `dt` is `stride` samples long: more than one if values were
    recorded between the samples. `truths` are the signals of truth values, and `units` the known
    ones.
    """

    formula: Formula
    length: int
    dt: float
    kind: str
    error: float | None
    bound: str
    end: End
    compat: str | None
    stride: int = 1
    truths: frozenset[str] = frozenset()
    units: tuple[tuple[str, str], ...] = ()


def as_formula(formula: Formula | str) -> Formula:
    if isinstance(formula, str):
        return parse(formula)
    if not isinstance(formula, Formula):
        raise TypeError(f"a formula or its text is needed; got {formula!r}")
    return formula


def check_trace(trace: object) -> None:
    """Refuse anything that is not a trace, with advice on how to make one."""
    if isinstance(trace, Trace):
        return
    if hasattr(trace, "columns"):
        how = ": write vj.Trace.from_dataframe(...), which reads its column of times"
    elif isinstance(trace, Mapping):
        names = ", ".join(f"{str(name)!r}: ..." for name in list(trace)[:3]) or "'x': ..."
        more = ", ..." if len(trace) > 3 else ""
        how = (
            f", which has no clock: write vj.Trace({{{names}{more}}}, dt=0.1), where dt is the "
            "seconds from one sample to the next, or times=[...] for the seconds of each"
        )
    else:
        how = ': write vj.Trace({"x": [...]}, dt=0.1), signals by name and the seconds of a sample'
    raise TypeError(f"a Trace is needed here; got a {type(trace).__name__}{how}")


def prepare(
    formula: Formula | str, trace: Trace, semantics: Semantics, end: End, compat: str | None
) -> tuple[Setting, dict[str, Array], Array | None, Array | None]:
    """Check an evaluation; return its setting, signals, temperature and valid length."""
    formula = as_formula(formula)
    check_trace(trace)
    if end not in ("hold", "truncate", "strict"):
        raise ValueError(f"end is 'hold', 'truncate' or 'strict'; got {end!r}")
    if compat not in (None, "pymtl"):
        raise ValueError(f"compat is None or 'pymtl'; got {compat!r}")
    if not isinstance(semantics, Semantics):
        raise TypeError(f"semantics is hard, boolean or smooth(tau); got {semantics!r}")
    check_signals(formula, trace, "the trace")
    dt, stride = period(trace), trace.stride
    if end == "strict":
        check_horizon(formula, trace, dt)
    if trace.valid is not None and end == "hold":
        trace = trace.hold()
    trace = trace.finely()
    # Under "hold" only what is counted depends on where a trace ended.
    ends = end != "hold" or sampled_in(formula)
    valid = jnp.asarray(trace.valid) if trace.valid is not None and ends else None
    signals = numbers_of_signals({name: trace.signals[name] for name in formula.signals()})
    setting = Setting(
        formula, trace.length, dt, semantics.kind, semantics.error, semantics.bound, end, compat,
        stride, frozenset(name for name in formula.signals() if trace.is_truth(name)),
        tuple((name, trace.units[name]) for name in formula.signals() if name in trace.units),
    )  # fmt: skip
    tau = None
    if semantics.kind == "smooth" and semantics.error is None:
        dtype = next(iter(signals.values())).dtype if signals else jnp.result_type(float)
        tau = jax.lax.stop_gradient(jnp.asarray(semantics.tau, dtype))
    return setting, signals, tau, valid


def check_signals(formula: Formula, trace: Trace, source: str) -> None:
    """Refuse a signal that a trace lacks, with the note of its recording on it."""
    for name in formula.signals():
        if name not in trace.signals:
            error = missing_name(source, "signal", name, trace.signals)
            said = [n for n in trace.notes if getattr(n, "column", None) == name]
            raise type(error)(f"{str(error).rstrip('.')}; {said[0]}") if said else error


def numbers_of_signals(signals: dict[str, Samples]) -> dict[str, Array]:
    """Return the signals as arrays of one floating type, with 1 for true and 0 for false."""
    arrays = {name: as_array(value) for name, value in signals.items()}
    floats = [a.dtype for a in arrays.values() if jnp.issubdtype(a.dtype, jnp.floating)]
    dtype = jnp.result_type(*floats) if floats else jnp.result_type(float)
    return {name: array.astype(dtype) for name, array in arrays.items()}


def period(trace: Trace) -> float:
    """Return the trace's sampling period in seconds.

    **Raises:** `ValueError` if its sample times are not evenly spaced, or are not known yet.
    """
    if trace.dt is not None:
        return float(trace.dt)
    if isinstance(trace.times, Tracer):
        raise ValueError(
            "the sample times of a trace must be known before compiling; give it a period dt"
        )
    times = np.asarray(trace.times)
    elapsed, resolution = since_first(times)
    if not np.all(np.isfinite(elapsed)):
        k = int(np.argmin(np.isfinite(elapsed)))
        raise ValueError(f"sample times must be finite; sample {k} is at {times[k]:zg} s")
    if len(elapsed) == 1:
        return 1.0
    steps = np.diff(elapsed)
    dt = elapsed[-1] / (len(elapsed) - 1)
    if not np.all(steps > 0):
        k = int(np.argmin(steps))
        single = np.asarray(trace.times).dtype.itemsize < 8 and steps[k] == 0
        raise ValueError(
            f"sample times must increase; got {_at(trace, k)} and then {_at(trace, k + 1)}"
            f"{_too_coarse(trace, resolution) if single else ''}"
        )
    if resolution > 0.1 * dt:
        raise ValueError(
            f"the sample times do not tell a period of {format_seconds(dt)}"
            f"{_too_coarse(trace, resolution)}"
        )
    if np.any(np.abs(steps - dt) > EVEN * dt + resolution):
        k = int(np.argmax(np.abs(steps - dt)))
        raise SamplingError(
            f"the trace is not evenly sampled: steps of {format_seconds(steps.min())} to "
            f"{format_seconds(steps.max())}, as at {_at(trace, k)}",
            float(np.median(steps)),
        )
    check_period(dt)
    return plain_period(dt, resolution / (len(elapsed) - 1))


EVEN = 1e-3
"""Share of the period by which a step may differ: clocks of loggers and of simulators round."""


def since_first(times: Real[np.ndarray, " time"]) -> tuple[Float[np.ndarray, " time"], float]:
    """Return the seconds since the first sample time, and the resolution of the time stamps.

    The origin is subtracted before rounding. Stamps in single precision, as JAX gives them, keep
    their coarse resolution.
    """
    if times.dtype.kind in "iu":
        # Integers are exact, whatever their width and their origin.
        return np.array([int(t) - int(times[0]) for t in times], float), 0.0
    stamps = times if times.dtype.kind == "f" else times.astype(float)
    return stamps.astype(float) - float(stamps[0]), resolution_of(stamps)


def resolution_of(stamps: np.ndarray) -> float:
    """Return by how much sample times are rounded, in seconds; 0 for whole numbers."""
    known = stamps[np.isfinite(stamps)]
    if stamps.dtype.kind != "f" or not len(known):
        return 0.0
    return float(np.spacing(np.abs(known).max()))


def plain_period(dt: float, error: float) -> float:
    """Return the period, or rate, with the fewest digits that agrees with `dt`.

    Stamps are rounded, so 0.1 s may appear as 0.09999 s, and a thirtieth as 0.033333334 s.

    **Arguments:**
    - `error`: the possible error of `dt` in seconds.
    """
    error = max(error, 1e-9 * dt)
    for digits in range(1, 10):
        for meant in (float(f"{dt:z.{digits}g}"), 1 / float(f"{1 / dt:z.{digits}g}")):
            if abs(meant - dt) <= error:
                return meant
    return dt


def _too_coarse(trace: Trace, resolution: float) -> str:
    return (
        f": at {_at(trace, -1)} they are {np.asarray(trace.times).dtype} numbers, whose spacing is "
        f"{resolution:z.3g} s; give them in double precision, or in seconds since the first"
    )


def _at(trace: Trace, k: int) -> str:
    # In seconds, as whoever looks for it in a recording finds it.
    return f"{format_time(float(np.asarray(trace.clock())[k]))} s"


def check_horizon(formula: Formula, trace: Trace, dt: float) -> None:
    """Raise `HorizonError` for a formula that looks beyond the end of a trace."""
    length = trace.length
    if trace.valid is not None and not isinstance(trace.valid, Tracer):
        length = int(np.min(np.asarray(trace.valid)))
    check_reach(formula, (length - 1) * dt, dt)


def check_reach(formula: Formula, duration: float, dt: float) -> None:
    """Raise `HorizonError` for a formula that looks beyond a duration in seconds."""
    horizon, lasts = formula.horizon(dt), format_seconds(duration)
    if horizon > duration * (1 + 1e-9) + 1e-9 * dt:
        what = "has no end" if math.isinf(horizon) else f"looks {format_seconds(horizon)} ahead"
        raise HorizonError(f"the formula {what}, but the trace lasts {lasts}: {formula}")


def evaluator_of(
    setting: Setting, signals: dict[str, Array], tau: Array | float | None, valid: Array | None,
    lanes: int,
) -> Evaluator:  # fmt: skip
    of, pymtl = setting, setting.compat == "pymtl"
    return Evaluator(
        signals, of.length, of.dt, of.kind, tau, of.end, valid, pymtl, lanes,
        stride=of.stride, truths=of.truths, units=dict(of.units),
    )  # fmt: skip
