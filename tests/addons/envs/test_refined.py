"""Systems at a finer step: the same sampling and decisions, a solution that converges."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from envs import cartpole
from envs.arch.automatic_transmission import automatic_transmission
from envs.arch.chasing_cars import chasing_cars
from envs.arch.neural_network_controller import neural_network_controller
from envs.arch.pacemaker import pacemaker
from envs.mountain_car import mountain_car
from verifai_jax.core.values.trace import Trace

FEATURES = {"a": 1.3, "x0": 2.0}


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def decaying(method="euler", **options):
    """The equation x' = -a x + cos t, whose solution is known."""
    return vj.ode(
        lambda t, x, control, f: {"x": -f["a"] * x["x"] + jnp.cos(t)},
        lambda f, key: {"x": f["x0"]},
        dt=0.5,
        duration=4.0,
        method=method,
        **options,
    )


def exact(times, a=1.3, x0=2.0):
    particular = a / (a * a + 1)
    return (x0 - particular) * np.exp(-a * times) + (a * np.cos(times) + np.sin(times)) / (
        a * a + 1
    )


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("rk4", 4)])
def test_errors_fall_with_the_order_of_the_method(method, order):
    system = decaying(method)
    at = jax.jit(lambda factor: system.refined(factor)(FEATURES))
    traces = {factor: at(factor) for factor in (4, 8, 16)}
    assert all(trace.length == 9 and trace.dt == 0.5 for trace in traces.values())
    wanted = exact(0.5 * np.arange(9))
    errors = [np.max(np.abs(trace["x"] - wanted)) for trace in traces.values()]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, order, atol=0.25)


def test_semi_implicit_euler_converges_to_the_oscillation():
    system = vj.ode(
        lambda t, s, control, f: (s[1], -s[0]),
        lambda f, key: (jnp.asarray(1.0), jnp.asarray(0.0)),
        signals=lambda t, s, control, f: {"x": s[0]},
        dt=0.25, duration=5.0, method="semi_implicit_euler",
    )  # fmt: skip
    at = jax.jit(lambda factor: system.refined(factor)({})["x"])
    wanted = np.cos(0.25 * np.arange(21))
    coarse, fine = (np.max(np.abs(at(factor) - wanted)) for factor in (8, 16))
    assert 1.8 < coarse / fine < 2.2


def test_a_traced_factor_is_the_same_as_an_integer():
    system = decaying("rk4")
    plain = jax.jit(system.refined(3).__call__)(FEATURES)
    traced = jax.jit(lambda factor: system.refined(factor)(FEATURES))(3)
    np.testing.assert_allclose(traced["x"], plain["x"], rtol=1e-14)
    twice = jax.jit(system.refined(2).refined(3).__call__)(FEATURES)
    six = jax.jit(lambda factor: system.refined(factor)(FEATURES))(6)
    np.testing.assert_allclose(twice["x"], six["x"], rtol=1e-14)


@pytest.mark.parametrize("factor", [0, -1, True, 2.0, "2"])
def test_a_factor_is_a_positive_integer(factor):
    message = f"factor must be a positive integer; got {factor!r}"
    for system in (decaying(), automatic_transmission(1.0)):
        with unchecked(), pytest.raises(ValueError, match=message):
            system.refined(factor)


def test_a_finer_loop_decides_at_the_same_instants():
    def counting(time, state, memory, features):
        return jnp.sin(10 * time), memory + 1.0

    system = vj.ode(
        lambda t, x, control, f: control,
        lambda f, key: jnp.asarray(f["x0"]),
        controller=counting,
        controller_memory=0.0,
        control_period=0.2,
        signals=lambda t, x, control, f: {"x": x, "control": control},
        terminate=lambda x, f: x > 2.05,
        dt=0.1,
        duration=2.0,
    )
    coarse, fine = (jax.jit(system.refined(n).__call__)(FEATURES) for n in (1, 4))
    # The slope is the held control alone, so that no step is too coarse.
    np.testing.assert_allclose(fine["x"], coarse["x"], rtol=1e-12)
    np.testing.assert_array_equal(fine["control"], coarse["control"])
    assert int(fine.valid) == int(coarse.valid) < 21


def test_a_finer_loop_has_derivatives():
    system = decaying("rk4").refined(2)

    def last(x0):
        return system({"a": 1.3, "x0": x0})["x"][-1]

    for derivative in (jax.jacrev, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(derivative(last))(2.0), np.exp(-5.2), rtol=1e-3)


