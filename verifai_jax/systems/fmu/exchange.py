"""FMUs for model exchange, which bring equations and events but no solver: both are solved here.

instance = ExchangeInstance(description, folder)     # begin, set, step and get as of `Instance`

LSODA integrates, which changes to implicit steps where the equations are stiff. An event happens
where an indicator has changed its sign after a step of communication, which bisection finds within
it, at a time that the FMU named, where it asks for one, and wherever an input changes.
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
MIN_STEPS = 50
"""Steps of the integrator in a simulation, at least: longer ones might miss a short pulse."""
MAX_STEPS = 100_000
"""Steps of the integrator in one step of communication, at which a simulation is given up."""
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
        self._size, self._count = self._sizes()
        self._states, self._state_view = _shared(self._size)
        self._slopes, self._slope_view = _shared(self._size)
        self._indicators, self._indicator_view = _shared(self._count)
        nominals, nominal = _shared(self._size)
        if self._size:
            self._call("GetNominalsOfContinuousStates", nominals, c_size_t(self._size))
        self._tolerances: Any = TOLERANCE * np.where(nominal == 0, 1.0, np.abs(nominal))
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
        end, events = time + size, 0
        while self._time < end and not self._ended:
            event = self._integrate(min(end, self._next))
            if self._completed() or event or self._time >= self._next:
                events += 1
                if events > MAX_EVENTS:
                    raise self._chatters("events in a step of communication")
                self._call("EnterEventMode")
                self._settle()
        return not self._ended

    def _integrate(self, end: float) -> bool:
        """Go on up to a time, or to a change of sign before it, and return whether there is one."""
        from scipy.integrate import ode, solve_ivp

        begin, before = self._time, self._state_view.copy()
        if self._solver is None:
            self._solver = ode(self._slope).set_integrator(
                "lsoda", rtol=TOLERANCE, atol=self._tolerances, max_step=self._stop / MIN_STEPS,
                nsteps=MAX_STEPS,
            )  # fmt: skip
            self._solver.set_initial_value(before, begin)
        longer = end - begin > RESOLUTION * end
        self._move(end, self._solver.integrate(end) if longer else before)
        if not self._solver.successful():
            raise FMUError(
                f"{self.description.file.name} cannot be integrated from {begin:z.6g} to {end:z.6g}"
                f" s{self._said()}"
            )
        self._time = end
        if not self._changed():
            return False
        course: Any = solve_ivp(
            self._slope, (begin, end), before, "LSODA", rtol=TOLERANCE, atol=self._tolerances,
            dense_output=True,
        ).sol  # fmt: skip
        low, high = begin, end
        while high - low > RESOLUTION * max(high, end - begin):
            middle = (low + high) / 2
            self._move(middle, course(middle))
            low, high = (low, middle) if self._changed() else (middle, high)
        self._time = high
        self._move(high, course(high))
        return True

    def _changed(self) -> bool:
        """Return whether an indicator has another sign than after the last event."""
        return bool(self._count) and bool(np.any(self._signs() != self._signs_before))

    def _signs(self) -> Bool[np.ndarray, " indicators"]:
        if self._count:
            self._call("GetEventIndicators", self._indicators, c_size_t(self._count))
        return self._indicator_view > 0

    def _slope(self, time: float, states: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        self._move(time, states)
        if self._size:
            name = "GetDerivatives" if self._two else "GetContinuousStateDerivatives"
            self._call(name, self._slopes, c_size_t(self._size))
        return self._slope_view

    def _move(self, time: float, states: Float[np.ndarray, " n"]) -> None:
        """Take the FMU to a time and its states."""
        self._call("SetTime", c_double(time))
        if self._size:
            self._state_view[:] = states
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


def _shared(count: int) -> tuple[Any, Float[np.ndarray, " n"]]:
    """Return numbers for C, and the same memory as an array.

    It has one number at least: a model without states is integrated as one that stands still.
    """
    numbers: Any = (c_double * max(count, 1))()
    return numbers, np.frombuffer(numbers)
