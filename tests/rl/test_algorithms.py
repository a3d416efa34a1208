import jax
import pytest

from benchmarks.control_tasks import Acrobot, Pendulum
from verifai_jax.errors import UnknownNameError
from verifai_jax.rl import PPO, Continuous, Discrete
from verifai_jax.rl.algorithm import Algorithm
from verifai_jax.rl.algorithms import ALGORITHMS, algorithm_named, fitting
from verifai_jax.rl.pqn import PQN


def test_algorithms_by_name():
    assert algorithm_named("pqn") is PQN
    assert algorithm_named("ppo") is PPO
    with pytest.raises(UnknownNameError, match="unknown training algorithm 'sacc'; did you mean"):
        algorithm_named("sacc")


def test_which_fit_an_action():
    assert fitting(Discrete(3)) == ("ppo", "pqn")
    assert fitting(Continuous(-1.0, 1.0)) == ("ppo", "sac")


@pytest.mark.parametrize("name", ALGORITHMS)
def test_each_one_keeps_the_protocol_and_its_defaults_can_train(name):
    algorithm = ALGORITHMS[name]()
    assert isinstance(algorithm, Algorithm)
    algorithm.check()
    assert algorithm.steps_per_update == algorithm.environments * algorithm.horizon


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_update_keeps_the_form_of_the_state(name):
    # A leaf that is weakly typed at first only would have everything compiled twice.
    algorithm, task = ALGORITHMS[name](), Pendulum() if name == "sac" else Acrobot()
    key = jax.eval_shape(lambda: jax.random.key(0))
    before = jax.eval_shape(lambda key: algorithm.init(task, key, 10), key)
    after, _ = jax.eval_shape(lambda state: algorithm.step(task, state), before)
    assert jax.tree.structure(before) == jax.tree.structure(after)
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_policy_acts_on_what_the_task_shows(name):
    algorithm, task = ALGORITHMS[name](), Pendulum() if name == "sac" else Acrobot()

    def acts(key):
        state = algorithm.init(task, key, 10)
        policy = algorithm.policy(task, state)
        assert policy.action == task.action
        return policy.act(task.observe(task.reset(key)))

    action = jax.eval_shape(acts, jax.eval_shape(lambda: jax.random.key(0)))
    assert action.shape == ((1,) if name == "sac" else ())
