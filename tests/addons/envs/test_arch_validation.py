"""The competition's table: what stands in it is what was simulated."""

import csv

import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from benchmarks import arch_validation
from specs.arch import automatic_transmission, fuel_control
from verifai_jax.core.values.waveform import Waveform


def read(text):
    return np.array([[float(x) for x in row.split()] for row in text[1:-1].split(";")])


def test_pieces_begin_where_they_begin():
    features = {"a": Waveform(np.array([1.0, 2.0, 3.0]), "constant"), "b": 7.0}
    rows = arch_validation.input_matrix(features, ("b", "a"), 6.0)
    np.testing.assert_array_equal(rows, [[0, 7, 1], [2, 7, 2], [4, 7, 3]])
    assert arch_validation.as_matrix(rows[:2]) == "[0.0 7.0 1.0; 2.0 7.0 2.0]"


def test_pieces_of_different_lengths_are_cut_at_all_beginnings():
    features = {
        "a": Waveform(np.array([1.0, 2.0, 3.0]), "constant"),
        "b": Waveform(np.array([5.0, 6.0]), "constant"),
    }
    rows = arch_validation.input_matrix(features, ("a", "b"), 6.0)
    np.testing.assert_array_equal(rows, [[0, 1, 5], [2, 2, 5], [3, 2, 6], [4, 3, 6]])


def test_lines_are_sampled_up_to_the_end():
    rows = arch_validation.input_matrix({"a": Waveform(np.array([0.0, 5.0]))}, ("a",), 5.0)
    assert len(rows) == 51
    np.testing.assert_allclose(rows[:, 1], rows[:, 0], atol=1e-6)


def test_no_inputs_leave_the_beginning():
    np.testing.assert_array_equal(arch_validation.input_matrix({}, (), 15.0), [[0.0]])


@pytest.mark.slow
def test_the_input_of_a_line_breaks_the_requirement_again(tmp_path, monkeypatch):
    file = tmp_path / "results.csv"
    monkeypatch.setattr("sys.argv", ["", str(file), "at2", "--seeds", "2", "--budget", "50"])
    arch_validation.main()
    with file.open() as text:
        lines = list(csv.DictReader(text))
    assert [line["falsified"] for line in lines] == ["yes", "yes"]
    problem = automatic_transmission.at2
    for line in lines:
        assert (line["system"], line["property"], line["instance"]) == ("AT", "AT2", "2")
        rows = read(line["input"])
        assert float(line["stop time"]) == 30.0
        np.testing.assert_array_equal(rows[:, 0], np.arange(6) * 5.0)
        row = {f"throttle[{i}]": value for i, value in enumerate(rows[:, 1])}
        row |= {f"brake[{i}]": value for i, value in enumerate(rows[:, 2])}
        again = vj.simulate(problem, pd.DataFrame([row]), progress=False).best["rho"]
        assert again == pytest.approx(float(line["robustness"]), abs=1e-3)
        assert again < 0


def test_every_requirement_has_a_name_there():
    names = set(arch_validation.PROPERTIES)
    assert {"afc27", "at6abc", "ccx", "nnx", "sc"} <= names
    assert {arch_validation.system_of(name) for name in names} == set(arch_validation.INPUTS)
    assert fuel_control.afc27.name in names
