"""The grid against the product of its axes, and its order."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.addons.searches.grid import STEPS, Grid, permuted
from verifai_jax.core.values.cube import Cube
from verifai_jax.testing import check_batch_independence, check_search


def asked(search, cube, batch=7, seed=0):
    """All points of the grid in the order of the search, in batches that do not divide it."""
    search.check(cube)
    state, parts = search.init(jax.random.key(seed), cube, batch), []
    for _ in range(-(-search.total(cube) // batch)):
        u, state = search.ask(state, cube, batch)
        parts.append(np.asarray(u))
    return np.concatenate(parts)


def whole(search, cube, batch=7):
    """All points of the grid in the order of its rows, which are those that the search asks for."""
    total = search.total(cube)
    points = np.asarray(search.points_at(jnp.arange(total, dtype=jnp.uint32), cube))
    found = asked(search, cube, batch)[:total]
    assert sorted(map(tuple, found)) == sorted(map(tuple, points))
    return points


@pytest.mark.slow
def test_orders_are_permutations():
    run = jax.jit(permuted, static_argnums=1)
    for total in (1, 2, 3, 5, 7, 12, 441, 10_201):
        orders = set()
        for seed in range(3):
            keys = jax.random.bits(jax.random.key(seed), (STEPS,), jnp.uint32)
            found = np.asarray(run(jnp.arange(total, dtype=jnp.uint32), total, keys))
            np.testing.assert_array_equal(np.sort(found), np.arange(total))
            orders.add(tuple(found))
        assert len(orders) == 3 or total < 12


@pytest.mark.thorough
def test_a_part_of_a_grid_is_spread_over_all_of_it():
    cube = Cube((101, 0, 101))
    u = np.asarray(Grid().ask(Grid().init(jax.random.key(3), cube, 400), cube, 400)[0])
    for column in u.T:
        counts = np.histogram(column, 4, (0, 1))[0]
        # Of a random sample of 400, 100 in each quarter, with a deviation of 9.
        assert np.all(np.abs(counts - 100) < 45)
    assert np.all(np.abs(np.corrcoef(u.T) - np.eye(3)) < 0.25)


def test_continuous_as_verifai():
    # Conformance case grid-01: both ends, the first dimension fastest.
    u = whole(Grid(3), Cube((0, 0)), batch=9)
    values = u * [1, 2] - [0, 1]
    expected = [[x, y] for y in (-1, 0, 1) for x in (0, 0.5, 1)]
    np.testing.assert_array_equal(values, expected)


def test_mixed_as_verifai():
    # Conformance case grid-02: a=Box((0, 1)) outside, b=Categorical("x", "y") inside.
    cube = Cube((0, 2))
    u = whole(Grid(2), cube, batch=4)
    np.testing.assert_array_equal(u[:, 0], [0, 0, 1, 1])
    np.testing.assert_array_equal(cube.cells(u)[:, 0], [0, 1, 0, 1])


@pytest.mark.slow
def test_every_combination_once_in_order():
    cube = Cube(
        (3, 0, 2, 0, 1),
        weights=((0.5, 0.25, 0.25), None, None, None, None),
    )
    search = Grid((4, 1))
    assert search.total(cube) == 3 * 2 * 1 * 4 * 1
    expected = [
        [a, x, b, 0.5, 0.5]
        for x, b, a in itertools.product(np.linspace(0, 1, 4), (0.25, 0.75), (0.25, 0.625, 0.875))
    ]
    np.testing.assert_allclose(whole(search, cube), expected, atol=1e-7)
    # Beyond the end the last point is repeated.
    u = asked(search, cube)
    np.testing.assert_array_equal(u[24:], np.repeat(u[23:24], len(u) - 24, axis=0))
    assert not np.array_equal(u, asked(search, cube, seed=1))


@pytest.mark.thorough
def test_large_indices_are_exact():
    cube, search = Cube((0, 0, 0, 97)), Grid((21, 1009, 1000))
    total = search.total(cube)
    assert 2**30 < total < 2**31
    state = search.init(jax.random.key(0), cube, 8)
    first = total - 5
    numbers = jnp.arange(first, total, dtype=jnp.uint32)
    for row, number in zip(np.asarray(search.points_at(numbers, cube)), numbers, strict=True):
        number = int(number)
        rest, cell = divmod(number, 97)
        rest, x = divmod(rest, 21)
        z, y = divmod(rest, 1009)
        np.testing.assert_allclose(row, [x / 20, y / 1008, z / 999, (cell + 0.5) / 97], atol=1e-7)
    found = np.asarray(permuted(numbers, total, state.keys))
    assert len(np.unique(found)) == 5
    assert np.all(found < total)
    # At the end the number stays there.
    u, after = search.ask(state._replace(index=jnp.uint32(first)), cube, 8)
    assert len(np.unique(np.asarray(u), axis=0)) == 5
    assert after.index == total
    assert search.ask(after, cube, 8)[1].index == total


@pytest.mark.thorough
def test_a_grid_counts_its_points():
    assert Grid().total(Cube((0, 0, 4))) == 21 * 21 * 4
    assert Grid().total(Cube(())) == 1
    assert whole(Grid(), Cube(()), batch=1).shape == (1, 0)
    assert Grid(1).total(Cube((0,) * 200)) == 1
    np.testing.assert_array_equal(whole(Grid(1), Cube((0,) * 200), batch=1), np.full((1, 200), 0.5))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "cube",
    [
        Cube(()),
        Cube((0, 4, 0, 1, 1000)),
        Cube((3, 0, 2), weights=((0.7, 0.2, 0.1), None, None), ordered=(False, True, True)),
    ],
    ids=lambda cube: str(cube.levels),
)
def test_the_contract_of_searches_holds(cube):
    check_search(Grid(), cube)


@pytest.mark.slow
def test_contract_of_many_dimensions():
    check_search(Grid(1), Cube((0,) * 200))
    check_batch_independence(Grid(), Cube((0, 0, 5)))


@pytest.mark.parametrize(
    ("search", "cube", "message"),
    [
        (Grid(), Cube((0,) * 8), r"points=21 on the 8 .* 37822859361 points; at most 2147483647"),
        (Grid(), Cube((0,) * 200), "has about 10.264 points; at most 2147483647 are allowed. Take"),
        (Grid((3, 3)), Cube((0, 5)), r"points must have 1 entries.*got \(3, 3\)"),
    ],
)
def test_spaces_that_do_not_fit(search, cube, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        search.check(cube)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("points", "message"),
    [
        (0, "points must be an integer of at least 1; got 0"),
        (2.5, "points must be an integer of at least 1; got 2.5"),
        ((3, -1), r"points\[1\] must be an integer of at least 1; got -1"),
    ],
)
def test_values_out_of_range(points, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        Grid(points)
