"""The files that define an object: its modules as they were imported, and what it declares.

    made = made_here()                                  # where a problem is made, remembered there
    sources = sources_of(problem, made=made)            # taken when a run begins

The files are those of the user: the module that makes the problem, the modules of its functions,
modules of the user that these import, directly or not, and files that a system declares, in an
attribute `source_files` with their hashes when they were read. The hash of a module is that of the
file as it was first seen here, so an edit without a new import does not change it. A function
without a file, from a notebook, is recorded by its text and the plain values that it uses.
"""

import ast
import functools
import hashlib
import importlib.machinery
import importlib.util
import inspect
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple

from verifai_jax.core.user_code.sources import (
    CALLER,
    DECLARED,
    FUNCTION,
    IMPORTED,
    PROBLEM,
    PROGRAM,
    Maker,
    Source,
    Sources,
    shown_path,
    tree_commits,
    tree_of,
    versions,
)
from verifai_jax.core.user_code.user_files import file_hash, is_notebook_cell, is_user_file

MAX_OBJECTS = 4000
"""Objects that are looked at for functions, at most."""
MAX_ENTRIES = 200
"""Entries of a container that are looked at, at most."""
_OPAQUE = ("numpy", "jax", "jaxlib", "mujoco", "pandas", "scipy", "torch", "builtins")
"""Packages whose objects hold no functions of a user."""
_COMPILED = ("programs", "_problems")
"""Attributes with values derived from an object, which are not its parts."""
_PLAIN = (bool, int, float, complex, str, bytes, type(None))
GIT_SECONDS = 5.0
"""Seconds after which git's answer is not waited for."""


def made_here() -> tuple[Maker, ...]:
    """Return the user's modules on the call stack, from the innermost to the last import.

    Modules that import the one that makes a problem are not part of it.
    """
    found: dict[str, Maker] = {}
    frame = sys._getframe(1)
    while frame is not None:
        file = frame.f_code.co_filename
        if found and file.startswith("<frozen importlib"):
            break
        if is_user_file(file):
            role = PROBLEM if not found else CALLER
            # A cell, or what is executed as text, belongs to no file.
            path = os.path.abspath(file) if os.path.isfile(file) else ""
            if path not in found:
                owner = frame.f_globals.get("__spec__") or frame.f_globals
                found[path] = Maker(path, _as_imported(owner, path) if path else "", role)
        frame = frame.f_back
    return tuple(found.values())


def sources_of(
    *things: object, made: Sequence[Maker] = (), first: int = 0, program: str = "", git: bool = True
) -> Sources:
    """Return the files and versions of some objects: code as imported, data as declared.

    **Arguments:**
    - `things`: objects such as a problem; their functions and declared files are included.
    - `made`: the modules in which they were made, from `made_here`.
    - `first`: the first row of a table to which they apply.
    - `program`: the fingerprint of the traced program; empty without one.
    - `git`: whether git is asked for the commit, which a comparison of files does not need.
    """
    modules: dict[str, Source] = {}
    others: dict[str, Source] = {}
    without = []
    for maker in made:
        if maker.file:
            modules[maker.file] = Source(shown_path(maker.file), maker.role, maker.sha256)
        elif maker.role == PROBLEM:
            without.append("the problem is made in no file, as in a notebook")
    loaded = {each.get("__file__"): each for each in map(_variables, tuple(sys.modules.values()))}
    # A caller does other things besides, which have no part in the model.
    waiting = [
        _module(loaded.get(file, {})) or _Module(file, "", None)
        for file, source in modules.items()
        if source.role != CALLER
    ]
    waiting += _look_into(things, others)
    done: set[str] = set()
    while waiting:
        module = waiting.pop()
        if module.file in done:
            continue
        done.add(module.file)
        if module.file not in modules or modules[module.file].role == CALLER:
            sha256 = _as_imported(module.owner, module.file)
            modules[module.file] = Source(shown_path(module.file), IMPORTED, sha256)
        if tree_of(module.file) is None:  # At a revision the commit says what is imported.
            waiting += _imports(module)
    order = (PROBLEM, CALLER, IMPORTED)
    files = sorted(modules.values(), key=lambda each: (order.index(each.role), each.name))
    files += sorted(others.values())
    files += [Source(PROGRAM, PROGRAM, program)] if program else []
    tree = next((tree for tree in map(tree_of, modules) if tree is not None), None)
    commit, dirty = _checked_out() if tree is None and git else ("", False)
    root, revision = Path.cwd().as_posix(), "" if tree is None else tree_commits[tree]
    without_file = tuple(without)
    return Sources(tuple(files), versions(), without_file, root, first, commit, dirty, revision)


