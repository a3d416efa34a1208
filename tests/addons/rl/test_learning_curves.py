"""The algorithms against what is known of classic control, five or ten seeds each."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.control_tasks import Acrobot, Angles, Pendulum, Swing
from benchmarks.learning_curves import CURVES, returns

UNSTEADY = {"Pendulum ppo"}
"""Curves of which a seed in ten stays far behind; see docs/training.md."""
STEADY = [curve for curve in CURVES if curve.name not in UNSTEADY]


@pytest.mark.proves
@pytest.mark.parametrize("curve", STEADY, ids=lambda curve: curve.name)
def test_five_seeds_reach_the_known_return(curve):
    got = returns(curve, seeds=5)
    assert got.mean() >= curve.wanted, got
    # No seed is left behind: four of five are there, the fifth within a fifth.
    assert np.sum(got >= curve.wanted - 0.05 * abs(curve.wanted)) >= 4, got
    assert got.min() >= curve.wanted - 0.2 * abs(curve.wanted), got


@pytest.mark.proves
def test_most_of_ten_seeds_reach_the_known_return():
    # What a seed learns depends on the last digits of the processor, so one that stays behind on
    # one machine is another on the next.
    (curve,) = (curve for curve in CURVES if curve.name in UNSTEADY)
    got = returns(curve, seeds=10)
    assert np.median(got) >= curve.wanted, got
    assert np.sum(got >= curve.wanted - 0.05 * abs(curve.wanted)) >= 7, got


def stepped(task, states, actions):
    @jax.jit
    @jax.vmap
    def one(state, action):
        after, reward, over = task.step(jax.random.key(0), state, action)
        return task.observe(after), reward, over

    seen, reward, over = one(states, actions)
    return np.asarray(seen), np.asarray(reward), np.asarray(over)


def test_pendulum_is_gymnasiums_step_for_step():
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    draw = np.random.default_rng(0)
    angle, rate = draw.uniform(-7, 7, 100), draw.uniform(-8, 8, 100)
    action = draw.uniform(-2, 2, (100, 1))
    start = Swing(jnp.asarray(angle), jnp.asarray(rate))
    seen, reward, over = stepped(Pendulum(), start, jnp.asarray(action))
    for i in range(100):
        env.state = np.array([angle[i], rate[i]])
        observation, expected, *_ = env.step(action[i])
        np.testing.assert_allclose(seen[i], observation, atol=2e-5)
        assert reward[i] == pytest.approx(float(expected), rel=1e-4, abs=1e-4)
    assert not over.any()


@pytest.mark.thorough
def test_acrobot_is_gymnasiums_step_for_step():
    env = gymnasium.make("Acrobot-v1").unwrapped
    env.reset(seed=0)
    draw = np.random.default_rng(0)
    states = draw.uniform([-3, -3, -4, -6], [3, 3, 4, 6], (60, 4))
    action = draw.integers(0, 3, 60)
    start = Angles(*jnp.asarray(states.T))
    seen, reward, over = stepped(Acrobot(), start, jnp.asarray(action, jnp.int32))
    for i in range(60):
        env.state = states[i]
        observation, expected, terminated, *_ = env.step(int(action[i]))
        np.testing.assert_allclose(seen[i], observation, atol=5e-4)
        assert (reward[i], over[i]) == (expected, terminated)
    assert 5 <= over.sum() <= 55
