"""The robustness of a formula on a trace, and its derivative.

    robustness("always[0, 4] (abs(x) <= 2.4)", trace)         # a number: positive, it holds
    jax.vmap(lambda t: robustness(f, t))(traces)              # many traces
    jax.grad(lambda x: robustness(f, Trace({"x": x}, dt=0.1), smooth(0.1)))(x)

Under `jax.vmap` all lanes are evaluated together, time-major, as many at a time as fit into the
cache (`on_lanes`). The derivative of the scalar is one reverse sweep through the monitor, provided
as a `custom_jvp`: the tangent is the product of gradient and input tangent, so forward and reverse
mode both cost one sweep.
"""

import functools
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, PyTree

from verifai_jax.core.compute.compilation import jit_each
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import windows
from verifai_jax.mtl._smoothing_error import error_of_setting
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.semantics import Semantics, boolean, hard
from verifai_jax.mtl.setting import Setting, as_formula, evaluator_of, prepare


def robustness(
    formula: Formula | str, trace: Trace, semantics: Semantics = hard, end: End = "hold",
    compat: str | None = None,
) -> Float[Array, ""]:  # fmt: skip
    """Compute the robustness of a formula on a trace at time 0; it holds if this is positive.

    **Arguments:**
    - `formula`: a `Formula`, or its text.
    - `trace`: an evenly sampled trace with signals `[time]` or `[time, k]`; use `jax.vmap` for
      batches.
    - `semantics`: `hard` (in the unit of the predicates), `smooth(tau)`, or `boolean` (+1 / -1).
    - `end`: how the trace continues after the last sample. `"hold"`: the last sample is held for
      ever. `"truncate"`: windows are cut there (an empty one is true under always, false under
      eventually). `"strict"`: it is an error if the formula looks beyond the end.
    - `compat`: `"pymtl"` for the right-open windows of metric-temporal-logic.

    A NaN among the relevant samples gives NaN.

    **Raises:** `UnknownNameError` for a signal that the trace lacks, `IntervalError` for an
    interval that is not a multiple of the sampling period, `HorizonError` under `"strict"`,
    `TypeError` for a vector used as a scalar, `ValueError` for unevenly spaced sample times; all
    before anything compiles.

    Source: A. Donze, O. Maler, "Robust satisfaction of temporal logic over real-valued signals",
    FORMATS 2010. Until does not need its left side at the witness; windows are closed.
    """
    setting, signals, tau, valid = prepare(formula, trace, semantics, end, compat)
    return _root_compiled(setting, signals, tau, valid)


def robustness_signal(
    formula: Formula | str, trace: Trace, semantics: Semantics = hard, end: End = "hold",
    compat: str | None = None,
) -> Float[Array, " time"]:  # fmt: skip
    """Compute the robustness at every sample of the trace; only for reverse-mode gradients.

    It is NaN, no verdict, where `end` leaves none: under `"strict"` at samples from which the
    formula looks beyond the end, and under `"truncate"` and `"strict"` after the last valid sample.
    See `robustness` for the arguments.
    """
    setting, signals, tau, valid = prepare(formula, trace, semantics, end, compat)
    return _everywhere_compiled(setting, signals, tau, valid)[:: setting.stride]


def satisfied(
    formula: Formula | str, trace: Trace, end: End = "hold", compat: str | None = None
) -> Bool[Array, ""]:
    """Return whether a trace satisfies a formula at time 0; at robustness 0 the comparator decides.

    If a NaN leaves it undecided, there is no verdict: an error, or `False` under `jit`.

    **Raises:** the errors of `robustness`, and `ValueError` for a NaN, naming signal and time.
    """
    verdict = robustness(formula, trace, boolean, end, compat)
    if isinstance(verdict, Tracer):
        return verdict > 0
    # In NumPy, where nothing compiles.
    numbers = np.asarray(verdict)
    if np.any(np.isnan(numbers)):
        raise ValueError(f"no verdict: {first_nan(as_formula(formula), trace)}")
    return jax.device_put(numbers > 0)


