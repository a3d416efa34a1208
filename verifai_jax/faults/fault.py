"""Descriptions of faults: the channel, the time, and numbers that say how severe they are.

Each number is fixed, or a domain, which makes it a feature of the problem.
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

Number: TypeAlias = float | Domain
Vector: TypeAlias = Float[Array | np.ndarray, " n"]


def number(low: float = -math.inf, high: float = math.inf, default: Any = MISSING) -> Any:
    """Return the field of a number of a fault, which has to lie between two ends."""
    return field(metadata={"ends": (low, high)}, default=default)


class Moment(NamedTuple):
    """The instant at which a fault acts, and its numbers there.

    - `xp`: `jax.numpy`, or `numpy` on the host.
    - `number`: the numbers of the fault by name.
    - `live`: whether the onset has passed and the end has not; `since`: seconds since the onset, at
      least 0.
    - `time`, `period`: of the instant, and between two instants, in seconds.
    - `first`: whether nothing passed before; `acts`: whether the channel is part of an action.
    - `other`: the values of the channel `source` of `WrongChannel`.
    - `uniform(count)`: random numbers of this instant, between 0 and 1.
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


class FaultFeatures(Struct):
    """The numbers of a fault that vary, or the choice of `AtMost`; nominal is the weakest fault."""

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
    """A fault of one channel; its kinds derive from it, as frozen dataclasses.

    **Arguments:**
    - `channel`: `"observation"`, `"action"`, one entry of them, `"observation[2]"`, or the name of
      a sensor, signal, joint, actuator or part of the state.
    - `onset`: seconds from the beginning of the simulation until the fault; below 0 it has begun
      before.
    - `duration`: seconds until the channel recovers; None for never.
    - `name`: the name of the fault, and of its feature: `gyro_dropout` when left out.
    **Raises:** `ValueError` for numbers that are not finite or out of range, with their names.
    """

    severity: ClassVar[str] = "duration"
    """The number that says how bad it is."""
    off: ClassVar[float] = 0.0
    """The severity at which there is no fault."""
    choices: ClassVar[bool] = True
    """Whether a channel of whole numbers can have it."""
    draws: ClassVar[bool] = False
    """Whether it draws random numbers."""
    holds: ClassVar[bool] = False
    """Whether it remembers a value to repeat it."""
    late: ClassVar[tuple[str, ...]] = ()
    """The numbers whose sum is the longest time, in seconds, by which a value can be late."""
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
        """All numbers by name, those of the kind first; no duration if the fault never ends."""
        timing = ("onset",) if self.duration is None else ("onset", "duration")
        all_of_them = [each.name for each in fields(self) if each.metadata]
        own = [name for name in all_of_them if name not in ("onset", "duration")]
        return {name: getattr(self, name) for name in (*own, *timing)}

    @property
    def domains(self) -> dict[str, Domain]:
        """The numbers that vary."""
        return {n: value for n, value in self.numbers.items() if isinstance(value, Domain)}

    @property
    def grade(self) -> str:
        """The number that varies and says how bad the fault is."""
        ordered = (self.severity, "duration", "onset", *self.domains)
        return next(name for name in ordered if name in self.domains)

    def weakest(self, name: str) -> PyTree:
        """Return the value of a number that varies in the weakest, shortest and latest fault."""
        low, high = ends(self.domains[name])
        wanted = {"onset": math.inf, "duration": 0.0, self.severity: self.off}
        value = min(max(wanted.get(name, (low + high) / 2), low), high)
        return value if self.domains[name].levels == (0,) else round(value)

    def memory(self, zero: Vector, period: float) -> PyTree:
        """Return what it remembers at first, for entries like `zero`."""
        if self.late:
            longest = sum(ends(self.numbers[name])[1] for name in self.late)
            return line_of(zero, math.ceil(longest / period - 1e-6) + 1)
        return zero if self.holds else ()

    def corrupt(self, good: Vector, memory: PyTree, at: Moment) -> tuple[Vector, PyTree]:
        """Return the entries that the fault makes of `good` ones, and what it remembers then."""
        raise NotImplementedError


@dataclass(frozen=True)
class AtMost:
    """Several faults of which at most `count` happen in one simulation.

    - `count`: the number of faults in one simulation; `faults`: those that are chosen from.
    - `name`: the name of the feature that chooses, whose entries are each the name of a fault or
      `none`, equally likely.

    **Raises:** `ValueError` for a count that is not positive, and for things that are no faults.
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
        """The choices, one for each fault that can happen at once."""
        chosen = Categorical("none", *(fault.name for fault in self.faults))
        return {str(i + 1): chosen for i in range(min(self.count, len(self.faults)))}

    def weakest(self, name: str) -> str:
        """Return the choice of no fault."""
        return "none"


def ends(value: Number) -> tuple[float, float]:
    """Return the lowest and the highest value of a number."""
    if not isinstance(value, Domain):
        return float(value), float(value)
    low, high = getattr(value, "low", None), getattr(value, "high", None)
    if not (is_number(low) and is_number(high)):
        low, high = (value.from_unit(jnp.full(1, end)) for end in (0.0, 1.0))
    return float(low), float(high)
