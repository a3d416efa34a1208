"""Derivatives of MJX rollouts in float64, against central differences.

Compiling is all that takes long here, and what XLA optimises makes no difference in float64.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import ball, cartpole, mujoco_cartpole
from verifai_jax.addons.simulators.mujoco.system import mjx

pytestmark = pytest.mark.thorough


# A weight between two stops.
WEIGHT = """
<mujoco>
  <option timestep="0.01" integrator="RK4"/>
  <worldbody>
    <body>
      <joint name="rail" type="slide" axis="1 0 0" limited="true" range="-1 1"/>
      <geom size="0.1"/>
    </body>
  </worldbody>
</mujoco>
"""


def derivatives(function, points, step):
    """Central differences, and the derivatives in forward and in reverse mode."""

    def twice(values):
        result = function(values)
        return result, result

    # With the value beside the derivative, there is no third program to compile.
    forward = jax.jit(jax.vmap(jax.jacfwd(twice, has_aux=True)))
    backward = jax.jit(jax.vmap(jax.jacrev(function)))
    columns = [
        (forward(points.at[:, i].add(step))[1] - forward(points.at[:, i].add(-step))[1])
        / (2 * step)
        for i in range(points.shape[1])
    ]
    return np.stack(columns, axis=-1), forward(points)[0], backward(points)


@pytest.mark.slow
def test_smooth_dynamics_in_both_modes():
    """A cart-pole with all that changes its model: masses, length, damping, gravity."""
    places = ("theta0", "x_dot0", "masscart", "masspole", "length", "damping", "gravity")
    system = mujoco_cartpole.cartpole(
        cartpole.linear((0.9, 2.1, 30.0, 7.8)), features=places, duration=0.5, backend="mjx"
    )

    def signals(values):
        trace = system(dict(zip(places, values, strict=True)))
        return jnp.stack([trace["x"][-1], trace["theta"][-1], jnp.sum(trace["force"])])

    with jax.enable_x64():
        points = jnp.array(
            [[0.1, 0.2, 1.0, 0.1, 0.5, 0.01, -9.8], [-0.05, 0.5, 0.8, 0.4, 0.9, 0.05, -9.0]]
        )
        wanted, forward, backward = derivatives(signals, points, 1e-6)
    np.testing.assert_allclose(forward, wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(backward, forward, rtol=1e-9, atol=1e-11)
    assert np.abs(wanted).min() > 1e-4


@pytest.mark.slow
def test_through_contacts_in_both_modes():
    """A ball that slides, one that lands, one that hits the rail: no event within the step."""
    places = ("speed", "lift", "height", "friction", "radius")

    def end(values):
        trace = system(dict(zip(places, values, strict=True)))
        return jnp.stack([trace["x"][-1], trace["z"][-1]])

    system = ball.ball(features=places, duration=0.3, backend="mjx")
    assert system.reverse_hint == ""
    with jax.enable_x64():
        points = jnp.array(
            [
                [2.0, 0.0, 0.0995, 0.2, 0.1],
                [3.0, -2.0, 0.3, 0.7, 0.12],
                [8.0, 1.0, 0.25, 0.5, 0.08],
            ]
        )
        wanted, forward, backward = derivatives(end, points, 1e-7)
    np.testing.assert_allclose(forward, wanted, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(backward, forward, rtol=1e-6, atol=1e-9)
    # All three did touch something: the derivative with respect to friction or speed tells.
    assert np.abs(wanted[0, 0, 3]) > 1e-2


@pytest.mark.slow
def test_what_cannot_be_reversed_says_what_would_help():
    system = mjx(WEIGHT, duration=0.02, control_period=0.02, bind={"v": "joint/rail/qvel[0]"})
    assert "has no reverse-mode derivative inside its Runge-Kutta" in system.reverse_hint
    assert 'integrator="implicitfast" or "Euler"' in system.reverse_hint

    def end(v):
        return system({"v": v})["rail"][-1]

    with pytest.raises(ValueError, match="Reverse-mode differentiation does not work"):
        jax.eval_shape(jax.grad(end), 1.0)
    jax.eval_shape(jax.jacfwd(end), 1.0)
