"""The code of the pages runs as it stands there, block after block, in an empty folder.

A comment before a block says where it cannot: `<!-- needs PACKAGE -->` runs it where the package is
installed, `<!-- not run: why -->` compiles it only. What a block prints is as the page says:

- in a block without a language right below it, in words and numbers, where lines may be
  left out or broken and times differ, and ` ...` stands for the rest of a line;
- in a comment behind `print(...)` that begins with a value: each number of it is printed there.

On a page that shows what a command prints, its commands run, too.
"""

import ast
import contextlib
import importlib.util
import io
import itertools
import os
import pkgutil
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from click.testing import CliRunner

import verifai_jax
from notebooks.outputs import NUMBER, SPENT, agree
from verifai_jax.cli.main import main

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
BLOCK = re.compile(r"(?:<!-- (needs|not run:?) ([^>]*?) -->\n)?```python\n(.*?)```", re.DOTALL)
FILES = (ROOT / "README.md", *sorted(DOCS.glob("*.md")))
OURS = ("verifai_jax", "envs", "specs")
PAGES = [
    "../README",
    *(file.stem for file in sorted(DOCS.glob("*.md")) if "```python" in file.read_text()),
]
"""Pages with code."""
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
FENCE = re.compile(r"^(?:<!-- ([^>]*?) -->\n)?```(\w*)\n(.*?)^```\n", re.DOTALL | re.MULTILINE)
"""A block of any language, and the comment before it."""
COMMENTED = re.compile(r"print\(.*\)\s+# ((?:[-\d\[({]|True|False).*)")
"""A line that prints, with a comment that begins with a value."""
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


def dotted_names(code: str) -> set[str]:
    """Return the names, from their modules on, that code imports from here or reads from these."""
    tree, known = ast.parse(code), {"vj": "verifai_jax"}
    for part in ast.walk(tree):
        if isinstance(part, ast.ImportFrom) and str(part.module).split(".")[0] in OURS:
            known |= {one.asname or one.name: f"{part.module}.{one.name}" for one in part.names}
    read = [
        ast.unparse(part).split(".") for part in ast.walk(tree) if isinstance(part, ast.Attribute)
    ]
    chains = {".".join([known[first], *rest]) for first, *rest in read if first in known}
    return {*known.values(), *(chain for chain in chains if re.fullmatch(r"[\w.]+", chain))}


@pytest.mark.thorough
def test_code_that_is_not_run_names_what_there_is():
    for page in PAGES:
        text = (DOCS / f"{page}.md").read_text()
        inline = set(re.findall(r"`((?:envs|specs)\.[\w.]+)`", text))
        for block in blocks(page):
            inline |= dotted_names(block.code)
        for name in sorted(inline):
            pkgutil.resolve_name(name)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_links_lead_to_files(file):
    prose = CODE.sub("", file.read_text())
    assert [link for link in LINK.findall(prose) if not (file.parent / link).exists()] == []


class Shown(NamedTuple):
    """A block that runs, the number of its first line, and what the page says that it prints."""

    language: str
    code: str
    line: int
    output: str


def shown_on(page: str) -> list[Shown]:
    """Return the blocks of a page that run, each with the blocks of output right below it."""
    text, found, end = (DOCS / f"{page}.md").read_text(), list[Shown](), -1
    for fence in FENCE.finditer(text):
        about, language, code = fence.groups()
        kind, _, package = (about or "").partition(" ")
        if language in ("python", "sh"):
            line = text.count("\n", 0, fence.start(3))
            runs = not about or (kind == "needs" and importlib.util.find_spec(package))
            end = fence.end() if runs else -1
            found += [Shown(language, code, line, "")] if runs else []
        elif not language and not text[end : fence.start()].strip() and end > 0:
            found[-1] = found[-1]._replace(output=found[-1].output + code)
            end = fence.end()
    commands = any(each.language == "sh" and each.output for each in found)
    return [each for each in found if each.language == "python" or commands]


def is_printed(shown: str, printed: str) -> bool:
    """Return whether what is shown are lines that were printed, in their order, broken or not.

    Numbers agree as those of notebooks do, and ` ...` stands for the rest of a line.
    """
    words = iter(timeless(shown).split())
    word = next(words, None)
    for line in timeless(printed).splitlines():
        kept, words = itertools.tee(words)
        rest, at = line.split(), word
        for each in rest:
            if at is None or at == "..." or not agree(at, each):
                break
            at = next(words, None)
        else:
            each = None
        if rest and (each is None or at == "..."):
            word = next(words, None) if at == "..." else at
        else:
            words = kept
    return word is None


