from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.control_tasks import Acrobot, Pendulum
from verifai_jax.addons.rl import PPO, BatchedTraining, Configuration, Continuous, Discrete, train
from verifai_jax.addons.rl.algorithm import Algorithm
from verifai_jax.addons.rl.algorithms import ALGORITHMS, algorithm_named, algorithms_for
from verifai_jax.addons.rl.pqn import PQN
from verifai_jax.addons.rl.sac import SAC
from verifai_jax.core.messages.errors import UnknownNameError


def test_algorithms_by_name():
    assert algorithm_named("pqn") is PQN
    assert algorithm_named("ppo") is PPO
    with pytest.raises(UnknownNameError, match="unknown training algorithm 'sacc'; did you mean"):
        algorithm_named("sacc")


def test_which_fit_an_action():
    assert algorithms_for(Discrete(3)) == ("ppo", "pqn")
    assert algorithms_for(Continuous(-1.0, 1.0)) == ("ppo", "sac")


@pytest.mark.parametrize("name", ALGORITHMS)
def test_each_one_keeps_the_protocol_and_its_defaults_can_train(name):
    algorithm = ALGORITHMS[name]()
    assert isinstance(algorithm, Algorithm)
    algorithm.check()
    assert algorithm.steps_per_update == algorithm.environments * algorithm.horizon


@pytest.mark.thorough
@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_update_keeps_the_form_of_the_state_and_its_policy_acts(name):
    # A leaf that is weakly typed at first only would have everything compiled twice.
    algorithm, task = ALGORITHMS[name](), Pendulum() if name == "sac" else Acrobot()
    key = jax.eval_shape(lambda: jax.random.key(0))
    before = jax.eval_shape(lambda key: algorithm.init(task, key, 10), key)
    after, _ = jax.eval_shape(lambda state: algorithm.step(task, state), before)
    assert jax.tree.structure(before) == jax.tree.structure(after)
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)

    def acts(state, key):
        policy = algorithm.policy(task, state)
        assert policy.action == task.action
        return policy.act(task.observe(task.reset(key)))

    assert jax.eval_shape(acts, after, key).shape == ((1,) if name == "sac" else ())


SMALL = {
    "ppo": PPO(hidden=(8,), value_hidden=(8,), environments=4, horizon=32),
    "pqn": PQN(hidden=(8,), environments=4),
    "sac": SAC(
        hidden=(8,), value_hidden=(8,), environments=4, capacity=4_000, warmup=200, batch=32
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ALGORITHMS)
def test_in_a_group_and_under_vmap_as_alone(name):
    task, steps = Pendulum() if name == "sac" else Acrobot(), 1_024
    group = [
        Configuration(task, replace(SMALL[name], learning_rate=rate), steps, seed=3)
        for rate in (1e-3, 3e-3, 1e-2)
    ]

    def trained(configurations, **options):
        one = jax.local_devices()[:1]
        training = BatchedTraining(configurations, devices=one, **options)
        for steps_so_far in (256, steps):
            list(training.advance(dict.fromkeys(range(len(configurations)), steps_so_far)))
        return [jax.tree.leaves(training.policy(n)) for n in range(len(configurations))]

    policies = trained(group)
    for ours, alone in zip(policies[1], trained(group[1:2])[0], strict=True):
        np.testing.assert_array_equal(ours, alone)
    for one, other in zip(policies, trained(group, per_device=3), strict=True):
        for a, b in zip(one, other, strict=True):
            # Rounding grows in a thousand steps; another learning rate moves weights far more.
            np.testing.assert_allclose(a, b, atol=5e-3)
    assert np.any(policies[0][0] != policies[1][0])


class Broken(Pendulum):
    """Its rewards are no numbers where the pendulum is fast."""

    def step(self, key, state, action):
        state, reward, over = super().step(key, state, action)
        return state, jnp.where(jnp.abs(state.rate) > 4, jnp.nan, reward), over


@pytest.mark.slow
@pytest.mark.parametrize("name", algorithms_for(Pendulum().action))
def test_what_is_no_number_is_told_and_stops_nothing(name):
    trained = train(Broken(), SMALL[name], steps=4_096)
    assert len(trained.mean_return) == len(trained.steps)
    assert np.isnan(trained.mean_return).any()
    assert not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(trained.policy))
    action = trained.policy.act(jnp.zeros(3))
    assert action.shape == (1,)