def first_nan(formula: Formula, trace: Trace) -> str:
    """Return a message that names the signal with a NaN and its time, or the NaN of the formula."""
    trace = trace.trim().finely()
    clock = np.asarray(trace.clock())
    for name in formula.signals():
        signal = np.asarray(trace.signals[name])
        bad = np.isnan(signal.reshape(signal.shape[0], -1)).any(axis=1)
        if bad.any():
            return f"signal {name!r} is NaN at {format_seconds(clock[int(np.argmax(bad))])}"
    return f"the value of {formula} is NaN"


def _values(
    setting: Setting, last: int, signals: dict[str, Array], tau: Array | None, valid: Array | None,
    lanes: int,
) -> Float[Array, "instants *lanes"]:  # fmt: skip
    """Compute the values at the instants 0 to `last`."""
    if setting.kind == "smooth":
        shift = 0.0
        if setting.error is not None or setting.bound != "none":
            sides = error_of_setting(setting, last)
            if setting.error is not None:
                dtype = next(iter(signals.values())).dtype if signals else jnp.result_type(float)
                tau = jnp.full((1,) * lanes, setting.error / max(sides.total, 1e-6), dtype)
            shift = {"none": 0.0, "lower": -sides.above, "upper": sides.below}[setting.bound]
    value = evaluator_of(setting, signals, tau, valid, lanes).value(setting.formula, 0, last)
    if setting.kind == "smooth":
        value = jnp.where(jnp.abs(value) >= 0.5 * windows.NEVER, jnp.inf * jnp.sign(value), value)
        if shift:
            assert tau is not None
            value = value + tau * shift
    value = jnp.where(_open(setting, valid, value), jnp.nan, value)
    shape = jnp.broadcast_shapes(
        value.shape[1:], *(s.shape[1 : 1 + lanes] for s in signals.values())
    )
    return jnp.broadcast_to(value, (last + 1, *shape))


def _open(setting: Setting, valid: Array | None, value: Array) -> Any:
    """Return at which instants `end` leaves no verdict; False where it leaves one at all."""
    if setting.end == "hold" or (valid is None and setting.end == "truncate"):
        return False
    count = setting.length if valid is None else valid
    left = count - 1 - np.arange(len(value)).reshape((-1,) + (1,) * (value.ndim - 1))
    reach = setting.formula.horizon(setting.dt) if setting.end == "strict" else 0.0
    return left * (setting.dt / setting.stride) < reach - 1e-9 * setting.dt


class _Root:
    """The value at time 0, and optionally its gradient: what `robustness` computes."""

    def __init__(self, setting: Setting, gradient: bool) -> None:
        self.setting = setting
        self.gradient = gradient
        self.out_axes: tuple[int, ...] = (0, 1) if gradient else (0,)

    def __call__(self, lanes: int, *arguments: PyTree) -> tuple[PyTree, ...]:
        work = functools.partial(self._work, lanes)
        # One reduction makes no arrays in between, so there is nothing to keep in the cache.
        if lanes and (self.gradient or self.setting.formula.temporal_depth > 1):
            return in_chunks(work, (1, 0, 0), self.out_axes, *arguments)
        return work(*arguments)

    def _work(
        self, lanes: int, signals: dict[str, Array], tau: Array | None, valid: Array | None
    ) -> Any:
        def value(signals: dict[str, Array]) -> Array:
            return _values(self.setting, 0, signals, tau, valid, lanes)[0]

        if not self.gradient:
            return (value(signals),)
        rho, pullback = jax.vjp(value, signals)
        return rho, pullback(jnp.ones_like(rho))[0]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _root(
    setting: Setting, signals: dict[str, Array], tau: Array | None, valid: Array | None
) -> Array:
    return on_lanes(_Root(setting, False), 0, (1, 0, 0), False)(signals, tau, valid)[0]


@_root.defjvp
def _root_jvp(
    setting: Setting, primals: tuple[Any, ...], tangents: tuple[Any, ...]
) -> tuple[Array, Array]:
    rho, gradient = on_lanes(_Root(setting, True), 0, (1, 0, 0), True)(*primals)
    products = (jnp.sum(gradient[name] * tangent) for name, tangent in tangents[0].items())
    return rho, sum(products, jnp.zeros_like(rho))


