import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.rl import (
    Continuous,
    Discrete,
    Policy,
    PolicyFileError,
    load_policy,
    policy_notes,
    policy_sources,
    save_policy,
)
from verifai_jax.addons.rl.policy import new_layers, scalar_network
from verifai_jax.core.messages.errors import UnknownNameError

LAYERS = (
    (jnp.array([[1.0, -1.0], [0.5, 2.0]]), jnp.array([0.1, -0.2])),
    (jnp.array([[1.0, 0.0], [0.0, 3.0]]), jnp.array([0.0, 1.0])),
)
SEEN = jnp.array([0.3, -0.4])


def by_hand(x):
    (w0, b0), (w1, b1) = [(np.asarray(w), np.asarray(b)) for w, b in LAYERS]
    return np.tanh(np.asarray(x) @ w0 + b0) @ w1 + b1


def test_network_by_hand():
    policy = Policy(LAYERS, None, None, None, Discrete(2))
    np.testing.assert_allclose(policy(SEEN), by_hand(SEEN), rtol=1e-6)
    assert int(policy.act(SEEN)) == int(np.argmax(by_hand(SEEN)))
    np.testing.assert_allclose(scalar_network(LAYERS, list(SEEN)), by_hand(SEEN), rtol=1e-6)


def test_observations_are_normalised():
    policy = Policy(LAYERS, jnp.array([1.0, 2.0]), jnp.array([2.0, 4.0]), None, Discrete(2))
    np.testing.assert_allclose(policy(SEEN), by_hand([-0.35, -0.6]), rtol=1e-6)


def test_continuous_actions_stay_in_their_range():
    policy = Policy(LAYERS, None, None, jnp.zeros(2), Continuous(-1.0, 3.0, size=2))
    expected = np.clip(1.0 + 2.0 * by_hand(SEEN), -1.0, 3.0)
    np.testing.assert_allclose(policy.act(SEEN), expected, rtol=1e-6)
    assert expected.min() == -1.0


def test_relu_between_the_layers():
    policy = Policy(LAYERS, None, None, None, Discrete(2), activation="relu")
    (w0, b0), (w1, b1) = [(np.asarray(w), np.asarray(b)) for w, b in LAYERS]
    expected = np.maximum(np.asarray(SEEN) @ w0 + b0, 0.0) @ w1 + b1
    np.testing.assert_allclose(policy(SEEN), expected, rtol=1e-6)
    np.testing.assert_allclose(scalar_network(LAYERS, list(SEEN), "relu"), expected, rtol=1e-6)


def test_squashed_outputs():
    policy = Policy(LAYERS, None, None, None, Continuous(-1.0, 3.0, size=2), squash=True)
    np.testing.assert_allclose(policy(SEEN), np.tanh(by_hand(SEEN)), rtol=1e-6)
    np.testing.assert_allclose(policy.act(SEEN), 1 + 2 * np.tanh(by_hand(SEEN)), rtol=1e-6)


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_units_without_weights_change_nothing(activation):
    (w0, b0), (w1, b1) = LAYERS
    wider = (
        (jnp.pad(w0, ((0, 0), (0, 3))), jnp.pad(b0, (0, 3))),
        (jnp.pad(w1, ((0, 3), (0, 0))), b1),
    )
    narrow, wide = (
        Policy(layers, None, None, None, Discrete(2), activation) for layers in (LAYERS, wider)
    )
    np.testing.assert_array_equal(wide(SEEN), narrow(SEEN))


def test_what_a_policy_cannot_be():
    with pytest.raises(UnknownNameError, match="unknown activation 'relo'; did you mean 'relu'"):
        Policy(LAYERS, None, None, None, Discrete(2), activation="relo")
    with pytest.raises(ValueError, match=r"only continuous actions.*Discrete\(n=2\)"):
        Policy(LAYERS, None, None, None, Discrete(2), squash=True)


@pytest.mark.parametrize(
    "policy",
    [
        Policy(LAYERS, None, None, None, Discrete(2)),
        Policy(LAYERS, None, None, None, Continuous(-1.0, 3.0, size=2), "relu", squash=True),
        Policy(LAYERS, jnp.ones(2), jnp.ones(2) * 2, jnp.zeros(2), Continuous(-1.0, 3.0, size=2)),
    ],
)
def test_file_gives_back_what_went_in(tmp_path, policy):
    path = tmp_path / "policy.npz"
    save_policy(policy, path, seed=3, task="hold")
    loaded = load_policy(path)
    assert loaded.action == policy.action
    assert jax.tree.structure(loaded) == jax.tree.structure(policy)
    for a, b in zip(jax.tree.leaves(loaded), jax.tree.leaves(policy), strict=True):
        np.testing.assert_array_equal(a, b)
    assert policy_notes(path) == {"seed": 3, "task": "hold"}


def test_files_of_before_activations_still_load(tmp_path):
    about = {"action": {"kind": "discrete", "n": 2}, "notes": {}}
    arrays = {
        f"{name}{i}": part
        for i, pair in enumerate(LAYERS)
        for name, part in zip(("weight", "bias"), pair, strict=True)
    }
    np.savez(tmp_path / "old.npz", about=np.array(json.dumps(about)), **arrays)
    old = load_policy(tmp_path / "old.npz")
    assert (old.activation, old.squash) == ("tanh", False)
    np.testing.assert_allclose(old(SEEN), by_hand(SEEN), rtol=1e-6)


