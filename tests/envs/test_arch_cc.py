import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import verifai_jax as vj
from envs.arch import chasing_cars as cc
from specs.arch import chasing_cars as specs
from verifai_jax.core.values.waveform import Waveform

NAMES = [f"y{i}" for i in range(1, 6)]


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64():
        yield


@pytest.fixture(scope="module")
def located():
    """Simulates 25 s, with inputs that change every 5 s."""
    with jax.enable_x64():
        system = cc.chasing_cars(25.0)

        @jax.jit
        def run(throttle, brake):
            pieces = {"throttle": throttle, "brake": brake}
            trace = system({n: Waveform(k, "constant") for n, k in pieces.items()})
            return jnp.stack([trace[name] for name in NAMES])

        return lambda *inputs: np.asarray(run(*(jnp.asarray(k, jnp.float64) for k in inputs)))


def places(trace, time):
    return [float(trace[name][round(time * 100)]) for name in NAMES]


@pytest.mark.thorough
def test_transitions_at_the_end_of_steps_are_what_fixed_step_tools_report():
    run = jax.jit(cc.chasing_cars(located=False).__call__)
    full = run({"throttle": jnp.array(1.0), "brake": jnp.array(0.0)})
    wanted = {
        1: [-0.5, 10, 20, 30, 40],
        5: [-12.5, 8.3255, 20, 30, 40],
        10: [-50, -13.3244, 13.3022, 29.8799, 40],
        20: [-200, -131.6244, -73.2978, -25.02, 13.2088],
        100: [-5000, -4678.0245, -4366.0978, -4064.2201, -3772.3912],
    }
    for time, values in wanted.items():
        np.testing.assert_allclose(places(full, time), values, rtol=0, atol=1.01e-4)
    half = run({"throttle": jnp.array(1.0), "brake": jnp.array(0.5)})
    last = [-196, -183.2454, -172.6878, -157.2582, -144.484]
    np.testing.assert_allclose(places(half, 100), last, rtol=0, atol=1.01e-4)
    problems = (specs.cc1, specs.cc2, specs.cc3, specs.cc4, specs.cc5)
    for trace, margins in (
        (full, [-251.83, 54.93, -1.77, 61.93, 7.04]),
        (half, [12.898, 0.6305, 3.282, 1.699, 0.167]),
    ):
        found = [float(vj.mtl.robustness(p.formulas["spec"], trace)) for p in problems]
        np.testing.assert_allclose(found, margins, rtol=0, atol=6e-3)


def events(throttle, brake, times):
    """The positions at some times, by a solver that locates events; inputs change every 5 s."""
    state, modes = np.array([0.0, 10, 20, 30, 40, 0, 0, 0, 0, 0]), [cc.KEEPING] * 4
    rates = {
        cc.CHASING: lambda v: (-v, 1.0),
        cc.KEEPING: lambda v: (v, 0.0),
        cc.BRAKING: lambda v: (-v, -v),
    }
    ends = {
        cc.CHASING: [(10, -1, cc.KEEPING)],
        cc.KEEPING: [(15, 1, cc.CHASING), (5, -1, cc.BRAKING)],
        cc.BRAKING: [(20, 1, cc.CHASING)],
    }
    now, found, changes = 0.0, [], 0
    for stop in sorted({*times, *np.arange(5.0, times[-1], 5.0)}):
        while now < stop:
            piece = int(now / 5 + 1e-9)

            def slope(t, s, piece=piece):
                moves = [(s[5], -throttle[piece] - brake[piece] * s[5])]
                moves += [rates[m](v) for m, v in zip(modes, s[6:], strict=True)]
                return [*(m[0] for m in moves), *(m[1] for m in moves)]

            watched = []
            for car, mode in enumerate(modes):
                for gap, direction, following in ends[mode]:

                    def watch(t, s, car=car, gap=gap):
                        return s[car + 1] - s[car] - gap

                    watch.terminal, watch.direction = True, direction
                    watched.append((watch, car, following))
            solved = solve_ivp(
                slope, (now, stop), state, "DOP853", rtol=1e-11, atol=1e-11, max_step=0.1,
                events=[w for w, _, _ in watched],
            )  # fmt: skip
            now, state = solved.t[-1], solved.y[:, -1]
            for (_, car, following), fired in zip(watched, solved.t_events, strict=True):
                if len(fired):
                    modes[car] = following
                    changes += 1
        if stop in times:
            found.append(state[:5])
    return np.array(found), changes


def test_transitions_within_steps_are_those_of_a_solver_with_events(located):
    throttle, brake, times = [1.0, 0.2, 0.9, 0.6, 0.0], [0.0, 0.7, 0.1, 0.3, 0.9], [7.0, 14.0, 25.0]
    wanted, changes = events(throttle, brake, times)
    assert changes > 20
    found = located(throttle, brake)[:, [round(100 * time) for time in times]].T
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6)


def test_transitions_at_the_end_of_steps_come_late(located):
    throttle, brake = [1.0] * 5, [0.5] * 5
    late = cc.chasing_cars(25.0, located=False)({"throttle": 1.0, "brake": 0.5})
    assert np.max(np.abs(located(throttle, brake)[-1] - late["y5"])) > 0.01


@pytest.mark.thorough
def test_located_transitions_do_not_depend_on_the_step(located):
    finer = cc.chasing_cars(25.0).refined(2)
    inputs = ([1.0, 0.2, 0.9, 0.6, 0.0], [0.0, 0.7, 0.1, 0.3, 0.9])
    names = ("throttle", "brake")
    features = {n: Waveform(jnp.array(k), "constant") for n, k in zip(names, inputs, strict=True)}
    places = jax.jit(finer.__call__)(features)
    np.testing.assert_allclose(located(*inputs)[4], places["y5"], rtol=0, atol=1e-8)
    with pytest.raises(ValueError, match="factor must be a positive integer; got 0"):
        finer.refined(0)


@pytest.mark.thorough
def test_single_precision_keeps_the_gaps():
    system, inputs = cc.chasing_cars(25.0), {"throttle": 1.0, "brake": 0.1}
    double = jax.jit(system.__call__)(inputs)
    with jax.enable_x64(False):
        single = jax.jit(system.__call__)(inputs)
    assert single["y5"].dtype == jnp.float32
    for ahead, behind in zip(NAMES[1:], NAMES[:-1], strict=True):
        gap = np.asarray(single[ahead] - single[behind])
        np.testing.assert_allclose(gap, double[ahead] - double[behind], rtol=0, atol=0.02)


@pytest.mark.slow
def test_derivatives_go_through_transitions(located):
    def outcome(x):
        features = {"throttle": Waveform(x[:2], "constant"), "brake": Waveform(x[2:], "constant")}
        trace = cc.chasing_cars(10.0)(features)
        return jnp.stack([trace["y3"][-1], trace["y4"][-1], trace["y5"][-1]])

    x, step = jnp.array([0.9, 0.8, 0.1, 0.3]), 1e-6
    jacobian = jax.jit(jax.jacfwd(outcome))(x)
    shifts = step * jnp.eye(4)
    beside = jax.jit(jax.vmap(outcome))(jnp.concatenate([x + shifts, x - shifts]))
    ahead, behind = jnp.split(beside, 2)
    differences = ((ahead - behind) / (2 * step)).T
    assert np.min(np.max(np.abs(differences), axis=1)[:2]) > 0.1
    np.testing.assert_allclose(jacobian, differences, rtol=1e-5, atol=1e-6)
