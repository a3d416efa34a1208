"""The core alone: a copy of the checkout without the add-ons and their tests."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROGRAM = """
import verifai_jax as vj

assert "judge" not in dir(vj.mtl) and "mcp" not in str(vj.search.names())
assert "bayes" not in vj.search.names() and "Bayes" not in dir(vj.search)
for names in (vj, vj.mtl, vj.search):
    for name in ("estimate", "judge", "Bayes"):
        try:
            getattr(names, name)
        except AttributeError as error:
            assert "has no" in str(error) or "an add-on whose files are missing" in str(error)
        else:
            raise AssertionError(name)
"""


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout without add-ons."""
    folder = tmp_path_factory.mktemp("core")
    for name in ("verifai_jax", "specs", "envs", "tests", "docs", "benchmarks"):
        ignored = shutil.ignore_patterns("addons", "__pycache__")
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "_verifai_jax_pytest.py", "Makefile"):
        shutil.copy(ROOT / name, folder / name)
    return folder


def call(folder: Path, environment: dict[str, str], *words: str) -> subprocess.CompletedProcess:
    environment = {**environment, "PYTHONPATH": str(folder)}
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.mark.slow
def test_the_core_falsifies_without_add_ons(core: Path, shared_cache: dict[str, str]) -> None:
    done = call(core, shared_cache, "-c", PROGRAM)
    assert done.returncode == 0, done.stderr
    command = ("-m", "verifai_jax")
    words = ("falsify", "specs/cartpole.py:balance", "--search", "uniform", "--budget", "2000")
    done = call(core, shared_cache, *command, *words)
    assert done.returncode == 0, done.stderr
    assert "violate the property" in done.stdout
    assert "worst.gif" in done.stdout
    listed = call(core, shared_cache, *command, "--help").stdout
    assert "  falsify " in listed
    assert "  estimate " not in listed
    unknown = call(core, shared_cache, *command, "estimate", "specs/cartpole.py:balance")
    assert unknown.returncode == 2
    assert "unknown command 'estimate'" in unknown.stderr


@pytest.mark.slow
@pytest.mark.timeout(1500)  # All quick tests of the core, in one process.
def test_the_tests_of_the_core_pass_without_add_ons(
    core: Path, shared_cache: dict[str, str]
) -> None:
    environment = {**shared_cache, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    environment.update({name: os.environ[name] for name in ("XLA_FLAGS",) if name in os.environ})
    whole = [f"--ignore=tests/{name}.py" for name in WHOLE]
    quick = "not addons and not slow and not thorough and not proves"
    words = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", quick, *whole, "tests")
    done = call(core, environment, *words)
    assert done.returncode == 0, done.stdout[-4000:]


WHOLE = (
    "test_architecture", "test_changed", "test_documents", "test_doors", "test_faults",
    "test_language",
    "test_notebooks", "test_plugin", "test_public_names", "test_readme_claims", "test_sentences",
    "test_tiers",
)  # fmt: skip
"""Tests of the checkout as a whole, with its add-ons."""
