"""What is wrong with a task or the options of an augmentation is said before anything trains."""

import re

import jax.numpy as jnp
import pytest
from checked_types import unchecked
from rings import point, rings

import verifai_jax as vj
from verifai_jax.addons.training.augmentation import TaskError


def never(*arguments):
    raise AssertionError("trained")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"render": 3}, "render of task 'rings' must be a function; got 3"),
        ({"detected": None}, "has present and no detected; precision and recall need both"),
        ({"space": 3}, "space must be a FeatureSpace or a dictionary of domains; got 3"),
        (
            {"training_space": {"x": vj.Box(-1, 0)}},
            "space has x, y, training_space x",
        ),
        ({"space": {"seed": vj.Box(0, 1)}}, "a feature may not be called 'seed'"),
        ({"lanes": 0}, "lanes must be an integer of at least 1; got 0"),
        ({"measures": {"rate": 0.5}}, "measure 'rate' of task 'rings' must be a function; got 0.5"),
    ],
)
def test_parts_that_do_not_fit_are_refused(options, message):
    with unchecked(), pytest.raises(ValueError, match=re.escape(message)):
        rings(**options)


def test_a_task_needs_a_name():
    with pytest.raises(TaskError, match="needs a name; got ' '"):
        rings(" ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"arms": ("none", "counterexample")}, "unknown arm 'counterexample'; did you mean"),
        ({"arms": ()}, "name at least one arm of none, random, standard, counterexamples"),
        ({"arms": ("none", "none")}, "arm 'none' is named twice"),
        ({"arms": "standard"}, "task 'rings' has no transformation: give it transform="),
        ({"search": "unifrom"}, "unknown search 'unifrom'; did you mean 'uniform'"),
        ({"initial": 0}, "initial must be an integer of at least 1; got 0"),
        ({"hard": -1}, "hard must be an integer of at least 0; got -1"),
        ({"confidence": 1}, "confidence must lie between 0 and 1; got 1"),
        ({"seed": -1}, "seed must be an integer of at least 0; got -1"),
        ({"images": 3}, "unknown option of augment 'images'"),
    ],
)
def test_options_are_refused_before_training(arguments, message):
    with unchecked(), pytest.raises(ValueError, match=re.escape(message)):
        vj.augment(rings(train=never), **arguments)


def test_a_black_box_has_no_gradient():
    task = rings(train=never, black_box=True)
    with pytest.raises(ValueError, match="is a black box, which has no gradient"):
        vj.augment(task, search="gradient")


def test_a_renderer_that_fails_is_named_with_its_line():
    def broken(features):
        return features["z"]

    with pytest.raises(TaskError, match=r"render of task 'rings' fails: .*there is no feature 'z'"):
        vj.augment(rings(render=broken, train=never))


def test_the_wrongness_must_be_one_real_number():
    task = rings(wrongness=lambda logit, label: jnp.stack([logit, label]))
    weights = ((jnp.ones((2, 3)), jnp.zeros(3)), (jnp.ones((3, 1)), jnp.zeros(1)))
    inputs, labels = jnp.zeros((1, 2)), jnp.zeros(1)
    with pytest.raises(TaskError, match=r"must return one number; it returned shape \[2\]"):
        task.check_network(weights, inputs, labels)
    task = rings(wrongness=lambda logit, label: (logit > 0) != (label > 0))
    with pytest.raises(TaskError, match=r"must return a real number.*it returned bool"):
        task.check_network(weights, inputs, labels)
    task = rings(wrongness=lambda logit: logit)
    with pytest.raises(TaskError, match="predict or wrongness of task 'rings' fails"):
        task.check_network(weights, inputs, labels)


def test_the_problem_of_a_network_has_minus_the_wrongness_for_robustness():
    weights = ((jnp.ones((2, 3)), jnp.zeros(3)), (jnp.ones((3, 1)), jnp.zeros(1)))
    task = rings()
    problem = task.problem(weights)
    features = {"x": jnp.float32(0.5), "y": jnp.float32(0.1)}
    trace = problem.system(features, None)
    logit = task.predict(weights, point(features)[None])[0]
    assert trace["margin"] == pytest.approx(-float(task.wrongness(logit, 1.0)))
    assert str(problem.formulas["spec"]) == "margin >= 0"
