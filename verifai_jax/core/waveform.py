"""Functions of time by their control points, as a `Signal` feature gives them to a rollout.

wind = Waveform(knots, hold="linear", duration=4.0)
wind(time)                                                   # in seconds; traced or concrete
features["wind"].over(4.0)(time)                             # where no duration was given
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any, TypeGuard, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Real

from verifai_jax.core.checks import is_number
from verifai_jax.core.errors import unknown_name

HOLDS = ("linear", "constant")
"""Courses between two control points: a line, or the value of the first."""

Features = TypeVar("Features")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Waveform:
    """Control points at equal distances, joined by lines or held until the next.

    **Arguments:**

    - `knots`: `[knots, ...]`. With `"linear"` the first is the value at time 0 and the last that
      at the end; with `"constant"` each is held for an equal part of the duration, its beginning
      included.
    - `duration`: in seconds; None until `over` sets it. Before 0 and behind the end the first and
      the last value hold.
    """

    # JAX rebuilds the class with placeholders and with batches, which have other shapes.
    __no_type_check__ = True

    knots: Float[Array | np.ndarray, "knots *shape"]
    hold: str = field(default="linear", metadata={"static": True})
    duration: float | None = field(default=None, metadata={"static": True})

    def __post_init__(self) -> None:
        if self.hold not in HOLDS:
            raise unknown_name("hold", self.hold, HOLDS)

    def over(self, duration: float) -> "Waveform":
        """Return the same control points over so many seconds.

        **Raises:** `ValueError` for a duration that is not positive.
        """
        return replace(self, duration=check_duration(duration))

    def __call__(
        self, time: Real[Array | np.ndarray, "*times"] | np.number | float
    ) -> Float[Array | np.ndarray, "*shape"] | np.floating:
        """Return the value at a time, or at several, in seconds.

        **Raises:** `ValueError` without a duration.
        """
        if self.duration is None:
            raise ValueError(
                "a Signal without a duration cannot be evaluated: give Signal(..., duration=4.0), "
                "or call features[...].over(4.0)(time)"
            )
        # A simulator on the host asks at every step: JAX op by op would take a millisecond each.
        on_host = isinstance(self.knots, np.ndarray) and isinstance(time, float | int | np.number)
        xp: Any = np if on_host else jnp
        knots = xp.asarray(self.knots)
        count = knots.shape[0]
        place = xp.asarray(time).astype(knots.dtype) / self.duration
        if count == 1:
            return knots[0]
        if self.hold == "constant":
            return knots[_piece(place, count, _slack(knots), xp)]
        place = xp.clip(place, 0.0, 1.0) * (count - 1)
        left = xp.clip(xp.floor(place).astype(np.int32), 0, count - 2)
        share = (place - left).astype(knots.dtype)
        return _between(knots[left], knots[left + 1], share, xp)

    def __repr__(self) -> str:
        over = "" if self.duration is None else f", over {self.duration:g} s"
        return f"Waveform({self._outline()}, {self.hold}{over})"

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
        return f"{text}, all {low:.4g}" if low == high else f"{text} from {low:.4g} to {high:.4g}"

    def refined(self, factor: int) -> "Waveform":
        """Return the same function by more control points; see `Signal.refined`."""
        knots = jnp.asarray(self.knots)
        if self.hold == "constant" or knots.shape[0] == 1:
            return replace(self, knots=jnp.repeat(knots, factor, axis=0))
        share = np.arange(factor).reshape((1, factor) + (1,) * (knots.ndim - 1)) / factor
        between = _between(knots[:-1, None], knots[1:, None], share.astype(knots.dtype), jnp)
        inner = between.reshape(-1, *knots.shape[1:])
        return replace(self, knots=jnp.concatenate([inner, knots[-1:]]))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WaveformWithinStep(Waveform):
    """A waveform that is held, as an integrator reads it at `now` in a step that began at `begin`.

    At any time of the step it has the value of its beginning. A method of high order evaluates the
    end of a step too, where the next piece may begin, and would lose its order there.
    """

    __no_type_check__ = True

    begin: Any = 0.0
    now: Any = 0.0

    def __call__(
        self, time: Real[Array | np.ndarray, "*times"] | np.number | float
    ) -> Float[Array | np.ndarray, "*shape"] | np.floating:
        constant = isinstance(self.now, Tracer) and not isinstance(time, Tracer)
        if self.duration is None or constant or not isinstance(time, jax.Array):
            return super().__call__(time)
        knots = jnp.asarray(self.knots)
        inside = (time >= self.begin) & (time <= self.now)
        place = jnp.where(inside, self.begin, time).astype(knots.dtype) / self.duration
        # Another time (a delay) moves with the stages as well: behind the beginning of the step, a
        # piece that begins just there belongs to the next step.
        before = (self.now > self.begin) & ~inside
        slack = jnp.where(before, -_slack(knots), _slack(knots))
        return knots[_piece(place, knots.shape[0], slack, jnp)]


def _slack(knots: Any) -> float:
    """Return the part of a piece up to which an instant counts as that at which one begins."""
    # A time in seconds, its division and its product have each been rounded.
    return max(1e-5, 4 * float(jnp.finfo(knots.dtype).eps) * knots.shape[0])


def _piece(place: Any, count: int, slack: Any, xp: Any) -> Any:
    """Return the index of the piece at a place from 0 to 1."""
    # An instant at which a piece begins belongs to it, whatever its rounding.
    piece = xp.floor(place * count + slack).astype(np.int32)
    return xp.clip(piece, 0, count - 1)


IS_CALLED = (
    "a Signal is a function of time and not a number: call it with a time in seconds, as in "
    "features['wind'](time); its control points are its .knots"
)
"""Advice for who takes a function of time for a number."""


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


def _between(left: Any, right: Any, share: Any, xp: Any) -> Any:
    """Return `left` where the share is 0 and `right` where it is 1, never beyond them."""
    value = left * (1 - share) + right * share
    # Between two knots at the end of their domain the sum may be rounded to a value outside.
    least, most = xp.minimum(left, right), xp.maximum(left, right)
    if xp is np:
        return np.clip(value, least, most)
    least, most, zero = *jax.lax.stop_gradient((least, most)), value - jax.lax.stop_gradient(value)
    # The derivative is that of the line, also where both knots are the same.
    value = jnp.where(value < least, least + zero, value)
    return jnp.where(value > most, most + zero, value)


def check_duration(duration: object) -> float:
    """Check a duration in seconds.

    **Raises:** `ValueError` unless it is a positive finite number.
    """
    if not is_number(duration) or not 0 < duration < math.inf:
        raise ValueError(f"duration must be a positive number of seconds; got {duration!r}")
    return float(duration)


def set_durations(features: Features, duration: float) -> Features:
    """Return the features with this duration in every waveform that has none."""

    def bind(leaf: object) -> object:
        return leaf.over(duration) if is_waveform(leaf) and leaf.duration is None else leaf

    return jax.tree.map(bind, features, is_leaf=is_waveform)


def within_step(features: Features, begin: Any, now: Any) -> Features:
    """Return the features for an integrator at `now`, in a step that began at `begin` seconds.

    Waveforms that are held keep their value during the step.
    """

    def hold(leaf: object) -> object:
        if not is_waveform(leaf) or leaf.hold != "constant" or np.shape(leaf.knots)[:1] == (1,):
            return leaf
        return WaveformWithinStep(leaf.knots, leaf.hold, leaf.duration, begin, now)

    return features if now is begin else jax.tree.map(hold, features, is_leaf=is_waveform)


def is_waveform(value: object) -> TypeGuard[Waveform]:
    """Return whether this is a `Waveform`, which `jax.tree` functions take as a leaf if told so."""
    return isinstance(value, Waveform)
