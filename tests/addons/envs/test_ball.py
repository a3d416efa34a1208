"""The ball: its problems, and both backends through contacts that come and go."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import ball
from specs import ball as specs
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.evaluation.host_engine import HostEngine


def rows(problem, n, seed=3):
    u = jax.random.uniform(jax.random.key(seed), (n, problem.space.dim))
    return jax.vmap(problem.space.unflatten)(u), jax.random.split(jax.random.key(0), n)


@pytest.mark.slow
@pytest.mark.parametrize("problem", [specs.over, specs.halt], ids=lambda p: p.name)
def test_problems_have_good_days_and_bad_ones(problem):
    problem = problem.on_backend("native")
    problem.check()
    u = np.random.default_rng(0).random((256, problem.space.dim), np.float32)
    u[0] = problem.space.flatten(problem.nominal)
    evaluation = HostEngine(problem).evaluate(u, jax.random.key(0), 0)
    assert not evaluation.status.any()
    least = evaluation.rho.min(axis=1)
    assert least[0] > 0
    assert 0.05 < (least < 0).mean() < 0.5


def test_a_thrown_ball_follows_the_textbook():
    """Until it lands: a parabola, but for the drag, which is set to nothing."""
    places = ["speed", "lift", "height", "drag"]
    system = ball.ball(features=places, duration=0.6, backend="native")
    values = {"speed": 3.0, "lift": 4.0, "height": 0.5, "drag": 0.0}
    trace = system({name: jnp.float32(value) for name, value in values.items()})
    time = np.arange(31) * 0.02
    np.testing.assert_allclose(trace["x"], 3.0 * time, atol=1e-4)
    # Semi-implicit Euler has fallen half a step further.
    fallen = 9.81 * time * (time + 0.005) / 2
    np.testing.assert_allclose(trace["z"], 0.5 + 4 * time - fallen, atol=1e-4)


def test_a_ball_of_another_size_lies_on_the_lawn():
    system = ball.ball(features=["radius"], duration=0.4, backend="native")
    trace = system.simulate_batch(
        {"radius": np.array([0.05, 0.2], np.float32)}, jax.random.split(jax.random.key(0), 2)
    )
    np.testing.assert_allclose(trace.signals["z"][:, -1], [0.05, 0.2], atol=5e-4)
    assert not trace.signals["hit"].any()


def test_a_feature_without_a_place_names_the_nearest():
    with pytest.raises(UnknownNameError, match="'sped'; did you mean 'speed'"):
        ball.ball(features=["sped"])


@pytest.mark.slow
@pytest.mark.parametrize("problem", [specs.over, specs.halt], ids=lambda p: p.name)
def test_backends_agree_through_contacts(problem):
    """Within 2 mm, and 1 cm/s: float32 and float64 meet the ground at slightly other times."""
    features, keys = rows(problem, 16)
    in_c = problem.system.with_backend("native").simulate_batch(
        jax.tree.map(np.asarray, features), keys
    )
    in_jax = jax.jit(jax.vmap(problem.system.with_backend("mjx")))(features, keys)
    for name, tolerance in (("x", 2e-3), ("z", 2e-3), ("speed", 1e-2)):
        np.testing.assert_allclose(in_c.signals[name], in_jax.signals[name], atol=tolerance)
    # The rail may be grazed a sample sooner or later.
    differ = in_c.signals["hit"] != np.asarray(in_jax.signals["hit"])
    assert differ.mean() < 0.01
