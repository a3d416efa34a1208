"""The code of the pages runs as it stands there, block after block, in an empty folder.

A comment before a block says where it cannot: `<!-- needs PACKAGE -->` runs it where the package is
installed, `<!-- not run: why -->` compiles it only.
"""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

import verifai_jax

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
BLOCK = re.compile(r"(?:<!-- (needs|not run:?) ([^>]*?) -->\n)?```python\n(.*?)```", re.DOTALL)
FILES = (ROOT / "README.md", *sorted(DOCS.glob("*.md")))
PAGES = [
    "../README",
    *(file.stem for file in sorted(DOCS.glob("*.md")) if "```python" in file.read_text()),
]
"""Pages with code."""
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
SHOWN = re.compile(r"```python\n(.*?)```\n\n```\n(.*?)```", re.DOTALL)
"""A block of code, and below it what it prints."""
LINK = re.compile(r"\]\(([\w./-]+)(?:#[\w-]+)?\)")
"""A link to a file; those with a scheme lead elsewhere."""


class Block(NamedTuple):
    """A block of code, the number of its first line, and what stands before it."""

    code: str
    line: int
    mark: str | None
    about: str | None

    @property
    def runs(self) -> bool:
        """True where the block is to be executed here."""
        if self.mark == "needs":
            return importlib.util.find_spec(str(self.about)) is not None
        return self.mark is None


def blocks(page: str) -> list[Block]:
    """Return the blocks of Python on a page."""
    text = (DOCS / f"{page}.md").read_text()
    return [
        Block(found[3], text.count("\n", 0, found.start(3)), found[1], found[2])
        for found in BLOCK.finditer(text)
    ]


@pytest.mark.parametrize("page", PAGES)
def test_every_block_is_python(page):
    found = blocks(page)
    assert found
    assert len(found) == (DOCS / f"{page}.md").read_text().count("```python")
    for block in found:
        compile(block.code, page, "exec")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_links_lead_to_files(file):
    prose = CODE.sub("", file.read_text())
    assert [link for link in LINK.findall(prose) if not (file.parent / link).exists()] == []


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": page}
    for block in blocks(page):
        if block.runs:
            # Lines of an error are those of the page.
            code = "\n" * block.line + block.code
            exec(compile(code, str(DOCS / f"{page}.md"), "exec"), names)


def test_the_first_page_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= 900


@pytest.mark.slow
def test_the_first_page_shows_what_its_code_prints(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shown = SHOWN.search((ROOT / "README.md").read_text())
    assert shown is not None
    exec(compile(shown[1], "README.md", "exec"), {"__name__": "first"})
    printed = capsys.readouterr().out.splitlines()
    expected = shown[2].splitlines()
    assert len(printed) == len(expected)
    for line, said in zip(expected, printed, strict=True):
        if line.startswith("  time "):  # Seconds differ.
            line, said = (re.sub(r"\d[\d.,]*", "0", text) for text in (line, said))
        beginning, dots, _ = line.partition(" ...")
        assert said.startswith(beginning) if dots else said == line
    assert (tmp_path / "worst.png").exists()


def test_the_citation_has_the_version():
    text = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {verifai_jax.__version__}\n" in text


def test_the_navigation_of_the_site_names_each_page_once():
    text = (ROOT / "website" / "mkdocs.yml").read_text()
    made = set(re.findall(r'"([a-z]+\.md)"', (ROOT / "website" / "pages.py").read_text()))
    named = re.findall(r"([a-z_]+\.md)", text.partition("nav:")[2])
    assert sorted(named) == sorted(made | {page.name for page in DOCS.glob("*.md")})


def test_the_first_page_links_to_each_page():
    linked = set(re.findall(r"\]\(docs/(\w+)\.md\)", (ROOT / "README.md").read_text()))
    assert linked == {page.stem for page in DOCS.glob("*.md")}


@pytest.mark.thorough
def test_the_site_is_built_strictly(tmp_path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(tmp_path)]
    command += ["--config-file", str(ROOT / "website" / "mkdocs.yml")]
    done = subprocess.run(
        command, capture_output=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    )
    assert done.returncode == 0, done.stderr.decode()
    assert "Fuzz" in (tmp_path / "reference" / "falsification.html").read_text()
