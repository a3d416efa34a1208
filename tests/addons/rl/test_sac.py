from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from verifai_jax.addons.rl import (
    BatchedTraining,
    Configuration,
    Continuous,
    Discrete,
    evaluate,
    train,
)
from verifai_jax.addons.rl.algorithm import Algorithm
from verifai_jax.addons.rl.replay_buffer import StoredTransitions, add, empty_buffer, sample, unpack
from verifai_jax.addons.rl.sac import SAC, act, squash_log_prob, total_loss


@dataclass(frozen=True)
class Aim:
    """Hit a target between 10 and 14 with an action between 10 and 14; best is 0."""

    time_limit: int = 3

    @property
    def action(self):
        return Continuous(10.0, 14.0)

    def reset(self, key):
        return jax.random.uniform(key, minval=10.5, maxval=13.5)

    def step(self, key, state, action):
        return state, -jnp.abs(action[0] - state), jnp.array(False)

    def observe(self, state):
        return jnp.stack([100 * (state - 12.0) + 1000.0])


class Blind(Aim):
    """The same in the dark."""

    def observe(self, state):
        return jnp.zeros(1)


SMALL = SAC(
    hidden=(16,),
    value_hidden=(16,),
    environments=4,
    horizon=16,
    batch=32,
    capacity=4_000,
    normalise=True,
    warmup=64,
    learning_rate=3e-3,
    discount=0.5,
)


def test_density_of_squashed_actions():
    mean, std = np.array([0.3, -1.0]), np.array([0.5, 2.0])
    noise = np.linspace(-2.5, 2.5, 11)[:, None] * np.array([1.0, 0.7])
    u = mean + std * noise
    # Change of variables in float64, an action at a time.
    expected = stats.norm(mean, std).logpdf(u) - np.log1p(-np.square(np.tanh(u)))
    got = jax.jit(squash_log_prob)(jnp.asarray(mean), jnp.log(jnp.asarray(std)), jnp.asarray(noise))
    np.testing.assert_allclose(got, expected.sum(axis=1), rtol=2e-3, atol=2e-4)


def test_density_integrates_to_one():
    noise = np.linspace(-6, 6, 20_001)[:, None]
    log_prob = jax.jit(squash_log_prob)(
        jnp.array([0.4]), jnp.log(jnp.array([0.8])), jnp.asarray(noise)
    )
    action = np.tanh(0.4 + 0.8 * noise[:, 0])
    assert np.trapezoid(np.exp(np.asarray(log_prob, np.float64)), action) == pytest.approx(
        1.0, abs=1e-3
    )


def test_density_and_its_slope_stay_finite_at_the_ends():
    def density(mean):
        return squash_log_prob(mean[None], jnp.array([2.0]), jnp.array([3.0]))

    means = jnp.array([-60.0, 0.0, 60.0])
    assert np.all(np.isfinite(jax.jit(jax.vmap(jax.value_and_grad(density)))(means)))


def rows(values):
    column = np.array(values, np.float32)[:, None]
    return StoredTransitions(column, column + 0.5, 10 * column, -column[:, 0], column[:, 0] > 3)


filled = jax.jit(add)


@jax.jit
def drawn_of(buffer):
    return sample(buffer, jax.random.key(0), 600, actions=1)


def test_buffer_is_a_ring_and_gives_back_whole_transitions():
    buffer = empty_buffer(6, size=1, actions=1)
    for start in (0, 2, 4, 6):
        buffer = filled(buffer, rows([start, start + 1]))
    assert (int(buffer.filled), int(buffer.index)) == (6, 2)
    np.testing.assert_array_equal(buffer.rows[:, 0], [6, 7, 2, 3, 4, 5])
    drawn = drawn_of(buffer)
    assert set(np.asarray(drawn.observation[:, 0])) == {2, 3, 4, 5, 6, 7}
    np.testing.assert_array_equal(drawn.next_observation, drawn.observation + 0.5)
    np.testing.assert_array_equal(drawn.action, 10 * drawn.observation)
    np.testing.assert_array_equal(drawn.reward, -drawn.observation[:, 0])
    np.testing.assert_array_equal(drawn.terminated, drawn.observation[:, 0] > 3)


def test_only_what_happened_is_drawn():
    buffer = filled(empty_buffer(6, size=1, actions=1), rows([7, 8]))
    drawn = drawn_of(buffer)
    assert set(np.asarray(drawn.observation[:, 0])) == {7, 8}


@pytest.mark.thorough
def test_noise_lasts_as_long_as_its_episode_and_has_the_policys_deviation():
    # The first policy has mean 0 and deviation 1, so that an action is the tanh of its noise.
    sac = SAC(hidden=(4,), value_hidden=(4,), environments=400, capacity=2_000, correlation=0.9)

    @jax.jit
    def collect(key):
        def step(state, key):
            noise_key, key = jax.random.split(key)
            noise = jax.random.normal(noise_key, (400, 1))
            keys = jax.random.split(key, (400, 2))
            return act(sac, Blind(time_limit=4), state, noise, keys)[0], None

        start = sac.init(Blind(time_limit=4), key, updates=1)
        state, _ = jax.lax.scan(step, start, jax.random.split(key, 5))
        return unpack(state.buffer.rows, actions=1)

    seen = collect(jax.random.key(0))
    action = np.clip(np.asarray(seen.action, np.float64), -0.999_999, 0.999_999)
    noise = np.arctanh(action).reshape(5, 400)
    assert np.std(noise) == pytest.approx(1.0, abs=0.1)
    for step in range(3):
        assert np.corrcoef(noise[step], noise[step + 1])[0, 1] == pytest.approx(0.9, abs=0.05)
    # Episodes have 4 steps: the fifth has nothing of the fourth.
    assert abs(np.corrcoef(noise[3], noise[4])[0, 1]) < 0.2
    np.testing.assert_array_equal(seen.terminated, 0)


