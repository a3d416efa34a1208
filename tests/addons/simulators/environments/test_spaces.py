"""Actions and observations of every space of Gymnasium, told apart by its class."""

import gymnasium as gym
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.addons.simulators.environments.spaces import (
    Misfit,
    check_observation,
    check_space,
    fit,
    named_numbers,
    no_action,
)

spaces = gym.spaces
BOX = spaces.Box(-1, 1, (2,), np.float32)
NESTED = spaces.Dict(
    {
        "grip": spaces.Discrete(2, start=1),
        "arm": spaces.Tuple((BOX, spaces.MultiBinary(2))),
        "word": spaces.Text(3, charset="ab"),
    }
)
HELD = {"grip": 1, "arm": (np.zeros(2), [0, 1]), "word": "ab"}
VALID = [
    (spaces.Discrete(3), 2),
    (spaces.Discrete(3), np.int64(0)),
    (spaces.Discrete(3), np.array(1.0)),
    (spaces.Discrete(3), np.array([2])),
    (spaces.Discrete(3, start=-1), -1),
    (spaces.MultiDiscrete([3, 3]), [1, 2]),
    (spaces.MultiDiscrete([[2, 3], [4, 5]]), [[1, 2], [3, 4]]),
    (spaces.MultiDiscrete([3, 3], start=[5, -1]), [7, -1]),
    (spaces.MultiBinary(3), [0, 1, 1]),
    (spaces.MultiBinary([2, 2]), np.eye(2)),
    (spaces.Box(-1, 1, (1,)), 0.5),
    (spaces.Box(-1, 1, ()), 0.5),
    (spaces.Box(0, 1, (2, 3)), np.full((2, 3), 0.1)),
    (spaces.Box(-0.1, 0.1, (1,), np.float32), np.array([0.1])),
    (spaces.Box(0, 255, (2,), np.uint8), [0, 255]),
    (spaces.Box(-np.inf, np.inf, (1,)), [1e30]),
    (NESTED, HELD),
    (spaces.Text(3, charset="ab"), "ba"),
    (spaces.Sequence(spaces.Discrete(2)), (0, 1)),
    (spaces.OneOf((spaces.Discrete(2), BOX)), (np.int64(0), np.int64(1))),
]
INVALID = [
    (spaces.Discrete(3), 3),
    (spaces.Discrete(3), -1),
    (spaces.Discrete(3), 0.5),
    (spaces.Discrete(3), np.nan),
    (spaces.Discrete(3), [1, 1]),
    (spaces.Discrete(3), "1"),
    (spaces.Discrete(3, start=1), 0),
    (spaces.Discrete(3), None),
    (spaces.MultiDiscrete([3, 3]), [1.9, 2]),
    (spaces.MultiDiscrete([3, 3]), [7, -4]),
    (spaces.MultiDiscrete([3, 3]), [1]),
    (spaces.MultiBinary(3), [0, 1, 2]),
    (spaces.MultiBinary(3), [0, 1, 0.5]),
    (spaces.MultiBinary(3), 1),
    (BOX, [np.nan, 0]),
    (BOX, [0, 0, 0]),
    (BOX, ["a", "b"]),
    (BOX, [[0], [0, 1]]),
    (BOX, np.ma.masked_array([0.0, 1.0], mask=[0, 1])),
    (spaces.Box(0, 255, (1,), np.uint8), [1.5]),
    (NESTED, {"grip": 1}),
    (NESTED, HELD | {"more": 1}),
    (NESTED, HELD | {"grip": 0}),
    (NESTED, HELD | {"arm": (np.zeros(2),)}),
    (NESTED, HELD | {"arm": (np.zeros(2), [0, 3])}),
    (NESTED, HELD | {"word": "xyz"}),
    (NESTED, [1, 2]),
    (spaces.Tuple((BOX, BOX)), 1.0),
    (spaces.Text(3, charset="ab"), "abab"),
    (spaces.Text(3, charset="ab"), 3),
    (spaces.Sequence(spaces.Discrete(2)), (0, 5)),
    (spaces.OneOf((spaces.Discrete(2), BOX)), (0, 3)),
]


