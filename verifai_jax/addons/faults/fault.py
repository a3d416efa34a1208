"""Descriptions of faults: the channel, the time, and numbers for the severity.

Each number is fixed or given as a domain; a domain becomes a feature of the problem.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, ClassVar, NamedTuple, TypeAlias, dataclass_transform

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from verifai_jax.core.messages.checks import check_count, check_name, is_number
from verifai_jax.features import Categorical, Domain, Struct
from verifai_jax.systems.delays import line_of

SLACK = 1e-3
"""Tolerance for rounded instants, in periods: onset 0.3 includes the instant 30 * 0.01 s."""
Number: TypeAlias = float | Domain
Vector: TypeAlias = Float[Array | np.ndarray, " n"]


def number(low: float = -math.inf, high: float = math.inf, default: Any = MISSING) -> Any:
    """Return a dataclass field for a number of a fault, limited to the range between two ends."""
    return field(metadata={"ends": (low, high)}, default=default)


class Moment(NamedTuple):
    """An instant of the simulation, with the numbers of a fault.

    - `xp`: `jax.numpy`, or `numpy` on the host.
    - `number`: the numbers of the fault by name.
    - `live`: whether the onset has passed and the end has not; `since`: seconds since the onset, at
      least 0.
    - `time`, `period`: time of the instant, and time between two instants, in seconds.
    - `first`: whether this is the first instant; `acts`: whether the channel is part of an action.
    - `other`: the values of the channel `source` of `WrongChannel`.
    - `uniform(count)`: function that returns random numbers of this instant, between 0 and 1.
    """

    xp: Any
    number: Mapping[str, Any]
    live: Bool[Any, ""]
    since: Any
    time: Any
    period: float
    first: Any
    acts: bool
    other: Vector | None
    uniform: Callable[[int], Vector]

    @property
    def instants(self) -> Any:
        """Number of instants since the first one that is not before the onset."""
        return self.xp.floor(self.since / self.period + slack(self.time, self.period))


def slack(time: Any, period: float) -> Any:
    """Return the tolerance for a rounded instant, in periods: late times are rounded more."""
    return SLACK + 2 * np.finfo(np.float32).eps * abs(time) / period


class FaultFeatures(Struct):
    """The varying numbers of a fault, or the choice of `AtMost`; the weakest fault is nominal."""

    fault: "Fault | AtMost"

    def __init__(self, fault: "Fault | AtMost") -> None:
        super().__init__(fault.domains)
        object.__setattr__(self, "fault", fault)

    @property
    def nominal(self) -> dict[str, PyTree]:
        return {name: self.fault.weakest(name) for name in self.fault.domains}


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(field, number))
@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault of one channel: the base class of all kinds, which are frozen dataclasses.

    **Arguments:**
    - `channel`: `"observation"` or `"action"`, one entry such as `"observation[2]"`, or the name of
      a sensor, signal, joint, actuator or part of the state.
    - `onset`: start of the fault in seconds; a negative onset lies before the simulation.
    - `duration`: seconds until the channel recovers; None for never.
    - `name`: the name of the fault and of its feature; by default channel and kind, such as
      `gyro_dropout`.
    **Raises:** `ValueError` for numbers that are not finite or out of range, with their names.
    """

    severity: ClassVar[str] = "duration"
    """The name of the number that is its severity."""
    off: ClassVar[float] = 0.0
    """The severity at which there is no fault."""
    choices: ClassVar[bool] = True
    """Whether the fault can affect a channel of integers."""
    draws: ClassVar[bool] = False
    """Whether it draws random numbers."""
    holds: ClassVar[bool] = False
    """Whether it remembers a value to repeat it."""
    late: ClassVar[tuple[str, ...]] = ()
    """Names of the numbers whose sum is the maximum delay of a value, in seconds."""
    channel: str = field(kw_only=False)
    onset: Number = field(default=0.0, metadata={"ends": (-math.inf, math.inf)})
    duration: Number | None = field(default=None, metadata={"ends": (0.0, math.inf)})
    name: str = ""

    def __init_subclass__(cls, **traits: Any) -> None:
        for name, value in traits.items():
            setattr(cls, name, value)
        dataclass(frozen=True, kw_only=True)(cls)

    def __post_init__(self) -> None:
        kind = type(self).__name__
        if not isinstance(self.channel, str) or not self.channel.strip():
            raise ValueError(f"{kind} needs a channel, such as 'action'; got {self.channel!r}")
        if not self.name:
            words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", kind).lower()
            stem = re.sub(r"\W+", "_", self.channel).strip("_")
            object.__setattr__(self, "name", f"{stem}_{words}")
        check_name("the name of a fault", self.name)
        for name, value in self.numbers.items():
            (low, high), wanted = self.__dataclass_fields__[name].metadata["ends"], None
            if not is_number(value) and not (isinstance(value, Domain) and value.size == 1):
                wanted = "a number, or a domain of one number such as vj.Box(0, 1)"
            elif not all(map(math.isfinite, ends(value))):
                wanted = "finite"
            elif ends(value)[0] < low or ends(value)[1] > high:
                wanted = f"at least {low:zg}" if high == math.inf else f"from {low:zg} to {high:zg}"
            if wanted is not None:
                raise ValueError(f"{name} of {kind} must be {wanted}; got {value!r}")

    @property
    def numbers(self) -> dict[str, Number]:
        """All numbers by name, those of the kind first, without those that are None."""
        timing = ("onset", "duration")
        own = [each.name for each in fields(self) if each.metadata and each.name not in timing]
        given = {name: getattr(self, name) for name in (*own, *timing)}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def domains(self) -> dict[str, Domain]:
        """The domains of the varying numbers, by name."""
        return {n: value for n, value in self.numbers.items() if isinstance(value, Domain)}

    @property
    def grade(self) -> str:
        """The name of the varying number that is the severity of the fault."""
        ordered = (self.severity, "duration", "onset", *self.domains)
        return next(name for name in ordered if name in self.domains)

    def weakest(self, name: str) -> PyTree:
        """Return the value of a varying number for the weakest, shortest and latest fault."""
        low, high = ends(self.domains[name])
        wanted = {"onset": math.inf, "duration": 0.0, self.severity: self.off}
        value = min(max(wanted.get(name, (low + high) / 2), low), high)
        return value if self.domains[name].levels == (0,) else round(value)

    def memory(self, zero: Vector, period: float) -> PyTree:
        """Return the initial memory of the fault, for entries with the shape of `zero`."""
        if self.late:
            longest = sum(ends(self.numbers[name])[1] for name in self.late)
            return line_of(zero, math.ceil(longest / period - 1e-6) + 1)
        return zero if self.holds else ()

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        """Return the faulty entries for the correct entries `good`, and the new memory."""
        raise NotImplementedError


