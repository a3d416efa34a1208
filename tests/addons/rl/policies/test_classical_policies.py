"""Trees, linear models, quantised networks and RecurrentPPO give what their own tools give."""

import base64
import io
import pickle
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import pytest
from onnx import helper
from test_checkpoints import rewritten
from test_policy_files import check_agrees, expected

from verifai_jax.addons.rl.policies import PolicyError, policy

FILES = Path(__file__).parent / "files"
OUTPUTS = {
    "trees": None, "boosted": "probabilities", "forest": None, "logistic": "probabilities",
    "linear": None, "quantised_dynamic": None, "quantised_pairs": None, "quantised_matmul": None,
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "output"), OUTPUTS.items())
def test_a_file_of_scikit_learn_or_of_the_quantiser(name, output):
    check_agrees(policy(FILES / f"{name}.onnx", output=output), *expected(name))


def tree(tmp_path, **changes):
    """A tree of one condition on `x[1]`, as a file."""
    attributes = {
        "nodes_treeids": [0, 0, 0], "nodes_nodeids": [0, 1, 2], "nodes_featureids": [1, 0, 0],
        "nodes_values": [0.5, 0.0, 0.0], "nodes_modes": ["BRANCH_LEQ", "LEAF", "LEAF"],
        "nodes_truenodeids": [1, 0, 0], "nodes_falsenodeids": [2, 0, 0], "n_targets": 1,
        "nodes_missing_value_tracks_true": [1, 0, 0], "base_values": [10.0],
        "target_treeids": [0, 0], "target_nodeids": [1, 2], "target_ids": [0, 0],
        "target_weights": [1.0, 2.0],
    } | changes  # fmt: skip
    node = helper.make_node("TreeEnsembleRegressor", ["x"], ["y"], "t", domain="ai.onnx.ml",
                            **attributes)  # fmt: skip
    ends = [[helper.make_tensor_value_info(n, 1, [1, k])] for n, k in (("x", 2), ("y", 1))]
    made = helper.make_model(helper.make_graph([node], "g", *ends),
                             opset_imports=[helper.make_opsetid("ai.onnx.ml", 3)])  # fmt: skip
    onnx.save(made, tmp_path / "tree.onnx")
    return policy(tmp_path / "tree.onnx")


@pytest.mark.thorough
@pytest.mark.parametrize(("mode", "wanted"), [
    ("BRANCH_LEQ", [1, 1, 2, 1]), ("BRANCH_LT", [1, 2, 2, 1]), ("BRANCH_GTE", [2, 1, 1, 1]),
    ("BRANCH_GT", [2, 2, 1, 1]), ("BRANCH_EQ", [2, 1, 2, 1]), ("BRANCH_NEQ", [1, 2, 1, 1]),
])  # fmt: skip
def test_conditions_of_trees(tmp_path, mode, wanted):
    """A missing value goes where it is told to: here to the true branch."""
    loaded = tree(tmp_path, nodes_modes=[mode, "LEAF", "LEAF"])
    x = jnp.array([[0, 0.4], [0, 0.5], [0, 0.6], [0, jnp.nan]])
    np.testing.assert_array_equal(jax.vmap(loaded.act)(x)[:, 0] - 10, wanted)


@pytest.mark.parametrize(("changes", "why"), [
    ({"nodes_truenodeids": [0, 0, 0]}, "leads back to itself"),
    ({"nodes_truenodeids": [7, 0, 0]}, "a branch to a node that is not there"),
    ({"nodes_featureids": [2, 0, 0]}, "a feature beyond the 2 of an observation"),
    ({"nodes_modes": ["BRANCH_MEMBER", "LEAF", "LEAF"]}, "nodes of the kind .'BRANCH_MEMBER'."),
    ({"nodes_nodeids": [0, 1, 1]}, "two nodes of one number"),
    ({"target_ids": [0, 9]}, "a weight of no target"),
    ({"n_targets": 10**9, "target_ids": [0, 9]}, "may compute at most"),
    ({"post_transform": "PROBIT"}, "post_transform='PROBIT'"),
])  # fmt: skip
def test_damaged_trees_are_named(tmp_path, changes, why):
    with pytest.raises(PolicyError, match=why):
        tree(tmp_path, **changes).act(jnp.zeros(2))


