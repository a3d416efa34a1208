"""CMA-ES: its step against the tutorial in plain NumPy, its quality on known landscapes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from playing import gain, play

from verifai_jax.addons.searches.cmaes import CMAES
from verifai_jax.addons.searches.evolution import Evolution, recombination, reverse_recombination
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations
from verifai_jax.search.halton import halton_points
from verifai_jax.testing import check_search

KEY = jax.random.key(0)


@pytest.mark.slow
def test_single_points():
    _, (value,) = play(CMAES(), ("ball",), 1, 256, 15)
    assert gain("ball", value) > 4


def rosenbrock(x):
    return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def rastrigin(x):
    return 10 * len(x) + jnp.sum(x**2 - 10 * jnp.cos(2 * jnp.pi * x))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "below", "median", "most"),
    [
        (lambda x: jnp.sum(x**2), 0.01, 1.25 * 565, 1000),
        (rosenbrock, 1.0, 1.25 * 3085, 8000),
        (rastrigin, 30.0, 1.25 * 940, 5000),
    ],
    ids=["sphere", "rosenbrock", "rastrigin"],
)
def test_in_ten_dimensions_as_the_cmaes_package(function, below, median, most):
    # The medians of the package cmaes 0.13.1: a random mean, steps of 0.3 times the range, and
    # generations of ten. Restart rules that ignore the dimension find none of the last two.
    search, cube = CMAES(), Cube((0,) * 10)

    def one(key):
        def step(state, _):
            u, state = search.ask(state, cube, 10)
            rho = jax.vmap(lambda point: function(10 * point - 5) - below)(u)
            return search.tell(state, cube, Observations(u, rho, jnp.ones(10, bool))), rho

        return jax.lax.scan(step, search.init(key, cube, 10), None, length=800)[1].ravel()

    failing = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(KEY, 10))) < 0
    first = np.where(failing.any(axis=1), failing.argmax(axis=1) + 1.0, np.inf)
    assert np.median(first) < median
    assert np.max(first) < most


@pytest.mark.slow
def test_the_same_robustness_everywhere_gives_the_prior():
    search, cube = CMAES(), Cube((0, 0))

    def step(state, _):
        u, state = search.ask(state, cube, 16)
        told = Observations(u, jnp.ones(16), jnp.ones(16, bool))
        return search.tell(state, cube, told), u

    _, seen = jax.jit(lambda state: jax.lax.scan(step, state, None, 4))(search.init(KEY, cube, 16))
    expected = halton_points(jnp.arange(1, 65, dtype=jnp.uint32), 2, KEY)
    np.testing.assert_allclose(seen.reshape(64, 2), expected, atol=1e-6)


def one_step(evolution, points, weights, worse):
    """The tutorial's equations, one after the other, for a full covariance."""
    mean, size, covariance, way, whitened, age = (np.asarray(x, float) for x in evolution)
    n = len(mean)
    mu = 1 / np.sum(weights**2)
    cs = (mu + 2) / (n + mu + 5)
    ds = 1 + 2 * max(0, np.sqrt((mu - 1) / (n + 1)) - 1) + cs
    cc = (4 + mu / n) / (n + 4 + 2 * mu / n)
    c1 = 2 / ((n + 1.3) ** 2 + mu)
    cmu = min(1 - c1, 2 * (0.25 + mu - 2 + 1 / mu) / ((n + 2) ** 2 + mu))
    y = (points - mean) / size
    total = sum(w * step for w, step in zip(weights, y, strict=True))
    factor = np.linalg.inv(np.linalg.cholesky(covariance))
    whitened = (1 - cs) * whitened + np.sqrt(cs * (2 - cs) * mu) * factor @ total
    chi = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
    norm = np.linalg.norm(whitened)
    h = norm / np.sqrt(1 - (1 - cs) ** (2 * (age + 1))) < (1.4 + 2 / (n + 1)) * chi
    way = (1 - cc) * way + h * np.sqrt(cc * (2 - cc) * mu) * total
    against = 1 / np.sum(worse**2)
    alpha = min(1 + c1 / cmu, 1 + 2 * against / (mu + 2), (1 - c1 - cmu) / (n * cmu))
    signed = weights - alpha * worse
    white = (factor @ y.T).T
    outer = sum(
        (w if w >= 0 else w * n / (z @ z)) * np.outer(step, step)
        for w, step, z in zip(signed, y, white, strict=True)
    )
    covariance = (
        (1 + c1 * (1 - h) * cc * (2 - cc) - c1 - cmu * signed.sum()) * covariance
        + c1 * np.outer(way, way)
        + cmu * outer
    )
    size_after = size * np.exp(cs / ds * (norm / chi - 1))
    return mean + size * total, size_after, covariance, way, whitened, age + 1


@pytest.mark.slow
def test_a_step_is_that_of_the_tutorial():
    rng = np.random.default_rng(0)
    evolution = Evolution.begin(jnp.full(3, 0.5), jnp.float32(0.2), True)
    learn = jax.jit(Evolution.learn)
    for _ in range(5):
        points = evolution.draw(jnp.asarray(rng.standard_normal((12, 3)), jnp.float32))
        score = jnp.sum((points - 0.2) ** 2, axis=1)
        weights, worse = recombination(score), reverse_recombination(score)
        each = (np.asarray(part, float) for part in (points, weights, worse))
        expected = one_step(evolution, *each)
        evolution = learn(evolution, points, weights, worse)
        for got, wanted in zip(evolution, expected, strict=True):
            np.testing.assert_allclose(got, wanted, rtol=2e-4, atol=1e-5)


