"""Integrators of diffrax as a method: stiff equations against SciPy, and the extra it needs."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import verifai_jax as vj
from verifai_jax.addons.simulators.blocks import adaptive
from verifai_jax.addons.simulators.blocks.adaptive import adaptive_solvers
from verifai_jax.core.messages.errors import MissingExtra, UnknownNameError
from verifai_jax.core.values.trace import Status
from verifai_jax.systems.ode import ode


def test_without_diffrax_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "diffrax", None)
    with pytest.raises(MissingExtra, match=r"pip install 'verifai_jax\[diffrax\]'"):
        adaptive()


def test_any_function_of_a_step_is_a_method():
    def midpoint(derivative, time, state, dt):
        half = jax.tree.map(lambda s, d: s + dt / 2 * d, state, derivative(time, state))
        return jax.tree.map(lambda s, d: s + dt * d, state, derivative(time + dt / 2, half))

    system = ode(lambda t, s, c, f: {"x": -s["x"]}, lambda f, key: {"x": 1.0}, dt=0.1, duration=0.5,
                 method=midpoint)  # fmt: skip
    np.testing.assert_allclose(system({})["x"], (1 - 0.1 + 0.005) ** np.arange(6), rtol=1e-5)


def van_der_pol(**options):
    """Relaxation oscillations, whose eigenvalues reach -3 mu: rk4 diverges at this step."""

    def slope(t, s, c, f):
        x, y = s["x"], s["y"]
        return {"x": y, "y": f["mu"] * (1 - x * x) * y - x}

    return ode(slope, lambda f, key: {"x": 2.0, "y": 0.0}, dt=0.1, duration=3.0, **options)


@pytest.mark.slow
def test_stiff_equations():
    pytest.importorskip("diffrax")
    system = van_der_pol(method=adaptive("Kvaerno5", rtol=1e-5, atol=1e-6))
    trace = jax.jit(system)({"mu": 100.0})
    oracle = solve_ivp(
        lambda t, s: [s[1], 100 * (1 - s[0] ** 2) * s[1] - s[0]], (0, 3), [2.0, 0.0],
        method="Radau", t_eval=np.linspace(0, 3, 31), rtol=1e-9, atol=1e-11,
    )  # fmt: skip
    np.testing.assert_allclose(trace["x"], oracle.y[0], atol=1e-4)
    assert int(van_der_pol()({"mu": 100.0}).status) == Status.NONFINITE


@pytest.mark.slow
def test_derivatives_and_batches():
    pytest.importorskip("diffrax")
    system = van_der_pol(method=adaptive("Tsit5", rtol=1e-5, atol=1e-6))
    last = jax.jit(jax.vmap(jax.value_and_grad(lambda mu: system({"mu": mu})["x"][-1])))
    mus = jnp.asarray([0.5, 1.0])
    _, slopes = last(mus)
    changes = (last(mus + 0.01)[0] - last(mus - 0.01)[0]) / 0.02
    np.testing.assert_allclose(slopes, changes, rtol=1e-2)
    forward = jax.jit(jax.jacfwd(lambda mu: system({"mu": mu})["x"][-1]))(0.5)
    np.testing.assert_allclose(forward, slopes[0], rtol=1e-3)


@pytest.mark.slow
def test_what_needs_too_many_steps_is_not_finite():
    pytest.importorskip("diffrax")
    system = van_der_pol(method=adaptive("Tsit5", max_steps=2))
    assert int(jax.jit(system)({"mu": 100.0}).status) == Status.NONFINITE


@pytest.mark.slow
def test_a_problem_with_it_is_falsified():
    pytest.importorskip("diffrax")
    system = van_der_pol(method=adaptive("Kvaerno3", rtol=1e-3, atol=1e-4))
    problem = vj.Problem("pol", {"mu": vj.Box(5.0, 10.0)}, system, "always x > 1.5")
    run = vj.falsify(problem, "uniform", 8, progress=False)
    assert run.simulations == 8
    assert len(run.table.failed) == 0


@pytest.mark.slow
def test_each_solver_that_is_known_can_be_used():
    diffrax = pytest.importorskip("diffrax")
    solvers = adaptive_solvers(diffrax)
    assert {"Tsit5", "Dopri8", "Kvaerno5"} <= set(solvers)
    for name in solvers:
        jax.eval_shape(van_der_pol(method=adaptive(name, rtol=1e-3)), {"mu": 1.0}, None)


def test_what_is_wrong_is_refused_where_it_is_made():
    pytest.importorskip("diffrax")
    with pytest.raises(UnknownNameError, match="did you mean 'Kvaerno5'"):
        adaptive("Kvaerno6")
    with pytest.raises(ValueError, match="rtol must lie between 0 and 1; got -1"):
        adaptive(rtol=-1.0)
    with pytest.raises(ValueError, match="max_steps"):
        adaptive(max_steps=0)