def _checked_out() -> tuple[str, bool]:
    """Return the commit that is checked out here, and whether tracked files differ from it."""
    words = ("status", "--porcelain=v2", "--branch", "--untracked-files=no")
    command = ["git", "--no-optional-locks", *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=GIT_SECONDS)
    except (OSError, subprocess.SubprocessError):
        return "", False
    lines = done.stdout.splitlines()
    oid = [line.split()[-1] for line in lines if line.startswith("# branch.oid ")]
    if done.returncode or not oid or oid[0] == "(initial)":
        return "", False
    return oid[0], any(not line.startswith("#") for line in lines)


class _Module(NamedTuple):
    """A user's module: its file, the package of its relative imports, and an owner.

    The owner represents it until it is imported again; None if it is not imported.
    """

    file: str
    package: str
    owner: object


def _variables(module: object) -> Mapping[str, Any]:
    # Asked without __getattr__, by which some modules import others.
    return getattr(module, "__dict__", {})


def _module(values: Mapping[str, Any]) -> _Module | None:
    """Return the module with these variables; None if it is not in a file of the user."""
    file = values.get("__file__")
    if not isinstance(file, str) or not os.path.isfile(file) or not is_user_file(file):
        return None
    owner = values.get("__spec__") or values
    return _Module(os.path.abspath(file), values.get("__package__") or "", owner)


def _imports(module: _Module) -> Iterator[_Module]:
    """Yield the user's modules that the import statements of a module name; nothing is run."""
    try:
        names = _imported_names(module.file, module.package, os.stat(module.file).st_mtime_ns)
    except OSError:
        return
    for name in names:
        parts, folders = name.split("."), None
        for count in range(1, len(parts) + 1):
            whole = ".".join(parts[:count])
            found = _find(parts[count - 1], sys.path if folders is None else folders)
            if loaded := _variables(sys.modules.get(whole)):
                known = _module(loaded)
                if known is None and loaded.get("__file__"):
                    break  # An installed package, of which no file is looked for.
                if known is not None:
                    yield known
                if isinstance(path := loaded.get("__path__"), list):
                    found = None, path
            elif found[0] is not None:
                if not is_user_file(found[0]):
                    break
                package = whole if found[1] else whole.rpartition(".")[0]
                yield _Module(os.path.abspath(found[0]), package, None)
            folders = found[1]
            if not folders:
                break


def _find(name: str, folders: Sequence[str]) -> tuple[str | None, list[str]]:
    """Return the file of a module in folders, and the folders of a package; nothing is imported."""
    bases = [os.path.join(folder or os.curdir, name) for folder in folders]
    package = f"{os.sep}__init__.py"
    for base in bases:
        for ending in (package, ".py", *importlib.machinery.EXTENSION_SUFFIXES):
            if os.path.isfile(base + ending):
                return base + ending, [base] if ending == package else []
    return None, [base for base in bases if os.path.isdir(base)]


@functools.lru_cache(maxsize=512)
def _imported_names(file: str, package: str, changed: int) -> tuple[str, ...]:
    """Return the absolute names in the import statements of a program; none if it is not Python."""
    try:
        tree = ast.parse(Path(file).read_bytes())
    except (SyntaxError, ValueError, RecursionError):
        return ()
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            try:
                base = "." * node.level + (node.module or "")
                base = importlib.util.resolve_name(base, package or None)
            except ImportError:
                continue
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    apart = (*sys.stdlib_module_names, "verifai_jax")
    return tuple(dict.fromkeys(name for name in names if name.partition(".")[0] not in apart))


