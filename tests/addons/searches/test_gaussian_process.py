"""Regression against scikit-learn, evidence by its definition, sampled functions by moments."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from verifai_jax.addons.searches.gaussian import GaussianProcess, Hyper, TrainingData

KEY = jax.random.key(0)
LENGTHS = np.array([0.3, 0.8, 1.7])
VARIANCE, NOISE = 1.7, 0.01


def hyper(dtype, lengths=LENGTHS):
    return Hyper(*(jnp.asarray(np.log(x), dtype) for x in (VARIANCE, lengths, NOISE)))


def data(rows=40, padding=24, dtype=jnp.float32):
    """Observations with rows that are not there between the others, full of nonsense."""
    rng = np.random.default_rng(1)
    x = rng.random((rows + padding, 3))
    y = np.sin(6 * x[:, 0]) + x[:, 1] ** 2 + 0.1 * rng.standard_normal(len(x))
    mask = rng.permutation(len(x)) < rows
    y[~mask] = np.nan
    seen = TrainingData(jnp.asarray(x, dtype), jnp.asarray(y, dtype), jnp.asarray(mask))
    return seen, x[mask], y[mask]


PLAIN = GaussianProcess((False,) * 3)


@pytest.mark.slow
@pytest.mark.parametrize(("wide", "tolerance"), [(False, 1e-3), (True, 1e-6)])
def test_agrees_with_scikit_learn(wide, tolerance):
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    kernel = ConstantKernel(VARIANCE) * Matern(LENGTHS, nu=2.5) + WhiteKernel(NOISE)
    with jax.enable_x64(wide):
        dtype = jnp.float64 if wide else jnp.float32
        seen, x, y = data(dtype=dtype)
        theirs = GaussianProcessRegressor(kernel, optimizer=None, alpha=0.0).fit(x, y)
        points = np.random.default_rng(2).random((30, 3))
        mean, std = theirs.predict(points, return_std=True)
        mine = PLAIN.condition(hyper(dtype), seen)
        got_mean, got_std = PLAIN.predict(mine, jnp.asarray(points, dtype))
        np.testing.assert_allclose(got_mean, mean, atol=tolerance)
        # Theirs has the noise in it.
        np.testing.assert_allclose(np.sqrt(got_std**2 + NOISE), std, atol=tolerance)

        value, gradient = jax.value_and_grad(PLAIN.evidence)(hyper(dtype), seen)
        log_likelihood, slope = theirs.log_marginal_likelihood(
            theirs.kernel_.theta, eval_gradient=True
        )
        np.testing.assert_allclose(value, log_likelihood, rtol=tolerance)
        got = np.concatenate([[gradient.variance], gradient.lengths, [gradient.noise]])
        np.testing.assert_allclose(got, slope, rtol=10 * tolerance, atol=10 * tolerance)


CODES = GaussianProcess((False, True, True))


@pytest.mark.thorough
def test_codes_count_by_whether_they_are_the_same():
    a = np.array([[0.1, 0, 3], [0.5, 1, 3], [0.9, 1, 2]])
    with jax.enable_x64(True):
        got = CODES.covariance(hyper(jnp.float64), jnp.asarray(a), jnp.asarray(a))
    for i in range(3):
        for j in range(3):
            r = math.sqrt(5) * abs(a[i, 0] - a[j, 0]) / LENGTHS[0]
            differ = (a[i, 1] != a[j, 1]) / LENGTHS[1] + (a[i, 2] != a[j, 2]) / LENGTHS[2]
            expected = VARIANCE * (1 + r + r * r / 3) * math.exp(-r - differ)
            np.testing.assert_allclose(got[i, j], expected, rtol=1e-9)


@pytest.mark.slow
def test_evidence_is_the_density_of_the_targets():
    with jax.enable_x64(True):
        seen, x, y = data(rows=12, padding=3, dtype=jnp.float64)
        codes = np.floor(3 * x[:, 1:])
        x = np.concatenate([x[:, :1], codes], axis=1)
        given = seen._replace(x=jnp.asarray(np.full((15, 3), np.nan)).at[seen.mask].set(x))
        given = given._replace(x=jnp.where(seen.mask[:, None], given.x, 0.5))
        covariance = np.asarray(CODES.covariance(hyper(jnp.float64), x, x))
        expected = multivariate_normal(cov=covariance + NOISE * np.eye(12)).logpdf(y)
        np.testing.assert_allclose(CODES.evidence(hyper(jnp.float64), given), expected, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("process", [PLAIN, CODES], ids=["plain", "codes"])
def test_sampled_functions_have_the_moments_of_the_posterior(process):
    rng = np.random.default_rng(3)
    x = rng.random((24, 3))
    points = rng.random((20, 3))
    for places in (x, points):
        places[:, process.unordered] = np.floor(3 * places[:, process.unordered])
    y = np.sin(5 * x[:, 0]) + x[:, 1]
    seen = TrainingData(
        jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32), jnp.arange(24) % 4 != 3
    )
    given = hyper(jnp.float32)

    @jax.jit
    def draw(key):
        posterior = process.condition(given, seen)
        paths = process.paths(posterior, key, 64, 256)
        at = jnp.asarray(points, jnp.float32)
        return process.basis(posterior, paths, at) @ paths.weights, process.predict(posterior, at)

    keys = jax.random.split(KEY, 60)
    values = np.concatenate([np.asarray(draw(key)[0]) for key in keys], axis=1)
    mean, std = (np.asarray(part) for part in draw(KEY)[1])
    # 3840 functions, in 60 groups that share their waves.
    np.testing.assert_allclose(values.mean(1), mean, atol=0.12)
    np.testing.assert_allclose(values.std(1), std, rtol=0.1, atol=0.02)
    assert np.all(np.abs(std) > 0.03)


@pytest.mark.slow
def test_fitting_finds_the_coordinates_that_matter():
    rng = np.random.default_rng(4)
    x = rng.random((96, 3))
    y = np.sin(9 * x[:, 0])
    seen = TrainingData(
        jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32), jnp.arange(96) < 80
    )
    fit = jax.jit(PLAIN.fit, static_argnums=2)
    first = PLAIN.first()
    fitted = fit(first, seen, 60)
    lengths = np.exp(fitted.lengths)
    assert lengths[0] < 1
    assert np.all(lengths[1:] > 3)

    def posterior(hyper):
        return float(PLAIN.evidence(hyper, seen) + PLAIN.log_prior(hyper))

    gained = posterior(fitted) - posterior(first)
    assert gained > 50
    # Going on from there gains little, by coordinates whose lengths are beyond all distances.
    assert abs(posterior(fit(fitted, seen, 60)) - posterior(fitted)) < 0.1 * gained


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("x", "y", "mask"),
    [
        (np.full((16, 3), 0.5), np.ones(16), np.ones(16, bool)),  # all the same point
        (np.zeros((16, 3)), np.arange(16.0) * 1e3, np.ones(16, bool)),  # contradictions
        (np.full((16, 3), 0.5), np.full(16, np.nan), np.zeros(16, bool)),  # nothing
        (np.full((16, 3), 0.5), np.zeros(16), np.arange(16) == 7),  # one
    ],
    ids=["same", "contradictions", "nothing", "one"],
)
def test_degenerate_observations(x, y, mask):
    seen = TrainingData(jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32), jnp.asarray(mask))

    @jax.jit
    def all_of_it(seen):
        fitted = PLAIN.fit(PLAIN.first(), seen, 5)
        posterior = PLAIN.condition(fitted, seen)
        paths = PLAIN.paths(posterior, KEY, 2, 64)
        at = jnp.eye(3)
        values = PLAIN.basis(posterior, paths, at) @ paths.weights
        return fitted, values, PLAIN.predict(posterior, at)

    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(all_of_it(seen)))


@pytest.mark.slow
def test_a_singular_covariance_is_made_regular():
    # Twice the same points without any noise: the plain factor does not exist.
    seen, _, _ = data(rows=40, padding=0)
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), seen)
    smooth = hyper(jnp.float32, lengths=np.full(3, 50.0))._replace(noise=jnp.float32(-40.0))
    mean, std = PLAIN.predict(PLAIN.condition(smooth, twice), seen.x)
    assert np.all(np.isfinite(mean))
    assert np.all(np.isfinite(std))


@pytest.mark.slow
def test_no_coordinates():
    empty = GaussianProcess(())
    seen = TrainingData(jnp.zeros((4, 0)), jnp.full(4, 2.0), jnp.ones(4, bool))
    given = empty.first()._replace(noise=jnp.log(1.0))
    mean, std = empty.predict(empty.condition(given, seen), jnp.zeros((2, 0)))
    # The mean of four noisy values, shrunk: 4 * 2 / (4 + 1), with variance 1 / (4 + 1).
    np.testing.assert_allclose(mean, 1.6, rtol=1e-5)
    np.testing.assert_allclose(std, math.sqrt(0.2), rtol=1e-4)
