"""Every requirement of the competition is there, fits its system, and holds on an ordinary day."""

import jax
import jax.numpy as jnp
import pytest

import verifai_jax as vj
from specs.arch import (
    automatic_transmission,
    chasing_cars,
    f16,
    fuel_control,
    neural_network_controller,
    pacemaker,
    steam_condenser,
)

MODULES = (
    automatic_transmission,
    chasing_cars,
    f16,
    fuel_control,
    neural_network_controller,
    pacemaker,
    steam_condenser,
)
PROBLEMS = {
    name: problem
    for module in MODULES
    for name, problem in vars(module).items()
    if isinstance(problem, vj.Problem)
}
BOTH = ["at1", "at2", "at51", "at52", "at53", "at54", "at6a", "at6b", "at6c", "at6abc"]
BOTH += ["cc1", "cc2", "cc3", "cc4", "cc5", "ccx", "nn", "nn_wide", "nnx", "pm", "sc"]


def test_requirements_are_complete():
    wanted = {f"{name}{suffix}" for name in BOTH for suffix in ("", "_instance1")}
    assert set(PROBLEMS) == wanted | {"f16a", "f16a_high", "afc27", "afc29", "afc33"}
    assert all(name == problem.name for name, problem in PROBLEMS.items())


@pytest.mark.thorough
@pytest.mark.parametrize("name", PROBLEMS)
def test_problem_fits_its_system_and_looks_no_further(name):
    problem = PROBLEMS[name]
    problem.check()
    assert problem.nominal is not None
    assert problem.description
    for formula in problem.formulas.values():
        assert formula.horizon() <= problem.system.duration + 1e-9


@pytest.mark.thorough
@pytest.mark.parametrize("module", MODULES)
def test_requirements_hold_on_an_ordinary_day(module):
    problems = [p for p in vars(module).values() if isinstance(p, vj.Problem)]
    # A formula looks no further than its own horizon, so that the longest simulation serves all.
    longest = max((p.system for p in problems), key=lambda system: system.duration)
    run, traces = jax.jit(longest.__call__), {}
    for problem in problems:
        day = str(problem.nominal)
        if day not in traces:
            traces[day] = run({name: jnp.array(v) for name, v in problem.nominal.items()})
        for formula in problem.formulas.values():
            assert float(vj.mtl.robustness(formula, traces[day])) > 0, problem.name