def test_files_of_another_kind_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path / "none.npz")
    other = tmp_path / "other.npz"
    np.savez(other, weight0=np.zeros((2, 2)))
    with pytest.raises(PolicyFileError, match=r"other\.npz holds no policy"):
        load_policy(other)
    text = tmp_path / "text.npz"
    text.write_text("hello")
    with pytest.raises(PolicyFileError, match=r"text\.npz holds no policy"):
        load_policy(text)
    code = tmp_path / "code.npz"
    np.savez(code, about=np.array({"action": print}, dtype=object))
    with pytest.raises(PolicyFileError, match=r"code\.npz holds no policy"):
        load_policy(code)
    newer = tmp_path / "newer.npz"
    about = {"action": {"kind": "discrete", "n": 2}, "activation": "swish"}
    np.savez(newer, about=np.array(json.dumps(about)), weight0=np.eye(2), bias0=np.zeros(2))
    with pytest.raises(PolicyFileError, match=r"newer\.npz holds no policy: unknown activation"):
        load_policy(newer)
    torn = tmp_path / "torn.npz"
    layers = (LAYERS[0], (jnp.zeros((3, 2)), jnp.zeros(2)))
    save_policy(Policy(layers, None, None, None, Discrete(2)), torn)
    with pytest.raises(PolicyFileError, match=r"array 'weight1' has shape \[3, 2\]"):
        load_policy(torn)


@pytest.mark.thorough
def test_new_layers_are_orthogonal_with_their_gains():
    layers = new_layers(jax.random.key(0), (4, 16, 2), gain=0.01)
    first, last = np.asarray(layers[0][0]), np.asarray(layers[1][0])
    np.testing.assert_allclose(first @ first.T, 2 * np.eye(4), atol=1e-5)
    np.testing.assert_allclose(last.T @ last, 1e-4 * np.eye(2), atol=1e-7)
    assert all(np.all(np.asarray(bias) == 0) for _, bias in layers)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Discrete(1), r"at least 2 choices; got \(n=1\)"),
        (lambda: Continuous(1.0, 1.0), r"needs low < high.*got \(low=1.0, high=1.0, size=1\)"),
        (lambda: Continuous(0.0, 1.0, size=0), r"size=0"),
    ],
)
def test_actions_that_make_no_sense_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_file_says_what_it_was_made_with(tmp_path):
    path = tmp_path / "policy.npz"
    save_policy(Policy(LAYERS, None, None, None, Discrete(2)), path)
    sources = policy_sources(path)
    assert any(name.endswith("test_policy.py") for name, *_ in sources["files"])
    assert "jax" in sources["versions"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"weight1": None}, "'weight1' is missing"),
        ({"weight1": None, "bias1": None, "n": 3}, "its network has 2 outputs, and .* need 3"),
        ({"weight0": np.full((2, 2), np.nan)}, "'weight0' must hold finite floating-point"),
        ({"weight0": np.array([["a"]])}, "'weight0' must hold finite floating-point"),
        ({"bias0": np.zeros(0)}, r"'bias0' must have shape \[2\]; got \[0\]"),
        ({"bias1": np.zeros((2, 1))}, r"'bias1' must have shape \[2\]; got \[2, 1\]"),
        ({"weight0": np.zeros(2)}, r"'weight0' has shape \[2\]"),
        ({"n": 10}, "its network has 2 outputs, and its actions need 10"),
        ({"n": "two"}, "the number n of its actions must be an integer"),
        ({"n": 2.5}, "the number n of its actions must be an integer"),
        ({"mean": np.zeros(3), "scale": np.ones(3)}, r"'mean' must have shape \[2\]; got \[3\]"),
        ({"mean": np.zeros(2)}, "it has only one of the arrays 'mean' and 'scale'"),
        ({"mean": np.zeros(2), "scale": np.zeros(2)}, "'scale' must hold positive numbers"),
        ({"weight7": np.zeros((2, 2))}, "it has an array 'weight7', which belongs to no layer"),
        ({"squash": "yes"}, "its activation must be a text and squash true or false"),
        ({"activation": 7}, "its activation must be a text"),
        ({"action": None}, "its action must be an object of kind discrete or continuous"),
        (
            {"action": {"kind": "continuous", "low": 0.0, "high": float("inf"), "size": 2}},
            "high of its action must be a finite",
        ),
        (
            {"action": {"kind": "discrete", "n": 2, "size": 3}},
            "its action must have n; got n, size",
        ),
    ],
)
def test_a_damaged_policy_is_named_at_load(tmp_path, changed, told):
    path = tmp_path / "policy.npz"
    save_policy(Policy(LAYERS, None, None, None, Discrete(2)), path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    about = json.loads(str(arrays.pop("about")))
    for name, value in changed.items():
        if name == "n":
            about["action"]["n"] = value
        elif name in ("squash", "activation", "action"):
            about[name] = value
        elif value is None:
            del arrays[name]
        else:
            arrays[name] = value
    np.savez(path, about=np.array(json.dumps(about)), **arrays)
    with pytest.raises(PolicyFileError, match=rf"policy\.npz holds no policy: .*({told})"):
        load_policy(path)
