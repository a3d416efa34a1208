"""Networks of several layers: bounds are as tight as those of backward linear relaxation."""

import itertools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.verification.sets import Form, Interpreter
from verifai_jax.addons.verification.sets.values import as_form

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


def zonotope(layers, low, high):
    """Return bounds of a ReLU network over one box, with an array of all symbols."""
    centre, symbols = (low + high) / 2, np.diag((high - low) / 2)
    for k, (matrix, shift) in enumerate(layers):
        centre, symbols = centre @ matrix + shift, symbols @ matrix
        spread = np.abs(symbols).sum(0)
        least, greatest = centre - spread, centre + spread
        if k + 1 == len(layers):
            return least, greatest
        slope = np.clip(greatest, 0, None) / np.where(greatest > 0, greatest - least, 1)
        slope = np.where(least >= 0, 1, slope)
        half = np.where((least < 0) & (greatest > 0), -slope * least / 2, 0)
        centre, symbols = slope * centre + half, np.vstack([symbols * slope, np.diag(half)])


def test_the_way_back_gives_what_all_symbols_give():
    layers, random = weights(5), np.random.default_rng(5)
    low = random.uniform(-1, 0.8, (4, 3))
    least, greatest = bounds(lambda x: network(layers, x), low, low + 0.3)
    for i in range(4):
        bottom, top = zonotope(layers, low[i], low[i] + 0.3)
        np.testing.assert_allclose(greatest[i], top, atol=2e-3 * (top - bottom).max())
        np.testing.assert_allclose(least[i], bottom, atol=2e-3 * (top - bottom).max())


def winding(random):
    """Return a network whose units are scaled, divided, cut, turned around, and skip layers."""
    matrices = [jnp.asarray(random.normal(size=s) / np.sqrt(s[0]), jnp.float32)
                for s in ((3, 16), (16, 16), (16, 12), (12, 12), (12, 2))]  # fmt: skip

    def function(x):
        a = jax.nn.relu(x @ matrices[0]) - 0.2
        b = jnp.tanh(a @ matrices[1]) / 3 + 0.5 * a
        c = jnp.clip(-(b.reshape(4, 4).T.ravel() @ matrices[2]), -1.5, 1.0)
        d = c[::-1] - jax.nn.sigmoid(c @ matrices[3])
        return jnp.concatenate([d @ matrices[4], (2 * d[2:4] - c[:2]) ** 2])

    return function


@pytest.mark.slow
def test_networks_that_wind_contain_their_values():
    for seed in range(4):
        random = np.random.default_rng(seed)
        function = winding(random)
        low = random.uniform(-1, 0.8, (70 if seed == 3 else 8, 3))
        high = low + random.uniform(0.001, 0.6, (len(low), 1))
        least, greatest = bounds(function, low, high)
        points = low[:, None] + random.random((len(low), 1000, 3)) * (high - low)[:, None]
        seen = np.asarray(jax.vmap(jax.vmap(function))(np.float32(points)), float)
        assert np.all(least <= seen.min(1))
        assert np.all(greatest >= seen.max(1))


def test_the_way_back_covers_its_own_rounding():
    """Exact values, of weights of which large ones cancel, in double precision."""
    random = np.random.default_rng(3)
    layers = [random.integers(-4, 5, s) for s in ((2, 8), (8, 8), (8, 8), (8, 1))]
    for k in (1, 2, 3):
        layers[k][1::2] = -layers[k][::2]
        layers[k] = layers[k] * 2**20 + random.integers(-1, 2, layers[k].shape)
    fractions = [np.array(matrix.tolist(), object) for matrix in layers]
    with jax.enable_x64(True):
        arrays = [jnp.asarray(matrix, jnp.float64) for matrix in layers]

        def function(x):
            for matrix in arrays[:-1]:
                x = jax.nn.relu(x @ matrix)
            return x @ arrays[-1]

        low = random.uniform(-1, 1, (30, 2))
        program = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((2,), np.float64))
        leaf = Form.leaf(low, low + 1e-9, np.eye(2), np.dtype(np.float64))
        (result,) = Interpreter(30, 2)(program, [leaf])
    least, greatest = as_form(result).bounds()
    for share in (0.0, 0.3, 1.0):
        for i, point in enumerate(low + share * 1e-9):
            x = np.array([Fraction(min(p, q)) for p, q in zip(point, low[i] + 1e-9, strict=True)])
            for matrix in fractions[:-1]:
                x = np.maximum(x @ matrix, Fraction(0))
            assert Fraction(least[i, 0]) <= (x @ fractions[-1])[0] <= Fraction(greatest[i, 0])
