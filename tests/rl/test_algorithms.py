import pytest

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
