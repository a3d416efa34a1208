"""Switches against closed forms and SciPy's events, their derivatives, latches and hysteresis."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from scipy.integrate import solve_ivp

from verifai_jax.core.values.trace import Status
from verifai_jax.systems.ode import ode
from verifai_jax.systems.ode.switching import Switch, hysteresis, latch

G, BACK, ONE = 9.81, 0.8, np.float32(1)
FLOOR = Switch(
    lambda t, s, f: s["height"],
    lambda t, s, f: {"height": s["height"], "speed": -BACK * s["speed"], "hits": s["hits"] + 1},
)


def ball(duration=1.7, **options):
    return ode(
        lambda t, s, c, f: {
            "height": s["speed"],
            "speed": -G * jnp.ones(()),
            "hits": jnp.zeros(()),
        },
        lambda f, key: {"height": f["height"], "speed": 0.0, "hits": 0.0},
        **{"dt": 0.034, "duration": duration, "switches": [FLOOR], **options},
    )


def bounces(height, clock):
    """Height and number of hits of a ball at each time, by its parabolas."""
    start, speed, heights, hits = -np.sqrt(2 * height / G), np.sqrt(2 * height * G), [], []
    for time in clock:
        begin, up, count = start, speed, 0
        while time > begin + 2 * up / G:
            begin, up, count = begin + 2 * up / G, BACK * up, count + 1
        heights.append(up * (time - begin) - G / 2 * (time - begin) ** 2)
        hits.append(count)
    return np.array(heights), np.array(hits)


def test_a_ball_bounces_at_the_right_instants():
    run = jax.jit(jax.vmap(lambda h: ball()({"height": h})))
    heights = np.float32([1.0, 0.4, 2.3])
    traces = run(heights)
    clock = np.arange(51) * 0.034
    for i, height in enumerate(heights):
        expected, hits = bounces(float(height), clock)
        np.testing.assert_allclose(traces["height"][i], expected, atol=3e-5)
        np.testing.assert_array_equal(traces["hits"][i], hits)


@pytest.mark.thorough
def test_the_derivative_goes_through_the_instant():
    """The height at the end moves with the instants of the hits."""
    last = jax.jit(lambda h: ball()({"height": h})["height"][-1])
    change = (bounces(1.001, [1.7])[0][0] - bounces(0.999, [1.7])[0][0]) / 0.002
    assert float(jax.jit(jax.grad(last))(1.0)) == pytest.approx(change, rel=2e-3)
    assert float(jax.jit(jax.jacfwd(last))(1.0)) == pytest.approx(change, rel=2e-3)


def room(**options):
    """A thermostat in two modes, the switch of each armed by the mode, and a latch of the alarm."""
    heat = Switch(
        lambda t, s, f: jnp.where(s["on"] > 0.5, 1.0, s["x"] - 18.0),
        lambda t, s, f: {**s, "on": jnp.ones(()), "turns": s["turns"] + 1},
    )
    cool = Switch(
        lambda t, s, f: jnp.where(s["on"] > 0.5, 22.0 - s["x"], 1.0),
        lambda t, s, f: {**s, "on": jnp.zeros(()), "turns": s["turns"] + 1},
    )
    zero = jnp.zeros(())
    return ode(
        lambda t, s, c, f: {"x": 3 * (10 + 25 * s["on"] - s["x"]), "on": zero, "turns": zero},
        lambda f, key: {"x": 20.0, "on": 0.0, "turns": 0.0},
        **{"dt": 0.05, "duration": 2.0, "switches": [heat, cool], **options},
    )


@pytest.mark.thorough
@pytest.mark.parametrize("factor", [1, 3])
def test_modes_change_as_by_the_events_of_scipy(factor):
    trace = room().refined(factor)({})
    clock, x, on, turns = np.linspace(0, 2, 41), [20.0], 0, [0]
    for begin, end in pairwise(clock):
        now, value, count = begin, x[-1], turns[-1]
        while now < end - 1e-12:
            limit = 22.0 if on else 18.0

            def crossing(t, y, limit=limit):
                return y[0] - limit

            crossing.terminal, crossing.direction = True, 1 if on else -1
            found = solve_ivp(
                lambda t, y, on=on: 3 * (10 + 25 * on - y),
                (now, end), [value], events=crossing, rtol=1e-9, atol=1e-9,
            )  # fmt: skip
            now, value = found.t[-1], found.y[0, -1]
            if found.status == 1:
                on, count, value = 1 - on, count + 1, limit
        x.append(value)
        turns.append(count)
    # What rk4 is off by shifts the phase of the cycle, and adds up.
    np.testing.assert_allclose(trace["x"], x, atol={1: 5e-4, 3: 5e-5}[factor])
    np.testing.assert_array_equal(trace["turns"], turns)
    assert turns[-1] >= 6


def test_two_switches_in_one_step_both_happen():
    def at(instant, name):
        return Switch(lambda t, s, f: instant - t, lambda t, s, f: {**s, name: s[name] + 1})

    zero = jnp.zeros(())
    system = ode(
        lambda t, s, c, f: {"a": zero, "b": zero, "x": s["a"]},
        lambda f, key: {"a": 0.0, "b": 0.0, "x": 0.0},
        dt=0.1,
        duration=0.4,
        switches=[at(0.17, "b"), at(0.125, "a")],
    )
    trace = system({})
    np.testing.assert_array_equal(trace["a"], [0, 0, 1, 1, 1])
    np.testing.assert_array_equal(trace["b"], [0, 0, 1, 1, 1])
    # The first of the two is located: x grows from 0.125 s on.
    np.testing.assert_allclose(trace["x"], [0, 0, 0.075, 0.175, 0.275], atol=1e-6)


def gears(count, extra=0):
    """A car that shifts up `count` times; nothing but its dynamics takes a sine.

    They have so many `extra` operations.
    """
    calls = []

    def dynamics(t, s, c, f):
        calls.append(t)
        force = f["push"] * (2 + jnp.sin(s["speed"]))
        for _ in range(extra):
            force = force * 1.0
        return {"speed": force / (1 + s["gear"]), "gear": 0.0 * t}

    def shift(gear):
        return Switch(
            lambda t, s, f: jnp.where(s["gear"] == gear, 3.0 * gear + 2 - s["speed"], 1.0),
            lambda t, s, f: {**s, "gear": s["gear"] + 1},
        )

    switches = [shift(gear) for gear in range(count)]
    system = ode(
        dynamics,
        lambda f, key: {"speed": 0.0, "gear": 0.0},
        dt=0.05,
        duration=2.0,
        switches=switches,
    )
    return system, calls


@pytest.mark.slow
@pytest.mark.parametrize(("extra", "copies"), [(0, 19), (30, 10)])
def test_the_dynamics_are_traced_as_often_for_many_switches_as_for_one(extra, copies):
    times, sines = [], []
    for count in (1, 5):
        system, calls = gears(count, extra)
        run = lambda push, system=system: system({"push": push})["speed"][-1]  # noqa: E731
        one = str(jax.make_jaxpr(run)(ONE)).count("= sin ")
        batch = str(jax.make_jaxpr(jax.vmap(run))(np.ones(3, np.float32))).count("= sin ")
        slopes = str(jax.make_jaxpr(jax.grad(run))(ONE)).count("= sin ")
        times.append(len(calls))
        sines.append((one, batch, slopes))
    assert times[0] == times[1]
    assert sines[0] == sines[1]
    # Four stages to the end of the step; where something happens, two for the cubic, four or a loop
    # for each of three more integrations, and one for what the guards do behind the instant.
    assert sines[0][:2] == (copies, copies)


@pytest.mark.slow
def test_a_batch_in_which_little_happens_is_what_its_simulations_are_alone():
    """The branch of the events is taken by lanes in which nothing happens, too."""
    system, _ = gears(3, 30)

    def last(push):
        return system({"push": push})["speed"][-1]

    both = jax.jit(jax.value_and_grad(last))
    pushes = np.float32([0.1, 3.0, 8.0])
    speeds, slopes = np.transpose([both(push) for push in pushes])
    batch = jax.jit(jax.vmap(jax.value_and_grad(last)))(pushes)
    np.testing.assert_allclose(batch, (speeds, slopes), rtol=2e-5)
    # The derivative of a batch, of batches.
    total = jax.grad(lambda pushes: jnp.sum(jax.vmap(jax.vmap(last))(pushes)))
    np.testing.assert_allclose(jax.jit(total)(pushes[:, None])[:, 0], slopes, rtol=2e-5)
    change = (both(3.01)[0] - both(2.99)[0]) / 0.02
    assert slopes[1] == pytest.approx(float(change), rel=5e-3)


@pytest.mark.thorough
def test_no_jump_hides_what_is_not_finite():
    system = ode(
        lambda t, s, c, f: {"x": jnp.where(t > 0.35, jnp.inf, -1.0), "y": -jnp.ones(())},
        lambda f, key: {"x": 0.0, "y": 0.45},
        dt=0.1,
        duration=1.0,
        switches=[Switch(lambda t, s, f: s["y"], lambda t, s, f: {"x": 0.0 * s["y"], "y": s["y"]})],
        update=lambda t, s, f: {**s, "x": jnp.where(jnp.isfinite(s["x"]), s["x"], 0.0)},
    )
    assert int(system({}).status) == Status.NONFINITE


def test_latches_and_hysteresis():
    on, seen = jnp.zeros(()), []
    for value in (60.0, 69.9, 70.0, 55.0, 50.0, 49.9, 60.0):
        on = hysteresis(on, value, 50.0, 70.0)
        seen.append(float(on))
    assert seen == [0, 0, 1, 1, 1, 0, 0]
    assert [float(latch(was, now)) for was in (0, 1) for now in (False, True)] == [0, 1, 1, 1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"switches": [1]}, r"a list of vj.blocks.Switch; got 1"),
        (
            {"switches": [Switch(lambda t, s, f: s["height"] > 0, FLOOR.reset)]},
            r"guard of a Switch must return one real number; got bool\[\]",
        ),
        (
            {"switches": [Switch(FLOOR.guard, lambda t, s, f: s["height"])]},
            "reset of a Switch must return a state, in the form of the state",
        ),
        ({"switches": FLOOR}, r"must be a list of vj.blocks.Switch; got one: write \[switch\]"),
        ({"method": lambda d, t, s: s}, r"method is called with \(derivative, time, state, dt\)"),
        ({"update": lambda t, s, f: 0.0}, "update must return a state, in the form of the state"),
    ],
)
def test_what_is_wrong_is_refused_where_it_is_made(options, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        ball(**options)({"height": 1.0})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Switch(1, FLOOR.reset), r"guard must be a function \(time, state, f.*; got 1"),
        (lambda: Switch(FLOOR.guard, None), "reset must be a function .*; got None"),
        (
            lambda: Switch(lambda s: s, FLOOR.reset),
            r"guard is called with \(time, state, features\)",
        ),
        (
            lambda: Switch(FLOOR.guard, lambda s: s),
            r"reset is called with \(time, state, features\)",
        ),
        (lambda: hysteresis(0, 1, 3, 2), r"hysteresis needs low <= high; got \(low=3, high=2\)"),
    ],
)
def test_what_is_refused_at_once(make, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        make()
