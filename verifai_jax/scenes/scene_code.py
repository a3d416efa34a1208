"""A scene as Scenic code that stands alone (`scene_code`)."""

import math
import sys
from collections.abc import Iterator, Mapping
from pathlib import PurePath
from typing import Any

import numpy as np

from verifai_jax.scenes.graph import kind_of

POSE = ("position", "orientation", "parentOrientation", "heading", "yaw", "pitch", "roll")
"""Properties that `at` and `facing` set together."""

UNWRITTEN = frozenset((*POSE, "shape", "regionContainedIn", "lastActions", "sensors"))
"""Properties that are written otherwise, or that say nothing about a scene that is drawn."""

SIZE = ("width", "length", "height")
"""Properties that may come from a shape which is not written."""

SHAPES = ("CylinderShape", "ConeShape", "SpheroidShape")
"""Shapes that are known by their name and the size of the object."""


class _NoCodeError(Exception):
    """A value that Scenic code cannot write."""


def scene_code(scene: Any, planar: bool) -> str:
    """Return Scenic code whose only scene is this one.

    Scenic's own `dumpAsScenicCode` needs the classes of the program. Here they are defined, without
    their properties, which each object has. What code cannot write, such as a behaviour, is named
    in a comment. Requirements are left out, since they hold in this scene.

    **Arguments:**

    - `scene`: the scene of Scenic.
    - `planar`: Scenic's `mode2D`, in which the code is meant to be compiled.
    """
    lines = [f"# One scene of a Scenic program{', in mode2D' if planar else ''}."]
    for kind in dict.fromkeys(each for body in scene.objects for each in _own_classes(type(body))):
        above = [base.__name__ for base in kind.__bases__ if _is_own(base)]
        lines += [f"class {kind.__name__}{f'({above[0]})' if above else ''}:", "    pass"]
    for name, value in scene.params.items():
        label = name if str(name).isidentifier() else f'"{name}"'
        try:
            lines.append(f"param {label} = {_written(value)}")
        except _NoCodeError as kind:
            lines.append(f"# The parameter {name!r} is left out: code cannot write a {kind}.")
    for body in scene.objects:
        specifiers, left_out = _specifiers(body, planar)
        lines += [f"# The property {name!r} of the next object is left out." for name in left_out]
        ego = "ego = " if body is scene.egoObject else ""
        kind = type(body).__name__ if _is_own(type(body)) else "Object"
        lines.append(f"{ego}new {kind} " + ",\n    ".join(specifiers))
    return "\n".join(lines) + "\n"


def _is_own(kind: type) -> bool:
    """Return whether a class of objects is no class of Scenic's language itself."""
    return issubclass(kind, _objects().Object) and kind.__module__ != _objects().__name__


def _own_classes(kind: type) -> Iterator[type]:
    """Return a class and those that it inherits from, of which code needs a definition."""
    return (each for each in reversed(kind.__mro__) if _is_own(each))


def _objects() -> Any:
    return sys.modules["scenic.core.object_types"]


def _specifiers(body: Any, planar: bool) -> tuple[list[str], list[str]]:
    """Return what sets the properties of an object, and the names of those that code cannot set."""
    yaw, pitch, roll = (float(angle) for angle in body.orientation.eulerAngles)
    facing = f"{yaw!r}" if planar else f"({yaw!r}, {pitch!r}, {roll!r})"
    found, left_out = [f"at {_written(body.position)}", f"facing {facing}"], []
    shape = kind_of(body.shape)
    if shape in SHAPES:
        found.append(f"with shape {shape}()")
    elif shape != "BoxShape":
        left_out.append("shape")
    for name in body.properties:
        value = getattr(body, name)
        hidden = name in UNWRITTEN or name.startswith(("_", "mutat")) or value is None
        if hidden or name in body._finalProperties or _is_scenics_default(body, name):
            continue
        if name == "color" and isinstance(value, str):
            left_out.append(name)  # Scenic takes a name for a color only where it is random.
            continue
        try:
            found.append(f"with {name} {_written(value)}")
        except _NoCodeError:
            left_out.append(name)
    return found, left_out


def _is_scenics_default(body: Any, name: str) -> bool:
    """Return whether a property has the value that Scenic itself gives to every object."""
    if name not in body._constProps or name in SIZE:
        return False
    kinds = (kind for kind in type(body).__mro__ if name in getattr(kind, "_scenic_properties", {}))
    return not _is_own(next(kinds))


def _written(value: Any) -> str:
    """Return a value as Scenic code.

    **Raises:** `_NoCodeError` for one that code cannot write.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else f'float("{value}")'
    if value is None or isinstance(value, bool | int | str):
        return repr(value)
    if isinstance(value, PurePath):
        return repr(str(value))
    if kind_of(value) in ("Vector", "OrientedVector"):
        return f"Vector({', '.join(_written(part) for part in value.coordinates)})"
    if kind_of(value) == "Orientation":
        return f"Orientation.fromEuler({', '.join(map(_written, value.eulerAngles))})"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_written(k)}: {_written(v)}' for k, v in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_written, value))}]"
    if isinstance(value, tuple):
        return f"({', '.join(map(_written, value))}{',' * (len(value) == 1)})"
    raise _NoCodeError(kind_of(value))