@pytest.mark.parametrize(("space", "action"), VALID)
def test_valid_actions_are_of_the_space(space, action):
    with unchecked():
        fitted = fit(space, action)
        assert not fitted.outside
        assert space.contains(fitted.action)
        check_observation(space, fitted.action)
        check_space(space, "env", delayed=False)


@pytest.mark.parametrize(("space", "action"), INVALID)
@pytest.mark.parametrize("clip", [True, False])
def test_invalid_actions_are_refused_with_the_space(space, action, clip):
    with (
        unchecked(),
        pytest.raises(Misfit, match=r"(Discrete|Binary|Box|Dict|Tuple|Text|Seq|OneOf)"),
    ):
        fit(space, action, clip)


@pytest.mark.parametrize(
    ("space", "action", "clipped"),
    [
        (BOX, [3, 0], [1, 0]),
        (BOX, [-np.inf, np.inf], [-1, 1]),
        (BOX, [1.0000002, 0], [1, 0]),
        (spaces.Box(0, 10, (1,), np.uint8), [200], [10]),
        (spaces.Box(np.float32([0, -5]), np.float32([1, 5])), [2, -9], [1, -5]),
    ],
)
def test_what_lies_outside_a_box_is_clipped_or_passed_on(space, action, clipped):
    fitted = fit(space, action)
    np.testing.assert_array_equal(fitted.action, np.array(clipped, space.dtype))
    assert fitted.outside
    passed = fit(space, action, clip=False)
    np.testing.assert_array_equal(passed.action, np.array(action, space.dtype))
    assert passed.outside
    deep = fit(spaces.Dict({"a": spaces.Tuple((space,))}), {"a": (action,)})
    assert deep.outside
    np.testing.assert_array_equal(deep.action["a"][0], np.array(clipped, space.dtype))


def test_an_integer_that_the_space_cannot_hold_does_not_wrap():
    with pytest.raises(Misfit, match="300"):
        fit(spaces.Box(0, 10, (1,), np.uint8), [300], clip=False)
    assert fit(spaces.Box(0, 10, (1,), np.uint8), [300]).action.tolist() == [10]


@pytest.mark.parametrize(
    "space",
    [
        space
        for space, _ in VALID
        if type(space).__name__ in "Dict Tuple Box Text Discrete MultiDiscrete MultiBinary"
    ],
)
def test_no_action_is_an_action(space):
    assert space.contains(no_action(space))


def test_problems_of_the_action_space_are_told_early():
    odd = spaces.Dict({"a": BOX})
    odd.spaces["a"] = object()
    with pytest.raises(ValueError, match="env has no action_space"):
        check_space(None, "env", delayed=False)
    with pytest.raises(
        ValueError, match=r"action_space\['a'\] of env must be a space of Gymnasium"
    ):
        check_space(odd, "env", delayed=False)
    with pytest.raises(ValueError, match="no neutral action, which action_delay needs"):
        check_space(spaces.Sequence(BOX), "env", delayed=True)
    bad = spaces.Box(-1, 1, (1,))
    bad.low = np.array([2.0], np.float32)
    with pytest.raises(ValueError, match="lower bound above the upper one"):
        check_space(bad, "env", delayed=False)


def test_numbers_have_names():
    named = named_numbers("action", {"grip": 1, "arm": (np.zeros((2, 2)), np.ones(1)), "word": "a"})
    assert {name: np.shape(value) for name, value in named.items()} == {
        "action.grip": (),
        "action.arm.0": (4,),
        "action.arm.1": (),
    }


class Machine(gym.Env):
    """Adds what it is told; its observation and its actions are nested."""

    dt = 1.0
    x0 = 0.0
    observation_space = spaces.Dict(
        {
            "x": spaces.Box(-np.inf, np.inf, (1,), np.float64),
            "arm": spaces.Tuple((spaces.Discrete(5), spaces.Box(-9, 9, (2, 2), np.float64))),
            "word": spaces.Text(3),
        }
    )
    action_space = NESTED
    mode = 1

    def observe(self):
        return {"x": np.array([self.x]), "arm": (self.mode, np.full((2, 2), self.x)), "word": "a"}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.x0
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action) or self.unclipped
        self.x += float(action["arm"][0][0])
        return self.observe(), 0.0, False, False, {}

    unclipped = False


def act(observation):
    return HELD | {"arm": (np.array([3.0, 0.0]), np.array([0, 1]))}


