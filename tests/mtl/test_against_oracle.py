"""Random formulas on random traces against the definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mtl_oracle import DT, Oracle, formulas, recordings

from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import (
    boolean,
    nnf,
    parse,
    robustness,
    robustness_signal,
    simplify,
    smooth,
    smoothing_error,
)

# Every example is another program: compiling them would take far longer than running them, and to
# run one operation by operation takes half a second. Each run of the tests draws other examples.
UNCOMPILED = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@pytest.fixture(autouse=True, scope="module")
def _interpreted():
    with jax.enable_x64(True), jax.disable_jit():
        yield


def trace_of(recording):
    return Trace({name: np.asarray(v, float) for name, v in recording.items()}, dt=DT)


@pytest.mark.thorough
@given(formulas(), recordings(), st.sampled_from(["hold", "truncate"]))
@UNCOMPILED
def test_hard_and_boolean_equal_the_definitions(formula, recording, end):
    trace, oracle = trace_of(recording), Oracle(recording, end)
    expected = [oracle.rho(formula, i) for i in range(trace.length)]
    np.testing.assert_array_equal(robustness_signal(formula, trace, end=end), expected)
    assert robustness(formula, trace, end=end) == expected[0]
    verdicts = np.asarray(robustness_signal(formula, trace, boolean, end=end)) > 0
    np.testing.assert_array_equal(verdicts, [oracle.holds(formula, i) for i in range(trace.length)])


@pytest.mark.slow
@given(formulas(), recordings(), st.sampled_from([1e-3, 0.1, 3.0]))
@UNCOMPILED
def test_smooth_stays_within_its_certificate(formula, recording, tau):
    trace, oracle = trace_of(recording), Oracle(recording)
    exact = oracle.rho(formula, 0)
    value = float(robustness(formula, trace, smooth(tau)))
    if np.isinf(exact):
        assert value == exact
        return
    sides = smoothing_error(formula, trace)
    rounding = 1e-9
    assert value - tau * sides.above <= exact + rounding
    assert exact <= value + tau * sides.below + rounding
    lower = float(robustness(formula, trace, smooth(tau, bound="lower")))
    upper = float(robustness(formula, trace, smooth(tau, bound="upper")))
    assert lower - rounding <= exact <= upper + rounding
    near = float(robustness(formula, trace, smooth(error=0.01)))
    assert abs(near - exact) <= 0.01 + rounding


@pytest.mark.slow
@given(formulas())
@settings(max_examples=300, deadline=None)
def test_the_text_parses_back(formula):
    assert parse(str(formula)) == formula


@given(formulas(3), recordings())
@UNCOMPILED
def test_rewriting_keeps_the_value(formula, recording):
    oracle = Oracle(recording)
    for rewritten in (nnf(formula), simplify(formula)):
        for i in range(len(recording["x"])):
            assert oracle.rho(rewritten, i) == oracle.rho(formula, i)
    for i in range(len(recording["x"])):
        assert oracle.holds(nnf(formula), i) == oracle.holds(formula, i)


@pytest.mark.thorough
@given(formulas(3), recordings(sizes=(6,)), st.sampled_from([0.05, 0.5]))
@settings(UNCOMPILED, max_examples=10)
def test_gradient_equals_finite_differences(formula, recording, tau):
    base = trace_of(recording)
    # Off the grid, because |x| and == have corners on it.
    x = jnp.asarray(base["x"]) + jnp.linspace(0.01, 0.037, 6)

    def rho(x):
        return robustness(formula, Trace({**base.signals, "x": x}, dt=DT), smooth(tau))

    if not np.isfinite(rho(x)):
        return
    direction = jnp.asarray([0.3, -1.0, 0.7, 0.2, -0.4, 1.1])
    step = 1e-6
    expected = (rho(x + step * direction) - rho(x - step * direction)) / (2 * step)
    reverse = jnp.vdot(jax.grad(rho)(x), direction)
    forward = jax.jvp(rho, (x,), (direction,))[1]
    np.testing.assert_allclose(reverse, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
