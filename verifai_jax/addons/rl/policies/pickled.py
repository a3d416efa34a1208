"""Pickled data as plain values: classes are names, calls are records, and nothing is executed.

    data = read_pickle(bytes)
    data["obs_rms"].state["mean"]

Checkpoints of PyTorch and files of Stable-Baselines3 hold pickles, whose format is a program that
may call any function. This reader follows the program and records the calls without making them.
Source: Python's `pickletools`, which names and describes the operations.
"""

import pickletools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from verifai_jax.addons.rl.policies.errors import MAX_VALUES, PolicyError, refused
from verifai_jax.core.store.foreign_files import check_shared


@dataclass(frozen=True)
class Name:
    """The name of a class or function in a pickle."""

    module: str
    name: str

    def __post_init__(self) -> None:
        if not (isinstance(self.module, str) and isinstance(self.name, str)):
            raise ValueError("the name of a class is not a text")


@dataclass(eq=False)
class Record:
    """An object that a pickle would make by a call, then give this state, if any, and items."""

    function: Any
    arguments: Any
    state: Any = None
    items: dict[Any, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Persistent:
    """A reference to data stored outside the pickle."""

    reference: Any


_MARK = object()


class _Stack(list[Any]):
    """The stack of a pickle's program, with its numbered memory."""

    def __init__(self) -> None:
        super().__init__()
        self.memo: dict[int, Any] = {}

    def take(self, count: int) -> list[Any]:
        """Take the last values."""
        taken = self[-count:]
        del self[-count:]
        return taken

    def since_mark(self) -> list[Any]:
        """Take all that was pushed since the last mark, and the mark."""
        count = 1
        while self[-count] is not _MARK:
            count += 1
        return self.take(count)[1:]

    def remember(self, number: int) -> None:
        self.memo[number] = self[-1]

    def call(self, function: Any, arguments: Any) -> None:
        # Old protocols write bytes as a call.
        is_bytes = function == Name("_codecs", "encode")
        self.append(arguments[0].encode("latin1") if is_bytes else Record(function, arguments))

    def build(self) -> None:
        state = self.pop()
        if isinstance(self[-1], Record):
            self[-1].state = state

    def add(self, values: list[Any]) -> None:
        """Append values to the list or record on top; no method of an object is called."""
        if isinstance(self[-1], list):
            self[-1].extend(values)

    def set(self, taken: list[Any]) -> None:
        """Set items of the dictionary or object on top, keys and values in turn."""
        items = self[-1].items if isinstance(self[-1], Record) else self[-1]
        items.update(_pairs(taken))


def _pairs(taken: list[Any]) -> Iterable[tuple[Any, Any]]:
    if not all(isinstance(key, str | bytes | float | int | Name | None) for key in taken[::2]):
        raise ValueError("a key of a dictionary is neither a text nor a number")
    return zip(taken[::2], taken[1::2], strict=True)


def _parts(value: Any) -> list[Any]:
    """Return the values that are directly below one."""
    if isinstance(value, Record):
        return [value.function, value.arguments, value.state, value.items]
    if isinstance(value, Persistent):
        return [value.reference]
    inner = [*value.values()] if isinstance(value, dict) else value
    return [*inner] if isinstance(inner, list | tuple) else []


def _named(function: Any, arguments: Any, named: Any) -> Record:
    return Record(function, (*arguments, named))


_OPERATIONS: dict[str, Callable[[_Stack, Any], object]] = {
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), lambda s, a: None),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda s, a: s.append(s.memo[int(a)])),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), lambda s, a: s.remember(int(a))),
    **dict.fromkeys(("EMPTY_LIST", "EMPTY_SET"), lambda s, a: s.append([])),
    **dict.fromkeys(("LIST", "FROZENSET"), lambda s, a: s.append(s.since_mark())),
    **dict.fromkeys(("APPENDS", "ADDITEMS"), lambda s, a: s.add(s.since_mark())),
    **dict.fromkeys(("REDUCE", "NEWOBJ"), lambda s, a: s.call(*s.take(2))),
    "MEMOIZE": lambda s, a: s.remember(len(s.memo)), "MARK": lambda s, a: s.append(_MARK),
    "POP": lambda s, a: s.pop(), "NONE": lambda s, a: s.append(None),
    "NEWTRUE": lambda s, a: s.append(True), "NEWFALSE": lambda s, a: s.append(False),
    "EMPTY_DICT": lambda s, a: s.append({}), "EMPTY_TUPLE": lambda s, a: s.append(()),
    **{f"TUPLE{n}": lambda s, a, n=n: s.append(tuple(s.take(n))) for n in (1, 2, 3)},
    "TUPLE": lambda s, a: s.append(tuple(s.since_mark())),
    "DICT": lambda s, a: s.append(dict(_pairs(s.since_mark()))),
    "APPEND": lambda s, a: s.add(s.take(1)), "SETITEM": lambda s, a: s.set(s.take(2)),
    "SETITEMS": lambda s, a: s.set(s.since_mark()),
    "GLOBAL": lambda s, a: s.append(Name(*a.split(" ", 1))),
    "STACK_GLOBAL": lambda s, a: s.append(Name(*s.take(2))),
    "NEWOBJ_EX": lambda s, a: s.append(_named(*s.take(3))), "BUILD": lambda s, a: s.build(),
    "BINPERSID": lambda s, a: s.append(Persistent(s.pop())),
}  # fmt: skip
"""The action of each operation on the stack; an operation not listed pushes its argument."""


