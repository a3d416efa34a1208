"""The language of the package: first words, typed arguments, one name for one thing."""

import ast
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "verifai_jax"
FILES = sorted(PACKAGE.rglob("*.py"))

QUESTIONS = {"What", "Which", "Whether", "How", "Who", "Of", "That", "Whose"}
"""First words of a sentence that names neither an act nor a thing."""

SHARE_OF_ANY = 0.05
"""Argument annotations that are `Any`, at most."""

SHADOWED_MODULES = 10
"""Modules hidden by a function of the same name that their package exports, at most."""

DIALECT = {"place", "places", "most", "least", "fewest", "told", "behind", "beside"}
"""Words of names that another one says better: index or position, `max_`, `min_`, observations,
after, alongside."""

USUAL = {
    "most_likely_action",  # The superlative of an adjective is no limit.
    "at_least",  # Plain English for a bound.
    "_at_least",
    "at_most",
}
"""Names with such a word that are plain English."""

Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
Nodes = Sequence[ast.AST]


def nodes_of(source: str) -> Nodes:
    return list(ast.walk(ast.parse(source)))


@pytest.fixture(scope="module")
def package() -> dict[str, Nodes]:
    """Return the nodes of each file of the package, which several tests read."""
    return {str(file.relative_to(PACKAGE)): nodes_of(file.read_text()) for file in FILES}


def documented(nodes: Nodes) -> Iterator[Documented | ast.Module]:
    for node in nodes:
        if isinstance(node, ast.Module):
            yield node
        if isinstance(node, Documented) and not node.name.startswith("_"):
            yield node


def first_word(docstring: str) -> str:
    return docstring.split()[0].rstrip(",:;.").split("'")[0].split("-")[0]


def questioning(nodes: Nodes) -> Iterator[tuple[int, str]]:
    """Yield lines of public docstrings that begin as a question does."""
    for node in documented(nodes):
        text = ast.get_docstring(node)
        if text and first_word(text) in QUESTIONS:
            yield getattr(node, "lineno", 1), text.splitlines()[0]


def argument_annotations(nodes: Nodes) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            arguments = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
            for argument in arguments:
                if argument.annotation is not None:
                    yield ast.unparse(argument.annotation)


def shadowed(package: Path) -> Iterator[tuple[str, str]]:
    """Yield each module that a name of its package's `__init__` hides, and the name's module."""
    here = ".".join(package.relative_to(PACKAGE.parent).parts)
    for node in ast.parse((package / "__init__.py").read_text()).body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                name = alias.asname or alias.name
                is_module = node.module == here
                exists = (package / f"{name}.py").exists() or (package / name).is_dir()
                if exists and not is_module:
                    yield f"{here}.{name}", node.module or ""
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            exists = (package / f"{node.name}.py").exists()
            yield from [(f"{here}.{node.name}", here)] * exists


@pytest.mark.slow
def test_first_words(package):
    wrong = [
        f"{file}:{line} {text}"
        for file, nodes in package.items()
        for line, text in questioning(nodes)
    ]
    assert not wrong, "\n".join(wrong)


def test_first_words_are_noticed():
    source = (
        '"""Whether it holds."""\ndef f():\n    """How."""\n'
        'def _g():\n    """What."""\nclass A:\n    """Something."""\n'
    )
    assert list(questioning(nodes_of(source))) == [(1, "Whether it holds."), (2, "How.")]


@pytest.mark.thorough
def test_arguments_have_types(package):
    annotations = [text for nodes in package.values() for text in argument_annotations(nodes)]
    share = sum(text in ("Any", "typing.Any") for text in annotations) / len(annotations)
    assert share <= SHARE_OF_ANY, f"{share:.1%} of {len(annotations)} annotations are Any"


def test_one_file_calls_shard_map():
    calls = [file for file in FILES if "shard_map(" in file.read_text()]
    assert calls == [PACKAGE / "core" / "compute" / "devices.py"]


def test_modules_hidden_by_a_function_of_their_name():
    packages = [file.parent for file in FILES if file.name == "__init__.py"]
    hidden = [pair for package in packages for pair in shadowed(package)]
    by_others = [pair for pair in hidden if pair[0] != pair[1]]
    assert len(hidden) <= SHADOWED_MODULES, hidden
    assert not by_others, by_others


def signed_zeros(nodes: Nodes) -> Iterator[tuple[int, str]]:
    """Yield lines of format specifications of real numbers that would write `-0`."""
    for node in nodes:
        if isinstance(node, ast.FormattedValue) and isinstance(node.format_spec, ast.JoinedStr):
            parts = [
                p.value if isinstance(p, ast.Constant) else "1" for p in node.format_spec.values
            ]
            spec = "".join(map(str, parts))
            if spec[-1:] in ("e", "f", "g") and "z" not in spec:
                yield node.lineno, spec


@pytest.mark.thorough
def test_no_zero_is_printed_with_a_sign(package):
    # `z` makes a zero of what rounds to it: f"{-0.0:zg}" is 0.
    wrong = [
        f"{file}:{line} {spec}"
        for file, nodes in package.items()
        # A client is copied to where Python is older.
        if file != "addons/simulators/remote_client.py"
        for line, spec in signed_zeros(nodes)
    ]
    assert not wrong, "\n".join(wrong)


def test_signs_of_zeros_are_noticed():
    assert list(signed_zeros(nodes_of('f"{a:.3g} {b:z.3g} {c:>3} {d:.{n}f}"'))) == [
        (1, ".3g"),
        (1, ".1f"),
    ]


def bound_names(nodes: Nodes) -> Iterator[tuple[int, str]]:
    """Yield the names that a file gives to arguments, variables, attributes and functions."""
    for node in nodes:
        if isinstance(node, Documented):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr


def is_dialect(name: str) -> bool:
    return name not in USUAL and bool(DIALECT & set(name.lower().split("_")))


@pytest.mark.slow
def test_names_are_plain_english(package):
    wrong = [str(file) for file in FILES if is_dialect(file.stem)]
    wrong += [
        f"{file}:{line} {name}"
        for file, nodes in package.items()
        for line, name in bound_names(nodes)
        if is_dialect(name)
    ]
    assert not wrong, "\n".join(wrong)


def test_names_that_are_dialect_are_noticed():
    source = "def f(most):\n    self.last_place = 1\nclass Placed:\n    least_x: int = 0\n"
    names = [name for _, name in bound_names(nodes_of(source)) if is_dialect(name)]
    assert sorted(names) == ["last_place", "least_x", "most"]
