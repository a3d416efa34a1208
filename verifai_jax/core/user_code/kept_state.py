"""The state that a user's code keeps between its calls: attributes, variables, globals.

    before = state_of(controller)
    controller(observation)
    changed(before, state_of(controller))               # ["attribute 'integral' of PID"]

Only functions and objects of the user's own files are looked into, and what holds them.
"""

import contextlib
import functools
import hashlib
import itertools
import random
import sys
import types
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.core
import numpy as np

from verifai_jax.core.user_code.source_collection import closure_of, names_in
from verifai_jax.core.user_code.user_files import is_user_file

MAX_ITEMS = 1000
"""Items of a container that are compared."""
MAX_DEPTH = 12
"""Objects within objects that are looked into."""
State = dict[str, list[object]]
"""Values that can be compared, by what holds them."""
CHANCE = "the random numbers of Python or NumPy"
_CONTAINERS = (list, tuple, deque, set, frozenset, Mapping)


def changed(before: State, after: State) -> list[str]:
    """Return the names of what differs between two states."""
    return [name for name in after if before.get(name) != after[name]]


def holds_tracer(state: State, name: str) -> bool:
    """Return whether something holds a value that JAX has traced."""
    return any(isinstance(each, _Traced) for each in state[name])


@dataclass(frozen=True, eq=False)
class _Traced:
    """A value that JAX has traced, equal to itself alone."""

    value: object

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Traced) and other.value is self.value


def state_of(root: object) -> State:
    """Return what can change of a function or object, and of Python's and NumPy's chance."""
    state: State = {CHANCE: [hash(random.getstate()), _text(np.random.get_state())]}  # noqa: NPY002
    # Objects are kept, so that their identities stay theirs.
    known: dict[int, object] = {}
    left: list[tuple[Any, str, int]] = [(root, "the function", 0)]
    while left:
        value, name, depth = left.pop()
        held = state.setdefault(name, [])
        if (text := _content(value)) is not None:
            held.append(text)
        elif id(value) not in known and depth < MAX_DEPTH:
            known[id(value)] = value
            # An object that cannot be looked into keeps nothing that is known.
            with contextlib.suppress(Exception):
                held.append(len(value) if isinstance(value, _CONTAINERS) else 0)
                left += [(inner, label, depth + 1) for inner, label in _parts(value, name)]
    return state


def _text(value: object) -> str:
    """Return a text of a value that differs where its numbers differ."""
    if isinstance(value, np.ndarray):
        data = repr(value).encode() if value.dtype == object else value.tobytes()
        return f"{value.dtype}{value.shape}{hashlib.sha256(data).hexdigest()}"
    if isinstance(value, tuple):
        return str([_text(each) for each in value])
    return str({k: _text(v) for k, v in value.items()}) if isinstance(value, dict) else repr(value)


def _content(value: Any) -> object:
    """Return what a value that holds no other can be compared by; None for one that may."""
    if isinstance(value, jax.core.Tracer):
        return _Traced(value)
    if isinstance(value, jax.Array | types.ModuleType):
        return id(value)
    if isinstance(value, np.random.Generator):
        return _text(value.bit_generator.state)
    if isinstance(value, np.random.RandomState | random.Random):
        state = value.get_state() if isinstance(value, np.random.RandomState) else value.getstate()
        return hash(_text(state))
    if isinstance(value, np.ndarray) and value.size > 100 * MAX_ITEMS:
        return id(value)
    if hasattr(type(value), "_version"):
        return id(value), getattr(value, "_version")  # noqa: B009 - a tensor of PyTorch.
    plain = (bool, int, float, complex, str, bytes, type(None), np.ndarray, np.generic)
    return _text(value) if isinstance(value, (*plain, itertools.count)) else None


def _parts(value: Any, name: str) -> Iterator[tuple[Any, str]]:
    """Yield what a value holds, each with the name of what holds it."""
    kind = value if isinstance(value, type) else type(value)
    if isinstance(value, _CONTAINERS):
        inside = list(value.items() if isinstance(value, Mapping) else value)
        # What is appended to a long one is at its end.
        yield from ((item, name) for item in inside[:MAX_ITEMS] + inside[-1:])
    elif isinstance(value, types.GeneratorType):
        frame = value.gi_frame
        held = {} if frame is None else {**frame.f_locals, "its place": frame.f_lasti}
        yield from ((v, f"variable {n!r} of {value.__name__}") for n, v in held.items())
    elif isinstance(value, types.MethodType):
        yield from ((value.__self__, name), (value.__func__, name))
    elif isinstance(value, functools.partial):
        yield from ((each, name) for each in (value.func, value.args, value.keywords))
    elif isinstance(value, types.FunctionType) and _is_looked_into(value):
        yield from _parts_of_function(value)
    elif any(map(_is_users, kind.__mro__)) or _is_looked_into(kind):
        slots = [n for c in kind.__mro__ for n in getattr(c, "__slots__", ()) if hasattr(value, n)]
        held = {**{n: getattr(value, n) for n in slots}, **getattr(value, "__dict__", {})}
        yield from ((v, f"attribute {n!r} of {kind.__name__}") for n, v in held.items())
        if kind is not value:
            yield from ((each, name) for each in kind.__mro__ if _is_users(each))
    else:
        inner = (getattr(value, n, None) for n in ("__wrapped__", "__func__", "fget", "func"))
        yield from ((each, name) for each in inner if isinstance(each, types.FunctionType))


def _parts_of_function(function: types.FunctionType) -> Iterator[tuple[Any, str]]:
    code, own = function.__code__, function.__name__
    yield from ((v, f"variable {n!r} of {own}") for n, v in closure_of(function).items())
    arguments = code.co_varnames[: code.co_argcount]
    defaults = dict(zip(arguments[::-1], (function.__defaults__ or ())[::-1], strict=False))
    for argument, default in {**defaults, **(function.__kwdefaults__ or {})}.items():
        yield default, f"the default argument {argument!r} of {own}"
    yield from ((v, f"attribute {n!r} of {own}") for n, v in vars(function).items())
    names = names_in(code) if is_user_file(code.co_filename) else set()
    spaces = [function.__globals__]
    spaces += [vars(m) for n in names if _is_users_module(m := function.__globals__.get(n))]
    for space in spaces:
        yield from ((space[n], f"global variable {n!r}") for n in sorted(names & space.keys()))


def _is_users_module(module: object) -> bool:
    if not isinstance(module, types.ModuleType):
        return False
    file = getattr(module, "__file__", None)
    return module.__name__ == "__main__" or (file is not None and is_user_file(file))


def _is_users(kind: type) -> bool:
    return _is_users_module(sys.modules.get(kind.__module__))


def _is_looked_into(value: Any) -> bool:
    """Return whether a function is the user's, or a function or class of ours may hold one."""
    ours = str(value.__module__).startswith("verifai_jax")
    if isinstance(value, types.FunctionType):
        return ours or is_user_file(value.__code__.co_filename)
    return ours and hasattr(value, "__dataclass_fields__")
