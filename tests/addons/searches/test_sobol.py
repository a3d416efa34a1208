"""Sobol' points against SciPy's, and what scrambling must keep."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from scipy import stats

from verifai_jax.addons.searches.sobol import Sobol
from verifai_jax.core.values.cube import Cube
from verifai_jax.testing import check_batch_independence, check_search


@lru_cache
def first(search, dim, count):
    cube = Cube((0,) * dim)
    return jax.jit(lambda key: search.ask(search.init(key, cube, count), cube, count)[0])


def points(search, dim, count, seed=0):
    return np.asarray(first(search, dim, count)(jax.random.key(seed)))


def test_the_first_points():
    np.testing.assert_array_equal(
        points(Sobol(scramble=False), 3, 8),
        [
            [0, 0, 0],
            [1 / 2, 1 / 2, 1 / 2],
            [3 / 4, 1 / 4, 1 / 4],
            [1 / 4, 3 / 4, 3 / 4],
            [3 / 8, 3 / 8, 5 / 8],
            [7 / 8, 7 / 8, 1 / 8],
            [5 / 8, 1 / 8, 7 / 8],
            [1 / 8, 5 / 8, 3 / 8],
        ],
    )


def test_equals_scipy_bit_for_bit():
    reference = stats.qmc.Sobol(250, scramble=False).random(1024)
    np.testing.assert_array_equal(points(Sobol(scramble=False), 250, 1024), reference)


@pytest.mark.slow
def test_large_indices():
    cube, search = Cube((0,) * 12), Sobol(scramble=False)
    state = search.init(jax.random.key(0), cube, 16)
    # Just before 2^28: a number of which all digits count.
    first = 2**28 - 7
    u, after = search.ask(state._replace(index=jnp.uint32(first)), cube, 16)
    reference = stats.qmc.Sobol(12, scramble=False, bits=32).fast_forward(first).random(16)
    np.testing.assert_array_equal(u, np.floor(reference * 2**24) / 2**24)
    assert after.index == first + 16
    # Up to the last index, points stay inside.
    assert np.all(search.ask(state._replace(index=jnp.uint32(2**32 - 16)), cube, 16)[0] < 1)


@pytest.mark.parametrize("scramble", [False, True])
def test_each_dyadic_box_gets_its_share(scramble):
    # 2^8 points fall one into each box of 2^-4 by 2^-4, 2^-3 by 2^-5, and so on; then again.
    u = points(Sobol(scramble), 2, 512)
    for half in (u[:256], u[256:]):
        for a in range(9):
            box = (half * [2**a, 2 ** (8 - a)]).astype(int) @ [2 ** (8 - a), 1]
            assert len(set(box.tolist())) == 256


def test_scrambled_is_more_even_than_random():
    even = [stats.qmc.discrepancy(points(Sobol(), 4, 256, seed)) for seed in range(5)]
    random = stats.qmc.discrepancy(np.random.default_rng(0).random((256, 4)))
    assert max(even) < 0.2 * random


def test_scrambled_points_are_uniform():
    # Over keys, one and the same point is anywhere: also the one that was the corner.
    cube, search = Cube((0, 0, 0)), Sobol()
    keys = jax.random.split(jax.random.key(5), 2000)
    u = jax.jit(jax.vmap(lambda key: search.ask(search.init(key, cube, 4), cube, 4)[0]))(keys)
    for place in (0, 3):
        for j in range(3):
            assert stats.kstest(u[:, place, j], "uniform").pvalue > 1e-3
        assert np.max(np.abs(np.corrcoef(u[:, place].T) - np.eye(3))) < 0.1
    # The scrambling of a digit depends on the digits before it.
    assert len({tuple(row) for row in np.asarray(u[:, 3, 0] - u[:, 0, 0])[:, None].tolist()}) > 1000


def test_the_key_decides_only_if_scrambled():
    assert not np.array_equal(points(Sobol(), 2, 8, 0), points(Sobol(), 2, 8, 1))
    plain = Sobol(scramble=False)
    np.testing.assert_array_equal(points(plain, 2, 8, 0), points(plain, 2, 8, 1))


@pytest.mark.slow
def test_the_contract_of_searches_holds():
    for cube in (Cube(()), Cube((0,) * 200)):
        check_search(Sobol(), cube)
    check_search(Sobol(scramble=False), Cube((0, 4, 0, 1, 1000)))
    for scramble in (False, True):
        check_batch_independence(Sobol(scramble), Cube((0, 0, 5)))


def test_what_cannot_work_is_refused_with_the_reason():
    with unchecked(), pytest.raises(ValueError, match="scramble must be True or False; got 1"):
        Sobol(scramble=1)
    with pytest.raises(ValueError, match="at most 21201 unit coordinates; this space has 21202"):
        Sobol().check(Cube((0,) * 21202))
