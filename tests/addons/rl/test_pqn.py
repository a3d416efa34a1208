from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.rl import Continuous, Discrete, evaluate, train
from verifai_jax.addons.rl.advantage import Ends, advantages
from verifai_jax.addons.rl.algorithm import Algorithm
from verifai_jax.addons.rl.pqn import PQN, exploration_chances, next_held, q_lambda_targets

NONE = jnp.zeros(3, bool)
SMALL = PQN(hidden=(16,), environments=8, horizon=16, minibatches=4)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Corridor:
    """Five cells; the end pays 1, each step costs 0.1, so from cell 0 the best is 0.7."""

    end: float = 4.0
    each: float = -0.1
    time_limit: int = field(default=20, metadata={"static": True})

    @property
    def action(self):
        return Discrete(2)

    def reset(self, key):
        return jnp.float32(0.0)

    def step(self, key, state, action):
        state = jnp.clip(state + jnp.where(action == 1, 1.0, -1.0), 0.0, 4.0)
        over = state >= self.end
        return state, jnp.where(over, 1.0, self.each), over

    def observe(self, state):
        return jnp.stack([state - 2.0, 1.0])


def targets(terminated=NONE, truncated=NONE, q_lambda=0.5):
    return np.asarray(
        q_lambda_targets(
            reward=jnp.array([1.0, 2.0, 3.0]),
            next_value=jnp.array([20.0, 30.0, 40.0]),
            ends=Ends(terminated, truncated),
            discount=0.5,
            q_lambda=q_lambda,
        )
    )


# By hand: G_t = r_t + 0.5 (0.5 v_{t+1} + 0.5 G_{t+1}), and the last looks one step ahead.


def test_targets_going_on():
    last = 3 + 0.5 * 40
    middle = 2 + 0.5 * (0.5 * 30 + 0.5 * last)
    np.testing.assert_allclose(targets(), [1 + 0.5 * (0.5 * 20 + 0.5 * middle), middle, last])


def test_targets_where_an_episode_ends():
    second = jnp.array([False, True, False])
    np.testing.assert_allclose(targets(terminated=second)[:2], [1 + 0.5 * (10 + 0.5 * 2), 2])
    np.testing.assert_allclose(targets(truncated=second)[:2], [1 + 0.5 * (10 + 0.5 * 17), 17])
    np.testing.assert_allclose(targets(second, second), targets(terminated=second))


def test_targets_are_values_plus_advantages_of_the_greedy_policy():
    # Where each action was the best, Q(lambda) is TD(lambda): the other implementation's answer.
    value = jnp.array([5.0, 20.0, 30.0])
    next_value = jnp.array([20.0, 30.0, 40.0])
    ends = Ends(NONE, jnp.array([False, False, True]))
    arguments = (jnp.array([1.0, 2.0, 3.0]), value, next_value, ends, 0.9, 0.7)
    got = q_lambda_targets(arguments[0], next_value, ends, 0.9, 0.7)
    np.testing.assert_allclose(got, advantages(*arguments) + value, rtol=1e-6)


def test_exploration_takes_its_part_of_the_steps_and_holds_on():
    pqn = PQN(epsilon_start=0.3, epsilon_end=0.3, hold=5.0)
    keep, start = exploration_chances(pqn, done=3, updates=10)

    def step(held, drawn):
        held = next_held(held, *drawn, keep, start)
        return held, held

    draws = np.random.default_rng(0)
    chance = jnp.asarray(draws.random((4000, 50)), jnp.float32)
    option = jnp.asarray(draws.integers(0, 1000, (4000, 50)))
    _, held = jax.lax.scan(step, jnp.full(50, -1), (chance, option))
    held = np.asarray(held)
    assert np.mean(held >= 0) == pytest.approx(0.3, abs=0.01)
    exploring = held[:-1] >= 0
    new = exploring & (held[1:] != held[:-1])
    assert np.sum(exploring) / np.sum(new) == pytest.approx(5.0, rel=0.05)


@pytest.mark.proves
def test_learns_the_corridor_and_the_same_from_the_same_seed():
    trained, again = (train(Corridor(), SMALL, seed=0, steps=8_000) for _ in range(2))
    np.testing.assert_allclose(evaluate(Corridor(), trained.policy, episodes=3), 0.7, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(trained.policy), jax.tree.leaves(again.policy), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.nanmean(trained.mean_return[-5:]) > np.nanmean(trained.mean_return[:5])


@pytest.mark.slow
def test_cut_off_is_not_terminated():
    # Of a reward of 1 for ever the value is 1 / (1 - 0.95) = 20, though episodes last 20 steps:
    # if each were over for good, it would be 12.8 at their beginning and less later.
    forever = Corridor(end=9.0, each=1.0)
    pqn = replace(SMALL, discount=0.95, learning_rate=1e-2)
    policy = train(forever, pqn, seed=0, steps=8_000).policy
    seen = jnp.stack([jnp.arange(-2.0, 2.0), jnp.ones(4)], axis=1)
    np.testing.assert_allclose(policy(seen) / pqn.reward_scale, 20.0, rtol=0.15)


def test_it_is_an_algorithm_for_discrete_actions():
    assert isinstance(PQN(), Algorithm)

    class Steered(Corridor):
        action = Continuous(-1.0, 1.0)

    with pytest.raises(ValueError, match="PQN learns discrete actions; Steered has Continuous"):
        train(Steered(), SMALL, steps=10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"learning_rate": 0.0}, r"PQN's learning_rate must be positive; got 0.0"),
        ({"q_lambda": 1.5}, r"PQN's q_lambda must be between 0 and 1; got 1.5"),
        ({"hold": 0.5}, r"PQN's hold must be at least 1; got 0.5"),
        ({"minibatches": 7}, r"divisor of environments \* horizon = 512; got 7"),
        ({"hidden": (4, 0)}, r"PQN's hidden must be positive widths; got \(4, 0\)"),
        ({"activation": "relo"}, r"PQN's activation must be tanh or relu; got relo"),
    ],
)
def test_hyper_parameters_that_cannot_train_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        train(Corridor(), PQN(**options), steps=10)
