"""What a first run compiles: no more programs than it needs, and none of them twice."""

import jax.numpy as jnp
import pytest

import verifai_jax as vj


def problem(bound=1.0):
    def pull(time, state, control, features):
        return {"x": features["k"] * state["x"] + features["push"](time)}

    def start(features, key):
        return {"x": features["x0"]}

    space = {
        "x0": vj.Box(-bound, bound),
        "k": vj.Box(-1, 0.5),
        "push": vj.Signal(vj.Box(-1, 1), knots=3, hold="linear"),
    }
    return vj.Problem(
        "first", space, vj.ode(pull, start, dt=0.1, steps=10), "always abs(x) < 1.5",
        nominal={"x0": 0.0, "k": -0.5, "push": 0.0},
    )  # fmt: skip


@pytest.mark.slow
def test_a_first_run_compiles_only_what_it_needs(compiled):
    run = vj.falsify(problem(), budget=64, stop=vj.Stop(after=1))
    assert len(run.table.counterexamples)
    # The search: init, ask, plan, tell. Simulations, gradients, the nominal point, two replays.
    assert len(compiled) <= 9, compiled
    vj.falsify(problem(), "uniform", budget=64, confirm=False)
    # Simulations in another batch, and two of the search; the nominal point again.
    assert len(compiled) <= 9 + 4, compiled


def test_a_second_run_of_a_problem_compiles_nothing(compiled):
    mine = problem()
    first = vj.falsify(mine, "uniform", budget=64)
    count = len(compiled)
    second = vj.falsify(mine, "uniform", budget=64)
    assert len(compiled) == count
    assert jnp.array_equal(first.table.all["rho"].to_numpy(), second.table.all["rho"].to_numpy())
