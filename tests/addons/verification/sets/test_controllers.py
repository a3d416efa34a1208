"""No value leaves its set: tables, sorts, switches, indices and convolutions of controllers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_controllers import PARTS, SIZE, controller

from verifai_jax.addons.verification.sets import Form, Interpreter

BOXES = 8


def escapes(function, random, points=1250):
    """Return how many of so many points of each box have values outside of their sets."""
    low = random.uniform(-1.5, 1.2, (BOXES, SIZE))
    high = low + np.array([0.0, 1e-6, 1e-3, 0.02, 0.1, 0.3, 1.0, 2.0])[:, None]
    low, high = np.float32(low).astype(float), np.float32(high).astype(float)
    program = jax.make_jaxpr(function)(jnp.zeros(SIZE, jnp.float32))
    leaf = Form.leaf(low, high, np.eye(SIZE), np.dtype(np.float32))
    (result,) = Interpreter(BOXES, SIZE)(program, [leaf])
    least, greatest = (np.broadcast_to(e, (BOXES, *result.shape)) for e in result.bounds())
    shares = random.random((points, BOXES, SIZE))
    shares[: 2**SIZE] = np.array(np.meshgrid(*[[0, 1]] * SIZE)).reshape(SIZE, -1).T[:, None]
    drawn = np.clip((low + shares * (high - low)).astype(np.float32), low, high)
    drawn = jnp.asarray(drawn, jnp.float32)
    values = np.asarray(jax.jit(jax.vmap(jax.vmap(function)))(drawn)).astype(float)
    wrong = (values < least) | (values > greatest)
    return int(np.sum(wrong | (np.isnan(values) & (np.isfinite(least) | np.isfinite(greatest)))))


@pytest.mark.thorough
@pytest.mark.parametrize("name", PARTS)
def test_each_part_contains_its_values(name):
    random = np.random.default_rng(sum(map(ord, name)))
    for _ in range(2):
        assert escapes(PARTS[name](random), random) == 0


@pytest.mark.slow
def test_random_controllers_contain_their_values():
    """Ten thousand points of each."""
    found = []
    for seed in range(60):
        random = np.random.default_rng(seed)
        name, function = controller(random, 1 + seed % 4)
        found += [name] * bool(escapes(function, random))
    assert found == []


def tightness(function, low, high):
    """Return how much wider the bounds are than the range of sampled values."""
    low, high = np.array([low]), np.array([high])
    program = jax.make_jaxpr(function)(jnp.zeros(SIZE, jnp.float32))
    leaf = Form.leaf(low, high, np.eye(SIZE), np.dtype(np.float32))
    (result,) = Interpreter(1, SIZE)(program, [leaf])
    drawn = low + np.random.default_rng(0).random((2000, SIZE)) * (high - low)
    values = np.asarray(jax.vmap(function)(jnp.asarray(drawn, jnp.float32))).astype(float)
    first, last = result.bounds()
    return float(np.max((last - first) / (np.ptp(values, axis=0) + 1e-6)))


def test_an_interpolation_is_linear_between_its_knots_and_bounded_across_them():
    knots, heights = jnp.array([-1.0, 0.0, 2.0]), jnp.array([0.0, 3.0, 1.0])
    one = lambda x: jnp.interp(x[0], knots, heights) - 3 * x[0]  # noqa: E731
    assert tightness(one, [-0.9] * 3, [-0.1] * 3) < 30  # it is constant: only rounding is left
    assert tightness(lambda x: jnp.interp(x[:1], knots, heights), [-0.5] * 3, [0.5] * 3) < 1.1


def test_a_table_has_the_hull_of_the_cells_in_reach():
    table = jnp.array([9.0, 1.0, 2.0, 9.0])
    assert tightness(lambda x: table[x.astype(jnp.int32)], [1.0] * 3, [2.9] * 3) < 1.01


def test_a_median_of_numbers_in_a_certain_order_is_one_of_them():
    one = lambda x: jnp.median(x + jnp.array([0.0, 9.0, 3.0]))[None] - x[2]  # noqa: E731
    assert tightness(one, [0.0] * 3, [1.0] * 3) < 30


def test_a_convolution_that_is_a_matrix_product_has_its_bounds():
    matrix = jnp.asarray(np.random.default_rng(0).normal(size=(20, SIZE)), jnp.float32)
    outer = jnp.asarray(np.random.default_rng(1).normal(size=(8, 20)), jnp.float32)

    def as_products(x):
        return outer @ jnp.tanh(matrix @ x)

    def as_convolutions(x):
        conv = jax.lax.conv_general_dilated
        hidden = jnp.tanh(conv(x.reshape(1, SIZE, 1, 1), matrix[:, :, None, None], (1, 1), "VALID"))
        return conv(hidden, outer[:, :, None, None], (1, 1), "VALID").reshape(-1)

    ends = [-0.2] * SIZE, [0.4] * SIZE
    assert tightness(as_convolutions, *ends) == pytest.approx(tightness(as_products, *ends), 1e-3)
