"""The public surface: names and signatures are those of a committed list.

After a deliberate change, write the list anew and read its difference:

    python tests/test_public_names.py > tests/public_names.txt
"""

import ast
import enum
import importlib
import inspect
import re
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from verifai_jax.core.display.extensions import entries
from verifai_jax.core.display.extensions import members as members_of_group

TESTS = Path(__file__).parent
SNAPSHOT = TESTS / "public_names.txt"
ROOMS = (
    "analysis",
    "augmentation",
    "blocks",
    "clusters",
    "events",
    "faults",
    "mtl",
    "perception",
    "policies",
    "rl",
    "search",
)
"""Modules that are used by their names, as in `vj.mtl.parse`; `vj` comes first in the list."""


def annotation_text(annotation: Any) -> str:
    """Return an annotation without the modules that its names come from."""
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    text = re.sub(r"\b(?:[A-Za-z_]\w*\.)+([A-Za-z_]\w*)", r"\1", text.replace("~", ""))
    return alternatives(re.sub(r"ForwardRef\('(\w+)'\)", r"\1", text))


def alternatives(text: str) -> str:
    """Write every `Union[A, B, NoneType]` as `A | B | None`: versions print either."""
    while (start := text.find("Union[")) >= 0:
        parts, depth, position = [""], 0, start + len("Union[")
        while depth or text[position] != "]":
            character = text[position]
            depth += (character in "[(") - (character in ")]")
            if character == "," and not depth:
                parts.append("")
            else:
                parts[-1] += character
            position += 1
        names = ["None" if part.strip() == "NoneType" else part.strip() for part in parts]
        text = text[:start] + " | ".join(names) + text[position + 1 :]
    return text


def default_text(default: Any) -> str:
    return getattr(default, "__qualname__", None) or re.sub(r" at 0x\w+", "", repr(default))


def signature_text(function: Callable[..., Any]) -> str:
    """Return a signature: names, kinds, annotations and defaults; none of an enumeration."""
    if isinstance(function, enum.EnumType):
        return ""
    try:
        signature = inspect.signature(function)
    except (ValueError, TypeError):
        return "(...)"
    parts = []
    before = None
    for parameter in signature.parameters.values():
        kind = parameter.kind
        if before is inspect.Parameter.POSITIONAL_ONLY and kind is not before:
            parts.append("/")
        if kind is parameter.KEYWORD_ONLY and before not in (kind, parameter.VAR_POSITIONAL):
            parts.append("*")
        stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(kind, "")
        part = stars + parameter.name
        if parameter.annotation is not parameter.empty:
            part += f": {annotation_text(parameter.annotation)}"
        if parameter.default is not parameter.empty:
            part += f" = {default_text(parameter.default)}"
        parts.append(part)
        before = kind
    result = ""
    if signature.return_annotation is not signature.empty:
        result = f" -> {annotation_text(signature.return_annotation)}"
    return f"({', '.join(parts)}){result}"


def members(kind: type, known: set[type]) -> Iterator[str]:
    """Yield a line for each public attribute and method of a class, each where it is defined.

    - `known`: the public classes; what is inherited from them is listed there.
    """
    ours = [base for base in kind.__mro__ if base.__module__.startswith("verifai_jax")]
    own = [base for base in ours if base is kind or base not in known]
    names = {name for base in own for name in vars(base) if not name.startswith("_")}
    for name in sorted(names):
        value = inspect.getattr_static(kind, name)
        if isinstance(value, staticmethod | classmethod):
            yield f"{name}{signature_text(value.__func__)}"
        elif inspect.isfunction(value):
            yield f"{name}{signature_text(value)}"
        elif isinstance(value, type):
            yield f"class {name}"
        else:
            yield name


def listing(
    module: types.ModuleType, prefix: str, known: set[type], listed: set[type]
) -> Iterator[str]:
    """Yield the lines of a module's public names; members of a class under its first name."""
    for name in sorted(dir(module)):
        value = getattr(module, name)
        if isinstance(value, types.ModuleType) or name == "__version__":
            yield f"{prefix}.{name}"
        elif isinstance(value, type):
            yield f"class {prefix}.{name}{signature_text(value)}"
            if value not in listed:
                yield from (f"    {line}" for line in members(value, known))
            listed.add(value)
        elif callable(value):
            yield f"{prefix}.{name}{signature_text(value)}"
        else:
            yield f"{prefix}.{name} = {default_text(value)}"


def public_names() -> str:
    """Return the text of the snapshot."""
    vj = importlib.import_module("verifai_jax")
    modules = {"vj": vj} | {f"vj.{room}": getattr(vj, room) for room in ROOMS}
    every = [getattr(module, name) for module in modules.values() for name in dir(module)]
    known = {value for value in every if isinstance(value, type)}
    listed: set[type] = set()
    found = (listing(module, prefix, known, listed) for prefix, module in modules.items())
    return "\n".join(line for lines in found for line in lines) + "\n"


def test_names_and_signatures_are_those_of_the_list():
    # In a process of its own, where no test's import hook wraps what is public.
    command = [sys.executable, __file__]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == SNAPSHOT.read_text().splitlines(), (
        "public names or signatures have changed; if that is meant, "
        "python tests/test_public_names.py > tests/public_names.txt"
    )


@pytest.mark.parametrize("room", ROOMS)
def test_completion_shows_public_names_only(room):
    module = getattr(importlib.import_module("verifai_jax"), room)
    added = members_of_group(module.GROUP) if room == "mtl" else {}
    added |= entries(module.GROUP, classes=True) if room == "search" else {}
    assert sorted(dir(module)) == sorted({*module.__all__, *added})
    for name in dir(module):
        assert not name.startswith("_")
        assert not isinstance(getattr(module, name), types.ModuleType), name


def test_completion_of_the_root_shows_public_names_only():
    import verifai_jax as vj

    assert dir(vj) == sorted(vj.__all__)
    modules = {name for name in dir(vj) if isinstance(getattr(vj, name), types.ModuleType)}
    assert modules == set(ROOMS)


def test_the_lazy_root_gives_what_type_checkers_see():
    import verifai_jax as vj

    tree = ast.parse(Path(vj.__file__ or "").read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    names = {"__version__"}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        assert node.module is not None
        for alias in node.names:
            assert alias.asname == alias.name
            names.add(alias.name)
            if node.module != "verifai_jax":
                module = importlib.import_module(node.module)
                assert getattr(vj, alias.name) is getattr(module, alias.name)
    assert names == set(vj.__all__)


def test_an_unknown_name_is_met_with_the_nearest():
    import verifai_jax as vj

    with pytest.raises(AttributeError, match=r"verifai_jax has no 'falsfy'.*falsify"):
        _ = vj.falsfy


if __name__ == "__main__":
    sys.path.insert(0, str(TESTS.parent))
    sys.stdout.write(public_names())
