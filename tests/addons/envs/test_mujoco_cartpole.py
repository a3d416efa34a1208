"""The cart-pole from MJCF against the analytic one."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from envs import cartpole as analytic
from envs import mujoco_cartpole
from specs import cartpole as paper
from specs import mujoco_cartpole as specs
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.host_engine import HostEngine
from verifai_jax.evaluation.verdicts import trace_verdict

ROWS = 256


def verdicts(problem, traces):
    rho, status = jax.jit(jax.vmap(lambda trace: trace_verdict(problem, trace)))(
        jax.tree.map(jnp.asarray, traces)
    )
    assert (np.asarray(status) == Status.OK).all()
    return np.asarray(rho)[:, 0]


@pytest.mark.slow
def test_qualitative_verdicts_agree_with_the_analytic_model():
    """At least 98 % of poles, long ones, which are hard for the controller."""
    hard = vj.FeatureSpace({**specs.poles.domains, "length": vj.Box(1.05, 1.2)})
    u = jax.random.uniform(jax.random.key(1), (ROWS, 4))
    features = jax.vmap(hard.unflatten)(u)
    keys = jax.random.split(jax.random.key(0), ROWS)
    in_c = specs.balance.system.with_backend("native")
    got = verdicts(specs.balance, in_c.simulate_batch(jax.tree.map(np.asarray, features), keys))
    # CartPole-v1's explicit Euler at 20 ms gains energy: the same equations, integrated well.
    fine = analytic.cartpole(analytic.neural(), terminate=True, method="rk4")
    problem = replace(paper.balance, system=fine)
    wanted = verdicts(problem, jax.jit(jax.vmap(fine))(features, keys))
    fails = wanted < 0
    assert 0.05 < fails.mean() < 0.95
    assert ((got < 0) == fails).mean() >= 0.98
    # And the robustness itself, where neither has chattered apart.
    assert np.median(np.abs(got - wanted)) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("problem", [specs.gusts, specs.settle], ids=lambda p: p.name)
def test_problems_fit_together_and_are_kept_on_an_ordinary_day(problem):
    problem = problem.on_backend("native")
    problem.check()
    u = np.random.default_rng(0).random((64, problem.space.dim), np.float32)
    u[0] = problem.space.flatten(problem.nominal)
    evaluation = HostEngine(problem).evaluate(u, jax.random.key(0), 0)
    assert not evaluation.status.any()
    assert evaluation.rho[0].min() > 0
    assert evaluation.rho.min() < 0


def test_a_feature_without_a_place_names_the_nearest():
    with pytest.raises(UnknownNameError, match="'mass_pole'; did you mean 'masspole'"):
        mujoco_cartpole.cartpole(features=["mass_pole"])