def read_pickle(data: bytes, what: str) -> Any:
    """Return the content of a pickle, without calling anything.

    **Arguments:**
    - `what`: the origin of the bytes, for errors.
    **Returns:** numbers, texts, bytes, tuples, lists and dictionaries as such; a `Name` for a class
    or function, a `Record` for an object, a `Persistent` for data outside.
    **Raises:** `PolicyError` for bytes that are not a pickle.
    """
    stack = _Stack()
    with refused(f"{what} is damaged: it holds no pickled data"):
        for operation, argument, _ in pickletools.genops(data):
            known = _OPERATIONS.get(operation.name)
            if known is not None:
                known(stack, argument)
            elif argument is not None:
                stack.append(argument)  # A number, a text or bytes.
            else:
                raise ValueError(f"the operation {operation.name} is not supported")
        (result,) = stack
        # Whoever walks or shows it meets a shared value as often as it is referred to.
        check_shared(result, _parts, MAX_VALUES, f"{what} refers to", cycles=True)
        return result


def array_of(record: object) -> np.ndarray | None:
    """Return the array described by a NumPy record; None for anything else.

    Arrays are pickled as `_reconstruct` with a state `(version, shape, dtype, fortran, bytes)`,
    scalars as `scalar(dtype, bytes)`.
    """
    if not isinstance(record, Record) or not isinstance(record.function, Name):
        return None
    if record.function.name == "scalar" and len(record.arguments) == 2:
        return _array(record.arguments[1], record.arguments[0])[0]
    if record.function.name == "_frombuffer":
        data, dtype, shape, order = record.arguments
        return _array(data, dtype).reshape(shape, order=order)
    if record.function.name != "_reconstruct" or not isinstance(record.state, tuple):
        return None
    _, shape, dtype, fortran, data = record.state
    return _array(data, dtype).reshape(shape, order="F" if fortran else "C")


def _array(data: object, dtype: object) -> np.ndarray:
    if not isinstance(data, bytes | bytearray):
        raise PolicyError("an array of the pickled data has no bytes")
    return np.frombuffer(bytes(data), _dtype(dtype))


def _dtype(record: object) -> np.dtype[Any]:
    if not isinstance(record, Record) or not isinstance(record.arguments, tuple):
        raise PolicyError("an array of the pickled data has no dtype")
    dtype = np.dtype(str(record.arguments[0]))
    if dtype.kind not in "fiub":
        raise PolicyError(f"an array of the pickled data holds no numbers but {dtype}")
    order = record.state[1] if isinstance(record.state, tuple) else "="
    return dtype if order in ("|", "=") else dtype.newbyteorder(order)