OPTIONS = {"steps": 4, "features": {"x0": "x0"}}


def machine_problem(policy=act, spec="x < 9", env=Machine, **options):
    system = vj.gymnasium(env, policy, **OPTIONS, **options)
    return vj.Problem("machine", {"x0": vj.Box(0.0, 0.1)}, system, f"always ({spec})")


def test_nested_spaces_are_simulated_and_overshoots_counted():
    problem = machine_problem(spec='x < 9 & "arm.0" == 1 & "action.arm.0"[0] <= 1')
    problem.check()
    trace = problem.system({"x0": 0.0}, 0)
    assert set(trace.signals) == {
        *("x", "arm.0", "reward", "action.grip", "action.arm.0", "action.arm.1"),
        *("arm.1",) * ("arm.1" in trace.signals),
    }
    assert trace["x"].tolist() == [0, 1, 2, 3, 4]
    run = vj.falsify(problem, "uniform", budget=8, progress=False)
    assert not run.table.all["violated"].any()
    (note,) = [note for note in run.notes if "action" in note]
    assert note.startswith("in 8 of 8 simulations (32 times in all): the policy's action lay")
    assert "Box(-1.0, 1.0, (2,), float32)" in note
    assert "was clipped to it, as in training" in note


class Free(Machine):
    unclipped = True


def test_an_overshoot_may_be_passed_on_and_is_noted():
    problem = machine_problem(env=Free, clip=False)
    assert problem.system({"x0": 0.0}, 0)["x"].tolist() == [0, 3, 6, 9, 12]
    run = vj.falsify(problem, "uniform", budget=8, progress=False)
    assert run.table.all["violated"].all()
    assert any("was passed on (clip=False)" in note for note in run.notes)


@pytest.mark.slow
def test_workers_count_too():
    problem = machine_problem(workers=1)
    run = vj.falsify(problem, "uniform", budget=4, progress=False)
    problem.system.close()
    assert any(note.startswith("in 4 of 4 simulations (16 times") for note in run.notes)


def test_invalid_actions_and_observations_are_errors_of_their_rows():
    problem = machine_problem(lambda o: HELD | {"grip": 0})
    run = vj.falsify(problem, "uniform", budget=2, progress=False)
    assert set(run.table.all["status"]) == {"error"}
    message = run.table.all["message"].iloc[0]
    assert "policy must return an action of Machine's Dict(" in message
    assert "got 0, which Discrete(2, start=1) does not have" in message

    class Astray(Machine):
        mode = 7

    with pytest.raises(TypeError, match=r"reset must return the first observation of Astray, Dict"):
        vj.gymnasium(Astray, act, steps=2)({}, 0)

    class Lost(Machine):
        def step(self, action):
            self.mode = 9
            return super().step(action)

    with pytest.raises(
        ValueError, match=r"step must return an observation of Lost, .* got 9, which"
    ):
        vj.gymnasium(Lost, act, steps=2)({}, 0)


def test_late_actions_are_of_the_space():
    problem = machine_problem(action_delay=2)
    assert problem.system({"x0": 0.0}, 0)["x"].tolist() == [0, 0, 0, 1, 2]


@pytest.mark.thorough
def test_actions_of_spaces_without_a_shape_are_simulated():
    class Sequences(gym.Env):
        action_space = spaces.Sequence(spaces.Discrete(3))
        observation_space = spaces.Box(-9, 9, (1,), np.float64)
        dt, x0 = 0.1, 0.0

        def reset(self, *, seed=None, options=None):
            return np.zeros(1), {}

        def step(self, action):
            return np.array([float(sum(action))]), 0.0, False, False, {}

    for action, status in (((1, 2), "ok"), ((1, 3), "error")):
        options = {"steps": 2, "signals": ("x",), "features": {"x0": "x0"}}
        system = vj.gymnasium(Sequences, lambda observation, a=action: a, **options)
        problem = vj.Problem("sequences", {"x0": vj.Box(0, 1)}, system, "x <= 3")
        table = vj.falsify(problem, "uniform", 1, progress=False).table.all
        assert set(table["status"]) == {status}


def test_the_option_is_checked():
    with unchecked(), pytest.raises(ValueError, match="clip is True or False; got 2"):
        vj.gymnasium(Machine, act, steps=2, clip=2)
