"""Scenes that go out of a program and come back, and programs that draw only while they run."""

import random

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.scenic import ProgramError
from verifai_jax.addons.scenic.recipe import compiled_recipe

scenic = pytest.importorskip("scenic")
pytestmark = [pytest.mark.thorough, pytest.mark.filterwarnings("ignore")]

WIDE = """
class Car:
    speed: Range(1, 3)
param weather = Uniform('rain', 'sun')
ego = new Object at Range(-2, 2) @ 0, facing Range(-10, 10) deg
other = new Car at 10 @ Range(1, 3), with color Uniform([1, 0, 0], [0, 0, 1])
third = new Object at 20 @ Range(Range(0, 1), 3), with width Uniform(Range(1, 2), 4)
"""


def pose(body):
    return (*body.position, body.orientation.yaw, body.width)


def drawn(program):
    random.seed(3)
    return program.scenario.generate(maxIterations=100)[0]


class TestThereAndBack:
    @pytest.fixture(scope="class")
    def program(self):
        return vj.scenic(WIDE)

    @pytest.mark.slow
    def test_features_of_scenics_own_scenes_give_them_again(self, program):
        random.seed(0)
        for _ in range(8):
            scene = program.scenario.generate()[0]
            features = program.features_of(scene)
            program.space.check(features)
            again = program.scene(features)
            for one, other in zip(scene.objects, again.objects, strict=True):
                assert pose(one) == pytest.approx(pose(other), abs=1e-5)

    def test_features_of_a_scene_from_bytes_are_numbers(self, program):
        for _ in range(8):
            scene = program.scenario.generate()[0]
            features = program.features_of(program.from_bytes(program.to_bytes(scene)))
            program.space.check(features)
            again = program.scene(features)
            for one, other in zip(scene.objects, again.objects, strict=True):
                assert pose(one) == pytest.approx(pose(other), abs=1e-5)

    def test_scenes_takes_what_features_of_gives(self, program):
        scene = drawn(program)
        numbers = program.scenes(program.features_of(scene))
        assert float(numbers["other"]["y"]) == pytest.approx(scene.objects[1].position.y, abs=1e-5)
        with pytest.raises(ValueError, match="is missing"):
            program.scenes({"ego.position.x": 0.0})

    def test_a_scene_of_another_compilation_is_refused(self, program):
        scene = drawn(program)
        compiled_recipe.cache_clear()
        other = vj.scenic(WIDE)
        with pytest.raises(ValueError, match=r"another compilation .*from_bytes\(other.to_bytes"):
            other.features_of(scene)
        with pytest.raises(ValueError, match="another compilation"):
            other.to_bytes(scene)
        carried = other.from_bytes(program.to_bytes(scene))
        assert other.features_of(carried)["other.speed"] == pytest.approx(scene.objects[1].speed)
        with pytest.raises(ValueError, match="a scene is one that Scenic draws; got dict"):
            program.features_of({})

    def test_code_is_a_program_that_scenic_runs(self, program):
        scene = drawn(program)
        code = program.code(scene)
        assert "np.float64" not in code
        again = scenic.scenarioFromString(code, mode2D=True).generate(maxIterations=1)[0]
        assert again.params["weather"] == scene.params["weather"]
        for one, other in zip(scene.objects, again.objects, strict=True):
            assert pose(one) == pytest.approx(pose(other), abs=1e-9)
            assert type(one).__name__.removesuffix("2D") == type(other).__name__.removesuffix("2D")

    def test_code_of_three_dimensions_and_inherited_classes(self):
        program = vj.scenic(
            "class Car:\n    width: Range(1, 2)\n"
            "class Truck(Car):\n    length: 7\n    name: 'red one'\n"
            "param 'a b' = Range(0, 1)\nparam region = CircularRegion(0 @ 0, 3)\n"
            "new Truck at (5, Range(4, 5), 6), facing (1, 0.5, 0.2), with shape ConeShape()\n"
            "new Car with allowCollisions True\n",
            mode2D=False,
        )
        scene = drawn(program)
        code = program.code(scene)
        assert "class Truck(Car):" in code
        assert "# The parameter 'region' is left out: code cannot write a CircularRegion." in code
        again = scenic.scenarioFromString(code).generate(maxIterations=1)[0]
        for one, other in zip(scene.objects, again.objects, strict=True):
            assert pose(one) == pytest.approx(pose(other), abs=1e-9)
        assert again.objects[0].orientation.approxEq(scene.objects[0].orientation)
        assert type(again.objects[0].shape).__name__ == "ConeShape"
        assert again.egoObject is None


