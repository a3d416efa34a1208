"""The binary of an FMU, called through ctypes: instances of FMI 2 and 3, here for co-simulation.

    instance = Instance(description, folder)            # folder: where the FMU is unpacked
    instance.begin({"m": 2.0}, duration=4.0)
    instance.set({"force": 1.0}); instance.step(0.0, 0.02); instance.get(["x", "v"])

An FMU runs inside this process, so a crash ends the simulation's worker.
"""

import ctypes
from collections.abc import Callable, Mapping
from contextlib import suppress
from ctypes import byref, c_bool, c_char_p, c_double, c_int, c_size_t, c_uint32, c_void_p
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from verifai_jax.addons.simulators.fmu.description import Description, Variable

OK, WARNING, DISCARD = 0, 1, 2
"""Statuses of FMI after which a simulation may go on, and the one of a step that was cut short."""
C_TYPES: dict[str, Any] = {
    "Real": c_double, "Integer": c_int, "Boolean": c_int, "Float64": c_double,
    "Float32": ctypes.c_float, "Int8": ctypes.c_int8, "Int16": ctypes.c_int16,
    "Int32": ctypes.c_int32, "Int64": ctypes.c_int64, "UInt8": ctypes.c_uint8,
    "UInt16": ctypes.c_uint16, "UInt32": ctypes.c_uint32, "UInt64": ctypes.c_uint64,
}  # fmt: skip
"""C types of the values; Boolean is one byte in FMI 3."""
MESSAGES = 5
"""Last messages of an FMU that an error repeats."""
Logger2 = ctypes.CFUNCTYPE(None, c_void_p, c_char_p, c_int, c_char_p, c_char_p)
Logger3 = ctypes.CFUNCTYPE(None, c_void_p, c_int, c_char_p, c_char_p)


class _Callbacks(ctypes.Structure):
    """The functions that an FMU of FMI 2 is given."""

    _fields_ = (
        ("logger", Logger2), ("allocate", c_void_p), ("free", c_void_p),
        ("finished", c_void_p), ("environment", c_void_p),
    )  # fmt: skip


class _Group(NamedTuple):
    """Variables of one type by their indices, memory for their values, and calls that use it."""

    variables: Mapping[int, Variable]
    buffer: Any
    get: Callable[[], int]
    set: Callable[[], int]


class FMUError(RuntimeError):
    """An error returned by a function of an FMU, with the FMU's message."""


