"""A hook of mkdocs: pages that are made of other files, and links as the site has them.

The README is the first page. Notebooks become pages with the outputs that are stored in them, so
that nothing runs. The reference has a page for each room, with the names that a user imports.
"""

import ast
import base64
import json
import posixpath
import re
import tomllib
from pathlib import Path
from typing import Any

from markdown import Extension, Markdown
from markdown.preprocessors import Preprocessor
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "benchmarks/RESULTS.md": "benchmarks.md",
}
"""Files of the checkout that are pages of the site."""
LINK = re.compile(r"(!?)\[([^\]\n]*(?:\n[^\]\n]*)?)\]\(([\w./-]+)(#[\w-]+)?\)")
"""A link or a picture whose place is a path."""
IMAGE = re.compile(r'(<img src=")([\w./-]+)(")')
BLOCK = re.compile(r"(^```.*?^```)", re.DOTALL | re.MULTILINE)
ANSI = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
SECTIONS = ("**Returns:**", "**Raises:**", "**Yields:**")
"""Beginnings of paragraphs that follow arguments, or each other, in a docstring."""
LONGEST_OUTPUT = 6000
"""Characters of an output of a notebook that are shown."""


def on_config(config: Any) -> Any:
    """Fill those parts of the navigation that are lists of files."""
    lists = {
        "pages-of-notebooks": [_page_of(path) for path in _notebooks()],
        "pages-of-reference": [f"reference/{room}.md" for room in _rooms()],
    }

    def filled(entry: Any) -> Any:
        if isinstance(entry, list):
            return [filled(each) for each in entry]
        if isinstance(entry, dict):
            return {title: filled(each) for title, each in entry.items()}
        return lists.get(entry, entry)

    config["nav"] = filled(config["nav"])
    config["markdown_extensions"].append(Sections())
    return config


class Sections(Extension):
    """Sections of docstrings, `**Arguments:**` and others, without empty lines between them."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Add the empty lines that Markdown needs in front of a list and of a paragraph."""
        md.preprocessors.register(_Spaced(md), "sections", priority=15)


class _Spaced(Preprocessor):
    def run(self, lines: list[str]) -> list[str]:
        spaced: list[str] = []
        for line in lines:
            before = spaced[-1] if spaced else ""
            begins = line.startswith("- ") and before.startswith("**")
            if begins or (before and line.startswith(SECTIONS)):
                spaced.append("")
            spaced.append(line)
        return spaced


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made of other files."""
    made = {page: (ROOT / source).read_text() for source, page in PAGES.items()}
    for path in _notebooks():
        made[_page_of(path)] = _notebook(path, made)
    for room, (file, names) in _rooms().items():
        made[f"reference/{room}.md"] = _reference(room, file, names)
    for page, content in made.items():
        files.append(File.generated(config, page, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Lead links to pages of the site; what is no page of it is named only."""
    source = {page: source for source, page in PAGES.items()}.get(page.file.src_uri)
    if source is None:
        if page.file.src_uri.startswith(("reference/", "notebooks/")):
            folder = posixpath.dirname(page.file.src_uri)
        else:
            folder = "docs"
    else:
        folder = posixpath.dirname(source)
    parts = BLOCK.split(markdown)
    parts[::2] = [_links(part, folder, page.file.src_uri) for part in parts[::2]]
    return "".join(parts)


def _links(text: str, folder: str, page: str) -> str:
    def link(found: re.Match[str]) -> str:
        mark, words, path, anchor = found.groups()
        place = relative(path)
        if place is None:
            return words if words.startswith("`") else f"{words} (`{path.replace('../', '')}`)"
        return f"{mark}[{words}]({place}{anchor or ''})"

    def image(found: re.Match[str]) -> str:
        return f"{found[1]}{relative(found[2]) or found[2]}{found[3]}"

    def relative(path: str) -> str | None:
        place = _place(posixpath.normpath(posixpath.join(folder, path)))
        return place and posixpath.relpath(place, posixpath.dirname(page) or ".")

    return IMAGE.sub(image, LINK.sub(link, text))


