"""VerifAI's histogram rule, case by case, and against the rule row by row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.addons.searches.ce_compat import CECompat
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations
from verifai_jax.testing import check_search

NAN = float("nan")


def histories(search, cube, rows):
    """The histograms of the first set after each row `(u, rho)`; NaN stands for no verdict."""
    state = search.init(jax.random.key(0), cube, 1)
    seen = []
    for u, rho in rows:
        told = Observations(
            jnp.array([u], jnp.float32), jnp.array([rho]), jnp.array([not np.isnan(rho)])
        )
        state = search.tell(state, cube, told)
        seen.append(np.asarray(state.histograms[0]))
    return seen


@pytest.mark.thorough
def test_continuous_as_verifai():
    # Conformance case ce-01; its last rows, at and above the threshold and without a verdict, are
    # no evidence (nor is the threshold itself in fals-03).
    feedback = [(0, -1.0), (0, -0.1), (3, -2.0), (1, 0.5), (2, 0.0), (4, NAN)]
    seen = histories(CECompat(), Cube((0,)), [([b / 5 + 0.1], rho) for b, rho in feedback])
    expected = [
        [0.28, 0.18, 0.18, 0.18, 0.18],
        [0.352, 0.162, 0.162, 0.162, 0.162],
        *[[0.3168, 0.1458, 0.1458, 0.2458, 0.1458]] * 4,
    ]
    np.testing.assert_allclose(np.array(seen)[:, 0], expected, atol=1e-6)


@pytest.mark.thorough
def test_discrete_as_verifai():
    # Conformance case ce-03: DiscreteBox((2, 5)) has a bin for each integer.
    feedback = [(3, -1.0), (5, -1.0), (2, 1.0)]
    cube = Cube((4,))
    seen = histories(CECompat(alpha=0.5), cube, [([(v - 1.5) / 4], rho) for v, rho in feedback])
    expected = [[0.125, 0.625, 0.125, 0.125], *[[0.0625, 0.3125, 0.0625, 0.5625]] * 2]
    np.testing.assert_allclose(np.array(seen)[:, 0], expected, atol=1e-6)


@pytest.mark.thorough
def test_discrete_without_a_verdict():
    # Conformance case ce-05, which raised in VerifAI, for Categorical("a", "b").
    (seen,) = histories(CECompat(), Cube((2,), ordered=(False,)), [([0.25], NAN)])
    np.testing.assert_array_equal(seen, [[0.5, 0.5]])


def test_each_length_has_histograms_of_its_own():
    # Conformance case ce-06: a list of one or two numbers in (0, 1).
    search = CECompat(buckets=2, alpha=0.5)
    cube = Cube((2, 0, 0), lengths=(0,))

    def step(state, _):
        u, state = search.ask(state, cube, 1)
        rho = jnp.where((u[:, 0] < 0.5) & (u[:, 1] < 0.5), -1.0, 1.0)
        return search.tell(state, cube, Observations(u, rho, jnp.ones(1, bool))), u

    state = search.init(jax.random.key(0), cube, 1)
    state, u = jax.jit(lambda state: jax.lax.scan(step, state, None, length=100))(state)
    assert state.histograms[0, 1, 0] > 0.9
    np.testing.assert_array_equal(state.histograms[1, 1:], np.full((2, 2), 0.5))
    # Lengths stay uniform, although all failures have the one.
    assert 0.3 < np.mean(u[:, 0, 0] < 0.5) < 0.7


def row_by_row(search, cube, histograms, told):
    """The rule as VerifAI has it, in NumPy."""
    histograms = np.array(histograms, np.float64)
    sizes = [level or search.buckets for level in cube.levels]
    for u, rho, valid in zip(*map(np.asarray, told[:3]), strict=True):
        if not valid or not rho < search.threshold:
            continue
        bins = [min(int(x * size), size - 1) for x, size in zip(u, sizes, strict=True)]
        which = 0
        for i in cube.lengths:
            which = which * sizes[i] + bins[i]
        histograms[which] *= search.alpha
        for j, b in enumerate(bins):
            histograms[which, j, b] += 1 - search.alpha
    return histograms


@pytest.mark.parametrize("alpha", [0.9, 0.0, 1.0])
def test_a_batch_is_as_its_rows_one_by_one(alpha):
    cube = Cube((3, 0, 4, 0, 2), lengths=(0, 4))
    search = CECompat(buckets=7, alpha=alpha, threshold=0.2)
    rng = np.random.default_rng(0)
    state = search.init(jax.random.key(0), cube, 64)
    tell = jax.jit(search.tell, static_argnums=1)
    expected = state.histograms
    for _ in range(3):
        rho = rng.normal(size=64).astype(np.float32)
        rho[::9] = np.nan
        told = Observations(rng.random((64, 5)).astype(np.float32), rho, rng.random(64) < 0.8)
        state = tell(state, cube, told)
        expected = row_by_row(search, cube, expected, told)
    np.testing.assert_allclose(state.histograms, expected, atol=1e-6)
    np.testing.assert_allclose(state.histograms.sum(-1), np.ones((6, 5)), atol=1e-5)


@pytest.mark.slow
def test_points_follow_the_histograms():
    cube = Cube((0, 3), weights=(None, (0.6, 0.3, 0.1)))
    search = CECompat(buckets=4)
    state = search.init(jax.random.key(0), cube, 20000)
    prior, _ = search.ask(state, cube, 20000)
    shares = np.bincount(np.asarray(cube.cells(prior)[:, 0]), minlength=3) / 20000
    np.testing.assert_allclose(shares, [0.6, 0.3, 0.1], atol=0.02)

    told = jnp.array([[[0.1, 0.0, 0.7, 0.2], [0.0, 1.0, 0.0, 0.0]]])
    u, _ = search.ask(state._replace(histograms=told), cube, 20000)
    u = np.asarray(u)
    shares = np.histogram(u[:, 0], 4, (0, 1))[0] / 20000
    np.testing.assert_allclose(shares, [0.1, 0, 0.7, 0.2], atol=0.02)
    assert shares[1] == 0
    assert np.all(cube.cells(u) == 1)
    # Uniform inside a bucket.
    inside = u[(u[:, 0] > 0.5) & (u[:, 0] < 0.75), 0]
    assert abs(inside.mean() - 0.625) < 0.005
    assert abs(inside.std() - 0.25 / np.sqrt(12)) < 0.005


@pytest.mark.thorough
@pytest.mark.parametrize(
    "cube",
    [
        Cube(()),
        Cube((0, 4, 0, 1, 1000)),
        Cube((3, 0, 2), weights=((0.7, 0.2, 0.1), None, None), lengths=(0, 2)),
        Cube((0,) * 200),
    ],
    ids=lambda cube: f"{len(cube.levels)} {cube.levels[:3]} {cube.lengths}",
)
def test_the_contract_of_searches_holds(cube):
    check_search(CECompat(), cube)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CECompat(buckets=0), "buckets must be an integer of at least 1; got 0"),
        (lambda: CECompat(alpha=1.5), r"alpha must be in \[0, 1\]; got 1.5"),
        (lambda: CECompat(threshold=NAN), "threshold must be a finite number; got nan"),
    ],
)
def test_values_out_of_range(make, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("cube", "message"),
    [
        (Cube((9, 9, 20), lengths=(0, 1, 2)), "this space has 9 .* 9 .* 20 = 1620"),
        (Cube((1000, 100_000, 0), lengths=(0,)), "would keep 300000000 histogram bins"),
    ],
)
def test_spaces_that_do_not_fit(cube, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        CECompat().check(cube)