@pytest.mark.thorough
def test_the_push_of_the_cart_is_the_same_at_every_step():
    times = jnp.arange(0.99, 1.2, 0.005)
    share = jax.vmap(functools.partial(cartpole.pushed, push_time=1.013))
    # As at the steps of 0.02 s: the same impulse, nothing before the step in which it begins.
    fine = np.asarray(share(times))
    coarse = np.asarray(share(jnp.arange(50, 60) * 0.02))
    np.testing.assert_allclose(np.sum(fine) * 0.005, np.sum(coarse) * 0.02, rtol=1e-6)
    assert np.all(fine[np.asarray(times) < 0.999] == 0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("system", "features", "signal"),
    [
        (automatic_transmission(2.0), {"throttle": 80.0, "brake": 0.0}, "speed"),
        (chasing_cars(2.0), {"throttle": 0.8, "brake": 0.1}, "y5"),
        (neural_network_controller(1.0), {"Ref": 2.0}, "Pos"),
    ],
    ids=["at", "cc", "nn"],
)
def test_arch_models_take_a_traced_factor(system, features, signal):
    traced = jax.jit(lambda factor: system.refined(factor)(features)[signal])
    plain = jax.jit(lambda: system.refined(2)(features)[signal])()
    np.testing.assert_allclose(traced(2), plain, rtol=1e-9)
    coarse, fine = (np.max(np.abs(traced(n) - traced(8))) for n in (1, 4))
    assert fine <= coarse + 1e-12 < 1e-2


def test_a_step_that_belongs_to_the_system_is_not_refined():
    published = decaying(exact_step=True)
    assert published.exact_step
    assert not published.can_refine
    with pytest.raises(ValueError, match=r"the step belongs to this system \(exact_step=True\)"):
        published.refined(2)
    assert decaying().can_refine
    # CartPole-v1 is explicit Euler at 0.02 s; anything else approximates the continuous plant.
    assert cartpole.cartpole().exact_step
    assert cartpole.cartpole(method="rk4").can_refine
    assert cartpole.cartpole(dt=0.01).can_refine
    for discrete in (pacemaker(1.0), mountain_car(steps=3)):
        assert discrete.exact_step
        assert not discrete.can_refine
        with pytest.raises(ValueError, match="the step belongs to this model"):
            discrete.refined(2)
    assert automatic_transmission(1.0).can_refine


def stepping(factor):
    def simulate(features):
        return Trace({"x": np.full(3, features["x"] / factor)}, dt=0.1)

    simulate.refined = lambda finer: stepping(factor * finer)
    return simulate


def test_a_black_box_is_as_refined_as_its_function():
    box = vj.blackbox(stepping(1))
    assert box.refined(4)({"x": 8.0})["x"][0] == 2.0
    many = vj.blackbox(stepping(1), vectorised=True)
    assert many.can_refine
    assert not vj.blackbox(lambda features: Trace({"x": np.zeros(3)}, dt=0.1)).can_refine
    published = stepping(1)
    published.exact_step = True
    for options in ({}, {"vectorised": True}):
        system = vj.blackbox(published, **options)
        assert system.exact_step
        assert not system.can_refine
    assert not box.exact_step


SWING = """
<mujoco>
  <option timestep="0.02" integrator="Euler"/>
  <worldbody>
    <body name="rod"><joint name="hinge" type="hinge" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.03" mass="1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["native", "mjx"])
def test_mujoco_converges_on_both_engines(backend):
    pytest.importorskip("mujoco")
    system = vj.mujoco(
        SWING, duration=2.0, control_period=0.04, bind={"angle": "joint/hinge/qpos"},
        signals={"angle": "joint/hinge/qpos"}, backend=backend,
    )  # fmt: skip
    angles = {
        n: np.asarray(system.refined(n)({"angle": jnp.asarray(1.0)})["angle"]) for n in (1, 2, 4, 8)
    }
    assert len(angles[4]) == len(angles[1]) == 51
    gaps = [np.max(np.abs(angles[n] - angles[2 * n])) for n in (1, 2, 4)]
    assert 1.7 < gaps[0] / gaps[1] < 2.3
    assert 1.7 < gaps[1] / gaps[2] < 2.3
    with pytest.raises(ValueError, match="factor must be a positive integer; got 0"):
        system.refined(0)


@pytest.mark.slow
def test_brax_converges_where_it_is_the_same_model():
    pytest.importorskip("brax")
    with jax.enable_x64(False):
        still = lambda observation: jnp.zeros(1)  # noqa: E731
        system = vj.brax(
            "inverted_pendulum", still, steps=30, backend="generalized", exact_step=False
        )
        angles = [
            np.asarray(jax.jit(system.refined(n).__call__)({}, jax.random.key(0))["q"])[:, 1]
            for n in (1, 2, 4)
        ]
        gaps = [np.max(np.abs(a - b)) for a, b in itertools.pairwise(angles)]
        assert 1.6 < gaps[0] / gaps[1] < 2.5
        other = vj.brax("inverted_pendulum", still, steps=3, backend="positional", exact_step=False)
        with pytest.raises(ValueError, match="backend 'positional': its constraints are as stiff"):
            other.refined(2)
