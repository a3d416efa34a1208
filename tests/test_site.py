"""Pages of the site, without building it: every picture of a notebook is where its page looks."""

import importlib.util
import re
import sys
import types
from pathlib import Path

import pytest

import verifai_jax as vj

ROOT = Path(__file__).parents[1]
STUBS = {
    "markdown": ("Extension", "Markdown"),
    "markdown.preprocessors": ("Preprocessor",),
    "mkdocs": (),
    "mkdocs.structure": (),
    "mkdocs.structure.files": ("File", "Files"),
}
"""What the pages import of the tools that build the site, which need not be installed."""


@pytest.fixture
def pages(monkeypatch):
    for name, members in STUBS.items():
        module = types.ModuleType(name)
        vars(module).update({member: type(member, (), {}) for member in members})
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "website" / "pages.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_picture_is_where_its_page_looks(pages):
    count = 0
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        made, page = {}, f"notebooks/{path.stem}.md"
        text = pages._links(pages._notebook(path, made), "notebooks", page)
        sources = re.findall(r'<img src="([^"]+)"', text)
        assert sorted(f"notebooks/{source}" for source in sources) == sorted(made)
        assert all(picture[:4] in (b"\x89PNG", b"GIF8") for picture in made.values())
        count += len(sources)
    assert count > 40
    # The first page is above the folder of the documentation, in which its pictures are.
    first = pages._links('<img src="docs/features.png"> [a](docs/ode.md)', "", "index.md")
    assert first == '<img src="features.png"> [a](ode.md)'


@pytest.mark.addons
def test_searches_of_the_add_on_are_in_the_reference(pages):
    file, names = pages._rooms()["searches"]
    assert file.exists()
    assert "addons.searches.bayes.Bayes" in names
    assert all(hasattr(vj.search, name.rpartition(".")[2]) for name in names)
    assert "search.Bayes" not in pages._rooms()["search"][1]
