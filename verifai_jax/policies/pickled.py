"""Pickled data as plain values: classes are names, calls are records, and nothing is executed.

    data = read_pickle(bytes)
    data["obs_rms"].state["mean"]

Checkpoints of PyTorch and files of Stable-Baselines3 hold pickles, whose format is a program that
may call any function. This reader follows the program and writes down what it would call.
Source: Python's `pickletools`, which names and describes the operations.
"""

import pickletools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from verifai_jax.policies.errors import PolicyError


@dataclass(frozen=True)
class Name:
    """A class or function that a pickle names."""

    module: str
    name: str


@dataclass(eq=False)
class Record:
    """An object that a pickle would make by a call.

    - `function`: what would be called.
    - `arguments`: of the call.
    - `state`: what would be set on the object afterwards, or None.
    - `items`: what would be put into it, as for a dictionary.
    """

    function: Any
    arguments: Any
    state: Any = None
    items: dict[Any, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Persistent:
    """A reference to data that is kept outside of the pickle."""

    reference: Any


_MARK = object()
_CONSTANTS = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_DICT": dict,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
    "EMPTY_SET": list,
}
_IGNORED = {"PROTO", "FRAME", "STOP"}
_GETS = {"GET", "BINGET", "LONG_BINGET"}
_PUTS = {"PUT", "BINPUT", "LONG_BINPUT"}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def read_pickle(data: bytes, what: str) -> Any:
    """Return what a pickle describes, without calling anything.

    **Arguments:**

    - `data`: the bytes.
    - `what`: where they are from, for errors.

    **Returns:** numbers, texts, bytes, tuples, lists and dictionaries as they are; a `Name` for a
    class or function, a `Record` for an object, a `Persistent` for data outside.

    **Raises:** `PolicyError` for bytes that are no pickle.
    """
    try:
        return _Reader().run(data)
    except PolicyError:
        raise
    except Exception as error:
        raise PolicyError(f"{what} is damaged: it holds no pickled data ({error})") from error


class _Reader:
    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self, data: bytes) -> Any:
        for operation, argument, _ in pickletools.genops(data):
            self.step(operation.name, argument)
        (result,) = self.stack
        return result

    def since_mark(self) -> list[Any]:
        """Take all that was pushed since the last mark."""
        start = len(self.stack) - 1
        while self.stack[start] is not _MARK:
            start -= 1
        taken = self.stack[start + 1 :]
        del self.stack[start:]
        return taken

    def step(self, name: str, argument: Any) -> None:
        stack, pop = self.stack, self.stack.pop
        if name in _IGNORED:
            return
        if name in _CONSTANTS:
            stack.append(_CONSTANTS[name]())
        elif name in _GETS:
            stack.append(self.memo[int(argument)])
        elif name in _PUTS:
            self.memo[int(argument)] = stack[-1]
        elif name in _TUPLES:
            count = _TUPLES[name]
            taken = tuple(stack[-count:])
            del stack[-count:]
            stack.append(taken)
        elif (method := _METHODS.get(name)) is not None:
            method(self, argument)
        elif name == "MARK":
            stack.append(_MARK)
        elif name == "POP":
            pop()
        elif argument is not None:
            stack.append(argument)  # A number, a text or bytes.
        else:
            raise PolicyError(f"the pickled data has an operation {name}, which is not supported")

    def memoize(self, _: object) -> None:
        self.memo[len(self.memo)] = self.stack[-1]

    def global_name(self, argument: str) -> None:
        module, _, name = argument.partition(" ")
        self.stack.append(Name(module, name))

    def stack_global(self, _: object) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        self.stack.append(Name(module, name))

    def call(self, _: object) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        # Old protocols write bytes as a call.
        is_bytes = function == Name("_codecs", "encode")
        self.stack.append(
            arguments[0].encode("latin1") if is_bytes else Record(function, arguments)
        )

    def call_with_names(self, _: object) -> None:
        named, arguments, function = self.stack.pop(), self.stack.pop(), self.stack.pop()
        self.stack.append(Record(function, (*arguments, named)))

    def build(self, _: object) -> None:
        state = self.stack.pop()
        if isinstance(self.stack[-1], Record):
            self.stack[-1].state = state

    def persistent(self, _: object) -> None:
        self.stack.append(Persistent(self.stack.pop()))

    def tuple_since(self, _: object) -> None:
        self.stack.append(tuple(self.since_mark()))

    def list_since(self, _: object) -> None:
        self.stack.append(self.since_mark())

    def dict_since(self, _: object) -> None:
        taken = self.since_mark()
        self.stack.append(dict(zip(taken[::2], taken[1::2], strict=True)))

    def append(self, _: object) -> None:
        value = self.stack.pop()
        self.extend([value])

    def appends(self, _: object) -> None:
        self.extend(self.since_mark())

    def extend(self, values: list[Any]) -> None:
        if isinstance(self.stack[-1], list):
            self.stack[-1].extend(values)

    def set_item(self, _: object) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self.set_all([key, value])

    def set_items(self, _: object) -> None:
        self.set_all(self.since_mark())

    def set_all(self, taken: list[Any]) -> None:
        target = self.stack[-1]
        items = target.items if isinstance(target, Record) else target
        items.update(zip(taken[::2], taken[1::2], strict=True))


