"""Properties in VNN-LIB: networks whose greatest output is known, and a second checker."""

import itertools
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

from verifai_jax.addons.verification.network import verify_network
from verifai_jax.addons.verification.vnnlib import read_property
from verifai_jax.cli.main import main

CHECKER = Path(__file__).parents[3] / "examples" / "verification" / "check_boxes.py"
LOW, HIGH = np.array([-1.0, -0.5]), np.array([0.5, 1.0])


def small_network(random, path):
    """Write a network of one hidden layer of two inputs; return its function."""
    onnx = pytest.importorskip("onnx")
    helper, units = onnx.helper, int(random.integers(3, 7))
    arrays = {
        "w1": random.normal(size=(units, 2)), "b1": 0.5 * random.normal(size=units),
        "w2": random.normal(size=(1, units)), "b2": random.normal(size=1),
    }  # fmt: skip
    arrays = {name: np.float32(array) for name, array in arrays.items()}
    nodes = [
        helper.make_node("Gemm", ["x", "w1", "b1"], ["a"], transB=1),
        helper.make_node("Relu", ["a"], ["b"]),
        helper.make_node("Gemm", ["b", "w2", "b2"], ["y"], transB=1),
    ]
    number = onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        nodes, "network", [helper.make_tensor_value_info("x", number, [1, 2])],
        [helper.make_tensor_value_info("y", number, [1, 1])],
        [onnx.numpy_helper.from_array(array, name) for name, array in arrays.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, path)
    return {name: array.astype(float) for name, array in arrays.items()}


def greatest(arrays):
    """Return the greatest output: at a vertex of the pieces on which the network is linear."""
    lines = [(row, -shift) for row, shift in zip(arrays["w1"], arrays["b1"], strict=True)]
    lines += [(np.eye(2)[i], end[i]) for i in range(2) for end in (LOW, HIGH)]
    points = []
    for (a, b), (c, d) in itertools.combinations(lines, 2):
        if abs(np.linalg.det([a, c])) > 1e-12:
            points.append(np.linalg.solve([a, c], [b, d]))
    points = np.array(points)
    inside = points[((points >= LOW - 1e-9) & (points <= HIGH + 1e-9)).all(1)]
    hidden = np.maximum(inside @ arrays["w1"].T + arrays["b1"], 0)
    return float((hidden @ arrays["w2"].T + arrays["b2"]).max())


def above(path, threshold):
    """Write the property whose counterexamples have an output of at least a threshold."""
    text = "; the greatest output\n(declare-const X_0 Real)\n(declare-const X_1 Real)\n"
    text += "(declare-const Y_0 Real)\n"
    for i in range(2):
        text += f"(assert (>= X_{i} {LOW[i]}))\n(assert (<= X_{i} {HIGH[i]}))\n"
    path.write_text(text + f"(assert (>= Y_0 {threshold!r}))\n")


def answered(seed, folder):
    """Check the answers about one network, a little above and below its greatest output."""
    arrays = small_network(np.random.default_rng(seed), folder / "net.onnx")
    top, rule = greatest(arrays), folder / "rule.vnnlib"
    above(rule, top + 0.05)
    found = verify_network(folder / "net.onnx", rule, boxes=400, progress=False)
    assert (found.verdict, found.proved) == ("holds", 1.0)
    found.save(folder / "boxes.json")
    above(rule, top - 0.05)
    broken = verify_network(folder / "net.onnx", rule, boxes=400, progress=False)
    assert broken.verdict == "counterexample"
    hidden = np.maximum(arrays["w1"] @ broken.inputs + arrays["b1"], 0)
    value = arrays["w2"] @ hidden + arrays["b2"]
    assert value[0] >= top - 0.05 - 1e-5
    assert np.all((broken.inputs >= LOW) & (broken.inputs <= HIGH))
    np.testing.assert_allclose(broken.outputs, value, rtol=1e-4, atol=1e-5)
    above(rule, top + 0.05)


