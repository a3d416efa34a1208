"""What is saved and loaded again gives the same actions, and damaged files are refused."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen

import verifai_jax as vj
from verifai_jax.addons.rl.policies import PolicyError, policy

FILES = Path(__file__).parent / "files"
ENDINGS = (".npz", ".onnx", ".safetensors")


def check_again(loaded, tmp_path, observations, ending, **options):
    again = policy(loaded.save(tmp_path / f"saved{ending}", **options))
    for observation in observations:
        if loaded.initial_memory is None:
            one, other = loaded.act(observation), again.act(observation)
        else:
            (one, m), (other, n) = (p.act(observation, p.initial_memory) for p in (loaded, again))
            (one, _), (other, _) = loaded.act(observation, m), again.act(observation, n)
        np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-6)
        assert np.shape(one) == np.shape(other)
    return again


def observations_of(name):
    with np.load(FILES / f"{name}.expected.npz") as file:
        return file["observations"][:4]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ending"),
    [
        ("ppo.zip", ".npz"),
        ("ppo_categories.zip", ".onnx"),
        ("ppo_binary.zip", ".safetensors"),
        ("sac.zip", ".onnx"),
        ("mixed.onnx", ".npz"),
        pytest.param("cnn.onnx", ".onnx", marks=pytest.mark.thorough),
    ],
)
def test_a_file_that_is_saved_again(name, ending, tmp_path):
    check_again(policy(FILES / name), tmp_path, observations_of(name.partition(".")[0]), ending)


@pytest.mark.thorough
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_recurrent_one_that_is_saved_again(ending, tmp_path):
    loaded = policy(FILES / "gru.onnx")
    again = check_again(loaded, tmp_path, observations_of("gru")[0], ending)
    assert [m.shape for m in again.initial_memory] == [m.shape for m in loaded.initial_memory]


def test_scale_stack_and_bounds_are_saved(tmp_path):
    loaded = policy(
        FILES / "mlp.safetensors",
        activation="elu",
        normalise=(np.arange(6.0), 1 + np.arange(6.0)),
        action="tanh",
        low=(-1, 0),
        high=(2, 1),
        stack=3,
        observation=np.zeros(2),
    )
    again = check_again(loaded, tmp_path, np.eye(2, dtype=np.float32), ".npz")
    _, memory = again.act(np.ones(2, np.float32), again.initial_memory)
    np.testing.assert_array_equal(memory[0], [0, 0, 0, 0, 1, 1])


class Image(linen.Module):
    @linen.compact
    def __call__(self, x):
        x = linen.relu(linen.Conv(3, (3, 3), padding="SAME")(x[None]))
        x = linen.avg_pool(linen.max_pool(x, (2, 2), (2, 2)), (2, 2))
        x = linen.LayerNorm()(x.reshape(1, -1))
        return linen.softmax(linen.Dense(3)(linen.gelu(x)))[0]


@pytest.mark.slow
def test_a_model_of_flax_is_saved(tmp_path):
    module = Image()
    image = jax.random.normal(jax.random.key(0), (8, 8, 2))
    loaded = policy((module, module.init(jax.random.key(1), image)))
    with pytest.raises(
        PolicyError, match="does not define its input: give an example, observation="
    ):
        loaded.save(tmp_path / "a.npz")
    check_again(loaded, tmp_path, [image], ".onnx", observation=image)


def test_a_loop_over_time_is_written_out(tmp_path):
    def attend(x):
        def step(carry, row):
            carry = 0.5 * carry + jnp.where(row > 0, row, 0.1 * row)
            return carry, carry[0] ** 3

        last, heads = jax.lax.scan(step, jnp.zeros(2), x.reshape(3, 2), reverse=True)
        return jnp.concatenate([last, heads, jnp.log1p(jnp.abs(x[1:3])), jnp.max(x)[None]])

    observation = np.linspace(-1, 1, 6, dtype=np.float32)
    check_again(policy(attend), tmp_path, [observation], ".npz", observation=observation)


def test_an_own_policy_is_saved(tmp_path):
    layers = tuple(
        (np.float32(np.random.default_rng(i).normal(size=s)), np.ones(s[1], np.float32))
        for i, s in enumerate([(3, 5), (5, 2)])
    )
    own = vj.rl.Policy(layers, None, None, None, vj.rl.Continuous(-2.0, 3.0, 2))
    for ending in ENDINGS:
        again = policy(own.save(tmp_path / f"own{ending}"))
        observation = np.float32([0.1, -0.3, 0.7])
        np.testing.assert_allclose(again.act(observation), own.act(observation), rtol=1e-6)


def test_policies_of_one_form_are_of_one_structure(tmp_path):
    one = policy(policy(FILES / "ppo.zip").save(tmp_path / "one.npz"))
    other = policy(policy(FILES / "ppo_normalised.zip").save(tmp_path / "other.npz"))
    assert jax.tree.structure(one) == jax.tree.structure(other)
    third = policy(policy(FILES / "ppo_relu.zip").save(tmp_path / "third.npz"))
    assert jax.tree.structure(one) != jax.tree.structure(third)


def test_what_cannot_be_saved_or_was_damaged(tmp_path):
    loaded = policy(FILES / "ppo.zip")
    with pytest.raises(PolicyError, match=r"saved as \.onnx, \.safetensors, \.npz; got 'p\.pkl'"):
        loaded.save(tmp_path / "p.pkl")
    with pytest.raises(PolicyError, match="computes sort, which cannot be saved"):
        policy(jnp.sort).save(tmp_path / "p.npz", np.zeros(3))
    with pytest.raises(PolicyError, match="a random policy cannot be saved"):
        policy(lambda observation, key: observation).save(tmp_path / "p.npz", np.zeros(3))
    with pytest.raises(PolicyError, match="computes pure_callback"):
        policy(lambda x: np.float32([float(x[0])])).save(tmp_path / "p.npz", np.zeros(3))
    file = loaded.save(tmp_path / "p.npz")
    with np.load(file) as arrays:
        held = dict(arrays)
    about = json.loads(str(held["about"]))
    for change, message in (
        (lambda g: g["nodes"][0].__setitem__(0, "System"), "uses System, which is not supported"),
        (lambda g: g["nodes"].reverse(), "which no node before it computes"),
        (lambda g: g.pop("inputs"), "its graph is not valid"),
    ):
        broken = json.loads(json.dumps(about))
        change(broken["graph"])
        np.savez(file, **{**held, "about": np.array(json.dumps(broken))})
        with pytest.raises(PolicyError, match=message):
            policy(file)
    held["weights.0.0.0"] = np.full_like(held["weights.0.0.0"], np.nan)
    np.savez(file, **held)
    with pytest.raises(PolicyError, match=r"the array 'weights\.0\.0\.0' of .* holds NaN"):
        policy(file)
