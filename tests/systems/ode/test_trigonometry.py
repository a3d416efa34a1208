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


@pytest.mark.parametrize(("dtype", "quadrants"), [("float32", 2**16), ("float64", 2**20)])
def test_parts_of_half_pi_have_exact_products(dtype, quadrants):
    # Without fused operations a rounded product is as wrong as half a unit in its last place.
    numbers = trigonometry._NUMBERS[np.dtype(dtype)]
    assert abs(math.fsum(map(float, numbers.half_pi)) - math.pi / 2) < 1e-16
    assert numbers.largest * 2 / np.pi < quadrants
    bits = 24 if dtype == "float32" else 53
    for part in numbers.half_pi[:-1]:
        whole, _ = float(part).as_integer_ratio()
        assert whole.bit_length() + (quadrants - 1).bit_length() <= bits


def test_special_angles():
    sin, cos = sin_cos(jnp.array([0.0, jnp.nan, jnp.inf, 2e5]))
    np.testing.assert_array_equal(sin, [0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(cos, [1, np.nan, np.nan, np.nan])


def test_derivatives():
    slope = jax.grad(lambda a: sin_cos(a)[0] * 2 + sin_cos(a)[1])(1.2)
    assert float(slope) == pytest.approx(2 * np.cos(1.2) - np.sin(1.2), rel=1e-6)
    second = jax.grad(jax.grad(lambda a: sin_cos(a)[0]))(1.2)
    assert float(second) == pytest.approx(-np.sin(1.2), rel=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("largest", [1.0, 1e3, 1e6])
def test_float64_is_exact(largest):
    with jax.enable_x64():
        angles = np.random.default_rng(0).uniform(-largest, largest, 20_000)
        angles[::100] = np.round(angles[::100]) * (np.pi / 2)
        sin, cos = sin_cos(jnp.asarray(angles))
        exact = angles.astype(np.longdouble)
        inside = np.abs(angles) <= 1e6
        np.testing.assert_allclose(sin[inside], np.sin(exact)[inside], atol=2.3e-16, rtol=0)
        np.testing.assert_allclose(cos[inside], np.cos(exact)[inside], atol=2.3e-16, rtol=0)
        assert np.all(np.isnan(sin[~inside]))
