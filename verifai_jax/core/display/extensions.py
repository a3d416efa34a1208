"""Objects that add-ons and other packages offer by entry points, imported when they are used.

verb("analyze")                                 # the function of the add-on that analyses tables
extensions("verifai_jax.commands")              # the names of all commands of add-ons

The core names no add-on. Each add-on is registered in `pyproject.toml`, as a third party's package
is registered in its own, and an add-on whose files are missing is as if it were not installed.
`docs/extending.md` lists the groups.
"""

import functools
import importlib.util
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from verifai_jax.core.messages.errors import nearest_names, unknown_name

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@functools.cache
def _entry_points() -> "dict[str, dict[str, EntryPoint]]":
    """Return the entry points of this package's groups whose module exists, by group and name."""
    from importlib.metadata import entry_points

    found: dict[str, dict[str, EntryPoint]] = {}
    everything = entry_points()
    for group in everything.groups:
        if group.startswith("verifai_jax."):
            points = everything.select(group=group)
            found[group] = {each.name: each for each in points if _exists(each.module)}
    return found


def extensions(group: str) -> tuple[str, ...]:
    """Return the names of a group's entry points whose module exists; nothing is imported."""
    return tuple(sorted(_entry_points().get(group, ())))


def entries(group: str, classes: bool) -> dict[str, str]:
    """Return the names of a group's entries, or of their classes, with the entry of each."""
    points = _entry_points().get(group, {})
    return {point.attr if classes else name: name for name, point in points.items()}


def extension(group: str, name: str) -> Any:
    """Import the object that an entry point names.

    **Arguments:**
    - `group`: the group of entry points, such as `"verifai_jax.commands"`.
    - `name`: the name of the entry point.
    **Raises:** `UnknownNameError` for a name that no installed package registers.
    """
    known = _entry_points().get(group, {})
    if name not in known:
        error = unknown_name(group.split(".")[-1].removesuffix("s"), name, extensions(group))
        error.add_note("It belongs to an add-on that is not installed, or whose files are missing.")
        raise error
    return known[name].load()


def verb(name: str) -> Any:
    """Return what an add-on does with a result or a problem: `analyze`, `report`, `faults`."""
    return extension("verifai_jax.verbs", name)


def members(group: str) -> dict[str, str]:
    """Return the public names of the modules of a group, with the entry point of each."""
    modules = {point: extension(group, point) for point in extensions(group)}
    return {name: point for point, module in modules.items() for name in module.__all__}


def member(package: str, group: str, name: str, others: Iterable[str]) -> Any:
    """Return a name of a package that the modules of a group add to it, for its `__getattr__`.

    **Arguments:**
    - `package`: the name of the package.
    - `group`: the group of entry points.
    - `name`: the missing name.
    - `others`: the names that the package has itself.
    **Raises:** `AttributeError` with the nearest names.
    """
    found = {} if name.startswith("_") else members(group)
    if name not in found:
        raise AttributeError(f"{package} has no {name!r}{nearest_names(name, [*others, *found])}")
    return getattr(extension(group, found[name]), name)


def _exists(module: str) -> bool:
    """Return whether a module has a file, without importing the packages that hold it."""
    root, *parts = module.split(".")
    try:
        found = importlib.util.find_spec(root)
    except (ImportError, ValueError):
        return False
    folders = found.submodule_search_locations if found is not None else None
    if folders is None or not parts:
        return found is not None
    files = [Path(folder, *parts) for folder in folders]
    return any(file.is_dir() or file.with_suffix(".py").is_file() for file in files)
