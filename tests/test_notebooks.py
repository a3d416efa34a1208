"""The comparison of a notebook's outputs with those stored in it."""

import json
from pathlib import Path

import pytest

from notebooks.outputs import TAG, agree, differences, jax_version, texts

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def stream(text, name="stdout"):
    return {"output_type": "stream", "name": name, "text": text}


def result(text, **data):
    return {"output_type": "execute_result", "data": {"text/plain": text, **data}}


def notebook(*outputs, tags=()):
    cell = {"cell_type": "code", "source": "run\nmore", "metadata": {}, "outputs": list(outputs)}
    if tags:
        cell["metadata"]["tags"] = list(tags)
    return {"cells": [{"cell_type": "markdown", "source": "# Title"}, cell]}


@pytest.mark.parametrize(
    ("stored", "new"),
    [
        ("36 of 1000 fail", "36 of 1000 fail"),
        ("robustness -0.03111", "robustness -0.031112"),
        ("rho   0.5\n", "rho 0.5"),  # columns are as wide as their numbers
        ("p < 1.00e-04", "p < 0.0001"),
        ("12,345 rows", "12345 rows"),
        (
            "0.7 s to compile, 0.1 s to search, 0.05 s to simulate (20,670 simulations/s)",
            "1.9 s to compile, 2 min to search, 3 min to simulate (9 simulations/s)",
        ),
        ("0.05 s to simulate, 0.2 s to confirm", "3 min to simulate, 2 min to confirm"),
        ("1 s to confirm; stopped", "1 s to confirm, 0.01 s for callbacks and files; stopped"),
        ("48 simulations in 14.3 s, stopped: budget", "48 simulations in 2 min, stopped: budget"),
        ("10 of 10, 0 failing, 1.5 s", "10 of 10, 0 failing, 2 min"),
        ("32,768 steps in 0.2 s of a core", "32,768 steps in 1.5 s of a core"),
        ("a\n-----\n1.5", "a\n------\n1.5001"),
    ],
)
def test_outputs_that_differ_in_digits_alone_agree(stored, new):
    assert agree(stored, new)


@pytest.mark.parametrize(
    ("stored", "new"),
    [
        ("36 of 1000 fail", "37 of 1000 fail"),
        ("robustness -0.03111", "robustness 0.03111"),
        ("robustness -0.03111", "robustness -0.0312"),
        ("violated", "kept"),
        ("violated at 1.5 s", "violated at 1.6 s"),  # of the simulation, not of the machine
        ("two rows", "two rows and more"),
        ("row 5", "row 5.5"),
        ("x 1 2", "x 1"),
        ("x0 fails", "x1 fails"),
        ("stopped by budget", "stopped by time"),
    ],
)
def test_outputs_that_say_something_else_disagree(stored, new):
    assert not agree(stored, new)


def test_printed_text_is_one_text_however_it_came():
    cell = notebook(stream("a\n"), stream("warning", "stderr"), stream("b\n"))["cells"][1]
    assert texts(cell) == {"stdout": "a\nb\n"}


def test_a_difference_names_its_cell_and_shows_itself():
    (told,) = differences(notebook(stream("a 1\nb 2\n")), notebook(stream("a 1\nb 3\n")))
    assert told.startswith("cell 1, run\n")
    assert "  -b 2\n  +b 3" in told
    assert "a 1" not in told


def test_pictures_have_no_text_but_must_be_there():
    picture = result("<Figure 10x20>", **{"image/png": "..."})
    other = result("<Figure 11x20>", **{"image/png": "???"})
    assert differences(notebook(picture), notebook(other)) == []
    (told,) = differences(notebook(picture), notebook(result("None")))
    assert "stored outputs: picture 0; new: result 0" in told


def test_marked_cells_need_the_same_kinds_only():
    stored = notebook(stream("seed 1: 0.3\n"), tags=[TAG])
    assert differences(stored, notebook(stream("seed 1: 0.9\n"))) == []
    (told,) = differences(stored, notebook())
    assert "stored outputs: stdout; new: none" in told


def test_cells_without_output():
    assert differences(notebook(), notebook()) == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_notebooks_agree_with_themselves(path):
    stored = json.loads(path.read_text())
    assert differences(stored, stored) == []
    assert any(texts(cell) for cell in stored["cells"] if cell["cell_type"] == "code")


def test_another_compiler_may_give_other_numbers_and_no_other_words():
    stored, new = "1  1.85  20000  3  1.86\nnearest row 5", "1  1.85  20000  0  NaN\nnearest row 7"
    assert agree(stored, new, same_compiler=False)
    assert not agree(stored, new.replace("nearest", "worst"), same_compiler=False)
    before, after = notebook(stream(stored)), notebook(stream(new))
    assert differences(before, after)
    after["metadata"] = {"verifai_jax": {"jax": "0.12"}}
    assert not differences(before, after)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_notebook_says_which_jax_computed_it(path):
    assert jax_version(json.loads(path.read_text()))
