from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco.mjx")

from envs import reacher as rc
from specs.reacher import reach, reach_with
from verifai_jax.addons.rl import PPO, Continuous, Discrete, Policy, evaluate, train
from verifai_jax.addons.rl.policy import new_layers
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.evaluation.verdicts import trace_verdict

KEY = jax.random.key(2)


def place(shoulder, elbow):
    """Where the tip is, from the geometry of two links."""
    upper, lower = rc.LENGTHS
    x = upper * np.cos(shoulder) + lower * np.cos(shoulder + elbow)
    y = upper * np.sin(shoulder) + lower * np.sin(shoulder + elbow)
    return np.array([x, y])


def test_the_spring_pulls_the_tip_to_the_target():
    trace = rc.reacher("target_angle", "elbow0", backend="native")(
        {"target_angle": 2.0, "elbow0": -1.0}, KEY
    )
    goal = 0.5 * np.array([np.cos(2.0), np.sin(2.0)])
    away = [
        np.linalg.norm(place(float(s), float(e)) - goal)
        for s, e in zip(trace["shoulder"], trace["elbow"], strict=True)
    ]
    assert trace["shoulder"][0] == 0.0
    assert trace["elbow"][0] == -1.0
    np.testing.assert_allclose(trace["distance"], away, atol=1e-5)
    assert away[0] > 0.5
    assert away[-1] < rc.TOLERANCE


@pytest.mark.thorough
def test_reacher_refuses_what_it_does_not_have():
    with pytest.raises(UnknownNameError, match="'loads'; did you mean 'load'"):
        rc.reacher("loads")
    layers = new_layers(KEY, (10, 8, 2), gain=1.0)
    with pytest.raises(ValueError, match="sees 10 numbers and has 2 actions"):
        rc.neural(Policy(layers, None, None, None, Discrete(2)))
    assert reach_with(Policy(layers, None, None, None, Continuous(-1.0, 1.0, 2))).name == reach.name


@pytest.mark.proves
def test_a_policy_learns_to_reach_and_is_tested_in_one_program():
    task = rc.reacher_task()
    ppo = PPO(
        learning_rate=2e-3,
        entropy=0.0,
        discount=0.95,
        environments=32,
        horizon=64,
        minibatches=8,
        hidden=(32, 32),
        normalise=True,
    )
    trained = train(task, ppo, steps=200_000)
    assert trained.mean_return[0] < 10
    assert evaluate(task, trained.policy, episodes=100).mean() > 45

    @jax.jit
    def worst(policy, u):
        problem = reach_with(policy).on_backend("mjx")

        def one(u):
            return trace_verdict(problem, problem.system(problem.space.unflatten(u), KEY))[0][0]

        return jax.vmap(one)(u)

    u = np.random.default_rng(0).uniform(size=(200, 5)).astype(np.float32)
    rho = np.asarray(worst(trained.policy, u))
    assert np.mean(rho < 0) < 0.3
    still = jax.tree.map(jnp.zeros_like, trained.policy.layers)
    idle = np.asarray(worst(replace(trained.policy, layers=still), u))
    assert np.mean(idle < 0) > 0.9
    # The same in native MuJoCo, with the policy as a constant.
    problem = reach_with(trained.policy).on_backend("native")
    for row in (int(np.argmin(rho)), int(np.argmax(rho))):
        features = jax.tree.map(np.asarray, problem.space.unflatten(u[row]))
        native = trace_verdict(problem, problem.system(features, KEY))[0][0]
        assert float(native) == pytest.approx(float(rho[row]), abs=0.02)
