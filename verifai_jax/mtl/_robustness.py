"""How robustly a trace satisfies a formula: `robustness(f, trace)`, and its derivative.

    robustness("always[0, 4] (abs(x) <= 2.4)", trace)         # a number: positive, it holds
    jax.vmap(lambda t: robustness(f, t))(traces)              # many traces
    jax.grad(lambda x: robustness(f, Trace({"x": x}, dt=0.1), smooth(0.1)))(x)

Under `jax.vmap` the lanes are worked on together, time-major, whatever axis they came on. The
derivative of the scalar is a reverse sweep through the monitor offered as a `custom_jvp`: the
tangent is its product with the gradient, so forward and reverse mode both cost one sweep.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from verifai_jax.core.errors import unknown_name
from verifai_jax.core.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl import windows
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.evaluate import End, Evaluator
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.semantics import Semantics, boolean, hard
from verifai_jax.mtl.smoothing_error import Certificate, slack


class HorizonError(ValueError):
    """A formula that looks beyond the end of a trace, under `end="strict"`."""


class _Setting(NamedTuple):
    """Everything static about one evaluation."""

    formula: Formula
    length: int
    dt: float
    kind: str
    error: float | None
    bound: str
    end: End
    compat: str | None


def robustness(
    formula: Formula | str,
    trace: Trace,
    semantics: Semantics = hard,
    end: End = "hold",
    compat: str | None = None,
) -> Float[Array, ""]:
    """How robustly a trace satisfies a formula at time 0: positive, it holds; negative, it fails.

    **Arguments:**

    - `formula`: a `Formula`, or its text.
    - `trace`: signals `[time]` or `[time, k]`, evenly sampled. Batches by `jax.vmap`.
    - `semantics`: `hard` (in the unit of the predicates), `smooth(tau)`, or `boolean` (+1 / -1).
    - `end`: what comes after the last sample: `"hold"`, the trace goes on with it for ever;
      `"truncate"`, windows are cut there (an empty one is true under always, false under
      eventually); `"strict"`, an error if the formula looks beyond it.
    - `compat`: `"pymtl"` for the right-open windows of metric-temporal-logic.

    A NaN among the samples that matter gives NaN.

    **Raises:** `UnknownNameError` for a signal the trace lacks, `IntervalError` for an interval
    that is not a multiple of the sampling period, `HorizonError` under `"strict"`, `TypeError` for
    a vector used as a scalar, `ValueError` for sample times that are not evenly spaced; all before
    anything compiles.

    Source: A. Donze, O. Maler, "Robust satisfaction of temporal logic over real-valued signals",
    FORMATS 2010; until is half-open and windows are closed.
    """
    setting, signals, tau, valid = prepared(formula, trace, semantics, end, compat)
    return _root_compiled(setting, signals, tau, valid)


def robustness_signal(
    formula: Formula | str,
    trace: Trace,
    semantics: Semantics = hard,
    end: End = "hold",
    compat: str | None = None,
) -> Float[Array, " time"]:
    """The robustness at every sample of the trace; see `robustness`. Reverse mode only."""
    setting, signals, tau, valid = prepared(formula, trace, semantics, end, compat)
    return _everywhere_compiled(setting, signals, tau, valid)


def satisfied(
    formula: Formula | str, trace: Trace, end: End = "hold", compat: str | None = None
) -> Bool[Array, ""]:
    """Whether a trace satisfies a formula at time 0; at robustness 0 the comparison decides.

    Where a NaN leaves it open the answer is no verdict: an error, or `False` under `jit`.

    **Raises:** as `robustness`, and `ValueError` for a NaN, naming signal and time.
    """
    verdict = robustness(formula, trace, boolean, end, compat)
    if not isinstance(verdict, Tracer) and bool(jnp.any(jnp.isnan(verdict))):
        raise ValueError(f"no verdict: {_first_nan(_formula(formula), trace)}")
    return verdict > 0


def certificate(
    formula: Formula | str, trace: Trace, end: End = "hold", compat: str | None = None
) -> Certificate:
    """How far the smooth robustness of such a trace can be from the hard one, in temperatures.

    `smooth - tau * above <= hard <= smooth + tau * below`; only the trace's length and period
    matter, not its values.
    """
    setting, _, _, _ = prepared(formula, trace, hard, end, compat)
    return _certificate(setting)


def _formula(formula: Formula | str) -> Formula:
    if isinstance(formula, str):
        return parse(formula)
    if not isinstance(formula, Formula):
        raise TypeError(f"a formula or its text is needed; got {formula!r}")
    return formula


def prepared(
    formula: Formula | str, trace: Trace, semantics: Semantics, end: End, compat: str | None
) -> tuple[_Setting, dict[str, Array], Any, Any]:
    """The static setting, the signals it needs, the temperature and the length, all checked."""
    formula = _formula(formula)
    if end not in ("hold", "truncate", "strict"):
        raise ValueError(f"end is 'hold', 'truncate' or 'strict'; got {end!r}")
    if compat not in (None, "pymtl"):
        raise ValueError(f"compat is None or 'pymtl'; got {compat!r}")
    if not isinstance(semantics, Semantics):
        raise TypeError(f"semantics is hard, boolean or smooth(tau); got {semantics!r}")
    for name in formula.signals():
        if name not in trace.signals:
            raise unknown_name("signal", name, trace.signals)
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
    setting = _Setting(
        formula, trace.length, dt, semantics.kind, semantics.error, semantics.bound, end, compat
    )
    tau = None
    if semantics.kind == "smooth" and semantics.error is None:
        dtype = next(iter(signals.values())).dtype if signals else jnp.result_type(float)
        tau = jax.lax.stop_gradient(jnp.asarray(semantics.tau, dtype))
    return setting, signals, tau, valid


def _numbers(signals: dict[str, Any]) -> dict[str, Array]:
    """The signals as arrays of one floating type; true counts as +1 and false as -1."""
    arrays = {name: jnp.asarray(value) for name, value in signals.items()}
    floats = [a.dtype for a in arrays.values() if jnp.issubdtype(a.dtype, jnp.floating)]
    dtype = jnp.result_type(*floats) if floats else jnp.result_type(float)
    return {
        name: (jnp.where(a, 1.0, -1.0) if a.dtype == bool else a).astype(dtype)
        for name, a in arrays.items()
    }


def period(trace: Trace) -> float:
    """The trace's sampling period in seconds.

    **Raises:** `ValueError` if its sample times are not evenly spaced, or not known yet.
    """
    if trace.dt is not None:
        return float(trace.dt)
    if isinstance(trace.times, Tracer):
        raise ValueError(
            "the sample times of a trace must be known before compiling; give it a period dt"
        )
    times = np.asarray(trace.times, float)
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
        raise ValueError(
            f"the trace is not evenly sampled: steps of {steps.min():g} s to {steps.max():g} s, "
            f"as at {times[k]:g} s. Resample it first, as in "
            f'resample(trace, dt={np.median(steps):g}, method="hold") or method="linear"'
        )
    return float(f"{dt:.9g}")


def seconds(trace: Trace) -> Float[np.ndarray, " time"]:
    """Sample times in double precision, whatever JAX computes in."""
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
        raise HorizonError(
            f"the formula {what}, but the trace lasts {duration:g} s: {formula}. "
            'Use end="hold" or end="truncate", or a longer trace'
        )


def _first_nan(formula: Formula, trace: Trace) -> str:
    clock = seconds(trace)
    for name in formula.signals():
        signal = np.asarray(trace.signals[name])
        bad = np.isnan(signal.reshape(signal.shape[0], -1)).any(axis=1)
        if bad.any():
            return f"signal {name!r} is NaN at {clock[int(np.argmax(bad))]:g} s"
    return f"the value of {formula} is NaN"


# Evaluation on lanes


def _evaluator(
    setting: _Setting, signals: dict[str, Array], tau: Any, valid: Any, lanes: int
) -> Any:
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


@functools.lru_cache(maxsize=1024)
def _certificate(setting: _Setting, last: int = 0) -> Certificate:
    return slack(_evaluator(setting, {}, None, None, 0), setting.formula, 0, last)


def _values(
    setting: _Setting, last: int, signals: dict[str, Array], tau: Any, valid: Any, lanes: int
) -> Float[Array, "instants *lanes"]:
    """Values at the instants 0 to `last`."""
    if setting.kind == "smooth":
        shift = 0.0
        if setting.error is not None or setting.bound != "none":
            sides = _certificate(setting, last)
            if setting.error is not None:
                dtype = next(iter(signals.values())).dtype if signals else jnp.result_type(float)
                tau = jnp.full((1,) * lanes, setting.error / max(sides.total, 1e-6), dtype)
            shift = {"none": 0.0, "lower": -sides.above, "upper": sides.below}[setting.bound]
    value = _evaluator(setting, signals, tau, valid, lanes).value(setting.formula, 0, last)
    if setting.kind == "smooth":
        value = jnp.where(jnp.abs(value) >= 0.5 * windows.NEVER, jnp.inf * jnp.sign(value), value)
        if shift:
            value = value + tau * shift
    if setting.end == "strict" and valid is not None:
        short = (valid - 1) * setting.dt < setting.formula.horizon(setting.dt) - 1e-9 * setting.dt
        value = jnp.where(short, jnp.nan, value)
    shape = jnp.broadcast_shapes(
        value.shape[1:], *(s.shape[1 : 1 + lanes] for s in signals.values())
    )
    return jnp.broadcast_to(value, (last + 1, *shape))


def _on_lanes(function: Any, lanes: int, axes: tuple[int, ...], spread: bool) -> Any:
    """`function(lanes, *arguments)` with a batching rule that adds a lane axis to the arguments.

    `axes` says where each argument (a pytree) keeps its lane axes. `spread` repeats arguments that
    all lanes share, which a gradient with respect to them needs.
    """

    @jax.custom_batching.custom_vmap
    def call(*arguments: Any) -> Any:
        return function(lanes, *arguments)

    @call.def_vmap
    def rule(size: int, batched: Any, *arguments: Any) -> Any:
        def moved(axis: int, array: Array, is_batched: bool) -> Array:
            if is_batched:
                return jnp.moveaxis(array, 0, axis)
            array = jnp.expand_dims(array, axis)
            return jnp.repeat(array, size, axis) if spread else array

        arguments = tuple(
            jax.tree.map(functools.partial(moved, axis), argument, flags)
            for axis, argument, flags in zip(axes, arguments, batched, strict=True)
        )
        out = _on_lanes(function, lanes + 1, axes, spread)(*arguments)
        out_axes = function.out_axes
        out = tuple(
            jax.tree.map(lambda a, axis=axis: jnp.moveaxis(_widened(a, axis, size), axis, 0), part)
            for part, axis in zip(out, out_axes, strict=True)
        )
        return out, jax.tree.map(lambda _: True, out)

    return call


def _widened(a: Array, axis: int, size: int) -> Array:
    if a.shape[axis] == size:
        return a
    return jnp.broadcast_to(a, (*a.shape[:axis], size, *a.shape[axis + 1 :]))


#: Lanes worked on together: 256 of a thousand single-precision samples are 1 MB, a cache's worth.
LANES = 256


def _in_chunks(
    function: Any, axes: tuple[int, ...], out_axes: tuple[int, ...], *arguments: Any
) -> Any:
    """`function(*arguments)`, over the first lane axis, a cache's worth at a time.

    Arguments keep their lanes on `axes`, results on `out_axes`.
    """
    sizes = {
        leaf.shape[axis]
        for argument, axis in zip(arguments, axes, strict=True)
        for leaf in jax.tree.leaves(argument)
    }
    size = max(sizes, default=1)
    # The engine's batches come in at most 512 lanes, which fit well enough as they are.
    if size <= 2 * LANES or jax.default_backend() != "cpu":
        return function(*arguments)
    count = -(-size // LANES)
    lanes = -(-size // count)

    def chunk(k: Array) -> Any:
        def part(axis: int, leaf: Array) -> Array:
            if leaf.shape[axis] != size:
                return leaf
            return jax.lax.dynamic_slice_in_dim(leaf, k, lanes, axis)

        return function(
            *(
                jax.tree.map(functools.partial(part, axis), argument)
                for argument, axis in zip(arguments, axes, strict=True)
            )
        )

    def step(i: Array, out: Any) -> Any:
        # The last chunk starts early enough to be full, and does some lanes again.
        k = jnp.minimum(i * lanes, size - lanes)
        return tuple(
            jax.tree.map(
                lambda whole, new, axis=axis: jax.lax.dynamic_update_slice_in_dim(
                    whole, new, k, axis
                ),
                *pair,
            )
            for *pair, axis in zip(out, chunk(k), out_axes, strict=True)
        )

    shapes = jax.eval_shape(chunk, jnp.int32(0))
    empty = tuple(
        jax.tree.map(
            lambda s, axis=axis: jnp.zeros((*s.shape[:axis], size, *s.shape[axis + 1 :]), s.dtype),
            part,
        )
        for part, axis in zip(shapes, out_axes, strict=True)
    )
    return jax.lax.fori_loop(0, count, step, empty)


def _nested(formula: Formula, within: bool = False) -> bool:
    """Whether a temporal operator stands within another."""
    temporal = not isinstance(formula, ast.Not | ast.And | ast.Or) and bool(formula.operands())
    return (within and temporal) or any(_nested(p, within or temporal) for p in formula.operands())


class _Root:
    """The value at time 0, and optionally its gradient: the work behind `robustness`."""

    def __init__(self, setting: _Setting, gradient: bool) -> None:
        self.setting = setting
        self.gradient = gradient
        self.out_axes = (0, 1) if gradient else (0,)

    def __call__(self, lanes: int, *arguments: Any) -> Any:
        work = functools.partial(self._work, lanes)
        # One reduction makes no arrays in between, so there is nothing to keep in the cache.
        if lanes and (self.gradient or _nested(self.setting.formula)):
            return _in_chunks(work, (1, 0, 0), self.out_axes, *arguments)
        return work(*arguments)

    def _work(self, lanes: int, signals: dict[str, Array], tau: Any, valid: Any) -> Any:
        def value(signals: dict[str, Array]) -> Array:
            return _values(self.setting, 0, signals, tau, valid, lanes)[0]

        if not self.gradient:
            return (value(signals),)
        rho, pullback = jax.vjp(value, signals)
        return rho, pullback(jnp.ones_like(rho))[0]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _root(setting: _Setting, signals: dict[str, Array], tau: Any, valid: Any) -> Array:
    return _on_lanes(_Root(setting, False), 0, (1, 0, 0), False)(signals, tau, valid)[0]


@_root.defjvp
def _root_jvp(setting: _Setting, primals: Any, tangents: Any) -> tuple[Array, Array]:
    rho, gradient = _on_lanes(_Root(setting, True), 0, (1, 0, 0), True)(*primals)
    products = (jnp.sum(gradient[name] * tangent) for name, tangent in tangents[0].items())
    return rho, sum(products, jnp.zeros_like(rho))


class _Everywhere:
    """The value at every instant, and optionally its pullback."""

    def __init__(self, setting: _Setting, pullback: bool) -> None:
        self.setting = setting
        self.pullback = pullback
        self.out_axes = (1,)

    def __call__(self, lanes: int, *arguments: Any) -> Any:
        work = functools.partial(self._work, lanes)
        axes = (1, 0, 0, 1)[: len(arguments)]
        return _in_chunks(work, axes, self.out_axes, *arguments) if lanes else work(*arguments)

    def _work(
        self, lanes: int, signals: dict[str, Array], tau: Any, valid: Any, cotangent: Any = None
    ) -> Any:
        def value(signals: dict[str, Array]) -> Array:
            return _values(self.setting, self.setting.length - 1, signals, tau, valid, lanes)

        if not self.pullback:
            return (value(signals),)
        return jax.vjp(value, signals)[1](cotangent)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _everywhere(setting: _Setting, signals: dict[str, Array], tau: Any, valid: Any) -> Array:
    return _on_lanes(_Everywhere(setting, False), 0, (1, 0, 0), False)(signals, tau, valid)[0]


def _everywhere_forward(setting: _Setting, *arguments: Any) -> tuple[Array, Any]:
    return _everywhere(setting, *arguments), arguments


def _everywhere_backward(setting: _Setting, arguments: Any, cotangent: Array) -> Any:
    call = _on_lanes(_Everywhere(setting, True), 0, (1, 0, 0, 1), True)
    gradient = call(*arguments, cotangent)[0]
    return gradient, *(jax.tree.map(jnp.zeros_like, a) for a in arguments[1:])


_everywhere.defvjp(_everywhere_forward, _everywhere_backward)

# Compiled on their own, so that plain calls on arrays are fast too; inlined within a larger `jit`.
_root_compiled = jax.jit(_root, static_argnums=0, inline=True)
_everywhere_compiled = jax.jit(_everywhere, static_argnums=0, inline=True)
