"""The functions, classes and files that define an object, found by walking through it.

    for part in parts_of(problem):                      # Module, Function or OwnFiles
        ...

A function of a user's file represents its module. A function without a file, from a notebook or an
interpreter, represents itself: its text, and the plain values that it uses from its surroundings.
`is_user_file` distinguishes a user's own files from those of Python and of packages. This file
imports neither JAX nor other parts of this package, so it can be used at any time.
"""

import functools
import hashlib
import inspect
import os
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple, TypeAlias

MAX_OBJECTS = 4000
"""Objects that are looked at, at most."""
MAX_ENTRIES = 200
"""Entries of a container that are looked at, at most."""
FENCE = "VERIFAI_JAX_FENCE"
"""Variable of the environment with the only folder whose files may be run; unset, all may."""
_OPAQUE = ("numpy", "jax", "jaxlib", "mujoco", "pandas", "scipy", "torch", "builtins")
"""Packages whose objects hold no functions of a user."""
_COMPILED = ("programs", "_problems")
"""Attributes with values derived from an object, which are not its parts."""
_PLAIN = (bool, int, float, complex, str, bytes, type(None))


class Module(NamedTuple):
    """A user's module: its path, and an object that represents it until it is imported again."""

    file: str
    owner: object


class Function(NamedTuple):
    """A function without a file: its name, its claimed origin, and a hash of its text."""

    name: str
    file: str
    sha256: str


class OwnFiles(NamedTuple):
    """The files from which an object says it was read, with their hashes at that time."""

    files: Mapping[str, str]


Part: TypeAlias = Module | Function | OwnFiles


def parts_of(things: object) -> Iterator[Part]:
    """Return the parts of objects, each once."""
    waiting: list[object] = [things]
    kept: dict[int, object] = {}  # So that their identities stay theirs.
    while waiting and len(kept) < MAX_OBJECTS:
        value = waiting.pop()
        if isinstance(value, _PLAIN) or id(value) in kept:
            continue
        kept[id(value)] = value
        if isinstance(value, FunctionType):
            part = _part_of_function(value)
            if part is not None:
                yield part
            waiting += _around(value, deep=isinstance(part, Function))
        elif isinstance(value, MethodType):
            waiting += [value.__func__, value.__self__]
        elif isinstance(value, functools.partial):
            waiting += [value.func, value.args, value.keywords]
        elif isinstance(value, ModuleType):
            if (part := _part_of_module(value)) is not None:
                yield part
        elif isinstance(value, type):
            part = _part_of_class(value)
            if isinstance(part, Module):
                yield part
            elif part is not None:
                waiting += [each for each in vars(value).values() if callable(each)]
            waiting += [base for base in value.__bases__ if base is not object]
        elif isinstance(value, Mapping):
            waiting += list(value.values())[:MAX_ENTRIES]
        elif isinstance(value, list | tuple | set | frozenset):
            waiting += list(value)[:MAX_ENTRIES]
            waiting.append(type(value))
        else:
            try:
                own, inside = list(_own_files(value)), _inside(value)
            except Exception:  # Objects of somebody else may answer with anything.
                continue
            yield from own
            waiting += inside


def _inside(value: object) -> list[object]:
    kind = type(value)
    if kind.__module__.partition(".")[0] in _OPAQUE:
        # A compiled function of JAX has the one that it was made of.
        wrapped = getattr(value, "__wrapped__", None)
        return [] if wrapped is None else [wrapped]
    values = getattr(value, "__dict__", None)
    inside: list[object] = [kind]
    if isinstance(values, dict):
        inside += [each for name, each in values.items() if name not in _COMPILED]
    return inside


def _own_files(value: object) -> Iterator[OwnFiles]:
    files = getattr(value, "__dict__", {}).get("source_files")
    if isinstance(files, Mapping) and files:
        yield OwnFiles(files)


def _part_of_function(function: FunctionType) -> Module | Function | None:
    file = function.__code__.co_filename
    values = function.__globals__
    if os.path.isfile(file):
        return _module(file, values) if is_user_file(file) else None
    # Functions that decorators and dataclasses make say that they are from "<string>"; what they
    # were made of has a file.
    made = file == "<string>" and values.get("__name__") != "__main__"
    if made or not is_user_file(file):
        return None
    return Function(function.__qualname__, file, _hash_of_function(function))


