"""What a study says before anything trains, and how hyper-parameters become trainings."""

import numpy as np
import pytest
from checked_types import unchecked
from drifting import Drift, Picks, Point, closed_loop, drifting

import verifai_jax as vj
from verifai_jax.addons.rl import PPO
from verifai_jax.addons.training.sweeps.hyperparameters import values_at
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.trainer import StudyError, Trainer
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.features import Constant, FeatureSpace

TWO = {"drift": Drift(), "ppo": PPO(hidden=(8, 8))}


def test_names_are_those_of_the_algorithms_and_the_task():
    names = Trainer(Point(), TWO).names
    assert names[:3] == ("algorithm", "steps", "width")
    assert {"rate", "noise", "learning_rate", "clip", "reward_scale", "time_limit"} <= set(names)
    assert "hidden" not in names
    assert "value_hidden" not in names


def test_values_become_a_training():
    trainer = Trainer(Point(), TWO, steps=640)
    values = {"algorithm": "ppo", "width": 16, "learning_rate": 0.5, "rate": 9.0, "time_limit": 8}
    made = trainer.configuration({**values, "reward_scale": 2, "steps": 320}, seed=7)
    assert made.algorithm == PPO(hidden=(16, 16), value_hidden=(16, 16), learning_rate=0.5)
    assert made.task == Point(reward_scale=2.0, time_limit=8)
    assert (made.steps, made.seed) == (320, 7)
    assert type(made.task.reward_scale) is float
    assert trainer.configuration({"algorithm": "drift", "rate": 0.5}).steps == 640
    assert set(trainer.used_hyperparameters({"algorithm": "drift", "rate": 1.0, "clip": 0.1})) == {
        "algorithm",
        "rate",
    }


def test_points_become_plain_values():
    space = FeatureSpace(
        {
            "algorithm": vj.Categorical("drift", "ppo"),
            "rate": vj.Categorical(0.1, 0.25),
            "normalise": vj.Categorical(True, False),
            "environments": vj.DiscreteBox(2, 4),
            "noise": vj.Box(0.0, 1.0),
            "steps": Constant(64),
        }
    )
    points = np.array([[0.1, 0.1, 0.1, 0.1, 0.25], [0.9, 0.9, 0.9, 0.9, 0.1]])
    first, second = values_at(space, points)
    assert first == {
        "algorithm": "drift", "rate": 0.1, "normalise": True, "environments": 2, "noise": 0.25,
        "steps": 64,
    }  # fmt: skip
    assert second["noise"] == float(np.float32(0.1))
    assert [type(first[name]) for name in first] == [str, float, bool, int, float, int]
    many = values_at(space, np.tile(points, (40, 1)))
    assert len(many) == 80
    assert many[2:4] == [first, second]


def study(space=None, trainer=None, problem=closed_loop, **options):
    trainer = Trainer(Point(), Drift(), steps=128) if trainer is None else trainer
    return Study("s", {"rate": vj.Box(0.1, 1.0)} if space is None else space, trainer, problem,
                 **options)  # fmt: skip


def test_a_good_study_is_checked_without_training(monkeypatch):
    def trained(*_, **__):
        raise AssertionError("trained")

    for name in ("_start", "_advance_updates", "_policy"):
        monkeypatch.setattr(f"verifai_jax.addons.rl.batched_training.{name}", trained)
    study().check()
    drifting({"steps": vj.DiscreteBox(64, 256), "width": vj.Categorical(4, 8)}).check()


WRONG = {
    "unknown hyper-parameter 'raet'; did you mean 'rate'?": lambda: study({"raet": vj.Box(0, 1)}),
    r"rate: Drift's rate must be positive; got -0.1, the lower end of Box\(-0.1, 1\)": lambda: (
        study({"rate": vj.Box(-0.1, 1.0)})
    ),
    "parts: Drift's parts must be a divisor of environments = 4; got 3, a choice of": lambda: study(
        {"parts": vj.Categorical(1, 3)}
    ),
    r"environments: environments must be a whole number \(DiscreteBox, Categorical\); got 2.5": (
        lambda: study({"environments": vj.Box(2.5, 4)})
    ),
    "hidden is a tuple of widths; sweep 'width'": lambda: study({"hidden": vj.Categorical(4, 8)}),
    "hyper-parameter rate must be a single value": lambda: study(
        {"rate": vj.Box((0.1, 0.1), (1.0, 1.0))}
    ),
    'the space does not choose one: add "algorithm"': lambda: study(
        {"rate": vj.Box(0.1, 1)}, Trainer(Point(), TWO)
    ),
    "unknown algorithm 'drft'; did you mean 'drift'?": lambda: study(
        {"algorithm": vj.Categorical("drft", "ppo")}, Trainer(Point(), TWO)
    ),
    r"algorithm 'picks': Picks learns discrete actions; Point has Continuous\(.*\). "
    "Those that fit: ppo, sac": lambda: study(trainer=Trainer(Point(), Picks())),
    "checkpoints must lie between 1 and steps = 128; got 200": lambda: study(checkpoints=(64, 200)),
    "problem must return a Problem for a policy; it returned int": lambda: study(
        problem=lambda policy: 3
    ),
    "problem raised ZeroDivisionError for an untrained 'drift' policy": lambda: study(
        problem=lambda policy: 1 / 0
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_what_is_wrong_is_said_first(message):
    with pytest.raises((StudyError, UnknownNameError), match=message):
        WRONG[message]().check()


def test_a_signal_that_the_closed_loop_lacks_is_named():
    def problem(policy):
        loop = closed_loop(policy)
        return vj.Problem("stay", loop.space, loop.system, "always speed <= 1")

    with pytest.raises(StudyError, match="the problem of an untrained 'drift' policy does not fit"):
        study(problem=problem).check()
    with pytest.raises(StudyError, match="speed"):
        study(problem=problem).check()


def test_a_combination_is_not_refused_as_long_as_some_company_is_right():
    space = {"parts": vj.Categorical(1, 8), "environments": vj.Categorical(4, 8)}
    study(space).check()


def test_parts_of_a_wrong_kind():
    for wrong, message in (
        (lambda: study(p=0.0), "p must lie between 0 and 1"),
        (lambda: study(seeds=0), "seeds must be an integer of at least 1"),
        (lambda: study(seeds=(1, 1)), "training seeds must be different"),
        (lambda: study(checkpoints=(0,)), "a checkpoint must be an integer of at least 1"),
        (lambda: study(problem=drifting().untrained_problem()), "must be a function from a policy"),
        (lambda: study(curve="always retrun >= 3"), "did you mean 'return'"),
        (lambda: Trainer(Point(), {}), "at least one algorithm"),
        (lambda: Trainer(Point(), PPO), "must be an algorithm such as PPO"),
        (lambda: Trainer(3, PPO()), "int lacks action"),
        (lambda: Trainer(Point(), PPO(), steps=0), "steps must be at least 1"),
    ):  # fmt: skip
        with unchecked(), pytest.raises(ValueError, match=message):
            wrong()


def test_seeds_and_checkpoints():
    assert study(seeds=3).training_seeds == (0, 1, 2)
    assert study(seeds=(5, 2)).training_seeds == (5, 2)
    assert drifting().checkpoints_of(128) == (32, 64, 128)
    assert drifting().checkpoints_of(48) == (32, 48)
    text = str(drifting())
    assert "hyper-parameters: rate" in text
    assert "trains: drift on Point, 128 steps" in text
