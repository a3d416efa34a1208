"""The kinds of faults."""

import math
from dataclasses import field
from typing import Any

import jax
import numpy as np
from jax.lax import erf_inv
from jaxtyping import PyTree

from verifai_jax.addons.faults.fault import SLACK, Fault, Moment, Number, Vector, ends, number
from verifai_jax.core.compute.derivatives import with_derivative_of
from verifai_jax.systems.delays import entry, moved_up


class Dropout(Fault):
    """The channel reads `value` instead of its true value, such as a disconnected sensor."""

    value: Number = number(default=0.0)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        return at.xp.full_like(good, 1) * at.number["value"], memory


class Stuck(Dropout):
    """The channel is stuck at `value`, such as an open valve."""

    value: Number = number()


class Freeze(Fault, holds=True):
    """The channel repeats the last value that it had before the onset."""

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        held = at.xp.where(at.live & ~at.first, memory, good)
        return held, held


class HeldAction(Fault, severity="hold", holds=True):
    """The channel changes only every `hold` seconds, in whole periods, from the onset on.

    It keeps its value in between.
    """

    channel: str = field(default="action", kw_only=False)
    hold: Number = number(0)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        steps = at.xp.maximum(1, _nearest(at.number["hold"] / at.period, at.xp))
        fresh = ~at.live | (at.instants % steps == 0) | at.first
        held = at.xp.where(fresh, good, memory)
        return held, held


class Delay(Fault, severity="seconds", late=("seconds", "swing")):
    """The channel is `seconds` late, in whole periods.

    The delay oscillates by `swing` seconds with the period `cycle` in seconds.
    """

    seconds: Number = number(0)
    swing: Number = number(0, default=0.0)
    cycle: Number = number(1e-9, default=1.0)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        number = at.number
        turn = at.xp.sin(2 * math.pi * at.time / number["cycle"])
        return _late(good, memory, number["seconds"] + number["swing"] * turn, at)


class ClockJitter(Fault, severity="jitter", draws=True, late=("jitter",)):
    """Each value is late by a random time up to `jitter` seconds, in whole periods."""

    jitter: Number = number(0)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        return _late(good, memory, at.uniform(1)[0] * at.number["jitter"], at)


class PacketLoss(Fault, severity="loss", draws=True, holds=True):
    """Each value is lost with probability `loss`; the last one that arrived is used instead."""

    loss: Number = number(0, 1)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        lost = at.live & (at.uniform(1)[0] < at.number["loss"]) & ~at.first
        held = at.xp.where(lost, memory, good)
        if at.xp is np or good.dtype.kind != "f":
            return held, held
        # The derivative of the mean: the older value is used with probability `loss`.
        expected = held + (memory - good) * at.number["loss"]
        constant = (memory - good) * jax.lax.stop_gradient(at.number["loss"])
        return with_derivative_of(held, expected - constant), held


class Bias(Fault, severity="offset", choices=False):
    """A constant `offset` is added."""

    offset: Number = number()

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        return good + at.number["offset"], memory


class Drift(Fault, severity="rate", choices=False):
    """The added offset grows by `rate` per second from the onset on."""

    rate: Number = number()

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        return good + at.number["rate"] * at.since, memory


class Noise(Fault, severity="std", choices=False, draws=True):
    """Normal noise with standard deviation `std` is added, independent at each instant."""

    std: Number = number(0)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        normal = at.xp.asarray(erf_inv(2 * at.uniform(len(good)) - 1)) * np.float32(2**0.5)
        return good + at.number["std"] * normal, memory


class Spikes(Fault, severity="height", choices=False, draws=True):
    """Single values are shifted by `height`, up or down, on average `rate` times a second."""

    height: Number = number(0)
    rate: Number = number(0, default=1.0)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        chance = at.uniform(2 * len(good))
        sign = at.xp.where(chance[len(good) :] < 0.5, -1.0, 1.0)
        hit = chance[: len(good)] < at.number["rate"] * at.period
        return at.xp.where(hit, good + sign * at.number["height"], good), memory


