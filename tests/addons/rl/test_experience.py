from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.rl import Discrete
from verifai_jax.addons.rl.experience import (
    advance,
    progress,
    sizes,
    start_episodes,
    step_keys,
)
from verifai_jax.addons.rl.observations import (
    Statistics,
    mean_and_scale,
    normalise,
    update,
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Count:
    """Counts its steps from 10 on, and is over for good at `end`; the reward is the count."""

    end: float = 99.0
    time_limit: int = field(default=4, metadata={"static": True})

    @property
    def action(self):
        return Discrete(2)

    def reset(self, key):
        return {"count": jnp.float32(10.0), "place": jax.random.uniform(key, (2,))}

    def step(self, key, state, action):
        count = state["count"] + 1
        return {**state, "count": count}, state["count"] + 100 * action, count >= self.end

    def observe(self, state):
        return jnp.stack([state["count"], *state["place"]])


@jax.jit
def six_steps(task, action):
    def step(episodes, keys):
        observation = jax.vmap(task.observe)(episodes.state)
        episodes, transition = advance(task, episodes, action, keys)
        return episodes, (observation, transition)

    start = start_episodes(task, jax.random.key(0), 3)
    keys = step_keys(jax.random.key(1), 6, 3)
    episodes, (observed, transition) = jax.lax.scan(step, start, keys)
    return episodes, observed, transition, progress(transition)


LEFT = jnp.array([0, 0, 1])


@pytest.mark.thorough
def test_cut_off_is_not_terminated_and_leads_to_the_state_before_the_reset():
    episodes, observed, transition, told = six_steps(Count(), LEFT)
    np.testing.assert_array_equal(observed[:, 0, 0], [10, 11, 12, 13, 10, 11])
    np.testing.assert_array_equal(
        transition.next_observation, observed + jnp.array([1.0, 0.0, 0.0])
    )
    assert not np.any(transition.ends.terminated)
    cut = np.array([False, False, False, True, False, False])
    np.testing.assert_array_equal(transition.ends.truncated, np.tile(cut[:, None], 3))
    np.testing.assert_array_equal(transition.reward[:, 2], transition.reward[:, 0] + 100)
    np.testing.assert_array_equal(episodes.age, 2)
    np.testing.assert_array_equal(episodes.total, [21, 21, 221])
    assert int(told.episodes) == 3
    assert float(told.mean_return) == pytest.approx(46 + 400 / 3)


def test_terminated_is_terminated_and_the_next_episode_is_another():
    _, observed, transition, told = six_steps(Count(end=12.0), LEFT)
    np.testing.assert_array_equal(transition.ends.terminated[:, 0], [False, True] * 3)
    assert not np.any(transition.ends.truncated)
    places = np.asarray(observed[::2, :, 1:]).reshape(9, 2)
    assert len(np.unique(places, axis=0)) == 9
    np.testing.assert_array_equal(observed[::2, :, 1:], observed[1::2, :, 1:])
    assert int(told.episodes) == 9
    assert float(told.mean_return) == pytest.approx(21 + 200 / 3)


def test_no_episode_ended():
    _, _, transition, _ = six_steps(Count(), LEFT)
    told = progress(jax.tree.map(lambda leaf: leaf[:3], transition))
    assert int(told.episodes) == 0
    assert np.isnan(told.mean_return)


def test_size_of_an_observation():
    found = []

    def look(key):
        found.append(sizes(Count(), start_episodes(Count(), key, 2)))

    jax.eval_shape(look, jax.random.key(0))
    assert found == [(3, 2)]


@pytest.mark.thorough
def test_statistics_of_observations_merge():
    rows = np.random.default_rng(0).normal(3.0, 2.0, (3, 4, 5, 2)).astype(np.float32)
    statistics = Statistics.initial(2)
    np.testing.assert_array_equal(mean_and_scale(statistics), [[0, 0], [1, 1]])
    for batch in rows:
        statistics = update(statistics, jnp.asarray(batch))
    every = rows.reshape(-1, 2)
    np.testing.assert_allclose(statistics.mean, every.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(statistics.variance, every.var(axis=0), rtol=1e-4)
    got = np.asarray(normalise(statistics, jnp.asarray(every)))
    np.testing.assert_allclose(got.mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(got.std(axis=0), 1, rtol=1e-4)
    np.testing.assert_array_equal(normalise(statistics, jnp.asarray(every), enabled=False), every)