CAR = (
    "model scenic.simulators.newtonian.model\nparam render = False\n"
    "from scenic.core.dynamics import Action\n"
    "class Set(Action):\n    def __init__(self, x):\n        self.x = x\n"
    "    def applyTo(self, agent, simulation):\n        agent.velocity = self.x @ 0\n"
    "behavior Go(x):\n    while True:\n        take Set(x)\n"
)
PROGRAMS = {
    "behaviour": "behavior B():\n    while True:\n        take Set(Range(-9, 9))\n"
    "ego = new Object with behavior B\nrecord ego.position.x as x\n",
    "do choose": "behavior B():\n    do choose Go(-9), Go(-3), Go(3), Go(9)\n"
    "ego = new Object with behavior B\nrecord ego.position.x as x\n",
    "compose": "scenario Main():\n    setup:\n        ego = new Object with behavior Go(0)\n"
    "        record ego.position.x as x\n"
    "    compose:\n        do choose Sub(-9), Sub(-3), Sub(3), Sub(9)\n"
    "scenario Sub(x):\n    setup:\n        override ego with behavior Go(x)\n",
}


class TestProgramsThatDrawWhileTheyRun:
    """What is drawn while a program runs depends on the row, and on a feature `seed`."""

    @pytest.mark.parametrize("name", PROGRAMS)
    def test_they_run(self, name):
        program = vj.scenic(CAR + PROGRAMS[name])
        assert program.space.columns == ("seed",)
        run = program.simulator(steps=4, records=("x",))
        ends = [float(run({"seed": s}, seed).signals["x"][-1]) for s, seed in SEEDS]
        assert len({round(end, 4) for end in ends}) > 1
        assert ends[0] == float(run({"seed": 0.1}, 1).signals["x"][-1])

    @pytest.mark.slow
    def test_a_run_is_falsified_and_replayed(self):
        program = vj.scenic(CAR + PROGRAMS["behaviour"])
        problem = vj.Problem(
            "wander", program.space, program.simulator(steps=4, records=("x",)), "always x < 0.5"
        )
        run = vj.falsify(problem, budget=16, confirm=False, progress=False)
        row = int(run.table.counterexamples.index[0])
        assert run.replay(row).rho["spec"] == pytest.approx(run.table.row(row)["rho"])

    def test_what_neither_draws_nor_runs_is_refused(self):
        with pytest.raises(ProgramError, match=r"draws nothing .* no feature: write Range\(1, 2\)"):
            vj.scenic("ego = new Object at 0 @ 0")


SEEDS = ((0.1, 1), (0.1, 2), (0.2, 1), (0.7, 3), (0.9, 4))


class TestRecords:
    BASE = "ego = new Object at Range(0, 1) @ 0\n"

    def test_records_are_checked_before_anything_runs(self):
        program = vj.scenic(
            self.BASE + "record ego.position.x as gap\nrecord final ego.position.x as end\n"
        )
        with pytest.raises(ValueError, match="unknown record 'gapp'; did you mean 'gap'"):
            program.simulator(steps=2, records=("gapp",))
        with pytest.raises(ValueError, match="'end' is one value, at the first or last step"):
            program.simulator(steps=2, records=("end",))

    def test_a_program_without_records_is_refused(self):
        with pytest.raises(ValueError, match="records nothing over time: add `record EXPRESSION"):
            vj.scenic(self.BASE).simulator(steps=2)


class TestErrorsWithoutWords:
    def test_an_error_without_a_message_gets_the_line_that_raised_it(self):
        with pytest.raises(ProgramError, match="AssertionError: it came without a message, from"):
            vj.scenic("ego = new Object at Range(0, 1) @ 0\nassert ego is None\n")

    def test_a_choice_from_a_list_that_may_be_empty(self):
        program = vj.scenic(
            "a = Range(0, 1)\n"
            "ego = new Object at Uniform(*filter(lambda x: x > 0.5, [a, a])) @ 0, with name 'e'\n"
        )
        accepted = program.space.accepts_points(np.array([[0.2, 0.5], [0.8, 0.5]], np.float32))
        assert accepted.tolist() == [False, True]
        assert "no integer" in str(program.refusal(program.space.unflatten(np.float32([0.2, 0.5]))))


class TestThreeDimensions:
    PROGRAM = (
        "class Box:\n    width: Range(1, 3)\n    height: Range(2, 4)\n"
        "ego = new Box at (0, 0, Range(2, 8))\n"
        "for i in range(4):\n    new Box at (Range(-8, 15), Range(-15, 15), Range(0, 2))\n"
    )

    def test_a_second_is_enough_to_measure_the_requirements(self, monkeypatch, capsys):
        program = vj.scenic(self.PROGRAM, mode2D=False)
        constraint = program._constraint
        asked = []
        monkeypatch.setattr(constraint, "_accepts_anew", lambda f: asked.append(1) or slow())
        assert program.space.check_where() == 1.0
        assert 16 <= len(asked) < 200
        monkeypatch.setattr("verifai_jax.addons.scenic.requirements.FIRST_SHOWN", 0.05)
        program.space.accepts_points(
            np.random.default_rng(1).random((16, program.space.dim), np.float32)
        )
        assert "Scenic decides requirements in Python" in capsys.readouterr().err


def slow():
    import time

    time.sleep(0.01)
    return True
