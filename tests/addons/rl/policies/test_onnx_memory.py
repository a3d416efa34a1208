"""Memory of graphs of ONNX: by ports, by names, by the user, and never by shape alone."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from verifai_jax.addons.rl.policies import PolicyError, policy

RNG = np.random.default_rng(0)


def add(one, other, made):
    return helper.make_node("Add", [one, other], [made])


def saved(tmp_path, nodes, inputs, outputs, weights=()):
    values = [
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in each.items()]
        for each in (inputs, outputs)
    ]
    graph = helper.make_graph(nodes, "g", *values, list(weights))
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)]), tmp_path / "m.onnx"
    )
    return tmp_path / "m.onnx"


def pairs(file, **options):
    return dict(policy(file, **options).compute.memory)


def test_states_of_a_recurrent_node_by_their_ports_whatever_their_names_and_order(tmp_path):
    w, r = (RNG.normal(size=(1, 12, n)).astype(np.float32) for n in (2, 3))
    weights = [numpy_helper.from_array(w, "W"), numpy_helper.from_array(r, "R")]
    node = helper.make_node(
        "LSTM", ["x", "W", "R", "", "", "a", "b"], ["Y", "h", "c"], hidden_size=3
    )
    state = [1, 1, 3]
    file = saved(tmp_path, [node], {"b": state, "x": [1, 1, 2], "a": state},
                 {"Y": [1, *state], "c": state, "h": state}, weights)  # fmt: skip
    loaded = policy(file, output="Y")
    assert dict(loaded.compute.memory) == {"b": "c", "a": "h"}

    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    x, h, c, memory = np.float32([0.3, -2]), np.zeros(3), np.zeros(3), loaded.initial_memory
    for _ in range(3):
        i, o, f, g = np.split(w[0] @ x + r[0] @ h, 4)
        c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
        h = sigmoid(o) * np.tanh(c)
        action, memory = loaded.act(x[None], memory)
        np.testing.assert_allclose(np.ravel(action), h, rtol=1e-5)


@pytest.mark.parametrize(
    ("one", "after"),
    [("h_in", "h_out"), ("h0", "hn"), ("state", "next_state"), ("hiddenIn", "hiddenOut")],
)
def test_names_that_say_it(tmp_path, one, after):
    size = [1, 4]
    nodes = [add("obs", one, "action"), add("obs", "goal", after)]
    file = saved(tmp_path, nodes, {"obs": size, "goal": size, one: size},
                 {"action": size, after: size})  # fmt: skip
    assert pairs(file) == {one: after}


def test_equal_shapes_alone_are_a_question(tmp_path):
    size = [1, 4]
    nodes = [add("obs", "goal", "action"), add("obs", "goal", "feature")]
    file = saved(tmp_path, nodes, {"obs": size, "goal": size}, {"action": size, "feature": size})
    with pytest.raises(PolicyError, match=r"'goal' of .* may be an observation, or a memory whose"):
        policy(file)
    assert pairs(file, memory={}) == {}
    assert pairs(file, memory={"goal": "feature"}) == {"goal": "feature"}
    file = saved(tmp_path, [add("obs", "h_in", "action"), add("obs", "obs", "h_out")],
                 {"obs": size, "h_in": size}, {"action": size, "h_out": [1, 5]})  # fmt: skip
    with pytest.raises(PolicyError, match=r"'h_in' of .* has shape \[1, 4\], and its next value"):
        policy(file)


def test_a_tree_without_nodes_is_refused(tmp_path):
    node = helper.make_node("TreeEnsembleRegressor", ["x"], ["y"], domain="ai.onnx.ml")
    value = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, 2]) for n in "xy"]
    model = helper.make_model(
        helper.make_graph([node], "g", value[:1], value[1:]),
        opset_imports=[helper.make_opsetid("ai.onnx.ml", 3)],
    )
    onnx.save(model, tmp_path / "m.onnx")
    with pytest.raises(PolicyError, match=r"\(TreeEnsembleRegressor\) cannot be computed"):
        policy(tmp_path / "m.onnx").act(np.zeros(2))