_METHODS: dict[str, Callable[[_Reader, Any], None]] = {
    "MEMOIZE": _Reader.memoize,
    "GLOBAL": _Reader.global_name,
    "STACK_GLOBAL": _Reader.stack_global,
    "REDUCE": _Reader.call,
    "NEWOBJ": _Reader.call,
    "NEWOBJ_EX": _Reader.call_with_names,
    "BUILD": _Reader.build,
    "BINPERSID": _Reader.persistent,
    "TUPLE": _Reader.tuple_since,
    "LIST": _Reader.list_since,
    "FROZENSET": _Reader.list_since,
    "DICT": _Reader.dict_since,
    "APPEND": _Reader.append,
    "APPENDS": _Reader.appends,
    "ADDITEMS": _Reader.appends,
    "SETITEM": _Reader.set_item,
    "SETITEMS": _Reader.set_items,
}


def array_of(record: object) -> np.ndarray | None:
    """Return the array that a record of NumPy's describes; None for anything else.

    Arrays are pickled as `_reconstruct` with a state `(version, shape, dtype, fortran, bytes)`,
    scalars as `scalar(dtype, bytes)`.
    """
    if not isinstance(record, Record) or not isinstance(record.function, Name):
        return None
    if record.function.name == "scalar" and len(record.arguments) == 2:
        dtype, data = record.arguments
        return np.frombuffer(_bytes(data), _dtype(dtype))[0]
    if record.function.name == "_frombuffer":
        data, dtype, shape, order = record.arguments
        return np.frombuffer(_bytes(data), _dtype(dtype)).reshape(shape, order=order)
    if record.function.name != "_reconstruct" or not isinstance(record.state, tuple):
        return None
    _, shape, dtype, fortran, data = record.state
    array = np.frombuffer(_bytes(data), _dtype(dtype))
    return array.reshape(shape, order="F" if fortran else "C")


def _bytes(data: object) -> bytes:
    if not isinstance(data, bytes | bytearray):
        raise PolicyError("an array of the pickled data has no bytes")
    return bytes(data)


def _dtype(record: object) -> np.dtype[Any]:
    if not isinstance(record, Record) or not isinstance(record.arguments, tuple):
        raise PolicyError("an array of the pickled data has no dtype")
    dtype = np.dtype(str(record.arguments[0]))
    if dtype.kind not in "fiub":
        raise PolicyError(f"an array of the pickled data holds no numbers but {dtype}")
    order = record.state[1] if isinstance(record.state, tuple) else "="
    return dtype if order in ("|", "=") else dtype.newbyteorder(order)
