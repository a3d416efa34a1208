from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.rl import PPO, Discrete
from verifai_jax.addons.rl.on_policy import minibatch_network
from verifai_jax.addons.rl.policy import network, new_layers
from verifai_jax.addons.rl.ppo import collect, values

SMALL = PPO(hidden=(4,), value_hidden=(4,), environments=3, horizon=7, normalise=True)


@dataclass(frozen=True)
class Drift:
    """Walks at random, and is over for good beyond 2."""

    time_limit: int

    @property
    def action(self):
        return Discrete(2)

    def reset(self, key):
        return jax.random.normal(key)

    def step(self, key, state, action):
        after = state + jax.random.normal(key)
        return after, jnp.float32(1), jnp.abs(after) > 2

    def observe(self, state):
        return jnp.stack([state, state**2])


@pytest.mark.parametrize("limit", [1, 3, 7, 50, np.int64(3)])
def test_next_value_is_that_of_the_state_before_any_reset(limit):
    task = Drift(limit)

    @jax.jit
    def both(key):
        state = SMALL.init(task, key, 1)
        _, seen = collect(SMALL, task, state, key)
        value, next_value = values(SMALL, task, state, seen.transition, seen.observation)
        led_to = seen.transition.next_observation
        wanted = (network(state.weights.critic, one)[..., 0] for one in (seen.observation, led_to))
        return value, next_value, *wanted, seen.transition.ends

    ended = 0
    for seed in range(5):
        value, next_value, wanted, next_wanted, ends = both(jax.random.key(seed))
        np.testing.assert_allclose(value, wanted, rtol=1e-5, atol=1e-6)
        lives = ~np.asarray(ends.terminated)
        np.testing.assert_allclose(next_value[lives], next_wanted[lives], rtol=1e-5, atol=1e-6)
        ended += np.sum(lives & np.asarray(ends.truncated))
    assert ended > 0 or limit == 50


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_network_of_minibatches_has_the_gradients_of_the_network(activation):
    layers = new_layers(jax.random.key(0), (3, 5, 5, 2), gain=1.0)
    rows, aim = jax.random.normal(jax.random.key(1), (2, 6, 3))

    def error(evaluate):
        def of(layers, rows):
            return jnp.sum(jnp.square(evaluate(layers, rows, activation) - aim[:, :2]))

        return jax.value_and_grad(of, argnums=(0, 1))(layers, rows)

    found, wanted = jax.jit(lambda: (error(minibatch_network), error(network)))()
    for one, other in zip(*map(jax.tree.leaves, (found, wanted)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)