def test_operators_of_other_vendors_are_named(tmp_path):
    node = helper.make_node("QLinearAdd", ["x", "x"], ["y"], "add", domain="com.microsoft")
    ends = [[helper.make_tensor_value_info(n, 1, [1, 2])] for n in ("x", "y")]
    imports = [helper.make_opsetid("", 17), helper.make_opsetid("com.microsoft", 1)]
    made = helper.make_model(helper.make_graph([node], "g", *ends), opset_imports=imports)
    onnx.save(made, tmp_path / "it.onnx")
    with pytest.raises(
        PolicyError, match=r"uses QLinearAdd of com\.microsoft, which is not support"
    ):
        policy(tmp_path / "it.onnx")


def recurrent(tmp_path, layers=2, kind=b"csb3_contrib.policies\nRecurrentActorCriticPolicy\n."):
    """Copy a model of PPO with an LSTM before its layers, and return its tensors."""
    rng, tensors, size = np.random.default_rng(0), {}, 4
    for layer in range(layers):
        for name, shape in (("weight_ih", (20, size)), ("weight_hh", (20, 5)), ("bias_ih", 20),
                            ("bias_hh", 20)):  # fmt: skip
            for of in ("lstm_actor", "lstm_critic"):
                tensors[f"{of}.{name}_l{layer}"] = rng.normal(size=shape).astype(np.float32)
        size = 5
    for name, shape in (("mlp_extractor.policy_net.0", (6, size)), ("action_net", (2, 6)),
                        ("value_net", (1, 6))):  # fmt: skip
        tensors[f"{name}.weight"] = rng.normal(size=shape).astype(np.float32)
        tensors[f"{name}.bias"] = rng.normal(size=shape[0]).astype(np.float32)

    def change(settings):
        settings["policy_class"] = {":serialized:": base64.b64encode(kind).decode()}

    path, made = rewritten(tmp_path, "ppo.zip", change), io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("policy/data.pkl", pickle.dumps(tensors))
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in {**members, "policy.pth": made.getvalue()}.items():
            archive.writestr(name, data)
    return path, tensors


@pytest.mark.parametrize("layers", [1, 2])
def test_recurrent_ppo_remembers(tmp_path, layers):
    """ONNX's own evaluator computes the LSTM, whose gates are in another order than PyTorch's."""
    from onnx.reference import ReferenceEvaluator

    path, tensors = recurrent(tmp_path, layers)
    loaded = policy(path)
    seen = np.random.default_rng(1).normal(size=(7, 4)).astype(np.float32)
    x = seen[:, None]
    order = np.r_[0:5, 15:20, 5:15]  # i, o, f, c of ONNX among i, f, c, o of PyTorch
    for layer in range(layers):
        w, r, b1, b2 = (tensors[f"lstm_actor.{n}_l{layer}"][order][None]
                        for n in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"))  # fmt: skip
        node = helper.make_node("LSTM", ["x", "w", "r", "b"], ["y"], hidden_size=5)
        names = [helper.make_tensor_value_info(n, 1, None) for n in "xwrb"]
        graph = helper.make_graph([node], "g", names, [helper.make_tensor_value_info("y", 1, None)])
        run = ReferenceEvaluator(helper.make_model(graph)).run
        given = {"x": x, "w": w, "r": r, "b": np.concatenate([b1, b2], 1)}
        x = np.asarray(run(None, given)[0])[:, 0]
    hidden = np.tanh(x[:, 0] @ tensors["mlp_extractor.policy_net.0.weight"].T
                     + tensors["mlp_extractor.policy_net.0.bias"])  # fmt: skip
    wanted = hidden @ tensors["action_net.weight"].T + tensors["action_net.bias"]
    memory = loaded.initial_memory
    for observation, mean in zip(seen, wanted, strict=True):
        action, memory = loaded.act(jnp.asarray(observation), memory)
        clipped = np.clip(mean, [-2, -1], [2, 3])  # The bounds of the space in ppo.zip.
        np.testing.assert_allclose(action, clipped, rtol=1e-5, atol=1e-5)


def test_a_class_that_does_not_fit_its_tensors(tmp_path):
    path, _ = recurrent(tmp_path, kind=b"cstable_baselines3.common.policies\nActorCriticPolicy\n.")
    with pytest.raises(PolicyError, match="ActorCriticPolicy, but other tensors"):
        policy(path)
