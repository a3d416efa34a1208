"""The model of traces: its posterior against exact formulas, its components, its fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.searches import trace_model as models

WIDTH, ROWS, SIZE = 3, 10, 16


def covariance(hyper, a, b):
    """The covariance in double precision, written out once more."""
    lengths, parts = (np.asarray(leaf, np.float64) for leaf in (hyper.lengths, hyper.parts))
    a, b = a / np.exp(lengths), b / np.exp(lengths)
    inner = a @ b.T
    r = np.sqrt(5) * np.linalg.norm(a[:, None] - b[None], axis=2)
    constant, linear, quadratic, rough = np.exp(parts)
    return (
        constant + linear * inner + quadratic * inner**2 + rough * (1 + r + r**2 / 3) * np.exp(-r)
    )


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(0)
    x = np.zeros((SIZE, WIDTH))
    x[:ROWS] = rng.random((ROWS, WIDTH)) - 0.5
    mask = np.arange(SIZE) < ROWS
    coefficients = np.zeros((SIZE, 2))
    coefficients[:ROWS] = np.stack([np.sin(4 * x[:ROWS, 0]), 3 * x[:ROWS, 1] * x[:ROWS, 2]], 1)
    return jnp.asarray(x, jnp.float32), jnp.asarray(coefficients, jnp.float32), jnp.asarray(mask)


@pytest.mark.slow
def test_short_lengths_and_near_rows_leave_a_finite_model_that_can_be_fitted():
    """In 32 bits squares of points have no digits left for the distance of neighbours."""
    rng = np.random.default_rng(0)
    x = rng.random((64, WIDTH)) - 0.5
    x = x[np.arange(64) % 8] + 1e-3 * rng.normal(size=(64, WIDTH))
    x, mask = jnp.asarray(x, jnp.float32), np.ones(64, bool)
    coefficients = jnp.asarray(np.sign(np.sin(200 * np.asarray(x[:, :1]))), jnp.float32)
    hyper = models.TraceHyper(
        jnp.log(jnp.array([0.01, 0.5, 2.0])), jnp.array([0.0, -8.0, -8.0, 3.0]), jnp.float32(-9.0)
    )
    model = models.condition(hyper, x, mask, coefficients, jnp.zeros(1), jnp.eye(1))
    assert np.isfinite(model.factor).all()
    rows = np.asarray(x, np.float64)
    exact = covariance(hyper, rows, rows) + np.exp(-9.0) * np.eye(64)
    factor = np.asarray(model.factor, np.float64)
    np.testing.assert_allclose(
        factor @ factor.T, exact, rtol=1e-4, atol=2e-5 * np.trace(exact) / 64
    )
    fitted = models.fit(hyper, x, mask, coefficients)
    assert not np.array_equal(fitted.lengths, hyper.lengths)


@pytest.mark.slow
def test_the_fit_follows_the_derivative_of_the_evidence(data):
    """Of the plain formula, by autodiff in double precision."""
    x, coefficients, mask = data
    hyper, worth = models.first_hyper(WIDTH), jnp.array([1.0, 0.3])

    def surprise(hyper):
        count = jnp.float32(ROWS)
        return models._surprise(models._noisy(hyper, x, mask), coefficients, worth, count)

    def plain(hyper):
        rows = x.astype(jnp.float64)[:ROWS] / jnp.exp(hyper.lengths)
        inner = rows @ rows.T
        square = jnp.sum((rows[:, None] - rows[None]) ** 2, axis=2)
        r = jnp.sqrt(5 * jnp.where(square > 0, square, 1.0)) * (square > 0)
        constant, linear, quadratic, rough = jnp.exp(hyper.parts)
        known = constant + linear * inner + quadratic * inner**2
        known += rough * (1 + r + r**2 / 3) * jnp.exp(-r) + jnp.exp(hyper.noise) * jnp.eye(ROWS)
        y = coefficients.astype(jnp.float64)[:ROWS]
        variance = jnp.sum(y * jnp.linalg.solve(known, y), axis=0) / ROWS
        size = jnp.linalg.slogdet(known)[1]
        return jnp.sum(worth * (ROWS * jnp.log(variance) + size)) / 2

    value, slope = jax.value_and_grad(surprise)(hyper)
    with jax.enable_x64(True):
        double = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), hyper)
        exact, exact_slope = jax.value_and_grad(plain)(double)
    np.testing.assert_allclose(value, exact, rtol=1e-4)
    for got, wanted in zip(slope, exact_slope, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=2e-3, atol=2e-3)


@pytest.mark.proves
def test_draws_have_the_moments_of_the_exact_posterior(data):
    x, coefficients, mask = data
    hyper = models.first_hyper(WIDTH)._replace(noise=jnp.float32(-5.0))
    identity = jnp.eye(2)
    model = models.condition(hyper, x, mask, coefficients, jnp.zeros(2), identity)
    there = jnp.asarray(np.random.default_rng(1).random((4, WIDTH)) - 0.5, jnp.float32)

    @jax.jit
    def drawn(key):
        waves, weights = models.draw(model, key, 33)
        return jnp.einsum("mt,jtc->jmc", models.basis(model, waves, there), weights)

    # Each call has other waves, as their number is finite.
    values = np.concatenate(
        [np.asarray(drawn(key)) for key in jax.random.split(jax.random.key(0), 60)]
    )
    rows, new = np.asarray(x, np.float64)[:ROWS], np.asarray(there, np.float64)
    y = np.asarray(coefficients, np.float64)[:ROWS]
    known = covariance(hyper, rows, rows) + np.exp(-5.0) * np.eye(ROWS)
    cross = covariance(hyper, new, rows)
    mean = cross @ np.linalg.solve(known, y)
    scale = np.sqrt(np.sum(y * np.linalg.solve(known, y), axis=0) / ROWS)
    variance = np.diag(covariance(hyper, new, new) - cross @ np.linalg.solve(known, cross.T))
    std = np.sqrt(variance)[:, None] * scale
    # The first of each call is the mean itself.
    np.testing.assert_allclose(values[0], mean, atol=1e-3)
    others = np.delete(values, np.arange(0, len(values), 33), axis=0)
    assert np.all(np.abs(others.mean(axis=0) - mean) < 0.15 * std)
    np.testing.assert_allclose(others.std(axis=0), std, rtol=0.15)


@pytest.mark.thorough
def test_absent_rows_change_nothing(data):
    x, coefficients, mask = data
    hyper = models.first_hyper(WIDTH)
    padded = models.fit(hyper, x, mask, coefficients)
    exact = models.fit(hyper, x[:ROWS], mask[:ROWS], coefficients[:ROWS])
    for one, other in zip(padded, exact, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-2)


@pytest.mark.proves
def test_what_is_linear_is_learned_from_as_many_rows_as_it_has_inputs():
    # Forty inputs, fifty rows: a rough process alone would know nothing of a new point.
    rng = np.random.default_rng(2)
    weights = rng.normal(size=(40, 3))
    x = rng.random((64, 40)) - 0.5
    mask = np.arange(64) < 50
    y = np.where(mask[:, None], x @ weights, 0.0)
    x, y, mask = jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32), jnp.asarray(mask)
    x = jnp.where(mask[:, None], x, 0.0)
    hyper = models.fit(models.first_hyper(40), x, mask, y)
    model = models.condition(hyper, x, mask, y, jnp.zeros(3), jnp.eye(3))
    new = rng.random((20, 40)) - 0.5
    waves, drawn = models.draw(model, jax.random.key(0), 1)
    told = models.basis(model, waves, jnp.asarray(new, jnp.float32)) @ drawn[0]
    error = np.std(np.asarray(told) - new @ weights)
    assert error < 0.1 * np.std(new @ weights)


def test_components_give_back_the_traces():
    rng = np.random.default_rng(3)
    traces = (rng.normal(size=(30, 4)) @ rng.normal(size=(4, 200))).astype(np.float32) + 5
    mean, components = models.principal_components(traces)
    assert np.any(components, axis=1).sum() == 4
    assert len(components) == models.COMPONENTS
    again = mean + (traces - mean) @ components.T @ components
    np.testing.assert_allclose(again, traces, atol=1e-4)
    # Fewer rows than components.
    assert models.principal_components(traces[:2])[1].shape == (models.COMPONENTS, 200)


@pytest.mark.slow
def test_a_wider_draw_is_as_much_farther_from_the_mean(data):
    x, coefficients, mask = data
    hyper = models.first_hyper(WIDTH)
    zero, components = jnp.zeros(2), jnp.eye(2)
    model = models.condition(hyper, x, mask, coefficients, zero, components)
    points = jnp.concatenate([x[:ROWS], x[:ROWS] + 0.3])

    def drawn(spread):
        waves, weights = models.draw(model, jax.random.key(1), 2, True, spread)
        return np.asarray(models.basis(model, waves, points) @ weights)

    (mean, once), (same, wide) = drawn(1.0), drawn(3.0)
    np.testing.assert_array_equal(mean, same)
    np.testing.assert_allclose(wide - mean, 3 * (once - mean), atol=2e-3)
    assert np.abs(once - mean)[ROWS:].max() > 0.05
