"""The online monitor against the offline one and against the definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from hypothesis import HealthCheck, given, settings
from mtl_oracle import DT, Oracle, formulas, recordings

from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import IntervalError, online, robustness

UNCOMPILED = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def bounded(formula):
    try:
        return online(formula, DT)
    except ValueError:
        return None


@pytest.mark.slow
@given(formulas(3), recordings(sizes=(1, 5, 7)))
@UNCOMPILED
def test_every_prefix_equals_the_offline_value_and_lies_in_the_interval(formula, recording):
    with jax.enable_x64(True), jax.disable_jit():
        monitor = bounded(formula)
        if monitor is None:
            return
        final = Oracle(recording).rho(formula, 0)
        state = monitor.init()
        bounds = [(-np.inf, np.inf)]
        n = len(recording["x"])
        for k in range(n):
            state = monitor.step(state, {name: np.asarray(v[k]) for name, v in recording.items()})
            if k in (0, n // 2, n - 1):
                prefix = {name: v[: k + 1] for name, v in recording.items()}
                assert monitor.finish(state) == Oracle(prefix).rho(formula, 0)
                low, high = (float(b) for b in monitor.interval(state))
                assert bounds[-1][0] <= low <= final <= high <= bounds[-1][1]
                bounds.append((low, high))


def test_a_rollout_carries_its_monitor():
    text = "G[0,3] ((x > 0) -> F[0.2,0.6] (y > 0)) & ((x > -3) U[0,2] (y > 1))"
    monitor = online(text, 0.1)
    rng = np.random.default_rng(0)
    x, y = (jnp.asarray(rng.normal(size=(8, 50)), jnp.float32) for _ in range(2))

    def rollout(x, y):
        def step(state, row):
            return monitor.step(state, {"x": row[0], "y": row[1]}), None

        return monitor.finish(jax.lax.scan(step, monitor.init(), (x, y))[0])

    values = jax.jit(jax.vmap(rollout))(x, y)
    expected = jax.vmap(lambda x, y: robustness(text, Trace({"x": x, "y": y}, dt=0.1)))(x, y)
    np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("formula", ["G[0,2] x > 0", "F[1,3] x > 1", "G[1,2] F[0,1] x > 0"])
def test_a_number_of_samples_that_is_known_gives_the_same_value(formula):
    monitor = online(formula, 1.0)
    with jax.disable_jit():
        state = monitor.init()
        for count, x in enumerate((0.5, 2.0, -1.0, 3.0, 4.0, 0.2), start=1):
            state = monitor.step(state, {"x": x})
            assert monitor.finish(state, count) == monitor.finish(state)


def test_the_interval_closes_as_soon_as_the_answer_is_known():
    monitor = online("F[0,1] (x > 0) & G[0,0.5] (x > -1)", 0.5)
    state = monitor.init()
    assert monitor.interval(state) == (-np.inf, np.inf)
    state = monitor.step(state, {"x": 0.25})
    assert monitor.interval(state) == (-np.inf, 1.25)
    state = monitor.step(state, {"x": -0.5})
    assert monitor.interval(state) == (0.25, 0.5)
    state = monitor.step(state, {"x": 7.0})
    assert monitor.interval(state) == (0.5, 0.5)
    state = monitor.step(state, {"x": -9.0})
    assert monitor.interval(state) == (0.5, 0.5)


def test_memory_grows_with_what_is_looked_back_on_and_not_with_the_trace():
    for text, least, most in (
        ("G (x > 0)", 3, 5),
        ("G[0,100] (x > 0)", 3, 5),
        ("(x > 0) U (y > 0)", 4, 8),
        ("G (x > 0 -> F[0,1] (y > 0))", 20, 40),
        ("G (x > 0 -> F[0,10] (y > 0))", 200, 220),
    ):
        memory = online(text, 0.1, gaps=False).memory
        assert least <= memory < most
        assert memory < online(text, 0.1).memory < 3 * memory


def test_not_a_number_stays():
    monitor = online("G (x > 0)", 0.1)
    state = monitor.init()
    assert np.isnan(monitor.finish(state))
    for value in (1.0, np.nan, 2.0):
        state = monitor.step(state, {"x": value})
    assert np.isnan(monitor.finish(state))


@pytest.mark.thorough
def test_what_cannot_be_monitored_is_said_at_once():
    with pytest.raises(ValueError, match=r"eventually \(x > 0\) looks ahead without end"):
        online("G (y > 0 -> F (x > 0))", 0.1)
    with pytest.raises(IntervalError):
        online("G[0,0.15] (x > 0)", 0.1)
    with unchecked(), pytest.raises(ValueError, match="dt must be positive; got 0"):
        online("G (x > 0)", 0)
    monitor = online("G (speed > 0)", 0.1)
    with pytest.raises(
        UnknownNameError, match="the sample has no signal 'speed'; did you mean 'sped'"
    ):
        monitor.step(monitor.init(), {"sped": 1.0})


@pytest.mark.slow
def test_a_part_that_stands_in_several_places_is_followed_once():
    text = "x > 0"
    for i in range(16):
        text = f"({text}) <-> (y > {i})"
    monitor = online(text, DT, gaps=False)
    assert monitor.memory < 200
    with jax.disable_jit():
        state = monitor.step(monitor.init(), {"x": 2.0, "y": 3.5})
        trace = Trace({"x": np.full(1, 2.0), "y": np.full(1, 3.5)}, dt=DT)
        assert monitor.finish(state) == robustness(text, trace)
