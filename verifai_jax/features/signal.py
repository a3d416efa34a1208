"""Functions of time as features (`Signal`), varied through their control points."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.core.values.waveform import (
    HELD,
    HOLDS,
    Waveform,
    acting_spans,
    check_duration,
    check_refinable,
    check_times,
    check_width,
    control_times,
    is_waveform,
    refined_times,
)
from verifai_jax.features.box import Box
from verifai_jax.features.continuous import Continuous
from verifai_jax.features.domain import Domain, Row, as_numbers, indexed, on_device, short

DEFAULT_KNOTS = 16
"""Control points of a signal that says nothing else: enough for a few swings, and few enough to be
searched."""
Course = tuple[str, float | None, tuple[float, ...] | None, float | None]
"""Hold, duration, times and width."""


@dataclass(frozen=True)
class Signal(Domain):
    """A function of time with control points: `Signal(Box(-1, 1), knots=16, hold="linear")`.

        Signal(Box(0, 61), times=[0, 5, 20, 30], hold="pchip")   # where the control points are
        Signal(Box(0, 3), times=[2, 8], hold="pulse", width=0.5)  # two gusts of half a second

    A value is a `Waveform`, which a system calls with a time in seconds: `features["wind"](time)`.

    **Arguments:**
    - `domain`: the domain of each control point: a `Box` of numbers or vectors, or a distribution.
    - `knots`: number of control points at equal distances; left out if `times` is given.
    - `hold`: how they are interpolated. `"linear"` joins them by lines, the first at time 0 and the
      last at the end; `"pchip"` by a cubic that is monotone between them and never exceeds them;
      `"constant"` holds each for an equal part of the time; `"pulse"` holds each for `width`
      seconds from its time on, and is 0 otherwise.
    - `duration`: duration in seconds; that of the simulation when left out (`ode` knows it).
    - `times`: the increasing times of the control points in seconds. The first and the last value
      hold before and after them.
    - `width`: the width of a pulse in seconds; by default half the shortest distance of two pulses.
    **Raises:** `ValueError` for a domain that is not continuous, an unknown `hold`, too few knots
    (1 for constant and pulse, 2 for linear and pchip), a duration or width that is not positive,
    and times that do not increase, exceed the duration, or differ from the knots in number.
    """

    arguments = ("domain", "knots", "hold", "duration")
    domain: Domain
    knots: int = DEFAULT_KNOTS
    hold: str = "linear"
    duration: float | None = None
    times: Sequence[float] | None = None
    width: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.domain, Box | Continuous):
            raise ValueError(
                "the control points of a Signal come from a Box or a distribution; "
                f"got {self.domain!r}"
            )
        if self.hold not in HOLDS:
            raise unknown_name("hold", self.hold, HOLDS)
        minimum, knots = 1 if self.hold in HELD else 2, self.knots
        times = None if self.times is None else check_times(self.times)
        if times is not None:
            # The default cannot be distinguished from a 16 that was given.
            if knots not in (DEFAULT_KNOTS, len(times)):
                raise ValueError(
                    f"a Signal has one knot at each of its times; got {knots!r} knots and "
                    f"{len(times)} times"
                )
            knots = len(times)
        if isinstance(knots, bool) or not isinstance(knots, int | np.integer) or knots < minimum:
            raise ValueError(
                f"a Signal with {self.hold} hold needs at least {minimum} knots; got {knots!r}"
            )
        check_width(self.hold, times, self.width)
        object.__setattr__(self, "knots", int(knots))
        object.__setattr__(self, "times", times)
        if self.width is not None:
            object.__setattr__(self, "width", float(self.width))
        if self.duration is not None:
            object.__setattr__(self, "duration", check_duration(self.duration))
            if times is not None and times[-1] > self.duration:
                raise ValueError(
                    "the times of a Signal must lie in its duration of "
                    f"{format_seconds(self.duration)}; got "
                    f"{times[-1]:zg}"
                )

    @property
    def levels(self) -> tuple[int, ...]:
        return self.domain.levels * self.knots

    @property
    def signals(self) -> tuple[tuple[int, ...], ...]:
        each = self.domain.size
        return tuple(tuple(range(i, self.size, each)) for i in range(each))

    def from_unit(self, u: Float[Array, " size"]) -> Waveform:
        knots = jax.vmap(self.domain.from_unit)(u.reshape(self.knots, self.domain.size))
        return self.waveform(knots)

    @property
    def monotone(self) -> bool:
        return self.domain.monotone

    def to_unit(self, value: Waveform) -> Float[Array, " size"]:
        return jnp.ravel(jax.vmap(self.domain.to_unit)(value.knots))

    def coerce(self, value: PyTree) -> Waveform:
        """Convert a `Waveform`, a list of control points, or one value for all times."""
        if is_waveform(value):
            if (value.hold, value.times) != (self.hold, self._course[2]):
                wanted = _format_course((self.hold, None, *self._course[2:]))
                raise ValueError(f"a Signal with {wanted} cannot be {value!r}")
            return self.waveform(self.domain.coerce(value.knots))
        knots = self.domain.coerce(value)
        if knots.ndim == np.ndim(getattr(self.domain, "low", 0.0)):
            shape = (self.knots, *knots.shape)
            if isinstance(knots, Tracer):
                knots = jnp.broadcast_to(knots, shape)
            else:
                knots = on_device(np.array(np.broadcast_to(np.asarray(knots), shape)))
        return self.waveform(knots)

    def check(self, value: object, name: str) -> None:
        if isinstance(value, Waveform):
            own, course = self._course, (value.hold, value.duration, value.times, value.width)
            if course not in (own, (self.hold, None, *own[2:])):
                raise ValueError(
                    f"{name} must have {_format_course(own)}; got {_format_course(course)}"
                )
            value = value.knots
        knots = as_numbers(value, name)
        if knots.ndim == np.ndim(getattr(self.domain, "low", 0.0)):
            self.domain.check(knots, name)
            return
        if len(knots) != self.knots:
            raise ValueError(f"{name} must have {self.knots} control points; got {len(knots)}")
        for i, knot in enumerate(knots):
            self.domain.check(knot, f"{name}[{i}]")

    def columns(self, name: str) -> tuple[str, ...]:
        return tuple(
            column for knot in indexed(name, self.knots) for column in self.domain.columns(knot)
        )

    def labels(self, name: str, duration: float | None = None) -> tuple[str, ...]:
        length = self.duration or duration
        if length is None and self.times is None:
            return self.coordinates(name)
        parts = self.domain.coordinates(name)
        if self.hold in HELD:
            times = [_format_span(*span) for span in self.spans(length or math.inf)]
        else:
            instants = control_times(self.knots, self.hold, self.times, length or math.inf)
            times = [f"at {format_seconds(time, 4)}" for time in instants]
        return tuple(f"{part} {time}" for time in times for part in parts)

    def spans(self, duration: float) -> list[tuple[float, float]]:
        length = self.duration or duration
        return acting_spans(self.knots, self.hold, self.times, self.width, length)

    def to_columns(self, values: Waveform, name: str) -> dict[str, np.ndarray]:
        knots, columns = np.asarray(values.knots), {}
        for i, knot in enumerate(indexed(name, self.knots)):
            columns |= self.domain.to_columns(knots[:, i], knot)
        return columns

    def from_columns(self, row: Row, name: str) -> Waveform:
        knots = [self.domain.from_columns(row, knot) for knot in indexed(name, self.knots)]
        if any(isinstance(knot, Tracer) for knot in knots):
            return self.waveform(jnp.stack(knots))
        return self.waveform(on_device(np.stack([np.asarray(knot) for knot in knots])))

    def refined(self, factor: int) -> "Signal":
        """Return the signal with more control points, among them those of the coarse signal.

        There are `(knots - 1) * factor + 1` if linear, `knots * factor` if constant.
        `Waveform.refined` gives the same function on them, so that a search can go from coarse to
        fine. Given times are refined between the first and the last.

        **Raises:** `ValueError` for a factor that is not a positive integer, and for cubics and
        pulses, which more control points cannot represent.
        """
        if isinstance(factor, bool) or not isinstance(factor, int) or factor < 1:
            raise ValueError(f"factor must be a positive integer; got {factor!r}")
        check_refinable(self.hold)
        _, _, times, _ = self._course
        if times is not None:
            finer = refined_times(times, factor)
            assert finer is not None
            return replace(self, knots=len(finer), times=finer)
        count = self.knots * factor
        return replace(self, knots=count - factor + 1 if self.hold == "linear" else count)

    def refine(self, value: Waveform, factor: int) -> Waveform:
        return value.refined(factor)

    def waveform(self, knots: Float[Array | np.ndarray, "*knots"]) -> Waveform:
        """Return the function of time with these control points `[knots, ...]`, unchecked."""
        return Waveform(knots, *self._course)

    @property
    def _course(self) -> Course:
        return (
            self.hold,
            self.duration,
            None if self.times is None else tuple(self.times),
            self.width,
        )

    def words(self) -> str:
        each = self.domain.words()
        return f"a function of time with {self.knots} control points, each {each}"

    def parts(self, name: str) -> tuple[tuple[str, Domain], ...]:
        return tuple((knot, self.domain) for knot in indexed(name, self.knots))

    def check_reachable(self, value: Waveform, name: str) -> None:
        for knot in np.asarray(value.knots).ravel():
            self.domain.check_reachable(float(knot), name)

    def __repr__(self) -> str:
        points = f"knots={self.knots}" if self.times is None else f"times={short(self.times)}"
        duration = "" if self.duration is None else f", duration={self.duration:zg}"
        width = "" if self.width is None else f", width={self.width:zg}"
        return f"Signal({self.domain!r}, {points}, hold={self.hold!r}{width}{duration})"


def _format_course(course: Course) -> str:
    hold, duration, times, width = course
    text = f"hold={hold!r} and duration={duration}"
    if times is not None:
        text += f", times={short(times)}"
    return text if width is None else f"{text}, width={width:zg}"


def _format_span(begin: float, end: float) -> str:
    until = f" to {format_seconds(end, 4)}" if math.isfinite(end) else " on"
    return f"from {format_seconds(begin, 4)}{until}"
