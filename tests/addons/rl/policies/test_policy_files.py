"""Files of other frameworks give what those gave: `tests/addons/rl/policies/make_fixtures.py`."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.rl.policies import policy

FILES = Path(__file__).parent / "files"
OPTIONS = {
    "ppo_normalised": {"normalise": FILES / "vec_normalize.pkl"},
    "mlp.safetensors": {"activation": "elu", "layers": ["0", "2", "4"]},
}


def expected(name):
    with np.load(FILES / f"{name}.expected.npz") as file:
        return file["observations"], file["actions"]


def check_agrees(loaded, observations, actions):
    got = jax.jit(jax.vmap(loaded.act))(observations)
    assert got.shape == actions.shape
    np.testing.assert_allclose(got, actions, rtol=1e-5, atol=2e-6)


SB3 = sorted(p.stem for p in FILES.glob("*.zip") if p.stem != "sac_sde")


@pytest.mark.thorough
@pytest.mark.parametrize("name", SB3)
def test_a_model_of_stable_baselines3(name):
    check_agrees(policy(FILES / f"{name}.zip", **OPTIONS.get(name, {})), *expected(name))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["mlp", "mlp_dynamo", "mixed", "cnn"])
def test_a_graph_of_onnx(name):
    loaded = policy(FILES / f"{name}.onnx")
    observations, actions = expected(name)
    check_agrees(loaded, observations, actions)
    one = loaded.act(observations[0])
    assert one.shape == actions[0].shape


@pytest.mark.parametrize("name", ["lstm", "gru"])
def test_a_recurrent_graph_remembers(name):
    loaded = policy(FILES / f"{name}.onnx")
    observations, actions = expected(name)
    for episode, wanted in zip(observations, actions, strict=True):

        def step(memory, observation):
            action, memory = loaded.act(observation, memory)
            return memory, action

        _, got = jax.lax.scan(step, loaded.initial_memory, jnp.asarray(episode))
        np.testing.assert_allclose(got, wanted, rtol=1e-5, atol=2e-6)
    with pytest.raises(TypeError, match="has a memory: act\\(observation, memory\\)"):
        loaded.act(observations[0, 0])
