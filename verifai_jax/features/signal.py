"""Functions of time as features (`Signal`), varied through their control points."""

from dataclasses import dataclass, replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from verifai_jax.core.errors import unknown_name
from verifai_jax.core.waveform import HOLDS, Waveform, check_duration, is_waveform
from verifai_jax.features.box import Box
from verifai_jax.features.distributions import Continuous
from verifai_jax.features.domain import Domain, Row, as_numbers, indexed


@dataclass(frozen=True)
class Signal(Domain):
    """A function of time by control points: `Signal(Box(-1, 1), knots=16, hold="linear")`.

    A value is a `Waveform`, which a system calls with a time in seconds: `features["wind"](time)`.

    **Arguments:**

    - `domain`: of each control point: a `Box`, of numbers or vectors, or a distribution.
    - `knots`: number of control points, at equal distances.
    - `hold`: `"linear"` joins them by lines, the first at time 0 and the last at the end;
      `"constant"` holds each for an equal part of the time.
    - `duration`: in seconds; that of the simulation when left out (`ode` knows it).

    **Raises:** `ValueError` for a domain that is not continuous, an unknown `hold`, too few knots
    (1 for constant, 2 for linear) or a duration that is not positive.
    """

    domain: Domain
    knots: int = 16
    hold: str = "linear"
    duration: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.domain, Box | Continuous):
            raise ValueError(
                "the control points of a Signal come from a Box or a distribution; "
                f"got {self.domain!r}"
            )
        if self.hold not in HOLDS:
            raise unknown_name("hold", self.hold, HOLDS)
        least = 2 if self.hold == "linear" else 1
        knots = self.knots
        if isinstance(knots, bool) or not isinstance(knots, int | np.integer) or knots < least:
            raise ValueError(
                f"a Signal with {self.hold} hold needs at least {least} knots; got {knots!r}"
            )
        object.__setattr__(self, "knots", int(knots))
        if self.duration is not None:
            object.__setattr__(self, "duration", check_duration(self.duration))

    @property
    def levels(self) -> tuple[int, ...]:
        return self.domain.levels * self.knots

    @property
    def signals(self) -> tuple[tuple[int, ...], ...]:
        each = self.domain.size
        return tuple(tuple(range(i, self.size, each)) for i in range(each))

    def from_unit(self, u: Float[Array, " size"]) -> Waveform:
        knots = jax.vmap(self.domain.from_unit)(u.reshape(self.knots, self.domain.size))
        return self._waveform(knots)

    def to_unit(self, value: Waveform) -> Float[Array, " size"]:
        return jnp.ravel(jax.vmap(self.domain.to_unit)(value.knots))

    def coerce(self, value: PyTree) -> Waveform:
        """Convert a `Waveform`, a list of control points, or one value for all times."""
        if is_waveform(value):
            return self._waveform(self.domain.coerce(value.knots))
        knots = self.domain.coerce(value)
        if knots.ndim == np.ndim(getattr(self.domain, "low", 0.0)):
            knots = jnp.broadcast_to(knots, (self.knots, *knots.shape))
        return self._waveform(knots)

    def check(self, value: object, name: str) -> None:
        if isinstance(value, Waveform):
            if (value.hold, value.duration) not in ((self.hold, self.duration), (self.hold, None)):
                raise ValueError(
                    f"{name} must have hold={self.hold!r} and duration={self.duration}; got "
                    f"hold={value.hold!r} and duration={value.duration}"
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
        if length is None:
            return self.coordinates(name)
        parts = self.domain.coordinates(name)
        if self.hold == "linear":
            times = [f"at {time:.4g} s" for time in np.linspace(0, length, self.knots)]
        else:
            edges = np.linspace(0, length, self.knots + 1)
            times = [f"from {a:.4g} s to {b:.4g} s" for a, b in pairwise(edges)]
        return tuple(f"{part} {time}" for time in times for part in parts)

    def to_columns(self, values: Waveform, name: str) -> dict[str, np.ndarray]:
        knots, columns = np.asarray(values.knots), {}
        for i, knot in enumerate(indexed(name, self.knots)):
            columns |= self.domain.to_columns(knots[:, i], knot)
        return columns

    def from_columns(self, row: Row, name: str) -> Waveform:
        knots = [self.domain.from_columns(row, knot) for knot in indexed(name, self.knots)]
        return self._waveform(jnp.stack(knots))

    def refined(self, factor: int) -> "Signal":
        """Return the signal with more control points, among which are all of the coarse one's.

        `(knots - 1) * factor + 1` where linear, `knots * factor` where constant: `Waveform.refined`
        gives the same function on them, so that a search can go from coarse to fine.

        **Raises:** `ValueError` for a factor that is not a positive integer.
        """
        if isinstance(factor, bool) or not isinstance(factor, int) or factor < 1:
            raise ValueError(f"factor must be a positive integer; got {factor!r}")
        finer = self.knots * factor
        return replace(self, knots=finer - factor + 1 if self.hold == "linear" else finer)

    def refine(self, value: Waveform, factor: int) -> Waveform:
        """Convert a value to one of `refined(factor)`: the same function of time."""
        return value.refined(factor)

    def _waveform(self, knots: Float[Array, "*knots"]) -> Waveform:
        return Waveform(knots, self.hold, self.duration)

    def __repr__(self) -> str:
        duration = "" if self.duration is None else f", duration={self.duration:g}"
        return f"Signal({self.domain!r}, knots={self.knots}, hold={self.hold!r}{duration})"
