"""Environments of MuJoCo Playground in a closed loop; they run where the library is installed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.messages.errors import MissingExtra, UnknownNameError

HAS = bool(__import__("importlib.util").util.find_spec("mujoco_playground"))
needed = pytest.mark.skipif(not HAS, reason="MuJoCo Playground is not installed")


@pytest.mark.skipif(HAS, reason="MuJoCo Playground is installed")
def test_it_says_what_to_install():
    with pytest.raises(MissingExtra, match=r"pip install 'verifai_jax\[playground\]'"):
        vj.playground("CartpoleBalance", lambda o: jnp.zeros(1), steps=2)


def balance(steps=20, **options):
    def policy(observation):
        return jnp.clip(observation[2:3] + observation[4:5], -1.0, 1.0)

    return vj.playground("CartpoleBalance", policy, steps=steps, **options)


@needed
@pytest.mark.slow
def test_it_is_falsified_and_filmed_over_mass_and_start(tmp_path):
    system = balance(bind={"mass": "body/pole_1/mass", "angle": "joint/hinge_1/qpos"})
    problem = vj.Problem(
        "balance",
        {"mass": vj.Box(0.05, 0.5), "angle": vj.Box(-0.4, 0.4)},
        system,
        "always abs(qpos[1]) < 0.3",
    )
    run = vj.falsify(problem, "uniform", 64, batch=64, progress=False)
    assert 0 < run.table.all["violated"].mean() < 1
    simulate, key = jax.jit(system), jax.random.key(0)
    trace = simulate({"mass": 0.1, "angle": 0.25}, key)
    np.testing.assert_allclose(trace.signals["qpos"][0, 1], 0.25, rtol=1e-6)
    np.testing.assert_allclose(trace.signals["observation"][0, 2], np.sin(0.25), rtol=1e-4)
    heavy = simulate({"mass": 0.5, "angle": 0.25}, key)
    assert not np.allclose(trace.signals["qpos"][-1], heavy.signals["qpos"][-1], atol=1e-4)
    run.replay(run.table.all.index[0]).animate(tmp_path / "a.gif", size=(80, 60))
    assert (tmp_path / "a.gif").stat().st_size > 1000


@needed
@pytest.mark.slow
def test_it_is_a_task_to_train_on():
    task = vj.rl.playground_task("CartpoleBalance", time_limit=16)
    training = vj.rl.train(task, vj.rl.PPO(environments=4, horizon=8), steps=64, seed=0)
    assert training.policy.act(jnp.zeros(5)).shape == (1,)


@needed
def test_what_is_wrong_is_said():
    with pytest.raises(UnknownNameError, match="did you mean 'CartpoleBalance'"):
        vj.playground("CartpoleBalanc", lambda o: o, steps=2)
    with pytest.raises(UnknownNameError, match="pole_9"):
        balance(bind={"mass": "body/pole_9/mass"})
    with pytest.raises(ValueError, match=r"needs models that are not in the package: git clone"):
        vj.playground("Go1JoystickFlatTerrain", lambda o: o, steps=2)