@dataclass(frozen=True)
class AtMost:
    """A set of faults; at most `count` of them happen in one simulation.

    - `count`: the maximum number of faults in one simulation; `faults`: the candidates.
    - `name`: the name of the feature that chooses. Each of its entries is the name of a fault or
      `none`, all equally likely.

    **Raises:** `ValueError` for a count that is not positive, and for a candidate that is not a
    fault.
    """

    count: int
    faults: tuple[Fault, ...]
    name: str = "fault"

    def __post_init__(self) -> None:
        check_count("count", self.count)
        faults = tuple(self.faults) if isinstance(self.faults, list | tuple) else ()
        if not faults or not all(isinstance(fault, Fault) for fault in faults):
            raise ValueError(f"AtMost needs a list of faults; got {self.faults!r}")
        check_name("the name of AtMost", self.name)
        object.__setattr__(self, "faults", faults)

    @property
    def domains(self) -> dict[str, Domain]:
        """The domains of the choices, one choice for each fault that can happen at once."""
        chosen = Categorical("none", *(fault.name for fault in self.faults))
        return {str(i + 1): chosen for i in range(min(self.count, len(self.faults)))}

    def weakest(self, name: str) -> str:
        """Return the choice without a fault."""
        return "none"


def ends(value: Number) -> tuple[float, float]:
    """Return the lowest and the highest value of a number."""
    if not isinstance(value, Domain):
        return float(value), float(value)
    low, high = getattr(value, "low", None), getattr(value, "high", None)
    if not (is_number(low) and is_number(high)):
        low, high = (value.from_unit(jnp.full(1, end)) for end in (0.0, 1.0))
    return float(low), float(high)
