from dataclasses import replace

import jax
import numpy as np
import pytest

from envs.cartpole_task import CartPoleTask
from verifai_jax.addons.rl import PPO, train
from verifai_jax.addons.rl.batched_training import BatchedTraining, Configuration

RATES = (1e-3, 3e-3, 1e-2)
STEPS = 1024


def ppo(rate):
    return PPO(
        learning_rate=rate, hidden=(8,), value_hidden=(8,), environments=4, horizon=32, entropy=0.0
    )


def leaves(policy):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(policy)]


def trained(configurations, **options):
    training = BatchedTraining(configurations, **options)
    list(training.advance({n: c.steps for n, c in enumerate(configurations)}))
    return [leaves(training.policy(n)) for n in range(len(configurations))]


@pytest.fixture(scope="module")
def group():
    return [Configuration(CartPoleTask(), ppo(rate), STEPS, seed=3) for rate in RATES]


@pytest.fixture(scope="module")
def policies(group):
    return trained(group)


@pytest.mark.slow
def test_a_training_does_not_depend_on_its_company(group, policies):
    alone = leaves(train(CartPoleTask(), ppo(RATES[1]), seed=3, steps=STEPS).policy)
    for a, b in zip(alone, policies[1], strict=True):
        np.testing.assert_array_equal(a, b)
    assert any(np.any(a != b) for a, b in zip(policies[0], policies[1], strict=True))


@pytest.mark.slow
def test_under_one_vmap_the_same_to_rounding(group, policies):
    together = trained(group, devices=jax.local_devices()[:1], per_device=3)
    for one, other in zip(policies, together, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)


@pytest.mark.slow
def test_going_on_is_the_same_as_going_through(group, policies):
    training = BatchedTraining(group)
    assert list(training.advance({0: 256, 2: 256})) == [0, 2]
    steps, returns = training.curve(2)
    assert steps.tolist() == [128, 256]
    assert returns.shape == (2,)
    list(training.advance(dict.fromkeys(range(3), STEPS)))
    for n in range(3):
        for a, b in zip(leaves(training.policy(n)), policies[n], strict=True):
            np.testing.assert_array_equal(a, b)
    assert training.seconds(0) > 0


@pytest.mark.slow
def test_what_goes_on_in_other_company_compiles_nothing_new(group, policies, compiled):
    other = [replace(c, algorithm=replace(c.algorithm, horizon=64)) for c in group]
    list(BatchedTraining(other).advance({0: 256}))
    assert "jit(_advance_updates)" in compiled
    training = BatchedTraining([*group, *group])
    list(training.advance(dict.fromkeys(range(6), 256)))
    compiled.clear()
    # The last one goes on alone, the others in new pairs.
    list(training.advance({0: 512, 2: 512, 5: STEPS}))
    list(training.advance(dict.fromkeys((3, 0, 2), STEPS)))
    assert "jit(_advance_updates)" not in compiled
    for n, wanted in ((0, 0), (2, 2), (3, 0), (5, 2)):
        for a, b in zip(leaves(training.policy(n)), policies[wanted], strict=True):
            np.testing.assert_array_equal(a, b)
