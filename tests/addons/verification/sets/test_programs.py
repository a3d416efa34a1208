"""Programs of arrays, branches and loops: their values lie in their sets, which are not wide."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.verification.sets import Form, Interpreter, MissingRule

BOXES, POINTS = 8, 40
LOW = np.random.default_rng(1).uniform(-1, 0.9, (BOXES, 3))
HIGH = LOW + np.array([0.3, 0.1, 0.02, 0.001, 0.3, 0.1, 0.02, 0.001])[:, None]
MATRIX = jnp.asarray(np.random.default_rng(2).normal(size=(3, 4)), jnp.float32)


def interpreted(function):
    """Return the bounds of the leaves of a function of three numbers, `[boxes, *shape]` each."""
    program = jax.make_jaxpr(function)(jnp.zeros(3, jnp.float32))
    leaf = Form.leaf(LOW, HIGH, np.eye(3), np.dtype(np.float32))
    results = []
    for value in Interpreter(BOXES, 3)(program, [leaf]):
        low, high = value.bounds() if isinstance(value, Form) else (value.low, value.high)
        shape = (BOXES, *low.shape[1:])
        results.append((np.broadcast_to(low, shape), np.broadcast_to(high, shape)))
    return results


def contained(function, slack=None):
    """Assert that values lie in their sets, which are wider than these by a factor at most."""
    random = np.random.default_rng(0)
    shares = random.random((POINTS, BOXES, 3))
    shares[:8] = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T[:, None]
    drawn = np.clip((LOW + shares * (HIGH - LOW)).astype(np.float32), LOW, HIGH)
    values = jax.vmap(jax.vmap(function))(jnp.asarray(drawn, jnp.float32))
    for (low, high), leaf in zip(interpreted(function), jax.tree.leaves(values), strict=True):
        leaf = np.asarray(leaf).astype(float)
        assert np.all(leaf >= low - 1e-7)
        assert np.all(leaf <= high + 1e-7)
        if slack is not None:
            spread = leaf.max(0) - leaf.min(0)
            assert np.all(high - low <= slack * spread + 1e-4)


PROGRAMS = {
    "matrix": lambda x: (x @ MATRIX, MATRIX.T @ x, jnp.outer(x, x), x @ x),
    "indexing": lambda x: (x[::-1], x[jnp.array([2, 0, 0])], x.at[1].set(x[0]), jnp.roll(x, 1)),
    "shapes": lambda x: (
        jnp.pad(x, (1, 2), constant_values=4.0), jnp.concatenate([x, 2 * x]), jnp.stack([x, -x], 1),
        jnp.tile(x, 2), x[:, None].T, jnp.split(2 * x, [1]), jnp.repeat(x, 2),
    ),
    "numbers for arrays": lambda x: (
        jnp.sum(x[0] + jnp.arange(3.0)), jnp.prod(x[1] * jnp.arange(1.0, 4.0) - x[0]),
        (x[0] - jnp.arange(3.0))[2], jnp.cumsum(jnp.maximum(x[0], jnp.arange(3.0) - 1)),
        jnp.sum(jnp.where(x[0] > 0, x[1], jnp.arange(3.0))), jnp.sum(jnp.clip(x[0], -x / 2, 0.9)),
    ),
    "sums": lambda x: (jnp.sum(x), jnp.mean(x * x), jnp.cumsum(x), jnp.prod(x), jnp.linalg.norm(x)),
    "extremes": lambda x: (
        jnp.max(x), jnp.min(x), jnp.argmax(x), jnp.argmin(x), jax.lax.cummax(x),
        jnp.clip(x, -0.5, 0.5), jnp.all(x > 0), jnp.any(x > 0.5),
    ),
    "whole numbers": lambda x: (
        jnp.floor(3 * x).astype(jnp.int32) % 4, (x > 0).astype(jnp.int32) + 2,
        jnp.sign(x).astype(jnp.int32) * 3 - 1, (5 * x).astype(jnp.int32) // 2,
    ),
    "choices": lambda x: (
        jnp.where(x > 0, jnp.sin(x), x), jax.nn.leaky_relu(x), jax.nn.elu(x),
        jax.lax.cond(x[0] > 0, lambda: x[1], lambda: x[2] * x[1]),
        jnp.select([x > 0.5, x > 0], [x, 2 * x], -x), ~(x > 0) & ((x < 0.2) ^ (x[::-1] > 0)),
    ),
    "a table": lambda x: jnp.asarray([1.0, 4.0, 2.0, 8.0])[
        jnp.clip(jnp.floor(2 * x[0]) + 2, 0, 3).astype(jnp.int32)
    ],
    "loops": lambda x: (
        jax.lax.fori_loop(0, 5, lambda i, y: y * 0.5 + x * i, x),
        jax.lax.while_loop(lambda c: c[1] > 0.1, lambda c: (c[0] + 1, c[1] / 2), (0, 2.0 + x[0])),
        jax.lax.scan(lambda c, k: (c + jnp.sin(c) * 0.1, c[k % 3]), x, jnp.arange(9))[1],
        jax.lax.scan(lambda c, y: (c * 0.9 + y, c), 0.0, x, reverse=True),
    ),
    "angles": lambda x: (jnp.arctan2(x[0], x[1]), jnp.mod(x + 7, 2 * jnp.pi)),
    "quarter turns": lambda x: jnp.where(
        (jnp.round(9 * x[0]).astype(jnp.int32) & 1) != 0, -jnp.sin(x), jnp.cos(x)
    ),
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("name", PROGRAMS)
def test_values_lie_in_their_sets(name):
    contained(PROGRAMS[name])


@pytest.mark.thorough
def test_a_network_is_enclosed_tightly():
    weights = [
        np.random.default_rng(i).normal(size=s) / 2 for i, s in enumerate([(3, 16), (16, 2)])
    ]

    def network(x):
        hidden = jnp.tanh(x @ jnp.asarray(weights[0], jnp.float32))
        return hidden @ jnp.asarray(weights[1], jnp.float32)

    contained(network, slack=3.0)


@pytest.mark.thorough
def test_a_loop_that_turns_does_not_grow():
    """Two hundred rotations: boxes around boxes would be ten million times as wide."""

    def turned(x):
        c, s = np.float32(np.cos(0.1)), np.float32(np.sin(0.1))
        step = lambda i, y: (c * y[0] - s * y[1] + 1e-3 * y[0] ** 2, s * y[0] + c * y[1])  # noqa: E731
        return jax.lax.fori_loop(0, 200, step, (0.1 * x[0], 0.1 * x[1]))

    contained(turned, slack=2.5)


def test_a_missing_operation_is_named_with_its_line():
    with pytest.raises(MissingRule, match=r"nextafter \(.*test_programs.py, line \d+\)"):
        interpreted(lambda x: jax.lax.nextafter(x, x + 1))


def test_writing_at_several_indices_that_depend_on_features_is_an_error_that_says_so():
    with pytest.raises(MissingRule, match="several indices that depend on the features, by the op"):
        interpreted(lambda x: x.at[(4 * x).astype(jnp.int32)].set(1.0))
