"""Faults as features: at most some of them, the least one, its explanation."""

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons import faults

ONSET, DURATION = vj.Box(0, 4), vj.Box(0, 2)


def oscillator():
    """A mass that a spring and a damper in the controller hold near 0."""
    return vj.ode(
        lambda time, state, control, features: {"x": state["v"], "v": control["push"]},
        lambda features, key: {"x": features["x0"], "v": jnp.zeros(())},
        controller=lambda time, state, features: {"push": -4.0 * state["x"] - 2.0 * state["v"]},
        dt=0.02,
        control_period=0.04,
        duration=4.0,
    )


@pytest.fixture(scope="module")
def problem():
    space = {"x0": vj.Box(-0.5, 0.5)}
    return vj.Problem("held", space, oscillator(), "always abs(x) <= 1", nominal={"x0": 0.2})


@pytest.mark.slow
def test_the_least_fault_is_that_of_a_fine_grid(problem):
    """Two numbers, at a tenth of the grid's simulations."""
    bias = faults.Bias("push", offset=vj.Box(-9, 9), onset=0.5, duration=DURATION)
    faulty = problem.with_faults(bias).only("push_bias")
    run = vj.falsify(faulty, budget=400, confirm=False, progress=False)
    small = vj.shrink(run, by="distance", budget=2000, progress=False)
    count = 161
    offsets, durations = np.meshgrid(np.linspace(-9, 9, count), np.linspace(0, 2, count))
    rows = [
        {"x0": 0.2, "push_bias": {"offset": float(a), "duration": float(b)}}
        for a, b in zip(offsets.ravel(), durations.ravel(), strict=True)
    ]
    table = vj.simulate(faulty, rows, progress=False).table.all
    away = np.hypot(table["push_bias.offset"] / 18, table["push_bias.duration"] / 2)
    least = float(away[table["violated"]].min())
    assert small.distance <= 1.01 * least
    assert run.simulations + small.simulations <= count**2 / 10


@pytest.mark.slow
def test_at_most_one_and_its_explanation(problem):
    chosen = faults.AtMost(1, [
        faults.Stuck("push", value=3.0, onset=ONSET, duration=DURATION),
        faults.Freeze("v", onset=ONSET, duration=vj.Box(0, 0.1)),
    ])  # fmt: skip
    faulty = problem.with_faults(chosen)
    assert faulty.space["fault"].nominal == {"1": "none"}
    run = vj.falsify(faulty, "cross_entropy", budget=1500, confirm=False, progress=False)
    failing = run.table.counterexamples
    assert set(failing["fault.1"]) == {"push_stuck"}
    small = vj.shrink(run, budget=1500, progress=False)
    assert small.features["fault"]["1"] == 1
    assert "v_freeze.onset" not in small.changed
    assert "push_stuck.duration  0 -> " in str(small)
    text = str(vj.explain(run, progress=False))
    assert "With fault back at nominal (1 none) the failure vanishes" in text
    assert "With push_stuck back at nominal (onset 4, duration 0) the failure vanishes" in text
    assert "v_freeze" in text.partition("do not matter")[0]


def test_nominal_is_the_weakest_shortest_and_latest(problem):
    faulty = problem.with_faults(
        faults.Bias("x", offset=vj.Box(0.1, 1), onset=vj.Box(1, 2), duration=vj.Box(0, 1)),
        faults.Saturation("push", limit=vj.Box(0.5, 4), duration=vj.Box(0.2, 1)),
        faults.Stuck("push", value=vj.Box(-2, 4), duration=vj.Box(0, 1)),
    )
    nominal = {name: faulty.space[name].nominal for name in faulty.space.domains if name != "x0"}
    assert nominal == {
        "x_bias": {"offset": 0.1, "onset": 2.0, "duration": 0.0},
        "push_saturation": {"limit": 4.0, "duration": 0.2},
        "push_stuck": {"value": 1.0, "duration": 0.0},
    }
    assert set(faulty.nominal) == {"x0", *nominal}
    assert list(faulty.only("x_bias").space.columns) == list(faulty.space.columns)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: faults.Bias("x", offset=float("nan")), "offset of Bias must be finite; got nan"),
        (lambda: faults.Dropout("x", duration=-1.0), "duration of Dropout must be at least 0"),
        (lambda: faults.Noise("x", std=vj.Box(-1, 1)), "std of Noise must be at least 0; got Box"),
        (lambda: faults.PacketLoss("x", loss=2.0), "loss of PacketLoss must be from 0 to 1"),
        (lambda: faults.Drift("x", rate="1"), "rate of Drift must be a number, or a domain of one"),
        (lambda: faults.Bias("x", offset=vj.Box([0, 0], [1, 1])), "a domain of one number"),
        (lambda: faults.Dropout(""), "Dropout needs a channel, such as 'action'"),
        (lambda: faults.AtMost(1, ["bias"]), "AtMost needs a list of faults"),
        (lambda: faults.AtMost(0, [faults.Dropout("x")]), "count must be an integer of at least 1"),
    ],
)
def test_bad_faults_are_refused_by_name(make, words):
    with pytest.raises(ValueError, match=words):
        make()


@pytest.mark.parametrize(
    ("made", "words"),
    [
        ([faults.Bias("xx", offset=1.0)], "unknown channel 'xx'; did you mean 'x'"),
        ([faults.Bias("x[1]", offset=1.0)], r"channel 'x' has 1 entries; got 'x\[1\]'"),
        ([faults.Dropout("x"), faults.Dropout("x")], "there is a feature or a fault 'x_dropout'"),
        ([faults.Dropout("x", name="x0", duration=DURATION)], "a feature or a fault 'x0' already"),
        ([], "with_faults needs at least one fault"),
        (["x"], "with_faults takes faults, such as vj.faults.Bias; got 'x'"),
        ([faults.WrongChannel("x", source="push")], "source of WrongChannel must be part of the s"),
    ],
)
def test_faults_that_do_not_fit_are_refused(problem, made, words):
    with pytest.raises(ValueError, match=words):
        problem.with_faults(*made)
