"""What code of the user keeps between its calls: attributes, variables of closures, globals.

    before = state_of(controller)
    controller(observation)
    changed(before, state_of(controller))               # ["attribute 'integral' of PID"]

Only functions and objects of the user's own files are looked into, and what holds them.
"""

import functools
import hashlib
import itertools
import random
import sys
import types
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from verifai_jax.core.user_code.source_objects import is_user_file

MAX_ITEMS = 1000
"""Items of a container that are compared."""
MAX_DEPTH = 12
"""Objects within objects that are looked into."""
State = dict[str, list[object]]
"""Values that can be compared, by what holds them."""
CHANCE = "the random numbers of Python or NumPy"
_is_user_file = functools.cache(is_user_file)


def changed(before: State, after: State) -> list[str]:
    """Return the names of what differs between two states."""
    return [name for name in after if before.get(name) != after[name]]


def holds_tracer(state: State, name: str) -> bool:
    """Return whether something holds a value that JAX has traced."""
    return _Traced in state[name]


class _Traced:
    """The mark of a value that JAX has traced."""


def state_of(*roots: object) -> State:
    """Return what can change of functions and objects, and of Python's and NumPy's chance."""
    reader = _Reader()
    for root in roots:
        reader.read(root, "the function", 0)
    reader.add(CHANCE, hash(random.getstate()), _text(np.random.get_state()))  # noqa: NPY002
    return reader.state


def _text(value: object) -> str:
    if isinstance(value, np.ndarray):
        data = value.tobytes() if value.dtype != object else repr(value).encode()
        return hashlib.sha256(data).hexdigest()
    if isinstance(value, tuple | list):
        return str([_text(each) for each in value])
    return str({k: _text(v) for k, v in value.items()}) if isinstance(value, dict) else repr(value)


class _Reader:
    def __init__(self) -> None:
        self.state: State = {}
        self._known: dict[int, object] = {}  # Objects, so that their identities stay theirs.

    def add(self, name: str, *values: object) -> None:
        self.state.setdefault(name, []).extend(values)

    def read(self, value: Any, name: str, depth: int) -> None:
        """Read a value that something of this name holds."""
        if value is None or isinstance(value, bool | int | float | complex | str | bytes):
            self.add(name, repr(value))
        elif isinstance(value, jax.core.Tracer):
            self.add(name, _Traced)
        elif isinstance(value, jax.Array | types.ModuleType):
            self.add(name, id(value))
        elif isinstance(value, np.ndarray | np.generic):
            small = value.size <= 100 * MAX_ITEMS
            self.add(name, str(value.dtype), value.shape, _text(np.asarray(value)) if small else 0)
        elif isinstance(value, itertools.count | itertools.repeat):
            self.add(name, repr(value))
        elif isinstance(value, np.random.Generator):
            self.add(name, _text(value.bit_generator.state))
        elif isinstance(value, np.random.RandomState):
            self.add(name, _text(value.get_state()))
        elif isinstance(value, random.Random):
            self.add(name, hash(value.getstate()))
        elif hasattr(type(value), "_version"):
            self.add(name, id(value), value._version)  # A tensor of PyTorch.
        elif id(value) not in self._known and depth < MAX_DEPTH:
            self._known[id(value)] = value
            for inner, label in self._parts(value, name):
                self.read(inner, label, depth + 1)

    def _parts(self, value: Any, name: str) -> Iterator[tuple[Any, str]]:
        """Yield what a value holds, each with the name of what holds it."""
        if isinstance(value, list | tuple | deque | set | frozenset | Mapping):
            self.add(name, len(value))
            inside = list(value.items() if isinstance(value, Mapping) else value)
            # What is appended to a long one is at its end.
            yield from ((item, name) for item in inside[:MAX_ITEMS] + inside[-1:])
        elif isinstance(value, types.GeneratorType):
            self.add(name, None if value.gi_frame is None else value.gi_frame.f_lasti)
            held = {} if value.gi_frame is None else value.gi_frame.f_locals
            yield from ((v, f"variable {n!r} of {value.__name__}") for n, v in held.items())
        elif isinstance(value, types.FunctionType):
            yield from self._of_function(value)
        elif isinstance(value, types.MethodType):
            yield from ((value.__self__, name), (value.__func__, name))
        elif isinstance(value, functools.partial):
            yield from ((each, name) for each in (value.func, value.args, value.keywords))
        elif isinstance(value, staticmethod | classmethod | property | functools.cached_property):
            yield getattr(value, "__func__", getattr(value, "fget", None)), name
        elif (kind := value if isinstance(value, type) else type(value)) and _is_watched(kind):
            yield from self._of_object(value, kind)
        elif callable(inner := getattr(value, "__wrapped__", None)):
            yield inner, name

    def _of_function(self, function: types.FunctionType) -> Iterator[tuple[Any, str]]:
        code = function.__code__
        if not (_is_user_file(code.co_filename) or function.__module__.startswith("verifai_jax")):
            if inner := getattr(function, "__wrapped__", None):
                yield inner, function.__name__
            return
        where = f"of {function.__qualname__.replace('<locals>.', '')}"
        for variable, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
            with_value = getattr(cell, "cell_contents", None) if _filled(cell) else None
            yield with_value, f"variable {variable!r} {where}"
        for default in (function.__defaults__, function.__kwdefaults__):
            yield default, f"a default argument {where}"
        yield vars(function), f"an attribute {where}"
        names = set(_names(code)) if _is_user_file(code.co_filename) else set()
        spaces = [function.__globals__]
        spaces += [vars(m) for n in names if _is_users_module(m := function.__globals__.get(n))]
        for space in spaces:
            yield from ((space[n], f"global variable {n!r}") for n in sorted(names & space.keys()))

    def _of_object(self, value: Any, kind: type) -> Iterator[tuple[Any, str]]:
        slots = [n for c in kind.__mro__ for n in getattr(c, "__slots__", ()) if hasattr(value, n)]
        held = {n: getattr(value, n) for n in slots} | dict(getattr(value, "__dict__", {}))
        for attribute, inner in held.items():
            yield inner, f"attribute {attribute!r} of {kind.__name__}"
        if kind is not value:
            yield from ((c, kind.__name__) for c in kind.__mro__ if _is_users(c))


def _filled(cell: Any) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:
        return False


def _names(code: types.CodeType) -> Iterator[str]:
    """Yield the names that a function and the functions within it look up."""
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            yield from _names(inner)


def _is_users_module(module: object) -> bool:
    file = getattr(module, "__file__", None)
    if not isinstance(module, types.ModuleType):
        return False
    return module.__name__ == "__main__" or (file is not None and _is_user_file(file))


def _is_users(kind: type) -> bool:
    return _is_users_module(sys.modules.get(kind.__module__))


def _is_watched(kind: type) -> bool:
    """Return whether the objects of a class are looked into: the user's, and what holds them."""
    return any(map(_is_users, kind.__mro__)) or (
        kind.__module__.startswith("verifai_jax") and hasattr(kind, "__dataclass_fields__")
    )
