"""A whole small sweep: PPO on the cart-pole, certified."""

import jax
import numpy as np
import pytest

import verifai_jax as vj
from envs.cartpole_task import CartPoleTask
from specs.cartpole import balance_with
from verifai_jax.addons.rl import PPO, train
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.trainer import Trainer

TINY = PPO(hidden=(4,), value_hidden=(4,), environments=4, horizon=8, minibatches=2)


@pytest.mark.slow
def test_a_whole_sweep(tmp_path):
    study = Study(
        "tiny",
        {"learning_rate": vj.LogUniform(1e-3, 1e-1), "length_range": vj.Box(0.0, 1.0)},
        Trainer(CartPoleTask(), TINY, steps=256),
        balance_with,
        checkpoints=(64,),
        curve="eventually return >= 15",
    )
    found = vj.sweep(
        study, configurations=5, certification=vj.Certification(samples=64), folder=tmp_path
    )
    again = vj.sweep(study, configurations=5, certification=vj.Certification(samples=64))
    assert found.table.drop(columns="training_seconds").equals(
        again.table.drop(columns="training_seconds")
    )
    row = found.table.loc[7]
    alone = train(
        CartPoleTask(length_range=row["length_range"]),
        PPO(learning_rate=row["learning_rate"], hidden=(4,), value_hidden=(4,), environments=4,
            horizon=8, minibatches=2),
        steps=256, seed=0,
    )  # fmt: skip
    assert row["steps"] == 256
    for one, other in zip(
        jax.tree.leaves(found.policy(7)), jax.tree.leaves(alone.policy), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    certificates = vj.certify(
        balance_with,
        [found.policy(i) for i in range(10)],
        p=0.01,
        certification=vj.Certification(samples=64),
        seed=0,
        only_safe=True,
    )
    assert found.table["verdict"].tolist() == [c.verdict for c in certificates.rows]
    assert found.table["failures"].tolist() == [
        c.failures + c.not_finite for c in certificates.rows
    ]
    assert found.table["worst_robustness"].tolist() == [
        c.worst_robustness for c in certificates.rows
    ]
    # The worst features give the worst robustness again.
    worst = vj.simulate(found.problem(7), [found.record.worst[7]])
    assert worst.table.all["rho"][0] == pytest.approx(row["worst_robustness"], abs=1e-4)
    assert found.table["curve_robustness"].notna().any()