@pytest.mark.slow
def test_a_diagonal_covariance_learns_the_scales():
    scales = 10.0 ** -jnp.arange(3)
    rng = np.random.default_rng(1)
    learn = jax.jit(Evolution.learn)
    for full in (False, True):
        evolution = Evolution.begin(jnp.full(3, 0.5), jnp.float32(0.3), full)
        for _ in range(60):
            points = evolution.draw(jnp.asarray(rng.standard_normal((16, 3)), jnp.float32))
            value = jnp.sum((points / scales) ** 2, axis=1)
            evolution = learn(evolution, points, recombination(value))
        ratios = np.sqrt(np.asarray(evolution.variance()))
        # Standard deviations go with the widths of the bowl: 1, 0.1 and 0.01.
        assert 3 < ratios[0] / ratios[1] < 30
        assert 3 < ratios[1] / ratios[2] < 30
        assert np.max(np.abs(evolution.mean)) < 0.02


def test_the_better_half_is_recombined_by_rank():
    # The better half of what is there, in the order of the ranks; ties share.
    inf = np.inf
    weights = np.maximum(np.log(2.5) - np.log([3, inf, 1, 2, 4]), 0)
    for score, expected in (
        ([3, inf, 1, 2, 4], weights / weights.sum()),
        ([0, 0, 0, 0, 0], np.full(5, 0.2)),
        ([inf, 2, inf, inf, inf], [0, 1, 0, 0, 0]),
        ([inf] * 5, np.zeros(5)),
    ):
        got = jax.jit(recombination)(jnp.array(score, jnp.float32))
        np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_reverse_recombination():
    # The worse half, the worst most; nothing that is as good as one of the better half.
    inf = np.inf
    weights = np.maximum(np.log([3, 1, 1, 2, 4]) - np.log(2.5), 0) * [1, 0, 1, 1, 1]
    for score, expected in (
        ([3, inf, 1, 2, 4], weights / weights.sum()),
        ([0, 0, 0, 0, 0], np.zeros(5)),
        ([1, 1, 1, 1, 2], [0, 0, 0, 0, 1]),
        ([inf, 2, inf, inf, inf], np.zeros(5)),
    ):
        got = jax.jit(reverse_recombination)(jnp.array(score, jnp.float32))
        np.testing.assert_allclose(got, expected, rtol=1e-5)


@pytest.mark.thorough
def test_discrete_coordinates_keep_moving():
    evolution = Evolution.begin(jnp.full(2, 0.5), jnp.float32(1e-3), True)
    wide = evolution.widened(np.array([0.0, 0.1], np.float32))
    std = wide.size * np.sqrt(wide.variance())
    np.testing.assert_allclose(std, [1e-3, 0.1], rtol=1e-3)


@pytest.mark.thorough
def test_a_warm_start_begins_at_the_best_point():
    search, cube = CMAES(small_step=0.01), Cube((0, 0, 3), ordered=(True, True, False))
    u = jnp.array([[0.2, 0.9, 0.5], [0.7, 0.1, 0.9], [0.4, 0.4, 0.1], [0.1, 0.1, 0.1]])
    told = Observations(u, jnp.array([3.0, 1.0, 2.0, -1.0]), jnp.array([True, True, True, False]))
    state = search.init(KEY, cube, 4)
    worse = told._replace(rho=told.rho + 5)
    warm = jax.jit(search.warm_start, static_argnums=1)
    for table in (worse, told, worse):
        state = warm(state, cube, table)
    asked = np.asarray(jax.jit(search.ask, static_argnums=(1, 2))(state, cube, 4)[0])
    near = np.max(np.abs(asked[:, :2] - u[1, :2]), axis=1) < 0.06
    assert near.sum() == 3  # the other one explores


@pytest.mark.slow
@pytest.mark.parametrize(
    "cube",
    [
        Cube((3, 0, 9), weights=((0.7, 0.2, 0.1), None, None), ordered=(False, True, True)),
        Cube((3, 2), ordered=(False, False)),
    ],
    ids=["weighted", "unordered"],
)
def test_the_contract_of_searches_holds(cube):
    check_search(CMAES(), cube, batch=5, rounds=6)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"step": 0}, r"step must be in \(0, 1\]; got 0"),
        ({"small_step": 2}, r"small_step must be in \(0, 1\]; got 2"),
        ({"exploration": 0}, r"exploration must be in \(0, 1\]; got 0"),
        ({"min_std": "tiny"}, r"min_std must be in \(0, 1\]; got 'tiny'"),
        ({"full_up_to": -1}, "full_up_to must be an integer of at least 0; got -1"),
        ({"patience": 0}, "patience must be an integer of at least 1; got 0"),
        ({"failures": 1.5}, "failures must be an integer of at least 1; got 1.5"),
    ],
)
def test_values_out_of_range(options, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        CMAES(**options)
