"""Networks of several layers: bounds are as tight as those of backward linear relaxation."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.verification.sets import Form, Interpreter
from verifai_jax.addons.verification.sets.interpreter import as_form

LAYERS = (3, 24, 24, 24, 8)


def weights(seed):
    random = np.random.default_rng(seed)
    return [
        (random.normal(size=(n, m)) * 1.4 / np.sqrt(n), 0.3 * random.normal(size=m))
        for n, m in itertools.pairwise(LAYERS)
    ]


def network(layers, x, active=jax.nn.relu, xp=jnp):
    for matrix, shift in layers[:-1]:
        x = active(x @ xp.asarray(matrix) + xp.asarray(shift))
    return x @ xp.asarray(layers[-1][0]) + xp.asarray(layers[-1][1])


def bounds(function, low, high):
    program = jax.make_jaxpr(function)(jax.ShapeDtypeStruct(low.shape[1:], np.float32))
    leaf = Form.leaf(low, high, np.eye(low.shape[1]), np.dtype(np.float32))
    (result,) = Interpreter(len(low), low.shape[1])(program, [leaf])
    return as_form(result).bounds()


def crown(layers, low, high):
    """Return bounds of a ReLU network over one box.

    Source: H. Zhang et al., Efficient neural network robustness certification with general
    activation functions (2018), with the lower slope 0 or 1, whichever leaves less.
    """
    lines = []
    for k in range(len(layers)):
        ends = []
        for sign in (1.0, -1.0):
            rows, offset = sign * layers[k][0].T, sign * layers[k][1]
            for (matrix, shift), (lower, upper, above) in zip(
                layers[k - 1 :: -1] if k else [], lines[::-1], strict=True
            ):
                up, down = np.maximum(rows, 0), np.minimum(rows, 0)
                offset = offset + up @ above
                rows = up * upper + down * lower
                offset, rows = offset + rows @ shift, rows @ matrix.T
            middle, half = (low + high) / 2, (high - low) / 2
            ends.append(sign * (rows @ middle + np.abs(rows) @ half + offset))
        top, bottom = ends
        slope = np.where(
            bottom >= 0, 1, np.where(top <= 0, 0, top / np.where(top > bottom, top - bottom, 1))
        )
        crossing = (bottom < 0) & (top > 0)
        lower = np.where(crossing, (top > -bottom) * 1.0, slope)
        lines.append((lower, slope, np.where(crossing, -slope * bottom, 0)))
    return bottom, top


@pytest.mark.parametrize("active", [jax.nn.relu, jnp.tanh])
def test_bounds_of_a_network_contain_what_it_gives(active):
    for seed in range(4):
        layers, random = weights(seed), np.random.default_rng(seed)
        low = random.uniform(-1, 0.5, (6, 3))
        high = low + random.uniform(0.01, 0.5, (6, 1))
        least, greatest = bounds(lambda x, w=layers: network(w, x, active), low, high)
        points = low[:, None] + random.random((6, 2000, 3)) * (high - low)[:, None]
        seen = network(layers, np.float32(points), {jax.nn.relu: lambda x: np.maximum(x, 0)}.get(
            active, np.tanh), np)  # fmt: skip
        assert np.all(least <= seen.min(1))
        assert np.all(greatest >= seen.max(1))


def test_bounds_are_as_tight_as_those_of_crown():
    ratios = []
    for seed in range(4):
        layers, random = weights(seed), np.random.default_rng(seed)
        low = random.uniform(-1, 0.8, (6, 3))
        least, greatest = bounds(lambda x, w=layers: network(w, x), low, low + 0.1)
        for i in range(6):
            bottom, top = crown(layers, low[i], low[i] + 0.1)
            ratios += ((greatest[i] - least[i]) / (top - bottom)).tolist()
    assert np.median(ratios) < 1.05
    assert np.mean(ratios) < 1.1


def test_bounds_do_not_depend_on_the_shape_of_the_input():
    """Networks in ONNX files have inputs of images: `[1, 1, 1, inputs]`."""
    layers, random = weights(0), np.random.default_rng(0)
    low = random.uniform(-1, 0.8, (6, 3))
    flat = bounds(lambda x: network(layers, x), low, low + 0.2)
    image = bounds(lambda x: network(layers, x.reshape(1, 1, 1, 3)).ravel(), low, low + 0.2)
    np.testing.assert_allclose(image, flat, rtol=1e-12)


def test_a_network_in_a_loop_leaves_the_symbols_of_the_loop_as_they_are():
    """A turning point stays on its circle, whatever a network without influence says of it."""
    layers = weights(0)

    def turns(x):
        def step(state, _):
            a, b = state
            seen = network(layers, jnp.stack([a, b, a * b]))
            force = 1e-4 * jnp.clip(seen[0], -1, 1)
            return (a + 0.1 * b, b - 0.1 * a + force), None

        (a, b), _ = jax.lax.scan(step, (x[0], x[1]), None, 200)
        return jnp.stack([a, b])

    low = np.array([[0.9, -0.01]])
    least, greatest = bounds(turns, low, low + 0.02)
    growth = np.sqrt(1.01) ** 200
    assert np.all(greatest - least < 0.02 * np.sqrt(2) * growth + 0.15)
