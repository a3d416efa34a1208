"""FMUs for model exchange, which contain equations and events but no solver: both are solved here.

    instance = ExchangeInstance(description, folder)     # begin, set, step and get as of `Instance`

LSODA integrates, with implicit steps if the equations are stiff; samples within its steps are
interpolated. Events occur when an indicator changes its sign (located within the step), at times
that the FMU names, when the FMU requests one, and when an input changes.
"""

from collections.abc import Mapping
from ctypes import Structure, byref, c_bool, c_double, c_int, c_size_t
from typing import Any

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.simulators.fmu.library import FMUError, Instance

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
        ("again", c_int), ("ended", c_int), ("nominals_changed", c_int),
        ("states_changed", c_int), ("next_defined", c_int), ("next", c_double),
    )  # fmt: skip


class ExchangeInstance(Instance):
    """An instance of an FMU for model exchange; arguments and errors are those of `Instance`."""

    _running = _sized = False

    def begin(self, values: Mapping[str, object], duration: float) -> None:
        self._running = False
        super().begin(values, duration)
        self._running, self._ended = True, False
        self._inputs, self._time, self._longest = dict(values), 0.0, duration / MIN_STEPS
        if not self._sized:
            self._prepare(*self._sizes())
        self._solver: Any = self._integrator() if self._size else None
        self._settle()

    def _prepare(self, size: int, count: int) -> None:
        """Make memory for states and indicators, and the calls that use it."""
        self._size, self._watched = size, count
        self._states, self._state_view = _shared(size)
        self._slopes, self._slope_view = _shared(size)
        indicators, self._indicator_view = _shared(count)
        self._values_before = np.zeros(count)
        kind = c_int if self._two else c_bool
        self._asks, self._ends = kind(), kind()
        slopes = "Derivatives" if self._two else "ContinuousStateDerivatives"
        self._set_time = self._prepared("SetTime", self._clock)
        self._set_states = self._prepared("SetContinuousStates", self._states, c_size_t(size))
        self._get_states = self._prepared("GetContinuousStates", self._states, c_size_t(size))
        self._get_slopes = self._prepared(f"Get{slopes}", self._slopes, c_size_t(size))
        self._get_indicators = self._prepared("GetEventIndicators", indicators, c_size_t(count))
        ask = (kind(True), byref(self._asks), byref(self._ends))
        self._complete = self._prepared("CompletedIntegratorStep", *ask)
        self._sized = True

    def set(self, values: Mapping[str, float]) -> None:
        if self._running:
            if all(self._inputs.get(name) == value for name, value in values.items()):
                return
            self._inputs.update(values)
            self._call("EnterEventMode")
        super().set(values)
        if self._running:
            self._settle()

    def step(self, time: float, size: float) -> bool:
        """Integrate up to the next communication time; False if the FMU ended its simulation."""
        end, events = time + size, 0
        for _ in range(MAX_STEPS):
            if self._time >= end or self._ended:
                return not self._ended
            event = self._integrate(min(end, self._next))
            if self.description.asks_after_steps:
                self._complete()
                self._ended = self._ended or bool(self._ends.value)
            if event or self._asks.value or self._time >= self._next:
                events += 1
                if events > MAX_EVENTS:
                    many = f"more than {MAX_EVENTS:,} events in a step of communication"
                    raise self._stopped(f"has {many}")
                self._call("EnterEventMode")
                self._settle()
        raise self._stopped(f"takes more than {MAX_STEPS:,} steps of the integrator")

    def _integrate(self, end: float) -> bool:
        """Take one step of the integrator at most, and return whether an indicator has changed.

        An FMU that need not see each step of the integrator is taken to the last one only.
        """
        begin = self._time
        if self._solver is not None:
            if self._reached <= begin:
                self._advance()
            if self._reached < end and not (self._watched or self.description.asks_after_steps):
                self._time = self._reached
                return False
            end = min(end, self._reached)
        if self._watched:
            self._values_before[:] = self._indicator_view
        self._go(end)
        if self._signs() == self._signs_before:
            return False
        self._find_event(begin, end)
        return True

    def _advance(self) -> None:
        """Take one step of the integrator."""
        solver, begin = self._solver, self._reached
        if self._restarts:
            solver.set_initial_value(self._state_view.copy(), begin)
            self._restarts = False
        solver.integrate(begin + self._longest, step=True)
        self._reached = solver.t
        if not solver.successful():
            raise self._stopped("cannot be integrated further")

    def _go(self, time: float) -> None:
        """Take the FMU to a time that the integrator has reached."""
        solver, self._time = self._solver, time
        if solver is None:
            self._clock.value = time
            self._set_time()
        else:
            self._move(time, solver.y if time == solver.t else solver.integrate(time))

    def _find_event(self, low: float, high: float) -> None:
        """Go to the first change of sign between two times, by the Illinois method.

        Of two ends of which one stays, its value counts half as much, or less (Dowell and Jarratt,
        A modified regula falsi method for computing the root of an equation, 1971).
        """
        before, after = self._values_before, self._indicator_view.copy()
        narrow, moved, weight, rounds = RESOLUTION * max(high, high - low), 0, 1.0, 0
        while (width := high - low) > narrow:
            rounds += 1
            changed = (before > 0) != (after > 0)
            gaps = np.abs(before[changed]), weight * np.abs(after[changed])
            share = 0.5 if rounds % 4 == 0 else float(np.min(gaps[0] / (gaps[0] + gaps[1])))
            # So far from both ends that they close in on a change next to one of them.
            edge = min(0.5, narrow / (2 * width))
            self._go(low + min(max(share, edge), 1 - edge) * width)
            side = 1 if self._signs() != self._signs_before else -1
            weight, moved = (weight * 2.0**side if side == moved else 1.0), side
            if side > 0:
                high, after = self._time, self._indicator_view.copy()
            else:
                low, before = self._time, self._indicator_view.copy()
        if moved < 0:
            self._go(high)

    def _signs(self) -> bytes:
        """Return which indicators are positive."""
        if not self._watched:
            return b""
        self._get_indicators()
        return (self._indicator_view > 0).tobytes()

    def _slope(self, time: float, states: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        self._move(time, states)
        self._get_slopes()
        return self._slope_view

    def _move(self, time: float, states: Float[np.ndarray, " n"]) -> None:
        """Take the FMU to a time and its states."""
        self._clock.value = time
        self._set_time()
        self._state_view[:] = states
        self._set_states()

    def _integrator(self) -> Any:
        """Make the integrator of this simulation."""
        from scipy.integrate import ode

        nominals, nominal = _shared(self._size)
        self._call("GetNominalsOfContinuousStates", nominals, c_size_t(self._size))
        tolerances = TOLERANCE * np.where(nominal == 0, 1.0, np.abs(nominal))
        limits = {"rtol": TOLERANCE, "atol": tolerances, "max_step": self._longest}
        solver: Any = ode(self._slope).set_integrator("lsoda", **limits)
        # LSODA can take one step at a time, as SciPy's own class of that name makes it do.
        solver._integrator.supports_step = True
        return solver

    def _settle(self) -> None:
        """Let the FMU go through an event, and go on in continuous time."""
        for _ in range(MAX_EVENTS):
            if not self._event() or self._ended:
                break
        else:
            raise self._stopped(f"has more than {MAX_EVENTS:,} rounds of one event")
        self._call("EnterContinuousTimeMode")
        if self._size:
            self._get_states()
        self._signs_before, self._reached, self._restarts = self._signs(), self._time, True

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
        states, indicators = c_size_t(), c_size_t()
        self._call("GetNumberOfContinuousStates", byref(states))
        self._call("GetNumberOfEventIndicators", byref(indicators))
        return states.value, indicators.value

    def _stopped(self, why: str) -> FMUError:
        return FMUError(f"{self.description.file.name} {why} at {self._time:z.6g} s{self._said()}")


def _shared(count: int) -> tuple[Any, Float[np.ndarray, " n"]]:
    """Return numbers for C, and the same memory as an array."""
    numbers: Any = (c_double * max(count, 1))()
    return numbers, np.frombuffer(numbers)[:count]
