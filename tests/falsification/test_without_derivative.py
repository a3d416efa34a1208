"""Systems with a step that has no derivative: the default search goes on without gradients."""

import re

import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import io_callback
from jax.interpreters import batching, mlir

import verifai_jax as vj
from verifai_jax.problem.dependence import has_gradient, without_derivative


def road(x):
    return np.asarray(2 * x, np.float32)


def on_host(x):
    return jax.pure_callback(
        road, jax.ShapeDtypeStruct((), jnp.float32), x, vmap_method="expand_dims"
    )


doubled = jax.extend.core.Primitive("doubled")
doubled.def_abstract_eval(lambda x: x)
mlir.register_lowering(doubled, mlir.lower_fun(lambda x: 2 * x, multiple_results=False))
batching.defvectorized(doubled)


@jax.custom_jvp
def known(x):
    return on_host(x)


known.defjvp(lambda x, t: (known(x[0]), 2 * t[0]))


@jax.custom_vjp
def known_backwards(x):
    return on_host(x)


known_backwards.defvjp(lambda x: (on_host(x), None), lambda _, g: (2 * g,))

STEPS = {
    "host callback": (on_host, r"pure_callback of road \(.*test_without_derivative.py, line \d+\)"),
    "custom operation": (doubled.bind, r"doubled \("),
    "in a loop": (
        lambda x: jax.lax.scan(lambda c, _: (on_host(c), None), x, None, length=2)[0],
        "pure_callback of road",
    ),
    "its own derivative": (known, None),
    "its own derivative, backwards": (known_backwards, None),
    "stopped before": (lambda x: x + on_host(jax.lax.stop_gradient(x)), None),
}


def problem(step, formula="always y > 0", dim=2):
    def system(features, key):
        x = jnp.asarray(features["x"])
        read = {"y": jnp.full(2, 1.5 + step(x)), "plain": jnp.full(2, 1.5 + 2 * x)}
        return vj.Trace(read, dt=1.0)

    space = {f"{name}": vj.Box(-1.0, 1.0) for name in ("x", "z")[:dim]}
    return vj.Problem("p", space, system, formula)


@pytest.mark.parametrize("name", STEPS)
def test_steps_without_a_derivative_are_found(name):
    step, said = STEPS[name]
    lacking = without_derivative(problem(step))
    if said is None:
        assert lacking is None
        assert has_gradient(problem(step))
    else:
        assert lacking is not None
        assert re.match(said, lacking), lacking


def test_what_is_never_read_lacks_nothing():
    unread = problem(on_host, "always plain > 0")
    assert without_derivative(unread) is None
    assert has_gradient(unread)


@pytest.mark.slow
def test_the_default_search_goes_on_and_says_so_once():
    run = vj.falsify(
        problem(on_host), budget=200, stop=vj.Stop(after=1), progress=False, confirm=False
    )
    said = [note for note in run.notes if "pure_callback" in note]
    assert len(said) == 1
    assert said[0].startswith("portfolio without gradients: pure_callback of road (")
    assert said[0].endswith(" has no derivative")
    assert (run.table.all["rho"] < 0).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("step", "formula", "dim"),
    [
        (on_host, "always plain > 0", 2),
        (known_backwards, "always y > 0", 1),
    ],
)
def test_gradients_stay_where_there_are_some(step, formula, dim):
    run = vj.falsify(
        problem(step, formula, dim), "gradient", budget=32, progress=False, confirm=False
    )
    assert (run.table.all["rho"] < 0).any()


def test_a_search_that_needs_gradients_is_refused_before_anything_compiles():
    with pytest.raises(ValueError, match=r"pure_callback of road .* has no derivative\. Use a"):
        vj.falsify(problem(on_host), "gradient", budget=32, progress=False)


@pytest.mark.thorough
def test_other_verbs_do_without_too():
    estimate = vj.estimate(problem(on_host), budget=400, progress=False)
    assert 0 < estimate.probability < 0.5
    small = vj.falsify(problem(on_host), "uniform", budget=64, progress=False, confirm=False)
    row = int(small.table.all["rho"].idxmin())
    assert vj.shrink(small, row, nominal={"x": 0.9, "z": 0.0}, budget=100) is not None


def alone(x):
    return jax.pure_callback(road, jax.ShapeDtypeStruct((), jnp.float32), x)


def in_order(x):
    return io_callback(road, jax.ShapeDtypeStruct((), jnp.float32), x, ordered=True)


lonely = jax.extend.core.Primitive("lonely")
lonely.def_abstract_eval(lambda x: x)
ALONE = {
    "callback": (alone, r"pure_callback of road \(.*line \d+\) is for one .* vmap_method='seq"),
    "in a loop": (
        lambda x: jax.lax.fori_loop(0, 3, lambda _, x: alone(x), x),
        "pure_callback of road",
    ),
    "in order": (in_order, "io_callback of road .*; write ordered=False, or make the system a vj"),
    "custom operation": (lonely.bind, r"lonely \(.*'lonely'.*\); give the operation a rule"),
}


@pytest.mark.parametrize("name", ALONE)
def test_steps_for_one_simulation_at_a_time_are_refused(name):
    step, said = ALONE[name]
    for ends in (problem(step).check, lambda: vj.falsify(problem(step), budget=8)):
        with pytest.raises(vj.ProblemError, match=said):
            ends()


def test_steps_that_have_a_rule_for_batches_are_not():
    for step, _ in STEPS.values():
        problem(step).check()
    ruled = jax.custom_batching.custom_vmap(alone)
    ruled.def_vmap(lambda size, moved, x: (on_host(x), True))
    problem(ruled).check()


@pytest.mark.thorough
def test_what_cannot_be_compiled_ends_with_its_reason(monkeypatch):
    def refuses(*_, **__):
        raise NotImplementedError("no such operation here")

    monkeypatch.setattr("verifai_jax.falsification.loop.Rounds.compile", refuses)
    with pytest.raises(vj.RunError, match=r"after 0 simulations: .* no such operation here"):
        vj.falsify(problem(lambda x: x), "uniform", 8, progress=False)
