"""The mixture of episodes: its shares, its neighbourhoods, and tasks that do not fit."""

from dataclasses import dataclass

import jax
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from envs.cartpole_task import CartPoleTask
from specs.cartpole import balance
from verifai_jax.addons.rl.task.ode import OdeTask
from verifai_jax.addons.training.hardening.collecting import collect
from verifai_jax.addons.training.hardening.mixture import (
    NARROW,
    RADIUS,
    HardeningError,
    Mixture,
    mixture_of,
    neighbourhoods,
)


@pytest.mark.thorough
def test_near_draws_are_in_neighbourhoods_and_structure_stays():
    task = mixture_of(CartPoleTask(masspole_range=0.0, length_range=0.0), balance, None)
    centres = np.array([[0.2, 0.3, 0.4, 0.5]])
    near = Mixture.of(balance.space, (0.0, 0.0, 1.0), centres)
    assert jax.tree.structure(near) == jax.tree.structure(task.mixture)
    points = np.asarray(jax.vmap(near.draw)(jax.random.split(jax.random.key(0), 200)))
    assert np.abs(points - centres).max() <= RADIUS + 1e-6
    none = Mixture.of(balance.space, (0.25, 0.25, 0.5), centres[:0])
    np.testing.assert_allclose(none.shares, [0.25, 0.75, 0.0])


def test_a_task_that_cannot_start_is_refused():
    @dataclass(frozen=True)
    class Plain:
        time_limit: int = 3

    with pytest.raises(HardeningError, match="start\\(key, features\\)"):
        mixture_of(Plain(), balance, None)
    with pytest.raises(HardeningError, match="problem="):
        vj.harden(CartPoleTask())
    assert callable(OdeTask.start)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spec", "radius"), [("x <= 0.5", RADIUS), ("abs(x - 0.8) > 0.001", NARROW)]
)
def test_a_neighbourhood_is_narrow_where_few_of_its_samples_fail(spec, radius):
    still = vj.ode(
        lambda time, state, control, features: {"x": 0.0 * state["x"]},
        lambda features, key: {"x": features["x0"]},
        dt=0.1,
        steps=2,
    )
    space = {"x0": vj.Box(0.0, 1.0), "cell": vj.Categorical(1, 2)}
    problem = vj.Problem("still", space, still, f"always {spec}")
    found = collect(
        problem, pd.DataFrame({"x0": [0.8], "cell": [2]}), np.zeros((0, 2), np.float32), seed=1,
        added=4, table=8, shrunk=0,
    )  # fmt: skip
    assert set(found.radii[found.sources == "counterexample"]) == {radius}
    low, high = neighbourhoods(problem.space, found.points, found.radii)
    near = np.minimum(found.points[:, 0], 1 - found.points[:, 0]) > radius
    np.testing.assert_allclose((high - low)[near, 0], 2 * found.radii[near], rtol=1e-4)
    np.testing.assert_array_equal(low[:, 1], high[:, 1])  # A choice is its cell.