def _look_into(things: object, others: dict[str, Source]) -> Iterator[_Module]:
    """Yield the modules of the functions in objects; add functions without one, and files."""
    waiting: list[object] = [things]
    kept: dict[int, object] = {}  # So that their identities stay theirs.
    while waiting and len(kept) < MAX_OBJECTS:
        value = waiting.pop()
        if isinstance(value, (*_PLAIN, ModuleType)) or id(value) in kept:
            continue
        kept[id(value)] = value
        if isinstance(value, FunctionType):
            waiting += [value.__defaults__ or (), value.__kwdefaults__ or {}, closure_of(value)]
            if (wrapped := getattr(value, "__wrapped__", None)) is not None:
                waiting.append(wrapped)  # Whose module imports what wraps it.
            elif (module := _module(value.__globals__)) is not None:
                yield module
            elif value.__globals__.get("__name__") == "__main__":
                waiting += [value.__globals__.get(name) for name in names_in(value.__code__)]
                _add_function(value, others)
        elif isinstance(value, MethodType):
            waiting += [value.__func__, value.__self__]
        elif isinstance(value, functools.partial):
            waiting += [value.func, value.args, value.keywords]
        elif isinstance(value, Mapping):
            waiting += list(value.values())[:MAX_ENTRIES]
        elif isinstance(value, list | tuple | set | frozenset):
            waiting += [*list(value)[:MAX_ENTRIES], type(value)]
        elif isinstance(value, type):
            if str(value.__module__).partition(".")[0] not in (*_OPAQUE, "verifai_jax"):
                waiting += [each for each in vars(value).values() if callable(each)]
                waiting += value.__bases__
        elif str(type(value).__module__).partition(".")[0] in _OPAQUE:
            # A compiled function of JAX has the one that it was made of.
            waiting.append(getattr(value, "__wrapped__", None))
        else:
            values = _variables(value)
            for file, sha256 in dict(values.get("source_files") or {}).items():
                others[file] = Source(shown_path(file), DECLARED, sha256)
            waiting += [type(value), *(v for n, v in values.items() if n not in _COMPILED)]


def _add_function(function: FunctionType, others: dict[str, Source]) -> None:
    """Add a function that is in no file: its text, and the plain values that it uses."""
    where = "notebook" if is_notebook_cell(function.__code__.co_filename) else "no file"
    try:
        text = inspect.getsource(function)
    except (OSError, TypeError):
        text = function.__code__.co_code.hex()
    values = {name: function.__globals__.get(name) for name in names_in(function.__code__)}
    plain = {n: v for n, v in (values | closure_of(function)).items() if _is_plain(v)}
    texts = [text, *(f"{name}={value!r}" for name, value in sorted(plain.items()))]
    name = f"{function.__qualname__} ({where})"
    # Of several of one name, such as lambdas, the hash stands for all in their order.
    texts += [others[name].sha256] if name in others else []
    sha256 = hashlib.sha256("\n".join(texts).encode()).hexdigest()
    others[name] = Source(name, FUNCTION, sha256)


def closure_of(function: FunctionType) -> dict[str, object]:
    """Return the variables of outer functions that a function uses, if they have a value."""
    found = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=False):
        try:
            found[name] = cell.cell_contents
        except ValueError:  # It is empty still.
            continue
    return found


def names_in(code: CodeType) -> set[str]:
    """Return the global names of a function, and of those inside of it."""
    inner = [names_in(each) for each in code.co_consts if isinstance(each, CodeType)]
    return set(code.co_names).union(*inner)


def _is_plain(value: object) -> bool:
    if isinstance(value, tuple | list):
        return len(value) <= MAX_ENTRIES and all(map(_is_plain, value))
    return value is not None and isinstance(value, _PLAIN)


_imported_as: dict[int, tuple[object, str]] = {}
"""Hashes of modules as they were first seen, by their specs, which a reload replaces."""


def _as_imported(owner: object, file: str) -> str:
    known = _imported_as.get(id(owner))
    if owner is None or known is None or known[0] is not owner:
        try:
            known = (owner, file_hash(Path(file)))
        except OSError:
            known = (owner, "")  # It is gone since it was imported.
        if owner is not None:
            _imported_as[id(owner)] = known
    return known[1]
