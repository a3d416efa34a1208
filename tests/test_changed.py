"""The choice of tests by what has changed, as `make test-changed` makes it."""

import pytest
from changed import importers, paths_for

LAWS = ["tests/test_architecture.py", "tests/test_language.py", "tests/test_public_names.py"]


@pytest.mark.slow
def test_a_file_calls_for_its_room_and_for_those_that_import_it():
    found = paths_for(["verifai_jax/pictures/replay.py"])
    assert {"tests/addons/reports", "tests/cli", "tests/pictures", *LAWS} <= set(found)
    assert {"tests/mtl", "tests/evaluation", "tests/addons/native"}.isdisjoint(found)


@pytest.mark.thorough
def test_importers_go_through_others():
    found = importers(["verifai_jax.statistics.binomial"])
    assert {"verifai_jax.statistics.binomial", "verifai_jax.falsification.summary"} <= found
    assert "verifai_jax.core.values.trace" not in found


@pytest.mark.thorough
def test_a_file_that_is_gone_calls_for_all_that_its_room_does():
    gone = set(paths_for(["verifai_jax/addons/estimation/comparison/gone.py"]))
    assert {"tests/addons/estimation", "tests/cli"} <= gone
    assert "tests/mtl" not in gone


@pytest.mark.parametrize(
    ("file", "tests"),
    [
        ("tests/mtl/test_text.py", ["tests/mtl/test_text.py"]),
        ("tests/mtl/mtl_oracle.py", ["tests/mtl"]),
        ("tests/mtl/test_gone.py", []),
        ("tests/conftest.py", ["tests"]),
        ("pyproject.toml", ["tests"]),
        ("docs/formulas.md", ["tests/test_documents.py"]),
        ("README.md", ["tests/test_documents.py"]),
        ("specs/cartpole.py", ["tests/addons/envs", "tests/addons/rl", "tests/envs"]),
        ("verifai_jax/addons/simulators/remote_client.py", ["tests/addons/simulators", *LAWS]),
        ("LICENSE", []),
    ],
)
def test_other_files(file, tests):
    assert paths_for([file]) == tests


def test_a_folder_stands_for_its_files():
    assert paths_for(["tests/mtl/test_text.py", "tests/mtl/mtl_oracle.py"]) == ["tests/mtl"]