@pytest.mark.slow
def test_each_loss_has_a_gradient_for_its_own_weights():
    sac = SAC(hidden=(4,), value_hidden=(4,), environments=2, capacity=10)
    generator = np.random.default_rng(0)

    def part(*shape):
        return generator.normal(size=shape).astype(np.float32)

    batch = StoredTransitions(part(8, 1), part(8, 1), np.tanh(part(8, 1)), part(8), np.zeros(8))
    batch = StoredTransitions(*map(jnp.asarray, batch))
    noise = jnp.asarray(part(2, 8, 1))

    @jax.jit
    def gradient(reward):
        state = sac.init(Aim(), jax.random.key(0), updates=10)
        changed = batch._replace(reward=reward)
        return state, jax.grad(total_loss)(state.weights, sac, state.slow, changed, noise)

    (state, first), (_, other) = gradient(batch.reward), gradient(batch.reward + 1)
    same = jax.tree.map(lambda a, b: bool(np.allclose(a, b, atol=1e-6)), first, other)
    # Rewards reach the critics only.
    assert all(jax.tree.leaves((same.policy, same.log_temperature)))
    assert not all(jax.tree.leaves(same.critics))
    # By hand: d/d(log temperature) = mean(-log probability) - wanted entropy.
    (w0, b0), (w1, b1) = [(np.asarray(w), np.asarray(b)) for w, b in state.weights.policy]
    mean, log_std = np.split(np.maximum(batch.observation @ w0 + b0, 0) @ w1 + b1, 2, axis=-1)
    expected = 1.0 - float(
        np.mean(squash_log_prob(jnp.asarray(mean), jnp.asarray(log_std), noise[1]))
    )
    assert float(first.log_temperature) == pytest.approx(expected, rel=1e-4)


@pytest.mark.proves
def test_learns_from_observations_of_another_scale_and_the_same_from_the_same_seed():
    trained, again = (train(Aim(), SMALL, seed=0, steps=8_000) for _ in range(2))
    # Always the middle would lose 3 * 0.75 on average.
    assert evaluate(Aim(), trained.policy, episodes=200).mean() > -0.4
    assert trained.policy.squash
    for a, b in zip(jax.tree.leaves(trained.policy), jax.tree.leaves(again.policy), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_the_buffer_is_written_in_place():
    # Two buffers, one ten times as large: all else that a loop of updates allocates is as large.
    def temporary(capacity):
        sac = SAC(hidden=(4,), value_hidden=(4,), batch=8, horizon=2, capacity=capacity)
        state = jax.eval_shape(lambda key: sac.init(Aim(), key, 10), jax.random.key(0))
        loop = jax.jit(
            lambda state: jax.lax.fori_loop(0, 9, lambda _, s: sac.step(Aim(), s)[0], state)
        )
        return loop.lower(state).compile().memory_analysis().temp_size_in_bytes

    assert temporary(80_000) - temporary(8_000) < 1_000


def test_it_is_an_algorithm_for_continuous_actions():
    assert isinstance(SAC(), Algorithm)

    class Switched(Aim):
        action = Discrete(2)

    with pytest.raises(ValueError, match="SAC learns continuous actions; Switched has Discrete"):
        train(Switched(), SMALL, steps=10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"learning_rate": 0.0}, r"SAC's learning_rate must be positive; got 0.0"),
        ({"correlation": 1.0}, r"SAC's correlation must be at least 0 and below 1; got 1.0"),
        ({"target_rate": 0.0}, r"SAC's target_rate must be above 0 and at most 1; got 0.0"),
        ({"capacity": 1001}, r"SAC's capacity must be a multiple of environments = 8; got 1001"),
        ({"warmup": -1}, r"SAC's warmup must be at least 0; got -1"),
        ({"value_hidden": (0,)}, r"SAC's value_hidden must be positive widths; got \(0,\)"),
        ({"activation": "relo"}, r"SAC's activation must be tanh or relu; got relo"),
    ],
)
def test_hyper_parameters_that_cannot_train_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        train(Aim(), SAC(**options), steps=10)


@pytest.mark.slow
def test_trains_on_all_devices_at_once():
    # Decompositions of several matrices at once once waited for each other for ever here.
    group = [Configuration(Aim(), SAC(), steps=2_000, seed=seed) for seed in range(4)]
    training = BatchedTraining(group)
    assert list(training.advance(dict.fromkeys(range(4), 2_000))) == [0, 1, 2, 3]
