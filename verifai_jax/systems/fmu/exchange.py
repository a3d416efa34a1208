"""FMUs for model exchange, which bring equations and events but no solver: both are solved here.

instance = ExchangeInstance(description, folder)     # begin, set, step and get as of `Instance`

LSODA integrates, which changes to implicit steps where the equations are stiff. Its steps are at
most as long as those of communication. An event happens where an indicator changes its sign, which
bisection finds within the step, at a time that the FMU named, and wherever the FMU asks for one.
"""

from collections.abc import Mapping
from ctypes import Structure, byref, c_bool, c_double, c_int, c_size_t
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.systems.fmu.library import FMUError, Instance

TOLERANCE = 1e-6
"""Relative tolerance of the integration; the absolute one is this share of a state's nominal."""
RESOLUTION = 1e-12
"""Seconds, as a share of the time, to which the time of an event is found."""
MAX_EVENTS = 1000
"""Events of one step of communication, and rounds of one event, at which a simulation is given up:
such a model chatters."""


class _EventInfo(Structure):
    """The answer of an FMU of FMI 2 to an event; FMI 3 gives the same numbers one by one."""

    _fields_ = (
        ("again", c_int),
        ("ended", c_int),
        ("nominals_changed", c_int),
        ("states_changed", c_int),
        ("next_defined", c_int),
        ("next", c_double),
    )


class ExchangeInstance(Instance):
    """An instance of an FMU for model exchange; arguments and errors are those of `Instance`."""

    _running = False

    def begin(self, values: Mapping[str, float], duration: float) -> None:
        """Set start values, and initialize; after an earlier simulation the instance is reset."""
        self._running = False
        super().begin(values, duration)
        self._running, self._ended = True, False
        self._inputs, self._time, self._stop = dict(values), 0.0, duration
        self._size, indicators = self._sizes()
        # One number at least: without states the integrator is given one that stands still.
        self._states, self._slopes, nominals = ((c_double * max(self._size, 1))() for _ in range(3))
        self._indicators = (c_double * indicators)()
        if self._size:
            self._call("GetNominalsOfContinuousStates", nominals, c_size_t(self._size))
        self._tolerances: Any = TOLERANCE * np.maximum(np.abs(nominals), 1e-30 if self._size else 1.0)
        self._settle()

    def set(self, values: Mapping[str, float]) -> None:
        """Set variables by name; a change of an input is an event."""
        if self._running:
            if all(self._inputs.get(name) == value for name, value in values.items()):
                return
            self._inputs.update(values)
            self._call("EnterEventMode")
        super().set(values)
        if self._running:
            self._settle()

    def step(self, time: float, size: float) -> bool:
        """Integrate up to the next time of communication; False if the FMU ended its simulation.

        **Raises:** `FMUError` also where the integration fails, or events do not end.
        """
        end, events = min(time + size, self._stop), 0
        while self._time < end and not self._ended:
            if self._solver is None or self._time >= self._reached:
                self._integrate(size)
            self._time = max(self._time, min(end, self._reached, self._next))
            self._move(self._time, self._course(self._time))
            if self._completed() or self._time >= min(self._crossing, self._next):
                events += 1
                if events > MAX_EVENTS:
                    raise self._chatters("events in a step of communication")
                self._call("EnterEventMode")
                self._settle()
        return not self._ended

    def _integrate(self, size: float) -> None:
        """Take one step of the integrator, and find where in it an indicator changes its sign."""
        from scipy.integrate import LSODA

        if self._solver is None:
            self._solver = LSODA(
                self._slope, self._time, np.array(self._states), self._stop,
                max_step=size, rtol=TOLERANCE, atol=self._tolerances,
            )  # fmt: skip
        said = self._solver.step()
        if self._solver.status == "failed":
            raise FMUError(
                f"{self.description.file.name} cannot be integrated beyond {self._time:z.6g} s: "
                f"{said}{self._said()}"
            )
        self._course = self._solver.dense_output()
        low, high = self._time, self._solver.t
        self._reached, self._crossing = high, np.inf
        if not self._changed(high):
            return
        while high - low > RESOLUTION * max(high, size):
            middle = (low + high) / 2
            low, high = (low, middle) if self._changed(middle) else (middle, high)
        self._reached = self._crossing = high

    def _changed(self, time: float) -> bool:
        """Return whether an indicator has another sign than after the last event."""
        if not len(self._indicators):
            return False
        self._move(time, self._course(time))
        return bool(np.any(self._signs() != self._signs_before))

    def _signs(self) -> Bool[np.ndarray, " indicators"]:
        if len(self._indicators):
            self._call("GetEventIndicators", self._indicators, c_size_t(len(self._indicators)))
        return np.array(self._indicators) > 0

    def _slope(self, time: float, states: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        self._move(time, states)
        if self._size:
            name = "GetDerivatives" if self._two else "GetContinuousStateDerivatives"
            self._call(name, self._slopes, c_size_t(self._size))
        return np.array(self._slopes)

    def _move(self, time: float, states: Float[np.ndarray, " n"]) -> None:
        """Take the FMU to a time and its states."""
        self._call("SetTime", c_double(time))
        if self._size:
            self._states[:] = states.tolist()
            self._call("SetContinuousStates", self._states, c_size_t(self._size))

    def _completed(self) -> bool:
        """Say that a step is done, and return whether the FMU asks for an event."""
        kind = c_int if self._two else c_bool
        asks, ends = kind(False), kind(False)
        self._call("CompletedIntegratorStep", kind(True), byref(asks), byref(ends))
        self._ended = self._ended or bool(ends.value)
        return bool(asks.value)

    def _settle(self) -> None:
        """Let the FMU go through an event, and go on in continuous time."""
        for _ in range(MAX_EVENTS):
            if not self._event() or self._ended:
                break
        else:
            raise self._chatters("rounds of one event")
        self._call("EnterContinuousTimeMode")
        if self._size:
            self._call("GetContinuousStates", self._states, c_size_t(self._size))
        self._signs_before, self._solver = self._signs(), None

    def _event(self) -> bool:
        """Go through one round of an event, and return whether another one is needed."""
        if self._two:
            info = _EventInfo()
            self._call("NewDiscreteStates", byref(info))
            again, ended, timed, time = info.again, info.ended, info.next_defined, info.next
        else:
            flags, moment = (c_bool * 5)(), c_double()
            pointers = (byref(flags, i) for i in range(5))
            self._call("UpdateDiscreteStates", *pointers, byref(moment))
            again, ended, _, _, timed = flags
            time = moment.value
        self._ended = self._ended or bool(ended)
        self._next = time if timed else np.inf
        return bool(again)

    def _sizes(self) -> tuple[int, int]:
        """Return the numbers of states and of event indicators."""
        if self._two:
            return self.description.sizes
        found = [c_size_t(), c_size_t()]
        for kind, number in zip(("ContinuousStates", "EventIndicators"), found, strict=True):
            self._call(f"GetNumberOf{kind}", byref(number))
        return found[0].value, found[1].value

    def _chatters(self, events: str) -> FMUError:
        return FMUError(
            f"{self.description.file.name} has more than {MAX_EVENTS:,} {events} at "
            f"{self._time:z.6g} s{self._said()}"
        )
