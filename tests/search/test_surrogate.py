"""The models of the default search, against the formulas of linear regression and of a process."""

import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.surrogate import (
    ALONG,
    CAPACITY,
    ELITE,
    FLOOR,
    LENGTHS,
    NOISES,
    NUGGETS,
    Surrogate,
    positions,
    targets,
)

CUBE = Cube((0, 0, 3), weights=(None, None, (0.1, 0.2, 0.7)), ordered=(True, True, False))


def rows(count=40):
    """Points with a robustness that has its minimum at (0.3, 1), and in the second cell."""
    rng = np.random.default_rng(0)
    u = rng.random((count, 3), np.float32)
    u[:, 2] = CUBE.centres(CUBE.cells(u))[:, 0]
    score = 1 + (u[:, 0] - 0.3) ** 2 - 0.5 * u[:, 1] + 0.4 * (CUBE.cells(u)[:, 0] != 1)
    return u, (score + 0.01 * rng.normal(size=count)).astype(np.float32)


def learned():
    """The models of the rows, which of their points are there, and what they learn of each."""
    model = Surrogate.nothing(3).learned(*rows())
    there = jnp.isfinite(model.score)
    return model, there, targets(model.score, there)


def evidence(covariance, y):
    """The logarithm of the evidence, with the scale that makes it greatest."""
    square = y @ np.linalg.solve(covariance, y)
    return -0.5 * len(y) * np.log(square) - 0.5 * np.linalg.slogdet(covariance)[1]


@pytest.mark.thorough
def test_the_mean_of_the_additive_model_is_that_of_ridge_regression():
    model, there, y = learned()
    nothing = jnp.zeros((1, 2 * 2 + 3)), jnp.zeros((1, CAPACITY))
    found = np.asarray(model._minima(CUBE, y, there, *nothing))[0]
    # Regression in NumPy; the columns are a line and a parabola of each number, and the cells.
    u, y = np.asarray(model.u[:40], float), np.asarray(y[:40], float)
    line, cell = 2 * u[:, :2] - 1, CUBE.cells(u.astype(np.float32))[:, 0]
    x = np.hstack([line, line**2 - 1 / 3, np.eye(3)[cell] - 1 / 3])
    noise = max(NOISES, key=lambda each: evidence(x @ x.T + each * np.eye(40), y))
    weights = np.linalg.solve(x.T @ x + noise * np.eye(7), x.T @ y)
    best = np.clip(-weights[:2] / (2 * np.abs(weights[2:4])), -1, 1)
    np.testing.assert_allclose(found[:2], (best + 1) / 2, atol=1e-3)
    np.testing.assert_allclose(found[:2], [0.3, 1.0], atol=0.1)
    assert CUBE.cells(found[None])[0, 0] == np.argmin(weights[4:]) == 1


@pytest.mark.thorough
def test_the_process_chooses_the_lowest_bound():
    model, there, y = learned()
    choices = np.random.default_rng(1).random((60, 3), np.float32)
    optimism = np.array([[0.0], [0.5], [3.0], [30.0]], np.float32)
    found = model._lowest(CUBE, y, there, jnp.asarray(choices), jnp.asarray(optimism))

    def apart(one, two):
        gap = (one[:, None, :2] - two[None, :, :2]) ** 2
        other = CUBE.cells(one)[:, None, 0] != CUBE.cells(two)[None, :, 0]
        return np.sqrt((gap.sum(axis=2) + other) / 3)

    def matern(far):
        r = np.sqrt(5) * far
        return (1 + r + r**2 / 3) * np.exp(-r)

    known, y = np.asarray(model.u[:40]), np.asarray(y[:40], float)
    np.testing.assert_allclose(
        np.linalg.norm(positions(known, CUBE)[0] - positions(known, CUBE)[1]),
        apart(known[:1], known[1:2])[0, 0], rtol=1e-5,
    )  # fmt: skip
    # The same by the covariance of the best points.
    places, new = (np.asarray(positions(each, CUBE), float) for each in (known, choices))
    best = places[np.argsort(model.score[:40], kind="stable")[:ELITE]]
    inverse = np.linalg.inv(np.cov(best.T, bias=True) + FLOOR / 3 * np.eye(5)) / 5

    def along(one, two):
        gap = one[:, None] - two[None]
        return np.sqrt(np.einsum("ijk,kl,ijl->ij", gap, inverse, gap))

    far = [apart(known, known)] * 6 + [along(places, places)] * 6
    options = [(at, by) for lengths in (LENGTHS, ALONG) for at in lengths for by in NUGGETS]
    covariances = [
        matern(each / at) + by * np.eye(40) for each, (at, by) in zip(far, options, strict=True)
    ]
    best = int(np.argmax([evidence(each, y) for each in covariances]))
    crossed = apart(known, choices) if best < 6 else along(places, new)
    covariance, cross = covariances[best], matern(crossed / options[best][0])
    mean = cross.T @ np.linalg.solve(covariance, y)
    scale = y @ np.linalg.solve(covariance, y) / 40
    left = 1 - np.sum(cross * np.linalg.solve(covariance, cross), axis=0)
    bound = mean - optimism * np.sqrt(scale * np.maximum(left, 0))
    # Each row chooses among a quarter of them.
    bound = np.where((np.arange(60) - np.arange(4)[:, None]) % 4 == 0, bound, np.inf)
    np.testing.assert_array_equal(found, choices[bound.argmin(axis=1)])


def test_steps_have_the_covariance_of_the_best_points():
    model, _, _ = learned()
    rng = np.random.default_rng(2)
    coins = np.column_stack([np.full(20000, 0.7), np.full(20000, 0.0)]).astype(np.float32)
    normal = rng.normal(size=(20000, ELITE)).astype(np.float32)
    found = np.asarray(model._near(jnp.asarray(coins), jnp.asarray(normal)))
    order = np.argsort(model.score, kind="stable")[:ELITE]
    best = np.asarray(model.u)[order]
    inside = np.all((found > 0) & (found < 1), axis=1)
    assert inside.mean() > 0.5
    step = 0.3 * (normal @ ((best - best.mean(axis=0)) / np.sqrt(ELITE)))
    np.testing.assert_allclose(found[inside], (best[0] + step)[inside], atol=1e-4)
    expected = 0.09 * np.cov(best.T, bias=True)
    np.testing.assert_allclose(np.cov(step.T), expected, rtol=0.2, atol=5e-4)


def test_it_keeps_the_best_half_and_the_newest_others():
    u, score = rows(CAPACITY)
    old = Surrogate.nothing(3).learned(u, 1 + score)
    new = old.learned(u[:16] + 1, jnp.full(16, 50.0).at[0].set(0.0))
    kept = np.sort(np.asarray(new.score))
    assert kept[0] == 0
    assert (kept == 50).sum() == 15
    np.testing.assert_array_equal(kept[1:64], np.sort(1 + score)[:63])
    # A score that is infinite teaches nothing.
    same = old.learned(u[:16], jnp.full(16, jnp.inf))
    np.testing.assert_array_equal(np.sort(same.score), np.sort(old.score))
