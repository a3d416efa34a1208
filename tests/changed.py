"""Print the tests of what differs from another revision: paths for pytest, one a line.

    python tests/changed.py             # since main, with what is not committed
    python tests/changed.py HEAD~3

A changed file of the package calls for the tests of its folder and of every folder with a file that
imports it, directly or through others (the graph of `test_architecture.py`). A changed test is run
itself. What all tests share, and files that no rule knows, call for all of them.
"""

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from test_architecture import FILES, PACKAGE, ROOT, graph, room_of

TESTS = ROOT / "tests"
SHARED = {"conftest.py", "checked_types.py", "xla_flags.py"}
"""Files that every test depends on, with those that say what is installed."""
EVERYTHING = {"pyproject.toml", "constraints.txt", "_verifai_jax_pytest.py"}
LAWS = ("test_architecture.py", "test_language.py", "test_public_names.py")
"""Tests that read the whole package, and run whenever a file of it changes."""
ELSEWHERE = {"_version": "cli"}
"""Tests of files at the root."""


def main() -> None:
    """Print the paths, and what they are chosen for to the standard error."""
    revision = sys.argv[1] if len(sys.argv) > 1 else "main"
    files = changed_files(revision)
    paths = paths_for(files)
    chosen = " ".join(paths)
    print(f"{len(files)} files differ from {revision}; tests: {chosen}", file=sys.stderr)
    print(*paths, sep="\n")


def changed_files(revision: str) -> list[str]:
    """Return the files that differ from where this branch left a revision, new ones too.

    **Raises:** `subprocess.CalledProcessError` for a revision that git does not know.
    """
    base = _git("merge-base", "HEAD", revision)[0]
    new = _git("ls-files", "--others", "--exclude-standard")
    return sorted({*_git("diff", "--name-only", base), *new})


def _git(*words: str) -> list[str]:
    done = subprocess.run(["git", *words], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout.splitlines()


def importers(modules: Iterable[str]) -> set[str]:
    """Return these modules and all that import them, directly or through others."""
    by: dict[str, set[str]] = {}
    for module, imported in graph().items():
        for other in imported:
            by.setdefault(other, set()).add(module)
    found: set[str] = set()
    left = set(modules)
    while left:
        found |= left
        left = set().union(*(by.get(module, set()) for module in left)) - found
    return found


def paths_for(files: Iterable[str]) -> list[str]:
    """Return the paths of tests that changed files call for, from the root of the checkout.

    **Arguments:**

    - `files`: paths from the root of the checkout; files that are gone count, too.
    """
    names = {str(file.relative_to(ROOT)): module for module, file in FILES.items()}
    chosen: set[str] = set()
    folders: set[Path] = set()
    for name in files:
        path = Path(name)
        if (path.name in SHARED and path.parts[0] == "tests") or name in EVERYTHING:
            return ["tests"]
        if path.parts[0] == PACKAGE.name:
            chosen.update(f"tests/{law}" for law in LAWS)
            # A file that is gone was imported by what imports its folder now.
            modules = [names[name]] if name in names else _near(path)
            folders |= {_tests_of(module) for module in importers(modules)}
        elif path.parts[0] == "tests" and path.suffix == ".py":
            if (ROOT / path).exists():
                chosen.add(name if path.name.startswith("test_") else str(path.parent))
        elif path.parts[0] in ("envs", "specs"):
            chosen |= {"tests/envs", "tests/addons/envs", "tests/addons/rl"}
        elif path.parts[0] == "docs" or path.suffix == ".md":
            chosen.add("tests/test_documents.py")
        elif path.parts[0] == "notebooks":
            chosen.add("tests/test_notebooks.py")
        elif path.parts[0] in ("benchmarks", "examples"):
            chosen.add("tests/test_faults.py")
    chosen |= {str(folder.relative_to(ROOT)) for folder in folders - {TESTS}}
    inside = {name for name in chosen for other in chosen if _is_inside(name, other)}
    return sorted(chosen - inside)


def _tests_of(module: str) -> Path:
    """Return the folder of tests nearest to a file's own: it has the same path, or lies above."""
    tests = TESTS / ELSEWHERE.get(room_of(module), module.partition(".")[2].replace(".", "/"))
    return tests if tests.is_dir() else next(folder for folder in tests.parents if folder.is_dir())


def _near(path: Path) -> list[str]:
    """Return the modules in the folder of a file that is gone, or in its room."""
    inside = [name for name, file in FILES.items() if file.parent == (ROOT / path).parent]
    return inside or [module for module in FILES if room_of(module) == path.parts[1]]


def _is_inside(name: str, other: str) -> bool:
    return name != other and Path(name).is_relative_to(other)


if __name__ == "__main__":
    main()
