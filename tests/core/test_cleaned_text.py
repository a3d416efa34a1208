"""Texts of others, on a terminal and as names of folders."""

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.messages.text import (
    folder_name,
    format_error,
    format_features,
    one_line,
    printable,
)


def test_what_steers_a_terminal_is_written_out():
    assert printable("a\x1b[2Jb\x07\r") == "a\\x1b[2Jb\\x07\\r"
    assert printable("\u202eevil\u2028\udcff") == "\\u202eevil\\u2028\\udcff"
    assert printable("two\nlines\tand ä, 中, 🙂") == "two\nlines\tand ä, 中, 🙂"
    assert one_line("a\nb\x1b") == "a b\\x1b"
    assert len(one_line("x" * 5_000_000)) < 510


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("balance", "balance"),
        ("a-b_c 1.5", "a-b_c 1.5"),
        ("../../evil name\n", "evil name"),
        ("/etc/passwd", "etc_passwd"),
        ("..", "unnamed"),
        ("a\x00b\\c", "a_b_c"),
        ("größe", "größe"),
    ],
)
def test_a_name_stays_in_its_folder(name, folder):
    assert folder_name(name) == folder
    assert len(folder_name(name * 500)) < 110


def test_an_error_is_one_line_that_is_not_too_long():
    assert format_error(ValueError("first\nsecond")) == "ValueError: first"
    assert format_error(KeyError()) == "KeyError"
    assert len(format_error(ValueError("x" * 100_000))) < 600


@pytest.mark.parametrize("name", ["a\nb", "a\x1b[2Jb", "a\u2028b", "a\tb"])
def test_names_of_a_problem_are_one_line(name):
    def system(features, key):
        return vj.Trace({"x": features["a"]}, dt=1.0)

    told = "must be one line without control characters, as people read it in summaries; got "
    with pytest.raises(ValueError, match="the name of a field " + told):
        vj.FeatureSpace({name: vj.Box(0, 1)})
    with pytest.raises(ValueError, match="the name of a formula " + told):
        vj.Problem("p", {"a": vj.Box(0, 1)}, system, {name: "always x > 0"})
    problem = vj.Problem(name, {"a": vj.Box(0, 1)}, system, "always x > 0", description=name)
    assert problem.name in ("a_b", "a_[2Jb")
    assert "\x1b" not in str(problem)
    # What is data may be any text, and is written in one line.
    vj.Trace({name: np.ones(1)}, dt=1.0)
    assert len(format_features({"c": name}).splitlines()) == 1
