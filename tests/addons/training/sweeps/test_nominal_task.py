"""Nominal returns are measured on another task than trainings see, if the trainer says so."""

import numpy as np
import pytest
from checked_types import unchecked
from drifting import Drift, Point, closed_loop

from envs.cartpole_task import CartPoleTask
from verifai_jax.addons.training.sweeps import Study, StudyError, Trainer, sweep


def returns(nominal):
    import verifai_jax as vj

    study = Study(
        "measured",
        {"reward_scale": vj.Categorical(1.0, 2.0)},
        Trainer(Point(), Drift(), steps=64, nominal=nominal),
        closed_loop,
    )
    table = sweep(
        study,
        "grid",
        2,
        certification=vj.Certification(samples=8, attack_simulations=0),
        progress=False,
    ).table
    return table["nominal_return"].to_numpy()


@pytest.mark.slow
def test_the_nominal_task_is_measured_on():
    usual, doubled = returns(None), returns(Point(reward_scale=3.0))
    assert np.all(usual != 0)
    np.testing.assert_allclose(doubled, 3 * usual, rtol=1e-5)


def test_it_has_the_same_actions_and_observations():
    with pytest.raises(StudyError, match="nominal must have the actions and observations of task"):
        Trainer(Point(), Drift(), nominal=CartPoleTask())
    with (
        unchecked(),
        pytest.raises(StudyError, match=r"nominal must have action, time_limit, .* int lacks"),
    ):
        Trainer(Point(), Drift(), nominal=3)  # pyright: ignore[reportArgumentType]