def _place(path: str) -> str | None:
    """Return the page or picture of the site that a file of the checkout is; None without one."""
    if path in PAGES:
        return PAGES[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if path.startswith("notebooks/") and path.endswith(".ipynb"):
        return _page_of(ROOT / path)
    picture = path.endswith((".png", ".gif"))
    return path if path.startswith(("notebooks/", "reference/")) and picture else None


def _notebooks() -> list[Path]:
    return sorted((ROOT / "notebooks").glob("*.ipynb"))


def _page_of(notebook: Path) -> str:
    return f"notebooks/{notebook.stem}.md"


def _notebook(path: Path, made: dict[str, Any]) -> str:
    """Write a notebook as a page; its pictures become files beside it."""
    lines = []
    for number, cell in enumerate(json.loads(path.read_text())["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            lines += [source, ""]
            continue
        lines += ["```python", source, "```", ""]
        for place, output in enumerate(cell.get("outputs", [])):
            lines += _output(output, f"{path.stem}-{number}-{place}", made)
    return "\n".join(lines)


def _output(output: dict[str, Any], name: str, made: dict[str, Any]) -> list[str]:
    data = output.get("data", {})
    for kind, ending in (("image/png", "png"), ("image/gif", "gif")):
        if kind in data:
            made[f"notebooks/{name}.{ending}"] = base64.b64decode("".join(data[kind]))
            return [f'<img src="{name}.{ending}" alt="output of the cell above">', ""]
    text = "".join(output.get("text", data.get("text/plain", [])))
    text = ANSI.sub("", text).rstrip()[:LONGEST_OUTPUT]
    return ["```text", text, "```", ""] if text else []


def _rooms() -> dict[str, tuple[Path, list[str]]]:
    """Return the names that a user imports, by room or module, with the file that describes it.

    They are those of `verifai_jax/__init__.py`.
    """
    package = ROOT / "verifai_jax"
    rooms: dict[str, tuple[Path, list[str]]] = {}
    for node in ast.walk(ast.parse((package / "__init__.py").read_text())):
        if not isinstance(node, ast.ImportFrom) or not str(node.module).startswith(package.name):
            continue
        folder = ROOT.joinpath(*str(node.module).split("."))
        for name in [alias.name for alias in node.names if alias.asname == alias.name]:
            files = (folder / name / "__init__.py", folder / f"{name}.py")
            file = next((each for each in files if each.exists()), None)
            if file is not None:
                names = [f"{name}.{each}" for each in _exported(file)]
                rooms.setdefault(name, (file, []))[1].extend(names)
            elif (room := package.joinpath(*_room(folder.relative_to(package)))).is_dir():
                rooms.setdefault(room.name, (room / "__init__.py", []))[1].append(name)
    # Names that an add-on gives to another room, by an entry point, stand with the add-on.
    monitoring = package / "addons" / "monitoring" / "__init__.py"
    rooms["monitoring"] = (monitoring, [f"addons.monitoring.{n}" for n in _exported(monitoring)])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    searches = project["entry-points"]["verifai_jax.searches"].values()
    names = [each.removeprefix("verifai_jax.").replace(":", ".") for each in searches]
    rooms["searches"] = (package / "addons" / "searches" / "__init__.py", sorted(names))
    return dict(sorted(rooms.items()))


def _room(path: Path) -> tuple[str, ...]:
    """Return the folder of a room: the first, or of an add-on the second."""
    return path.parts[: 2 if path.parts[:1] == ("addons",) else 1]


def _exported(file: Path) -> list[str]:
    return sorted(
        alias.asname
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    )


def _reference(room: str, file: Path, names: list[str]) -> str:
    about = ast.get_docstring(ast.parse(file.read_text()))
    lines = [f"# {room}", "", (about or "").partition("\n")[0], ""]
    for name in names:
        lines += [f"::: verifai_jax.{name}", ""]
    return "\n".join(lines)
