"""Functions of time with control points: the values of a `Signal` feature in a rollout.

wind = Waveform(knots, hold="linear", duration=4.0)
wind(time)                                                   # in seconds; traced or concrete
features["wind"].over(4.0)(time)                             # where no duration was given
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, TypeGuard, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Real

from verifai_jax.core.messages.checks import is_number
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.core.values.interpolation import between, monotone_cubic

HOLDS = ("linear", "constant", "pchip", "pulse")
"""Courses between control points: lines, the value of the one before, a monotone cubic through
them, or the value of the one before for a while and then 0."""
HELD = ("constant", "pulse")
"""Courses that jump: within a step of an integrator they keep the value of its beginning."""
Features = TypeVar("Features")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Waveform:
    """Control points at equal distances or given times, with an interpolation.

    **Arguments:**
    - `knots`: `[knots, ...]`. With `"linear"` and `"pchip"` the first is the value at time 0 and
      the last that at the end. With `"constant"` each is held for an equal part of the duration,
      including its start. With `"pulse"` each is held for the first `width` seconds of its part,
      and the value is 0 for the rest. None may be masked.
    - `duration`: duration in seconds; None until `over` sets it. Before 0 and after the end the
      first and the last value hold; for pulses the value is 0 there.
    - `times`: the increasing times of the control points in seconds; equal distances when left out.
    - `width`: the width of a pulse in seconds; by default half the shortest distance of two pulses.
    """

    # JAX rebuilds the class with placeholders and with batches, which have other shapes.
    __no_type_check__ = True
    knots: Float[Array | np.ndarray, "knots *shape"]
    hold: str = field(default="linear", metadata={"static": True})
    duration: float | None = field(default=None, metadata={"static": True})
    times: tuple[float, ...] | None = field(default=None, metadata={"static": True})
    width: float | None = field(default=None, metadata={"static": True})

    def __post_init__(self) -> None:
        if self.hold not in HOLDS:
            raise unknown_name("hold", self.hold, HOLDS)
        if isinstance(self.knots, np.ma.MaskedArray):
            masked = np.argwhere(np.ma.getmaskarray(self.knots))
            if len(masked):
                raise ValueError(
                    f"the knots of a Waveform must be numbers; number {masked[0][0]} is masked"
                )
            object.__setattr__(self, "knots", np.asarray(self.knots))
        if self.times is not None:
            object.__setattr__(self, "times", check_times(self.times))
        check_width(self.hold, self.times, self.width)

    def over(self, duration: float) -> "Waveform":
        """Return the same control points with this duration in seconds.

        **Raises:** `ValueError` for a duration that is not positive, or ends before the last given
        time.
        """
        duration = check_duration(duration)
        if self.times is not None and self.times[-1] > duration * (1 + 1e-6):
            raise ValueError(
                f"the times of a Signal must lie in its duration of {format_seconds(duration)}; "
                f"got {self.times[-1]:zg}"
            )
        return replace(self, duration=duration)

    def __call__(
        self, time: Real[Array | np.ndarray, "*times"] | np.number | float
    ) -> Float[Array | np.ndarray, "*shape"] | np.floating:
        """Return the value at a time, or at several, in seconds.

        **Raises:** `ValueError` without a duration.
        """
        if self.duration is None and self.times is None:
            raise ValueError(
                "a Signal without a duration cannot be evaluated: give Signal(..., duration=4.0), "
                "or call features[...].over(4.0)(time)"
            )
        # A simulator on the host asks at every step: JAX op by op would take a millisecond each.
        on_host = isinstance(self.knots, np.ndarray) and isinstance(time, float | int | np.number)
        xp: Any = np if on_host else jnp
        knots = xp.asarray(self.knots)
        count = knots.shape[0]
        time = xp.asarray(time).astype(knots.dtype)
        if self.hold in HELD:
            return self._held(knots, time, 1, xp)
        if count == 1:
            return knots[0]
        left, share = self._position(time, count, xp)
        share = share.astype(knots.dtype)
        if self.hold == "linear":
            return between(knots[left], knots[left + 1], share, xp)
        gaps = np.ones(count - 1) if self.times is None else np.diff(self.times)
        return monotone_cubic(knots, gaps, left, share, xp)

    def _position(self, time: Any, count: int, xp: Any) -> tuple[Any, Any]:
        """Return the index of the control point before a time, and the share of the way on."""
        if self.times is None:
            position = xp.clip(time / self.duration, 0.0, 1.0) * (count - 1)
            left = xp.clip(xp.floor(position).astype(np.int32), 0, count - 2)
            return left, position - left
        starts, gaps = (xp.asarray(a, time.dtype) for a in (self.times, np.diff(self.times)))
        left = xp.clip(_last_not_after(starts, time, xp), 0, count - 2)
        return left, xp.clip((time - starts[left]) / gaps[left], 0.0, 1.0)

    def _held(self, knots: Any, time: Any, sign: Any, xp: Any) -> Any:
        """Return the value at a time; `sign` is -1 where a piece that just begins counts not yet.

        An instant at which a piece begins or a pulse ends belongs to the next piece.
        """
        count = knots.shape[0]
        if self.times is not None:
            starts = xp.asarray(self.times, time.dtype)
            gap = _shortest(self.times)
            rounding = 4 * float(jnp.finfo(time.dtype).eps) * self.times[-1]
            later = time + sign * max(1e-5 * gap, rounding)
            piece = xp.clip(_last_not_after(starts, later, xp), 0, count - 1)
            since, width = later - starts[piece], gap / 2 if self.width is None else self.width
        else:
            if count == 1 and self.hold == "constant":
                return knots[0]
            assert self.duration is not None
            position = time / self.duration * count + sign * _slack(knots)
            piece = xp.clip(xp.floor(position).astype(np.int32), 0, count - 1)
            since = position - piece
            width = 0.5 if self.width is None else self.width * count / self.duration
        if self.hold == "constant":
            return knots[piece]
        on = (since >= 0) & (since < width)
        return xp.where(on.reshape(on.shape + (1,) * (knots.ndim - 1)), knots[piece], 0)

    def __repr__(self) -> str:
        over = "" if self.duration is None else f", over {format_seconds(self.duration)}"
        at = "" if self.times is None else f" at {_listed(self.times)} s"
        return f"Waveform({self._outline()}{at}, {self.hold}{over})"

    def _outline(self) -> str:
        """Return the number of control points and the range of their values, never an array."""
        shape = getattr(self.knots, "shape", None)
        if not shape:  # A placeholder of JAX.
            return "knots"
        text = f"{shape[0]} knots"
        if len(shape) > 1:
            text += f" of shape {list(shape[1:])}"
        known = isinstance(self.knots, np.ndarray | jax.Array)
        if not known or isinstance(self.knots, Tracer) or not all(shape):
            return text
        values = np.asarray(self.knots, np.float64)
        low, high = values.min(), values.max()
        return (
            f"{text}, all {low:z.4g}" if low == high else f"{text} from {low:z.4g} to {high:z.4g}"
        )

    def refined(self, factor: int) -> "Waveform":
        """Return the same function with more control points; see `Signal.refined`."""
        check_refinable(self.hold)
        knots, times = jnp.asarray(self.knots), refined_times(self.times, factor)
        if (self.hold == "constant" and times is None) or knots.shape[0] == 1:
            return replace(self, knots=jnp.repeat(knots, factor, axis=0))
        if self.hold == "constant":
            inner = jnp.repeat(knots[:-1], factor, axis=0)
        else:
            share = np.arange(factor).reshape((1, factor) + (1,) * (knots.ndim - 1)) / factor
            inner = between(knots[:-1, None], knots[1:, None], share.astype(knots.dtype), jnp)
            inner = inner.reshape(-1, *knots.shape[1:])
        return replace(self, knots=jnp.concatenate([inner, knots[-1:]]), times=times)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WaveformWithinStep(Waveform):
    """A piecewise constant waveform, as an integrator sees it at `now` in a step from `begin`.

    During the step it keeps its value at the start of the step. A method of high order also
    evaluates the end of a step, where the next piece may begin, and would lose its order there.
    """

    __no_type_check__ = True
    begin: Any = 0.0
    now: Any = 0.0

    def __call__(
        self, time: Real[Array | np.ndarray, "*times"] | np.number | float
    ) -> Float[Array | np.ndarray, "*shape"] | np.floating:
        constant = isinstance(self.now, Tracer) and not isinstance(time, Tracer)
        unbound = self.duration is None and self.times is None
        if unbound or constant or not isinstance(time, jax.Array):
            return super().__call__(time)
        knots = jnp.asarray(self.knots)
        inside = (time >= self.begin) & (time <= self.now)
        # Another time (a delay) moves with the stages as well: after the beginning of the step, a
        # piece that begins just there belongs to the next step.
        before = (self.now > self.begin) & ~inside
        position = jnp.where(inside, self.begin, time).astype(knots.dtype)
        return self._held(knots, position, jnp.where(before, -1, 1).astype(knots.dtype), jnp)


def _slack(knots: Any) -> float:
    """Return the part of a piece up to which an instant counts as that at which one begins."""
    # A time in seconds, its division and its product have each been rounded.
    return max(1e-5, 4 * float(jnp.finfo(knots.dtype).eps) * knots.shape[0])


def _last_not_after(starts: Any, time: Any, xp: Any) -> Any:
    return xp.sum(time[..., None] >= starts, axis=-1).astype(np.int32) - 1


def _shortest(times: Sequence[float]) -> float:
    """Return the shortest distance of two times; of one alone, a second."""
    return min((b - a for a, b in pairwise(times)), default=1.0)


IS_CALLED = (
    "a Signal is a function of time and not a number: call it with a time in seconds, as in "
    "features['wind'](time); its control points are its .knots"
)
"""Advice for users who take a function of time for a number."""


def _refuse(self: Waveform, *_: object) -> None:
    raise TypeError(IS_CALLED)


# Without these Python would speak of operand types, and JAX of arrays. NumPy's own conversion stays
# as it is: a list of waveforms is an array of objects.
for _operator in (
    *("add", "sub", "mul", "truediv", "floordiv", "mod", "pow", "matmul"),
    *("radd", "rsub", "rmul", "rtruediv", "rfloordiv", "rmod", "rpow", "rmatmul"),
    *("neg", "pos", "abs", "lt", "le", "gt", "ge", "float", "int", "jax_array"),
):
    setattr(Waveform, f"__{_operator}__", _refuse)


def check_duration(duration: object) -> float:
    """Check a duration in seconds.

    **Raises:** `ValueError` unless it is a positive finite number.
    """
    if not is_number(duration) or not 0 < duration < math.inf:
        raise ValueError(f"duration must be a positive number of seconds; got {duration!r}")
    return float(duration)


def check_times(times: object) -> tuple[float, ...]:
    """Check the times of control points, in seconds.

    **Raises:** `ValueError` unless they are increasing finite numbers, the first not negative.
    """
    listed = tuple(times) if isinstance(times, list | tuple | np.ndarray) else ()
    if not listed or not all(is_number(time) and math.isfinite(time) for time in listed):
        raise ValueError(f"times must be a list of numbers, in seconds; got {times!r}")
    seconds = tuple(float(time) for time in listed)
    if seconds[0] < 0 or any(b <= a for a, b in pairwise(seconds)):
        raise ValueError(f"times must increase and begin at 0 or later; got {_listed(seconds)}")
    return seconds


def check_width(hold: str, times: tuple[float, ...] | None, width: object) -> None:
    """Check the width of pulses, in seconds.

    **Raises:** `ValueError` unless it is None or positive, for other waveforms than pulses, and for
    a single pulse with a given time, which has no distance to another.
    """
    if width is None:
        if hold == "pulse" and times is not None and len(times) == 1:
            raise ValueError("a pulse at one given time needs a width in seconds, as in width=0.5")
        return
    if hold != "pulse":
        raise ValueError(f"only pulses have a width; got width={width!r} with hold={hold!r}")
    if not is_number(width) or not 0 < width < math.inf:
        raise ValueError(f"width must be a positive number of seconds; got {width!r}")


def check_refinable(hold: str) -> None:
    """Refuse a waveform that more control points cannot represent.

    **Raises:** `ValueError` for cubics and pulses.
    """
    if hold in ("pchip", "pulse"):
        raise ValueError(
            f"a Signal with hold={hold!r} has no refinement: with more control points it would be "
            "another function of time; a search from coarse to fine needs 'linear' or 'constant'"
        )


def refined_times(times: tuple[float, ...] | None, factor: int) -> tuple[float, ...] | None:
    """Return the times with each interval divided into this many equal parts."""
    if times is None:
        return None
    inner = [a + (b - a) * i / factor for a, b in pairwise(times) for i in range(factor)]
    return (*inner, times[-1])


def control_times(
    count: int, hold: str, times: Sequence[float] | None, duration: float
) -> Float[np.ndarray, " knots"]:
    """Return the time in seconds at which each control point has, or starts to have, its value."""
    if times is not None:
        return np.asarray(times)
    return (
        np.linspace(0, duration, count + 1)[:-1]
        if hold in HELD
        else np.linspace(0, duration, count)
    )


def acting_spans(
    count: int, hold: str, times: Sequence[float] | None, width: float | None, duration: float
) -> list[tuple[float, float]]:
    """Return the start and end of each control point's influence, in seconds.

    With linear interpolation a point acts from the previous point to the next one, in a cubic from
    the second previous to the second next; the first and the last act up to the ends.
    """
    starts = [float(time) for time in control_times(count, hold, times, duration)]
    if hold in HELD:
        spans = [*pairwise([*starts, max(duration, starts[-1])])]
        if hold == "constant":
            return [(0.0, spans[0][1]), *spans[1:]]
        gap = _shortest(times) if times is not None else duration / count
        return [(a, min(b, a + (gap / 2 if width is None else width))) for a, b in spans]
    reach = 1 if hold == "linear" else 2
    padded = [0.0] * reach + starts + [max(duration, starts[-1])] * reach
    return list(zip(padded[:count], padded[2 * reach :], strict=True))


def _listed(times: tuple[float, ...]) -> str:
    shown = ", ".join(f"{time:zg}" for time in times[:6])
    return f"[{shown}{', ...' if len(times) > 6 else ''}]"


def set_durations(features: Features, duration: float) -> Features:
    """Return the features with this duration set in every waveform without one."""

    def bind(leaf: object) -> object:
        return leaf.over(duration) if is_waveform(leaf) and leaf.duration is None else leaf

    return jax.tree.map(bind, features, is_leaf=is_waveform)


def within_step(features: Features, begin: Any, now: Any) -> Features:
    """Return the features for an integrator at `now`, in a step that started at `begin` seconds.

    Piecewise constant waveforms keep their value during the step.
    """

    def hold(leaf: object) -> object:
        if not is_waveform(leaf) or leaf.hold not in HELD:
            return leaf
        if leaf.hold == "constant" and np.shape(leaf.knots)[:1] == (1,):
            return leaf
        course = (leaf.hold, leaf.duration, leaf.times, leaf.width)
        return WaveformWithinStep(leaf.knots, *course, begin=begin, now=now)

    return features if now is begin else jax.tree.map(hold, features, is_leaf=is_waveform)


def is_waveform(value: object) -> TypeGuard[Waveform]:
    """Return whether this is a `Waveform`; pass it to `jax.tree` functions as `is_leaf`."""
    return isinstance(value, Waveform)