def timeless(text: str) -> str:
    """Return a text without the time that the machine needed."""
    return re.sub(r"(?m)(?<=, )[\d.,]+ (?:ms|s|min|h)$", "TIME", SPENT.sub("TIME ", text))


def is_value(comment: str, printed: str) -> bool:
    """Return whether the value with which a comment begins, and its numbers, were printed."""
    if comment.startswith(("True", "False")):
        return comment.split()[0].strip(",.:") in printed.split()
    rest = iter(NUMBER.findall(printed))
    return all(any(is_rounded(number, each) for each in rest) for number in NUMBER.findall(comment))


def is_rounded(number: str, printed: str) -> bool:
    one, other = (float(each.replace(",", "")) for each in (number, printed))
    digits = len(number.partition(".")[2])
    return abs(one - other) <= 0.5 * 10.0**-digits * (1 + 1e-9) * bool(digits or "." in printed)


def run_commands(code: str) -> str:
    """Run those lines that are commands of the package, and return what they print."""
    printed = ""
    for line in code.splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["cd"]:
            os.chdir(words[1])
        elif words[:1] == ["verifai-jax"]:
            done = CliRunner().invoke(main, words[1:])
            assert done.exit_code == 0, done.output
            printed += done.stdout
    return printed


def run_page(page: str) -> None:
    """Run the code of a page in this folder, and compare what it prints with what the page says."""
    printed: dict[int, str] = {}

    def record(*values: object, **options: Any) -> None:
        text = io.StringIO()
        print(*values, **{"file": text, **options})
        line = sys._getframe(1).f_lineno
        printed[line] = printed.get(line, "") + text.getvalue()
        print(text.getvalue(), end="")

    names: dict = {"__name__": page, "print": record}
    for block in shown_on(page):
        with contextlib.redirect_stdout(io.StringIO()) as out:
            if block.language == "sh":
                print(run_commands(block.code), end="")
            else:
                # Lines of an error are those of the page.
                code = "\n" * block.line + block.code
                exec(compile(code, str(DOCS / f"{page}.md"), "exec"), names)
        said = out.getvalue()
        assert is_printed(block.output, said), f"{page}, line {block.line}: it prints\n{said}"
        for number, line in enumerate(block.code.splitlines(), block.line + 1):
            if found := COMMENTED.search(line):
                text = printed.get(number, "")
                assert is_value(found[1], text), f"{page}: {line}\nprints {text}"


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_the_code_of_a_page_runs_and_prints_what_the_page_says(page, tmp_path):
    # As a user compiles it: what adapts to what it finds depends on the last digits.
    own = ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")
    env = {name: value for name, value in os.environ.items() if name not in own}
    env["PYTHONPATH"] = os.pathsep.join([str(ROOT), env.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, __file__, page], cwd=tmp_path, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_what_a_page_says_is_compared():
    assert is_value("0.05, and 2 as well", "7 0.0501 2")
    assert not is_value("2, and 0.05", "7 0.0501 2")
    assert is_value("True: within 1 s", "True")
    assert not is_value("True", "False")
    printed = "a 1\n  b 2.5 of 7\nc, 1956 simulations, 3 s\nd"
    assert is_printed("a 1\nc, 1956\n  simulations, 7 s", printed)
    assert is_printed("b 2.5 ...\nd", printed)
    assert is_printed("", printed)
    for wrong in ("c, 1996 simulations, 3 s", "b 2.5", "d\na 1", "b 2.6 ...", "e"):
        assert not is_printed(wrong, printed), wrong
    blocks = [each for page in PAGES for each in shown_on(page) if each.output]
    assert len(blocks) > 10
    assert any(each.language == "sh" for each in blocks)


def test_the_first_page_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= 900


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
    pictures = [
        page.parent / source
        for page in tmp_path.glob("**/*.html")
        for source in re.findall(r'<img [^>]*?src="([^"]+)"', page.read_text())
        if not source.startswith(("data:", "http"))
    ]
    # Each one opens, as its beginning shows.
    beginnings = {b"\x89PNG", b"GIF8"}
    broken = [p for p in pictures if not p.exists() or p.read_bytes()[:4] not in beginnings]
    assert not broken
    assert len(pictures) > 50


if __name__ == "__main__":
    run_page(sys.argv[1])
