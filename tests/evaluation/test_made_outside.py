"""What is made outside of a simulation: the forms of features, and constants of either precision.

Confirmation traces its replays before there is a row. It must not make up values for that, which
the user's domains would refuse, and what was made in single precision must serve double precision.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.evaluation.confirmer import Confirmer
from verifai_jax.evaluation.replay import replay
from verifai_jax.systems.ode.delay_line import delay_line

CAR = vj.Struct({"size": vj.Box(1, 2), "at": vj.Struct({"kind": vj.Categorical("a", "b")})})


def traffic():
    event = {"to": "s", "wait": vj.Box(0.5, 1.0), "gap": vj.LogUniform(1, 9)}
    return vj.events.Automaton("s", {("s", "go"): event}, max_events=3, min_events=2)


EVENTS = {
    "events, two at least": traffic,
    "a structure of all": lambda: vj.Struct({"cars": vj.Array(CAR, length=(2, 3)), "t": traffic()}),
}
DOMAINS = {
    "a varying number of structures": vj.Array(CAR, length=(1, 4)),
    "no fewer than three": vj.Array(vj.DiscreteBox(3, 5), length=(3, 4)),
    "numbers without zero": vj.Categorical(1.5, 2.5),
}


def _problem(domain):
    def system(features, key):
        del key
        return vj.Trace({"x": jnp.full(2, features["x"])}, dt=1.0)

    return vj.Problem("p", {"x": vj.Box(-1, 1), "more": domain}, system, "x > 0")


@pytest.mark.thorough
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(
    "name", [*DOMAINS, *(pytest.param(name, marks=pytest.mark.addons) for name in EVENTS)]
)
def test_replays_are_planned_before_there_is_a_row(name, precision):
    problem = _problem(DOMAINS[name] if name in DOMAINS else EVENTS[name]())
    confirmer = Confirmer(problem, precision)
    confirmer.prepare()
    assert not confirmer.raised
    assert "float64" in confirmer._checks
    # The form is that of the rows that come later.
    points = np.full((1, problem.space.dim), 0.3, np.float32)
    rows = problem.space.rows(problem.space.features_at(points))
    features = problem.space.features_of(rows, "float64")
    form = problem.space.feature_form_in("float64")
    assert jax.tree.structure(form) == jax.tree.structure(features)
    for wanted, leaf in zip(jax.tree.leaves(form), jax.tree.leaves(features), strict=True):
        assert wanted.shape == leaf.shape[1:]


@pytest.mark.addons
@pytest.mark.thorough
def test_failures_with_items_are_confirmed():
    run = vj.falsify(_problem(EVENTS["a structure of all"]()), "uniform", 24, progress=False)
    failing = run.table.all.query("rho < 0")
    assert len(failing) > 4
    assert set(failing["verdict"]) == {"confirmed"}
    assert not [note for note in run.notes if "not " in note]


LINE = delay_line(0.0, longest=0.4, period=0.1)
MEMORY = {"line": delay_line(jnp.zeros(2), longest=0.4, period=0.1), "sum": jnp.zeros(())}
GAIN = jnp.asarray(0.5)


def _in_state():
    return vj.ode(
        lambda t, s, c, f: {"x": f["v"] - s["line"].at(t - f["lag"]), "line": LINE.still},
        lambda f, key: {"x": f["v"], "line": LINE},
        update=lambda t, s, f: {**s, "line": s["line"].push(t, s["x"])},
        signals=lambda t, s, c, f: {"x": s["x"]},
        dt=0.1, duration=1.0,
    )  # fmt: skip


def _in_memory():
    def control(t, s, m, f):
        line = m["line"].push(t, jnp.stack([s["x"], s["x"]]))
        return GAIN * line.at(t - f["lag"])[0], {"line": line, "sum": GAIN}

    table = jnp.asarray([0.0, 1.0])
    return vj.ode(
        lambda t, s, c, f: {"x": f["v"] * table[1] - c},
        lambda f, key: {"x": f["v"]},
        controller=control, controller_memory=MEMORY, dt=0.1, duration=1.0,
    )  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("system", [_in_state, _in_memory])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_blocks_made_outside_serve_both_precisions(system, precision):
    space = {"v": vj.Box(0.1, 1), "lag": vj.Box(0.1, 0.3)}
    problem = vj.Problem("lagging", space, system(), "always x > 0.5")
    problem.check()
    confirmer = Confirmer(problem, precision)
    confirmer.prepare()
    assert set(confirmer._checks) >= {"float64", "third_step"}
    trace = replay(problem, {"v": 0.25, "lag": 0.2}, run_keys(0)[1], 0, precision).trace
    assert trace["x"].dtype == precision
    assert np.all(np.isfinite(trace["x"]))
