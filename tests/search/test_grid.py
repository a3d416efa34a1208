"""The grid against the product of its axes."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.core.cube import Cube
from verifai_jax.search.grid import Grid
from verifai_jax.testing import check_batch_independence, check_search


def whole(search, cube, batch=7):
    """All points of the grid, asked in batches that do not divide it."""
    search.check(cube)
    state, parts = search.init(jax.random.key(0), cube, batch), []
    for _ in range(-(-search.total(cube) // batch)):
        u, state = search.ask(state, cube, batch)
        parts.append(np.asarray(u))
    return np.concatenate(parts)


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


@pytest.mark.thorough
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
    u = whole(search, cube)
    np.testing.assert_allclose(u[:24], expected, atol=1e-7)
    # Beyond the end the last point is repeated.
    np.testing.assert_array_equal(u[24:], np.repeat(u[23:24], len(u) - 24, axis=0))


def test_large_indices_are_exact():
    cube, search = Cube((0, 0, 0, 97)), Grid((21, 1009, 1000))
    total = search.total(cube)
    assert 2**30 < total < 2**31
    state = search.init(jax.random.key(0), cube, 8)
    first = total - 5
    u, after = search.ask(state._replace(index=jnp.uint32(first)), cube, 8)
    for row, number in zip(np.asarray(u), [*range(first, total), *[total - 1] * 3], strict=True):
        rest, cell = divmod(number, 97)
        rest, x = divmod(rest, 21)
        z, y = divmod(rest, 1009)
        np.testing.assert_allclose(row, [x / 20, y / 1008, z / 999, (cell + 0.5) / 97], atol=1e-7)
    # At the end the number stays there.
    assert after.index == total
    assert search.ask(after, cube, 8)[1].index == total


def test_totals():
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
def test_contract(cube):
    check_search(Grid(), cube)


@pytest.mark.thorough
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