class _Everywhere:
    """The value at every instant, and optionally its pullback."""

    def __init__(self, setting: Setting, pullback: bool) -> None:
        self.setting = setting
        self.pullback = pullback
        self.out_axes: tuple[int, ...] = (1,)

    def __call__(self, lanes: int, *arguments: PyTree) -> tuple[PyTree, ...]:
        work = functools.partial(self._work, lanes)
        axes = (1, 0, 0, 1)[: len(arguments)]
        return in_chunks(work, axes, self.out_axes, *arguments) if lanes else work(*arguments)

    def _work(
        self, lanes: int, signals: dict[str, Array], tau: Array | None, valid: Array | None,
        cotangent: Array | None = None,
    ) -> Any:  # fmt: skip
        def value(signals: dict[str, Array]) -> Array:
            return _values(self.setting, self.setting.length - 1, signals, tau, valid, lanes)

        if not self.pullback:
            return (value(signals),)
        return jax.vjp(value, signals)[1](cotangent)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _everywhere(
    setting: Setting, signals: dict[str, Array], tau: Array | None, valid: Array | None
) -> Array:
    return on_lanes(_Everywhere(setting, False), 0, (1, 0, 0), False)(signals, tau, valid)[0]


def _everywhere_forward(setting: Setting, *arguments: PyTree) -> tuple[Array, tuple[PyTree, ...]]:
    return _everywhere(setting, *arguments), arguments


def _everywhere_backward(
    setting: Setting, arguments: tuple[Any, ...], cotangent: Array
) -> tuple[Any, ...]:
    call = on_lanes(_Everywhere(setting, True), 0, (1, 0, 0, 1), True)
    gradient = call(*arguments, cotangent)[0]
    return gradient, *(jax.tree.map(jnp.zeros_like, a) for a in arguments[1:])


_everywhere.defvjp(_everywhere_forward, _everywhere_backward)
# Compiled on their own, so that plain calls on arrays are fast too; inlined within a larger `jit`.
_root_compiled = jit_each(inline=True)(_root)
_everywhere_compiled = jit_each(inline=True)(_everywhere)


@runtime_checkable
class Work(Protocol):
    """A function of lanes; `out_axes` gives the lane axis of each result."""

    out_axes: tuple[int, ...]

    def __call__(self, lanes: int, *arguments: PyTree) -> tuple[PyTree, ...]:
        """Return the results for arguments with this number of lane axes."""
        ...


def on_lanes(
    function: Work, lanes: int, axes: tuple[int, ...], spread: bool
) -> Callable[..., tuple[PyTree, ...]]:
    """Give `function(lanes, *arguments)` a batching rule that adds a lane axis to arguments.

    `axes` gives the lane axis of each argument (a pytree). `spread` repeats arguments that all
    lanes share, which gradients with respect to them need.
    """

    @jax.custom_batching.custom_vmap
    def call(*arguments: Any) -> Any:
        return function(lanes, *arguments)

    @call.def_vmap
    def rule(size: int, batched: PyTree, *arguments: Any) -> Any:
        def moved(axis: int, array: Array, is_batched: bool) -> Array:
            if is_batched:
                return jnp.moveaxis(array, 0, axis)
            array = jnp.expand_dims(array, axis)
            return jnp.repeat(array, size, axis) if spread else array

        arguments = tuple(
            jax.tree.map(functools.partial(moved, axis), argument, flags)
            for axis, argument, flags in zip(axes, arguments, batched, strict=True)
        )
        out = on_lanes(function, lanes + 1, axes, spread)(*arguments)
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


LANES = 256
"""Lanes worked on together: 256 of a thousand float32 samples are 1 MB, a cache's worth."""


def in_chunks(
    function: Callable[..., tuple[PyTree, ...]], axes: tuple[int, ...], out_axes: tuple[int, ...],
    *arguments: PyTree,
) -> tuple[PyTree, ...]:  # fmt: skip
    """Compute `function(*arguments)` over the first lane axis, in chunks that fit into the cache.

    Arguments have their lanes on `axes`, results on `out_axes`.
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

    def step(i: Array, out: tuple[PyTree, ...]) -> tuple[PyTree, ...]:
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
