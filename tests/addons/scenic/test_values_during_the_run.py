"""Scenic programs that ask for values while they run: reactions, and values of each step."""

from pathlib import Path

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.scenic import ProgramError

GALLERY = Path(__file__).parent / "gallery"
PUSH = vj.Reactive({"gap": (0, 20), "speed": (0, 14)}, bounds=(-8, 3))

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.filterwarnings("ignore"),
    pytest.mark.usefixtures("installed"),
]


@pytest.mark.slow
def test_a_behavior_that_asks_at_each_step_is_falsified():
    program = vj.scenic(GALLERY / "reacting.scenic", features={"push": PUSH})
    assert program.given == ("push",)
    system = program.simulator(steps=40, records=("gap",))
    problem = vj.Problem("tease", program.space, system, "always gap > 1")
    run = vj.falsify(problem, "cross_entropy", 16, batch=8, confirm=False, progress=False)
    assert len(run.table.counterexamples) > 0
    worst = run.best
    features = program.space.from_row(worst)
    again = run.replay(int(worst.name))
    assert min(again.rho.values()) == pytest.approx(worst["rho"], abs=1e-6)
    # What it answers decides how the gap closes.
    gentle = problem.system({**features, "push": PUSH.coerce([0.0, 0.0, 3.0])}, 0)
    assert np.min(gentle.signals["gap"]) > np.min(again.trace.signals["gap"]) + 1
    scene = program.scene(features)
    assert scene.params["push"](gap=3.0, speed=2.0) == features["push"](gap=3.0, speed=2.0)
    assert program.features_of(scene)["push"] is scene.params["push"]


def test_a_value_of_each_step():
    program = vj.scenic(GALLERY / "time_series.scenic")
    assert program.space["wind"] == vj.Array(vj.Box(-1, 1), 20)
    features = program.space.unflatten(np.linspace(0.01, 0.99, program.space.dim, dtype=np.float32))
    y = program.simulator(steps=20)(features, 0).signals["y"]
    moved = np.asarray(features["wind"]) * np.asarray(features["gear"])
    np.testing.assert_allclose(np.diff(y), 0.1 * moved, atol=1e-5)
    again = program.features_of(program.scene(features))
    for name, value in features.items():
        np.testing.assert_allclose(again[name], value, atol=1e-6)


def test_what_is_wrong_is_said():
    text = "ego = new Object at Range(0, 1) @ 0\nwind = TimeSeries(VerifaiRange(0, 1))\nrequire {}"
    with pytest.raises(ProgramError, match="the TimeSeries wind needs a number of steps"):
        vj.scenic(text.format("wind"))
    with pytest.raises(ProgramError, match=r"TimeSeries takes a VerifaiRange; got Range"):
        vj.scenic("x = TimeSeries(Range(0, 1))\nego = new Object")
    with pytest.raises(ValueError, match=r"has a value 'ego\.position\.x' already"):
        vj.scenic("ego = new Object at Range(0, 1) @ 0", features={"ego.position.x": vj.Box(0, 1)})
    long = vj.scenic((GALLERY / "time_series.scenic").read_text())
    features = long.space.unflatten(np.full(long.space.dim, 0.5, np.float32))
    with pytest.raises(RuntimeError, match="a TimeSeries of 20 values is asked at step 20"):
        long.simulator(steps=25, dt=0.05)(features, 0)
