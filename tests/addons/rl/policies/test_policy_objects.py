"""Models and functions of other frameworks as policies, in the systems that take one."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen

import verifai_jax as vj
from verifai_jax.addons.rl.policies import Policy, PolicyError, policy

FILES = Path(__file__).parent / "files"


class Actor(linen.Module):
    @linen.compact
    def __call__(self, x):
        return linen.Dense(2)(jnp.tanh(linen.Dense(5)(x)))


def check_same(loaded, function, size=3):
    for seed in range(3):
        observation = jax.random.normal(jax.random.key(seed), (size,))
        np.testing.assert_allclose(loaded.act(observation), function(observation), rtol=1e-6)


def test_flax():
    module = Actor()
    variables = module.init(jax.random.key(0), jnp.zeros(3))
    loaded = policy((module, variables))
    check_same(loaded, lambda x: module.apply(variables, x))
    assert len(jax.tree.leaves(loaded)) == 4


def test_flax_nnx():
    try:
        from flax import nnx
    except AttributeError as error:  # flax 0.12.8 asks JAX 0.12 for a name that is gone
        pytest.skip(f"this flax cannot be imported with this JAX: {error}")
    made = nnx.Linear(3, 2, rngs=nnx.Rngs(0))
    check_same(policy(made), made)


@pytest.mark.thorough
def test_equinox():
    equinox = pytest.importorskip("equinox")
    mlp = equinox.nn.MLP(3, 2, 4, 1, key=jax.random.key(1))
    check_same(policy(mlp), mlp)


def test_a_function_traced_or_on_the_host(caplog):
    check_same(policy(lambda x: 2 * x), lambda x: 2 * x)
    assert not caplog.records

    def on_host(x):
        return np.float32([float(x[0]) + 1.0])

    loaded = policy(on_host)
    batch = np.arange(6, dtype=np.float32).reshape(3, 2)
    np.testing.assert_allclose(jax.jit(jax.vmap(loaded.act))(batch), batch[:, :1] + 1)
    assert "runs in Python" in caplog.text
    assert "test_policy_objects.py" in caplog.text


def test_a_function_of_brax_draws_with_the_key_of_the_step():
    def infer(observation, key):
        return observation + jax.random.normal(key), {"log_prob": 0.0}

    key = jax.random.key(3)
    np.testing.assert_allclose(policy(infer).act(jnp.ones(2), key), infer(jnp.ones(2), key)[0])


def test_the_meaning_of_outputs_is_stated():
    loaded = policy(lambda x: x, action="tanh", low=(-1, -1), high=(3, 5))
    np.testing.assert_allclose(loaded.act(jnp.array([0.0, 100.0])), [1.0, 5.0])
    loaded = policy(lambda x: x, action="scale", low=-2, high=4)
    np.testing.assert_allclose(loaded.act(jnp.array([0.5])), [2.5])
    assert policy(lambda x: x, action="argmax").act(jnp.array([1.0, 3.0, 2.0])) == 1
    with pytest.raises(PolicyError, match="needs low= and high= of one size"):
        policy(lambda x: x, action="tanh", low=-1)
    with pytest.raises(ValueError, match="did you mean 'argmax'"):
        policy(lambda x: x, action="argmx")


def test_observations_are_scaled_clipped_and_stacked():
    normalise = (np.array([1.0, 2.0]), np.array([2.0, 4.0]))
    loaded = policy(lambda x: x, normalise=normalise)
    np.testing.assert_allclose(loaded.act(jnp.array([3.0, 6.0])), [1.0, 1.0])
    stacked = policy(lambda x: x, stack=3, observation=np.zeros(2))
    memory = stacked.initial_memory
    for k in range(4):
        seen, memory = stacked.act(jnp.full(2, 1.0 + k), memory)
    np.testing.assert_allclose(seen, [2, 2, 3, 3, 4, 4])


@pytest.mark.slow
def test_weights_are_a_pytree_with_gradients_and_in_double_precision():
    loaded = policy(FILES / "ppo.zip")
    observation = jnp.array([0.1, 0.2, -0.3, 0.4])
    gradient = jax.grad(lambda p: jnp.sum(p(observation)))(loaded)
    assert any(np.any(np.asarray(leaf) != 0) for leaf in jax.tree.leaves(gradient))
    with jax.enable_x64(True):
        action = loaded.act(np.asarray(observation, np.float64))
        assert action.dtype == np.float64
    np.testing.assert_allclose(action, loaded.act(observation), rtol=1e-5)
    scaled = replace(loaded, weights=jax.tree.map(lambda w: 0 * w, loaded.weights))
    np.testing.assert_allclose(scaled.act(observation), [0.0, 0.0], atol=1e-6)


@pytest.mark.slow
def test_it_controls_a_system_and_is_falsified():
    actor = policy(FILES / "ppo.zip")

    def plant(time, state, control, features):
        return {"x": state["v"], "v": control[0] + features["wind"]}

    def controller(time, state, features):
        zero = jnp.zeros(())
        return actor.act(jnp.stack([state["x"], state["v"], zero, features["wind"]]))

    problem = vj.Problem(
        "follow",
        {"x0": vj.Box(-1.0, 1.0), "wind": vj.Box(-0.5, 0.5)},
        vj.ode(
            plant,
            lambda features, key: {"x": features["x0"], "v": jnp.zeros(())},
            controller=controller,
            dt=0.1,
            steps=20,
        ),
        "always abs(x) < 1.2",
    )
    run = vj.falsify(problem, "gradient", 64, progress=False)
    assert len(run.table.all) == 64
    assert run.table.counterexamples["verdict"].notna().all()


@pytest.mark.slow
def test_a_recurrent_one_is_reset_with_the_episode():
    gymnasium = pytest.importorskip("gymnasium")
    actor = policy(FILES / "lstm.onnx", action="clip", low=(-1, -1), high=(1, 1))

    class Echo(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-9, 9, (3,), np.float32)
        action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
        start = 0.0

        def reset(self, *, seed=None, options=None):
            return np.full(3, self.start, np.float32), {}

        def step(self, action):
            return np.full(3, self.start + action[0], np.float32), 0.0, False, False, {}

    system = vj.gymnasium(Echo, actor, steps=5, features={"start": "start"}, dt=1.0)
    first, second, again = (system({"start": v}, 0)["action"] for v in (0.5, -2.0, 0.5))
    np.testing.assert_array_equal(first, again)
    memory, observation, expected = actor.initial_memory, np.full(3, 0.5, np.float32), []
    for _ in range(6):
        action, memory = actor.act(observation, memory)
        expected.append(action)
        observation = np.full(3, 0.5 + action[0], np.float32)
    np.testing.assert_allclose(first, expected, rtol=1e-5)
    assert not np.allclose(first, second)


def test_own_policies_and_refusals():
    assert isinstance(policy(Policy((), lambda w, o, m: (o, m))), Policy)
    with pytest.raises(PolicyError, match="a policy is a file, a model or a function"):
        policy(3)
    with pytest.raises(PolicyError, match="stack= needs observation="):
        policy(lambda x: x, stack=2)


@pytest.mark.slow
def test_a_checkpoint_of_brax_with_its_normaliser(tmp_path):
    checkpoint = pytest.importorskip("brax.training.agents.ppo.checkpoint")
    from brax.training.acme import running_statistics, specs
    from brax.training.agents.ppo import networks

    make = partial(networks.make_ppo_networks, policy_hidden_layer_sizes=(8, 8))
    made = make(5, 2, preprocess_observations_fn=running_statistics.normalize)
    scale = running_statistics.init_state(specs.Array((5,), np.dtype("float32")))
    scale = scale.replace(mean=jnp.arange(5.0), std=1 + jnp.arange(5.0))
    key = jax.random.key(0)
    weights = (scale, made.policy_network.init(key), made.value_network.init(key))
    config = checkpoint.network_config(5, 2, True, make)
    checkpoint.save(tmp_path, 7, weights, config)
    loaded = policy(tmp_path / "000000000007")
    infer = networks.make_inference_fn(made)(weights, deterministic=True)
    check_same(loaded, lambda x: infer(x, key)[0], size=5)
    (tmp_path / "000000000007" / "ppo_network_config.json").write_text("{}")
    with pytest.raises(PolicyError, match="holds no checkpoint of Brax' PPO"):
        policy(tmp_path / "000000000007")