def checked(*arguments):
    return subprocess.run(
        [sys.executable, CHECKER, *map(str, arguments)], capture_output=True, text=True, check=False
    )


@pytest.mark.thorough
def test_a_proof_is_checked_again_by_another_program(tmp_path):
    pytest.importorskip("mpmath")
    answered(100, tmp_path)
    files = tmp_path / "net.onnx", tmp_path / "rule.vnnlib", tmp_path / "boxes.json"
    done = checked(*files)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("boxes are proved\n")
    (tmp_path / "boxes.json").write_text('{"proved": [[[[0, 0]], [[1, 0.5]]]]}')
    assert "the boxes do not fill the inputs" in checked(*files).stderr
    (tmp_path / "boxes.json").write_text('{"proved": [[[[0, 0]], [[1, 1]]]]}')
    above(tmp_path / "rule.vnnlib", -1e3)
    assert "box 1 is not proved" in checked(*files).stderr


@pytest.mark.slow
@pytest.mark.parametrize("block", range(5))
def test_small_networks_have_the_answers_that_are_known(block, tmp_path):
    """Fifty properties: of each of 25 networks one that holds and one that does not."""
    for seed in range(5 * block, 5 * block + 5):
        answered(seed, tmp_path)


@pytest.mark.slow
def test_the_command_answers_for_a_network(tmp_path):
    arrays = small_network(np.random.default_rng(3), tmp_path / "net.onnx")
    above(tmp_path / "rule.vnnlib", greatest(arrays) - 0.1)
    files = [str(tmp_path / "net.onnx"), str(tmp_path / "rule.vnnlib")]
    done = CliRunner().invoke(main, ["verify", *files, "--fail-on", "counterexample"])
    assert done.exit_code == 1, done.output
    assert done.output.startswith("counterexample\n  inputs")
    done = CliRunner().invoke(main, ["verify", files[0]])
    assert "a network and a property go together" in done.output


def declared(text, folder):
    file = folder / "p.vnnlib"
    names = "(declare-const X_0 Real)(declare-const Y_0 Real)(declare-fun Y_1 () Real)"
    file.write_text(names + "(assert (and (<= X_0 2) (<= 1 X_0)))" + text)
    return read_property(file)


def test_alternatives_comparisons_and_sums_are_read(tmp_path):
    text = "(assert (or (and (>= Y_0 Y_1) (<= X_0 1.5)) (<= (+ Y_0 (* 2 Y_1)) (- 3))))"
    first, second = declared(text, tmp_path)
    assert (first.low, first.high) == ([1.0], [1.5])
    assert (second.low, second.high) == ([1.0], [2.0])
    x = jnp.array([1.2])
    assert float(first.margin(x, jnp.array([1.0, 3.0]))) == 2.0  # Y_1 - Y_0
    assert float(second.margin(x, jnp.array([1.0, 3.0]))) == 10.0  # Y_0 + 2 Y_1 + 3
    assert float(second.margin(x, jnp.array([-5.0, 0.5]))) == -1.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("(assert (<= Y_0 Z_1))", "'Z_1' is no number and no declared variable"),
        ("(assert (<= (* Y_0 Y_1) 1))", r"\(\* Y_0 Y_1\) is not a linear term"),
        ("(assert (=> Y_0 1))", "is no comparison"),
        ("(assert (<= Y_0 1)", "a bracket is not closed"),
        ("(" * 100_000, "its brackets are nested deeper than 100"),
        ("(assert (<= Y_0 1)))", "a bracket closes that was not opened"),
        ("(declare-const W Real)", "a variable 'W'"),
        ("(declare-const X_1 Real)(assert (<= X_1 1))", "the input X_1 has no bound on a side"),
    ],
)
def test_what_is_no_property_is_an_error_that_names_the_part(text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        declared(text, tmp_path)
