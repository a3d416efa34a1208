"""The setting of one evaluation: formula, trace and semantics, checked before anything compiles."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from verifai_jax.core.errors import missing_name
from verifai_jax.core.trace import Samples, Trace, as_array, check_period
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.evaluate import End, Evaluator
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.semantics import Semantics


class HorizonError(ValueError):
    """A formula that looks beyond the end of a trace, under `end="strict"`.

    `fact` says by how much, without the advice of the message.
    """

    def __init__(self, fact: str) -> None:
        self.fact = fact
        super().__init__(f'{fact}. Use end="hold" or end="truncate", or a longer trace')


class SamplingError(ValueError):
    """A trace whose samples are not evenly spaced.

    `fact` says where, without the advice of the message; `dt` is the usual step in seconds.
    """

    def __init__(self, fact: str, dt: float) -> None:
        self.fact, self.dt = fact, dt
        super().__init__(
            f"{fact}. Resample it first, as in "
            f'resample(trace, dt={dt:g}, method="hold") or method="linear"'
        )


class Setting(NamedTuple):
    """Everything static about one evaluation."""

    formula: Formula
    length: int
    dt: float
    kind: str
    error: float | None
    bound: str
    end: End
    compat: str | None


def as_formula(formula: Formula | str) -> Formula:
    if isinstance(formula, str):
        return parse(formula)
    if not isinstance(formula, Formula):
        raise TypeError(f"a formula or its text is needed; got {formula!r}")
    return formula


def prepare(
    formula: Formula | str, trace: Trace, semantics: Semantics, end: End, compat: str | None
) -> tuple[Setting, dict[str, Array], Array | None, Array | None]:
    """Check an evaluation; return its setting, its signals, its temperature and valid length."""
    formula = as_formula(formula)
    if end not in ("hold", "truncate", "strict"):
        raise ValueError(f"end is 'hold', 'truncate' or 'strict'; got {end!r}")
    if compat not in (None, "pymtl"):
        raise ValueError(f"compat is None or 'pymtl'; got {compat!r}")
    if not isinstance(semantics, Semantics):
        raise TypeError(f"semantics is hard, boolean or smooth(tau); got {semantics!r}")
    for name in formula.signals():
        if name not in trace.signals:
            raise missing_name("the trace", "signal", name, trace.signals)
    dt = period(trace)
    if end == "strict":
        _check_horizon(formula, trace, dt)
    valid = None
    if trace.valid is not None:
        if end == "hold":
            trace = trace.hold()
        else:
            valid = jnp.asarray(trace.valid)
    signals = _numbers({name: trace.signals[name] for name in formula.signals()})
    setting = Setting(
        formula, trace.length, dt, semantics.kind, semantics.error, semantics.bound, end, compat
    )
    tau = None
    if semantics.kind == "smooth" and semantics.error is None:
        dtype = next(iter(signals.values())).dtype if signals else jnp.result_type(float)
        tau = jax.lax.stop_gradient(jnp.asarray(semantics.tau, dtype))
    return setting, signals, tau, valid


def _numbers(signals: dict[str, Samples]) -> dict[str, Array]:
    """Return the signals as arrays of one floating type; true counts as +1 and false as -1."""
    arrays = {name: as_array(value) for name, value in signals.items()}
    floats = [a.dtype for a in arrays.values() if jnp.issubdtype(a.dtype, jnp.floating)]
    dtype = jnp.result_type(*floats) if floats else jnp.result_type(float)
    return {
        name: (jnp.where(a, 1.0, -1.0) if a.dtype == bool else a).astype(dtype)
        for name, a in arrays.items()
    }


def period(trace: Trace) -> float:
    """Return the trace's sampling period in seconds.

    **Raises:** `ValueError` if its sample times are not evenly spaced, or not known yet.
    """
    if trace.dt is not None:
        return float(trace.dt)
    if isinstance(trace.times, Tracer):
        raise ValueError(
            "the sample times of a trace must be known before compiling; give it a period dt"
        )
    times = np.asarray(trace.times, float)
    if not np.all(np.isfinite(times)):
        k = int(np.argmin(np.isfinite(times)))
        raise ValueError(f"sample times must be finite; sample {k} is at {times[k]:g} s")
    if len(times) == 1:
        return 1.0
    steps = np.diff(times)
    dt = (times[-1] - times[0]) / (len(times) - 1)
    if not np.all(steps > 0):
        k = int(np.argmin(steps))
        raise ValueError(
            f"sample times must increase; got {times[k]:g} s and then {times[k + 1]:g} s"
        )
    # float32 times carry an error that grows with their size, not with the step.
    slack = 1e-3 * dt + 4 * np.finfo(np.float32).eps * np.abs(times).max()
    if np.any(np.abs(steps - dt) > slack):
        k = int(np.argmax(np.abs(steps - dt)))
        raise SamplingError(
            f"the trace is not evenly sampled: steps of {steps.min():g} s to {steps.max():g} s, "
            f"as at {times[k]:g} s",
            float(np.median(steps)),
        )
    check_period(dt)
    return float(f"{dt:.9g}")


def seconds(trace: Trace) -> Float[np.ndarray, " time"]:
    """Return the sample times in double precision, whatever JAX computes in."""
    if trace.dt is not None:
        return np.arange(trace.length) * float(trace.dt)
    return np.asarray(trace.times, float)


def _check_horizon(formula: Formula, trace: Trace, dt: float) -> None:
    horizon = formula.horizon(dt)
    length = trace.length
    if trace.valid is not None and not isinstance(trace.valid, Tracer):
        length = int(np.min(np.asarray(trace.valid)))
    duration = (length - 1) * dt
    if horizon > duration * (1 + 1e-9) + 1e-9 * dt:
        what = "has no end" if math.isinf(horizon) else f"looks {horizon:g} s ahead"
        raise HorizonError(f"the formula {what}, but the trace lasts {duration:g} s: {formula}")


def evaluator_of(
    setting: Setting,
    signals: dict[str, Array],
    tau: Array | float | None,
    valid: Array | None,
    lanes: int,
) -> Evaluator:
    return Evaluator(
        signals,
        setting.length,
        setting.dt,
        setting.kind,
        tau,
        setting.end,
        valid,
        setting.compat == "pymtl",
        lanes,
    )
