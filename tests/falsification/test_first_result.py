"""What a first run compiles: no more programs than it needs, and none of them twice."""

import jax.numpy as jnp
import pytest

import verifai_jax as vj
from verifai_jax.core import compilation
from verifai_jax.evaluation.confirmation import Confirmer
from verifai_jax.falsification import loop
from verifai_jax.falsification.loop import Rounds


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


def settle():
    """Wait until nothing is compiled in the background."""
    compilation._pool().shutdown()
    compilation._pool.cache_clear()


@pytest.mark.thorough
def test_a_first_run_compiles_only_what_it_needs(compiled):
    run = vj.falsify(problem(), budget=64, stop_after=1)
    assert len(run.table.counterexamples)
    # The search: init, ask, plan, tell. Simulations, gradients, the nominal point, two replays.
    assert len(compiled) <= 9, compiled
    vj.falsify(problem(), "uniform", budget=64, confirm=False)
    # Simulations in another batch, and two of the search; the nominal point again.
    assert len(compiled) <= 9 + 4, compiled


def test_a_second_run_of_a_problem_compiles_nothing(compiled):
    mine = problem()
    first = vj.falsify(mine, "uniform", budget=64)
    settle()
    count = len(compiled)
    second = vj.falsify(mine, "uniform", budget=64)
    assert len(compiled) == count
    assert jnp.array_equal(first.table.all["rho"].to_numpy(), second.table.all["rho"].to_numpy())


def test_replays_begun_in_a_wait_are_those_that_failures_need(compiled):
    mine = problem()
    rows = vj.falsify(mine, "uniform", budget=64, confirm=False, progress=False).table.all
    columns = {name: rows[name].to_numpy() for name in rows}
    few = {name: column[:5] for name, column in columns.items()}
    some = {name: column[:20] for name, column in columns.items()}
    whole = Confirmer(mine)(some, rows.index[:20])
    fresh = problem()
    ahead = Confirmer(fresh)
    ahead.begin_compiling(1)  # Nothing is traced yet.
    ahead.prepare()
    ahead.begin_compiling(1)
    ahead.begin_compiling(20)
    settle()
    count = len(compiled)
    assert list(ahead(few, rows.index[:5]).verdict) == list(whole.verdict[:5])
    assert list(ahead(some, rows.index[:20]).verdict) == list(whole.verdict)
    assert len(compiled) == count


def test_what_a_run_did_not_wait_for_is_no_work_of_the_next_one():
    run = vj.falsify(problem(), "uniform", budget=8, batch=8, progress=False)
    assert len(run.table) == 8
    assert not [work for work in compilation._meanwhile if hasattr(work, "__self__")]


def test_replays_begun_in_a_wait_change_no_row(monkeypatch):
    options = {"budget": 64, "batch": 32, "seed": 1, "progress": False}
    monkeypatch.setattr(loop, "has_idle_core", lambda: False)
    plain = vj.falsify(problem(), "uniform", **options)
    begun = []
    begin = Rounds._begin_replays
    monkeypatch.setattr(Rounds, "_begin_replays", lambda self: [begun.append(1), begin(self)])
    monkeypatch.setattr(loop, "has_idle_core", lambda: True)
    # As if the first wait were long.
    monkeypatch.setattr(loop, "while_compiling", lambda work, after=1.0: work())
    ahead = vj.falsify(problem(), "uniform", **options)
    assert begun == [1]
    assert len(ahead.table.counterexamples)
    assert ahead.table.all.equals(plain.table.all)
