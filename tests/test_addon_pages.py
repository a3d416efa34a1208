"""Each add-on has a page beside its code; what it lists is what the add-on really has."""

import ast
import re
import tomllib
from pathlib import Path

import pytest
from test_architecture import ADDONS

ROOT = Path(__file__).parent.parent
ENTRIES = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]


def imported_as(source: str) -> dict[str, str]:
    """Return the module that each public name of a lazy table comes from."""
    return {
        alias.asname: f"{node.module}.{alias.name}"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
        if alias.asname
    }


PUBLIC = imported_as((ROOT / "verifai_jax" / "__init__.py").read_text())


def facts(name: str) -> dict[str, list[str]]:
    """Return what the page of an add-on lists: its names, its entry points, what it stands on."""
    inside = f"verifai_jax.addons.{name}"
    listed = {
        "Names": [
            f"vj.{n}" for n, module in PUBLIC.items() if f"{module}.".startswith(f"{inside}.")
        ]
    }
    for group, entries in ENTRIES.items():
        own = [n for n, module in entries.items() if re.match(rf"{inside}[.:]|{inside}$", module)]
        if own:
            listed[group.removeprefix("verifai_jax.").capitalize()] = own
    return listed | {"Stands on": sorted(ADDONS[name])}


@pytest.mark.addons
@pytest.mark.parametrize("name", sorted(ADDONS))
def test_the_page_of_an_add_on_lists_what_it_has(name):
    page = (ROOT / "verifai_jax" / "addons" / name / "README.md").read_text()
    for title, listed in facts(name).items():
        found = re.search(rf"^- \*\*{title}\*\*: (.*)$", page, re.MULTILINE)
        assert found or not listed, title
        if found:
            assert re.findall(r"`([^`]+)`", found[1]) == listed, title
    for title in ("For whom", "Promises", "Without it", "Pages", "Tests"):
        assert f"- **{title}**: " in page, title
    for target in re.findall(r"\]\(([^)#]+)", page):
        assert (ROOT / "verifai_jax" / "addons" / name / target).exists(), target
