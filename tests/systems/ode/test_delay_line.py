"""Transport delays: x' = -x(t - 1), solved by hand piece by piece, and delays that vary."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.systems.ode import ode
from verifai_jax.systems.ode.delay_line import delay_line


def loop(dt):
    return ode(
        lambda t, s, c, f: {"x": -s["line"].at(t - f["delay"]), "line": s["line"].still},
        lambda f, key: {"x": 1.0, "line": delay_line(1.0, longest=1.2, period=dt)},
        dt=dt,
        duration=3.0,
        update=lambda t, s, f: {**s, "line": s["line"].push(t, s["x"])},
        signals=lambda t, s, c, f: {"x": s["x"]},
    )


def by_hand(t):
    """The method of steps: x = 1 until time 0."""
    one, two, three = 1 - t, (t - 1) ** 2 / 2, (t - 2) ** 3 / 6
    return one + np.where(t > 1, two, 0) - np.where(t > 2, three, 0)


def test_a_delayed_equation_converges_to_its_solution():
    errors = []
    for dt in (0.1, 0.05):
        x = loop(dt)({"delay": 1.0})["x"]
        errors.append(np.abs(x - by_hand(np.arange(len(x)) * dt)).max())
    assert errors[0] < 2e-3
    assert errors[1] < errors[0] / 3


@pytest.mark.thorough
def test_a_finer_step_reads_the_same_line():
    coarse, fine = loop(0.1)({"delay": 0.93})["x"], loop(0.1).refined(3)({"delay": 0.93})["x"]
    np.testing.assert_allclose(fine, coarse, atol=2e-3)


@pytest.mark.thorough
def test_the_derivative_in_the_delay():
    last = jax.jit(lambda delay: loop(0.1)({"delay": delay})["x"][-1])
    change = (last(0.93 + 0.01) - last(0.93 - 0.01)) / 0.02
    assert float(jax.grad(last)(0.93)) == pytest.approx(float(change), abs=2e-3)


@pytest.mark.thorough
def test_it_holds_what_it_was_given():
    line = delay_line(jnp.asarray([5.0, 6.0]), longest=0.2, period=0.1)
    for time, value in ((0.1, 1.0), (0.2, 3.0)):
        line = line.push(time, [value, value])
    for time, value in ((0.3, 3), (0.2, 3), (0.15, 2), (0.1, 1), (0.0, 5), (-9.0, 5)):
        assert line.at(time)[0] == pytest.approx(value, abs=1e-5)
    assert jnp.all(line.still.values == 0)


@pytest.mark.parametrize("seconds", [0, -1.0, float("nan")])
def test_what_is_wrong_is_refused_where_it_is_made(seconds):
    with pytest.raises(ValueError, match="longest must be a positive number of seconds"):
        delay_line(0.0, longest=seconds, period=0.1)
    with pytest.raises(ValueError, match="period must be a positive number of seconds"):
        delay_line(0.0, longest=1.0, period=seconds)


@pytest.mark.parametrize("value", [float("nan"), "5"])
def test_refuses_what_is_no_number(value):
    with pytest.raises(ValueError, match="value must be a finite number or an array; got "):
        delay_line(value, longest=1.0, period=0.1)


@pytest.mark.parametrize("period", [0.05, 0.15])
def test_a_line_that_is_fed_at_another_period_is_refused(period):
    # Read 0.2 s ago, it would have said what was 0.4 s ago.
    line = delay_line(0.0, longest=0.5, period=period)
    plant = ode(
        lambda t, s, c, f: {"x": 1.0 - s["line"].at(t - 0.2), "line": s["line"].still},
        lambda f, key: {"x": 0.0, "line": line},
        update=lambda t, s, f: {**s, "line": s["line"].push(t, s["x"])},
        signals=lambda t, s, c, f: {"x": s["x"]}, dt=0.1, duration=1.0,
    )  # fmt: skip
    with pytest.raises(ValueError, match=rf"must be dt.* \(0.1 s\), or .*; got period={period}"):
        plant({})
    sampled = ode(
        lambda t, s, c, f: {"x": c}, lambda f, key: {"x": 0.0}, dt=0.02, duration=1.0,
        controller=lambda t, s, m, f: (m.at(t - 0.2), m.push(t, s["x"])),
        controller_memory=line, control_period=0.1,
    )  # fmt: skip
    with pytest.raises(ValueError, match=rf"the control period.*0.1 s.*; got period={period}"):
        sampled({})


def test_a_line_that_nothing_feeds_is_refused():
    plant = ode(
        lambda t, s, c, f: {"x": 1.0 - s["line"].at(t - 0.2), "line": s["line"].still},
        lambda f, key: {"x": 0.0, "line": delay_line(0.0, longest=0.5, period=0.1)},
        signals=lambda t, s, c, f: {"x": s["x"]}, dt=0.1, duration=1.0,
    )  # fmt: skip
    with pytest.raises(ValueError, match="a delay_line in the state needs update="):
        plant({})
