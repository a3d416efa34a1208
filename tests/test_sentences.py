"""Sentences are made of values, last, and never read back: nobody asks a note what it is about."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "verifai_jax"

SENTENCES = {"checked", "finding", "headline", "message", "note", "notes", "reason", "summary"}
"""Names of variables, fields and functions whose values are sentences for people."""
SENTENCES |= {"verdict", "why", "words"}
READERS = {"startswith", "endswith", "partition", "rpartition", "removeprefix", "removesuffix"}
READERS |= {"split", "rsplit", "find", "index", "replace", "contains"}
"""Methods of texts that take them apart."""


def name_of(node: ast.expr) -> str:
    """Return the last name of what is read: `note` of `note.text`, `notes` of `str(run.notes)`."""
    if isinstance(node, ast.Call):
        if isinstance(node.func, ast.Name) and node.func.id == "str" and node.args:
            return name_of(node.args[0])
        return name_of(node.func)
    if isinstance(node, ast.Subscript):
        key = node.slice
        return str(key.value) if isinstance(key, ast.Constant) else name_of(node.value)
    if isinstance(node, ast.Attribute):
        return name_of(node.value) if node.attr == "str" else node.attr
    return node.id if isinstance(node, ast.Name) else ""


def parsed(source: str) -> Iterator[tuple[int, str]]:
    """Yield the lines in which a sentence is taken apart, or searched for a part."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if node.func.attr in READERS and name_of(node.func.value) in SENTENCES:
                yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
            left, right = node.left, node.comparators[0]
            # A sentence itself among others is a comparison of values.
            texts = isinstance(left, ast.Constant | ast.JoinedStr | ast.Call)
            singular = name_of(right) in SENTENCES - {"notes", "checked", "summary"}
            if texts and singular and not isinstance(right, ast.Call):
                yield node.lineno, ast.unparse(node)


ALLOWED = {
    # The one reader of `safe@p`, beside what writes it.
    "addons/estimation/simultaneous_interval.py",
    # A message of Python itself.
    "problem/problem.py",
}
"""Files that may take such a text apart, and why."""


@pytest.mark.slow
def test_no_sentence_is_parsed():
    wrong = [
        f"{file.relative_to(PACKAGE)}:{line} {text}"
        for file in sorted(PACKAGE.rglob("*.py"))
        if file.relative_to(PACKAGE).as_posix() not in ALLOWED
        for line, text in parsed(file.read_text())
    ]
    assert not wrong, "\n".join(wrong)


def test_parsing_is_noticed():
    source = (
        'run.checked.partition(";")\nnote.startswith(kept)\nheadline(run).split(". ")[0]\n'
        'table["verdict"].str.startswith("safe")\nrepr(name) in note\nwhy in notes\n'
        'name.split(".")\n'
    )
    assert sorted(line for line, _ in parsed(source)) == [1, 2, 3, 4, 5]
