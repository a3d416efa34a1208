"""The problems of `benchmarks/ainncs.py` are answered, with small networks of our own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from benchmarks import ainncs
from benchmarks.verify import network


def saved(folder, name, law, low, high):
    """Write a network that is fitted to a control law as a file of ONNX."""
    fitted = network(law, low, high, 12, "relu")
    policy = vj.policy(lambda x: fitted(*x)[None])
    policy.save(folder / f"{name}.onnx", np.zeros(len(low), np.float32))


@pytest.mark.slow
def test_a_network_that_holds_the_pendulum_is_verified(tmp_path):
    pytest.importorskip("onnx")
    saved(tmp_path, "single_pendulum", lambda a, w: -0.7 * a - 0.5 * w, [-1, -3], [1.5, 2])
    found = ainncs.answer(ainncs.single_pendulum(tmp_path), boxes=20)
    assert (found.verdict, found.low, found.high) == ("verified", 0.0, 0.0)


@pytest.mark.slow
def test_a_network_that_lets_go_of_the_pendulum_is_falsified(tmp_path):
    pytest.importorskip("onnx")
    saved(tmp_path, "single_pendulum", lambda a, w: 0.1 * a, [-1, -3], [1.5, 2])
    found = ainncs.answer(ainncs.single_pendulum(tmp_path), boxes=20)
    assert found.verdict == "falsified"
    assert found.robustness < -0.1


@pytest.mark.slow
def test_a_network_of_convolutions_holds_the_unicycle(tmp_path):
    """Matrix products as convolutions, the mean as an input: as MATLAB exports them."""
    onnx = pytest.importorskip("onnx")
    helper, numpy_helper = onnx.helper, onnx.numpy_helper
    arrays = {
        "mean": np.zeros((1, 1, 1, 4)), "w1": np.array([[0, 0, 0, -2.0], [0, 0, -2.0, 0]]),
        "b1": np.full(2, 30.0), "w2": np.eye(2), "b2": np.full(2, -10.0),
    }  # fmt: skip
    arrays["w1"] = arrays["w1"].reshape(2, 1, 1, 4)
    arrays["w2"] = arrays["w2"].reshape(2, 2, 1, 1)
    nodes = [
        helper.make_node("Sub", ["x", "mean"], ["a"]),
        helper.make_node("Conv", ["a", "w1", "b1"], ["b"], kernel_shape=[1, 4]),
        helper.make_node("Relu", ["b"], ["c"]),
        helper.make_node("Conv", ["c", "w2", "b2"], ["d"], kernel_shape=[1, 1]),
        helper.make_node("Flatten", ["d"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes, "network",
        [helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 1, 1, 4])],
        [helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1, 2])],
        [numpy_helper.from_array(np.float32(a), name) for name, a in arrays.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 8)])
    model.ir_version = 8
    onnx.save(model, tmp_path / "unicycle.onnx")
    problem = ainncs.unicycle(tmp_path)
    problem = vj.Problem(problem.name, problem.space, problem.system, "always abs(v) <= 1.52")
    found = vj.verify(problem, boxes=4, continuous=True, progress=False)
    assert found.proved.mass == 1.0


def test_networks_of_sherlock_are_read_as_they_are_written(tmp_path):
    """One hidden layer of two: counts, then the weights and the bias of each unit."""
    file = tmp_path / "network.txt"
    file.write_text("2 1 1 2  1 2 3  -1 0.5 0  2 -1 0.25  0.5 4".replace(" ", "\n"))
    read = ainncs.from_text(file, jax.nn.relu, jnp.tanh)
    x = np.array([0.3, -0.2])
    hidden = np.maximum([x @ [1, 2] + 3, x @ [-1, 0.5]], 0)
    expected = 4 * (np.tanh(hidden @ [2, -1] + 0.25) - 0.5)
    np.testing.assert_allclose(np.ravel(read(jnp.asarray(x))), [expected], rtol=1e-5)


def test_networks_of_operator_set_6_are_read(tmp_path):
    onnx = pytest.importorskip("onnx")
    helper = onnx.helper
    values = {"mean": np.array([1.0, 2.0]), "w": np.array([[1.0, -1.0]]), "b": np.array([0.5])}
    nodes = [
        helper.make_node("Sub", ["x", "mean"], ["a"], broadcast=1),
        helper.make_node("Gemm", ["a", "w", "b"], ["y"], broadcast=1, transB=1),
    ]
    graph = helper.make_graph(
        nodes, "network", [helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 2])],
        [helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1, 1])],
        [onnx.numpy_helper.from_array(np.float32(a), name) for name, a in values.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 6)])
    model.ir_version = 3
    onnx.save(model, tmp_path / "acc.onnx")
    found = ainncs.from_onnx(tmp_path / "acc.onnx")(jnp.array([3.0, 1.0]))
    np.testing.assert_allclose(np.ravel(found), [2.0 + 1.0 + 0.5])