class Instance:
    """An instance of an FMU unpacked in `folder`; `begin` may be called again afterwards."""

    def __init__(self, description: Description, folder: Path) -> None:
        self.description, self.messages = description, []
        self._groups: dict[tuple[str, ...], list[_Group]] = {}
        self._two, three = description.version == 2, description.version == 3
        self._prefix = f"fmi{description.version}"
        try:
            self._library = ctypes.CDLL(str(folder / description.binary))
        except OSError as error:
            raise FMUError(f"{description.file.name} cannot be loaded: {error}") from error
        # Kept, since the FMU calls them as long as it lives.
        self._logger: Any = (Logger3 if three else Logger2)(self._log3 if three else self._log2)
        resources = folder / "resources"
        token, name = description.token.encode(), description.name.encode()
        if three:
            kind = "ModelExchange" if description.exchange else "CoSimulation"
            path = f"{resources}/".encode()
            # Co-simulation without event mode, early returns, and news from within a step.
            none = (c_bool(), c_bool(), c_void_p(), c_size_t(0)), (c_void_p(),)
            before, after = ((), ()) if description.exchange else none
            made = self._function(f"Instantiate{kind}", c_void_p)(
                c_char_p(name), c_char_p(token), c_char_p(path), c_bool(False), c_bool(False),
                *before, c_void_p(), self._logger, *after,
            )  # fmt: skip
        else:
            own = ctypes.CDLL(None)
            pointers = (ctypes.cast(f, c_void_p) for f in (own.calloc, own.free))
            self._callbacks = _Callbacks(self._logger, *pointers, None, None)
            made = self._function("Instantiate", c_void_p)(
                c_char_p(name), c_int(not description.exchange), c_char_p(token),
                c_char_p(resources.as_uri().encode()), byref(self._callbacks), c_int(0), c_int(0),
            )  # fmt: skip
        if not made:
            raise FMUError(f"{description.file.name} made no instance{self._said()}")
        self._component = c_void_p(made)
        # Arguments of a step in C's types, made once: FMI 3 answers by flags and a time.
        self._clock, self._span, last = c_double(), c_double(), c_double()
        self._flags: Any = (c_bool * 3)()
        answers = () if self._two else (*(byref(self._flags, i) for i in range(3)), byref(last))
        more = (c_int if self._two else c_bool)(1), *answers
        self._do_step = self._prepared("DoStep", self._clock, self._span, *more)
        self._begun, self.failed, self.new_state = False, False, c_void_p()
        if description.keeps_states:
            with suppress(FMUError):
                self._call(f"GetFMU{self._state}", byref(self.new_state))

    def begin(self, values: Mapping[str, object], duration: float) -> None:
        """Set start values and initialise, starting from the state of a new instance."""
        if self._begun:
            self._renew()
        self._begun, self.failed = True, False
        flag = c_int if self._two else c_bool
        times = flag(0), c_double(0.0), c_double(0.0), flag(1), c_double(duration)
        if self._two:
            self._call("SetupExperiment", *times)
        self.set(values)
        self._call("EnterInitializationMode", *(() if self._two else times))
        self._call("ExitInitializationMode")

    def step(self, time: float, size: float) -> bool:
        """Simulate one step; False if the FMU ended its simulation."""
        self._clock.value, self._span.value = time, size
        return self._do_step() != DISCARD and not self._flags[1]

    def set(self, values: Mapping[str, object]) -> None:
        """Set variables by name; refuse numbers beyond their types."""
        given = list(values.values())
        for group in self._grouped(tuple(values)):
            for i, (index, variable) in enumerate(group.variables.items()):
                number = variable.number(given[index])
                group.buffer[i] = number if variable.real else int(number)
                if not variable.real and group.buffer[i] != number:
                    raise ValueError(f"{variable.name} is of type {variable.type}; got {number:zg}")
            group.set()

    def get(self, names: tuple[str, ...]) -> list[float]:
        """Return the values of variables by name."""
        found = [0.0] * len(names)
        for group in self._grouped(names):
            group.get()
            for index, value in zip(group.variables, group.buffer, strict=True):
                found[index] = float(value)
        return found

    def free(self) -> None:
        """Free the instance; it cannot be used afterwards."""
        if self._component:
            self._function("FreeInstance", None)(self._component)
        self._component = c_void_p()

    def _renew(self) -> None:
        """Go back to the state of a new instance: the saved one, or where that fails by a reset.

        A reset may forget something, as that the FMU ended its simulation; a saved state does not.
        """
        if self.new_state:
            try:
                self._call(f"SetFMU{self._state}", self.new_state)
                return
            except FMUError:
                self.new_state = c_void_p()
        if not self.failed:
            self._call("Terminate")
        self._call("Reset")

    @property
    def _state(self) -> str:
        return "state" if self._two else "State"

    def _grouped(self, names: tuple[str, ...]) -> list[_Group]:
        """Return variables by type, with memory for their values."""
        if names not in self._groups:
            by_type: dict[str, dict[int, Variable]] = {}
            for index, variable in enumerate(map(self.description.variable, names)):
                by_type.setdefault(variable.type, {})[index] = variable
            self._groups[names] = [self._group(kind, those) for kind, those in by_type.items()]
        return self._groups[names]

    def _group(self, kind: str, variables: Mapping[int, Variable]) -> _Group:
        references = (c_uint32 * len(variables))(*(v.reference for v in variables.values()))
        c_type = c_bool if kind == "Boolean" and not self._two else C_TYPES[kind]
        buffer, count = (c_type * len(variables))(), c_size_t(len(variables))
        arguments = (references, count, buffer, *(() if self._two else (count,)))
        get, set_ = (self._prepared(f"{verb}{kind}", *arguments) for verb in ("Get", "Set"))
        return _Group(variables, buffer, get, set_)

    def _call(self, name: str, *arguments: Any) -> int:
        """Call a function of the instance, once."""
        return self._prepared(name, *arguments)()

    def _prepared(self, name: str, *arguments: Any) -> Callable[[], int]:
        """Return a call of a function of the instance, which reads its arguments each time."""
        function: Any = None
        passes = DISCARD if name == "DoStep" else WARNING

        def call() -> int:
            nonlocal function
            if function is None:
                function = partial(self._function(name, c_int), self._component, *arguments)
            status = function()
            if status > passes:
                what = f"{self._prefix}{name} of {self.description.file.name}"
                raise FMUError(f"{what} failed with status {status}{self._said()}")
            return status

        return call

    def _function(self, name: str, returns: Any) -> Any:
        function = getattr(self._library, f"{self._prefix}{name}", None)
        if function is None:
            file = self.description.file.name
            raise FMUError(f"the binary of {file} has no {self._prefix}{name}")
        function.restype = returns
        return function

    def _said(self) -> str:
        return f": {'; '.join(self.messages[-MESSAGES:])}" if self.messages else ""

    def _log2(self, _: Any, name: Any, status: int, category: Any, message: bytes | None) -> None:
        self._log3(_, status, category, message)

    def _log3(self, _: Any, status: int, category: Any, message: bytes | None) -> None:
        if status > OK and message:
            self.messages.append(message.decode(errors="replace").strip())