def _module(file: str, values: Mapping[str, Any]) -> Module:
    return Module(os.path.abspath(file), values.get("__spec__") or values)


def _part_of_module(module: ModuleType) -> Module | None:
    file = vars(module).get("__file__")
    if not isinstance(file, str) or not os.path.isfile(file) or not is_user_file(file):
        return None
    return _module(file, vars(module))


def _part_of_class(kind: type) -> Module | str | None:
    """Return the module of a class; `"no file"` for a user's class that is in none."""
    module = sys.modules.get(kind.__module__)
    if module is None or kind.__module__.partition(".")[0] in (*_OPAQUE, "verifai_jax"):
        return None
    if (part := _part_of_module(module)) is not None:
        return part
    return "no file" if kind.__module__ == "__main__" else None


def _around(function: FunctionType, deep: bool) -> list[object]:
    """Return the values that a function uses from its surroundings, global ones only if `deep`."""
    around: list[object] = [function.__defaults__ or (), function.__kwdefaults__ or {}]
    around += _closure(function).values()
    if (wrapped := getattr(function, "__wrapped__", None)) is not None:
        around.append(wrapped)
    if deep:
        values = function.__globals__
        around += [values[name] for name in _names(function.__code__) if name in values]
    return around


def _closure(function: FunctionType) -> dict[str, object]:
    found = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=False):
        try:
            found[name] = cell.cell_contents
        except ValueError:  # It is empty still.
            continue
    return found


def _names(code: CodeType) -> set[str]:
    """Return the global names of a function, and of those inside of it."""
    inner = [_names(each) for each in code.co_consts if isinstance(each, CodeType)]
    return set(code.co_names).union(*inner)


def _hash_of_function(function: FunctionType) -> str:
    """Return a hash of a function's text, and of the plain values that it takes from around it."""
    try:
        text = inspect.getsource(function)
    except (OSError, TypeError):
        text = _text_of_code(function.__code__)
    values = {name: function.__globals__.get(name) for name in _names(function.__code__)}
    values |= _closure(function)
    plain = {name: value for name, value in values.items() if _is_plain(value)}
    texts = [text, *(f"{name}={value!r}" for name, value in sorted(plain.items()))]
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def _is_plain(value: object) -> bool:
    if isinstance(value, tuple | list):
        return len(value) <= MAX_ENTRIES and all(map(_is_plain, value))
    return value is not None and isinstance(value, _PLAIN)


def _text_of_code(code: CodeType) -> str:
    constants = [
        _text_of_code(each) if isinstance(each, CodeType) else repr(each) for each in code.co_consts
    ]
    return "\n".join([code.co_code.hex(), *code.co_names, *constants])


PACKAGE = Path(__file__).resolve().parents[2]
"""Folder of this package."""
_INSTALLED = ("site-packages", "dist-packages")
"""Names of folders into which packages are installed."""


def is_notebook_cell(file: str) -> bool:
    """Return whether a name is that of a notebook cell."""
    return "ipykernel_" in file or file.startswith("<ipython")


@cache
def is_user_file(file: str) -> bool:
    """Return whether a file is a user's: not of this package, Python, or an installed package."""
    if file.startswith("<") and not file.startswith(("<stdin", "<string", "<ipython")):
        return False
    if "ipykernel_" in file:
        return True
    path = Path(file).absolute()
    if any(name in path.parts for name in _INSTALLED):
        return False
    return not any(path.is_relative_to(folder) for folder in _libraries())


@cache
def library_prefixes() -> tuple[str, ...]:
    """Return path prefixes of Python's files and of most installed packages."""
    return tuple(f"{folder}{os.sep}" for folder in _libraries())


@cache
def _libraries() -> tuple[Path, ...]:
    """Return the folders of this package, of Python and of what is installed."""
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    folders = {Path(sysconfig.get_path(name)) for name in names}
    folders |= {PACKAGE, Path(__file__).parents[2], Path(os.__file__).parent}
    # The plugin of pytest stands next to the package.
    folders |= {folder.parent / "_verifai_jax_pytest.py" for folder in tuple(folders)}
    return tuple(folders | {folder.resolve() for folder in folders})