class Quantisation(Fault, severity="step", choices=False):
    """Values are rounded to multiples of `step`."""

    step: Number = number(0)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        step = at.xp.where(at.number["step"] > 0, at.number["step"], 1.0)
        exact = good / step
        rounded = at.xp.round(exact) * step
        if at.xp is np:
            return rounded, memory
        # Rounding has no slope: it is 1 by the value, and the remainder's by the step.
        left = jax.lax.stop_gradient(at.xp.round(exact) - exact)
        return with_derivative_of(rounded, good + left * step), memory


class Saturation(Fault, severity="limit", off=math.inf, choices=False):
    """Values are limited to between `lower` and `limit`; without `lower`, from `-limit` on."""

    limit: Number = number(0)
    lower: Number | None = number(default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lower is not None and ends(self.lower)[1] > ends(self.limit)[0]:
            raise ValueError(
                f"lower of Saturation must not exceed limit, {self.limit!r}; got {self.lower!r}"
            )

    def weakest(self, name: str) -> PyTree:
        return ends(self.domains[name])[0] if name == "lower" else super().weakest(name)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        limit = at.number["limit"]
        return at.xp.clip(good, at.number.get("lower", -limit), limit), memory


class DeadBand(Fault, severity="width", choices=False):
    """Values within `width` of zero read zero, and others are closer to zero by `width`.

    An example is a valve whose spool has an overlap.
    """

    width: Number = number(0)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        width = at.number["width"]
        return good - at.xp.clip(good, -width, width), memory


class Backlash(Fault, severity="gap", choices=False, holds=True):
    """The channel has a mechanical play of `gap`: it moves only when it is pushed from one end."""

    gap: Number = number(0)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        half = at.number["gap"] / 2
        dragged = at.xp.clip(memory, good - half, good + half)
        held = at.xp.where(at.live & ~at.first, dragged, good)
        return held, held


class RateLimit(Fault, severity="rate", off=math.inf, choices=False, holds=True):
    """The channel changes by at most `rate` per second."""

    rate: Number = number(0)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        step = at.number["rate"] * at.period
        followed = at.xp.clip(good, memory - step, memory + step)
        held = at.xp.where(at.live & ~at.first, followed, good)
        return held, held


class Gain(Fault, severity="factor", off=1.0, choices=False):
    """Values are multiplied by `factor`, such as 1.5 for an amplifier that is set too high."""

    factor: Number = number()

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        return good * at.number["factor"], memory


class LossOfAuthority(Fault, severity="loss", choices=False):
    """The channel loses the share `loss` of its value; meant for actuators."""

    channel: str = field(default="action", kw_only=False)
    loss: Number = number(0, 1)

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        return good * (1 - at.number["loss"]), memory


class SignFlip(Fault, choices=False):
    """The channel has the wrong sign."""

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        return -good, memory


class WrongChannel(Fault):
    """The channel has the values of the channel `source`, as with two wires exchanged."""

    source: str

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        assert at.other is not None
        return at.other, memory


def _nearest(periods: Any, xp: Any) -> Any:
    """Return the nearest whole number of periods; halves, which are seldom exact, upwards."""
    return xp.floor(periods + (0.5 + SLACK))


def _late(good: Vector, line: Any, seconds: Any, at: Moment) -> tuple[Vector, Any]:
    """Return the value from some seconds ago, in whole periods, and the updated delay line."""
    xp, line = at.xp, moved_up(line, good, at.xp)
    if not at.acts:
        # The line begins with the first observation; before the first action there is none.
        line = jax.tree.map(lambda values: xp.where(at.first, good, values), line)
    latest = len(line) - 1
    periods = xp.clip(seconds / at.period, 0, latest)
    whole = entry(line, xp.minimum(_nearest(periods, xp), latest).astype(np.int32), xp)
    if xp is np or good.dtype.kind != "f" or not latest:
        return whole, line
    left = xp.clip(xp.floor(periods).astype(np.int32), 0, latest - 1)
    share = periods - left
    smooth = entry(line, left, xp) * (1 - share) + entry(line, left + 1, xp) * share
    return with_derivative_of(whole, smooth), line
