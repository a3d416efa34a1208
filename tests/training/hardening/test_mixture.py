"""The mixture of episodes: its shares, its neighbourhoods, and tasks that do not fit."""

from dataclasses import dataclass

import jax
import numpy as np
import pytest

import verifai_jax as vj
from envs.cartpole import CartPoleTask
from specs.cartpole import balance
from verifai_jax.rl.task.ode import OdeTask
from verifai_jax.training.hardening.mixture import RADIUS, HardeningError, Mixture, mixture_of


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
