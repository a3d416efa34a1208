import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.systems.ode import sin_cos, trigonometry


@pytest.mark.slow
@pytest.mark.parametrize("largest", [0.8, 3.2, 100.0, 1e5])
def test_as_close_as_float32_can_tell(largest):
    angles = np.random.default_rng(0).uniform(-largest, largest, 200_000).astype(np.float32)
    sin, cos = jax.jit(sin_cos)(angles)
    np.testing.assert_allclose(sin, np.sin(angles.astype(float)), atol=1.3e-7)
    np.testing.assert_allclose(cos, np.cos(angles.astype(float)), atol=1.3e-7)


def test_parts_of_half_pi_have_exact_products():
    # Without fused operations a rounded product is as wrong as half a unit in its last place.
    parts = trigonometry._HALF_PI
    assert abs(math.fsum(map(float, parts)) - math.pi / 2) < 1e-16
    quadrants = np.arange(2**16)
    for part in parts[:-1]:
        exact = quadrants * float(part)
        np.testing.assert_array_equal(np.float32(exact), exact)


def test_special_angles():
    sin, cos = sin_cos(jnp.array([0.0, jnp.nan, jnp.inf, 2e5]))
    np.testing.assert_array_equal(sin, [0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(cos, [1, np.nan, np.nan, np.nan])


def test_derivatives():
    slope = jax.grad(lambda a: sin_cos(a)[0] * 2 + sin_cos(a)[1])(1.2)
    assert float(slope) == pytest.approx(2 * np.cos(1.2) - np.sin(1.2), rel=1e-6)
    second = jax.grad(jax.grad(lambda a: sin_cos(a)[0]))(1.2)
    assert float(second) == pytest.approx(-np.sin(1.2), rel=1e-6)


def test_float64_is_exact():
    with jax.enable_x64():
        angles = jnp.linspace(-10, 10, 1001, dtype=jnp.float64)
        sin, cos = sin_cos(angles)
        np.testing.assert_allclose(sin, np.sin(np.asarray(angles)), atol=1e-15)
        np.testing.assert_allclose(cos, np.cos(np.asarray(angles)), atol=1e-15)
