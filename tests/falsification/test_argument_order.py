"""Arguments in another order are told, with the right one, before anything is simulated."""

import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.messages.errors import suggests_options

PROBLEM = vj.Problem(
    "order", {"a": vj.Box(0, 1)},
    vj.blackbox(lambda features: vj.Trace({"x": [features["a"], 1.0]}, dt=1.0)),
    "always x > 0",
)  # fmt: skip


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (
            lambda: vj.falsify("uniform", PROBLEM),
            r"falsify\(problem, search, budget\); got \(str, ",
        ),
        (lambda: vj.simulate({"a": 0.5}, PROBLEM), r"simulate\(problem, \w+\); got \(dict, Prob"),
        (lambda: vj.estimate(100, PROBLEM), r"estimate\(problem, .*\); got \(int, Problem\)"),
        (lambda: vj.certify(PROBLEM, []), r"certify\(lambda policy: Problem\(...\), policies\); g"),
    ],
)
def test_swapped_arguments_show_the_right_order(call, told):
    with unchecked(), pytest.raises((TypeError, ValueError), match=told):
        call()


def test_an_object_in_its_own_place_belongs_there():
    @suggests_options
    def both(one: vj.Problem, other: "Problem | str", third: object = None) -> object:
        return one, other

    @suggests_options
    def named(name: str, problem: "Problem") -> object:
        return problem

    assert both(PROBLEM, PROBLEM) == (PROBLEM, PROBLEM)
    assert both(3, "x") == (3, "x")  # Whatever is in no place is the function's to judge.
    assert named("a", problem=PROBLEM) is named("a", PROBLEM) is PROBLEM
    with pytest.raises(TypeError, match=r"named\(name, problem\); got \(Problem, str\)"):
        named(PROBLEM, "a")
