"""The shortest vector of linear inequalities, by the conditions that only it fulfils."""

import numpy as np
import pytest

from verifai_jax.statistics.smallest_change import _nonnegative, shortest


@pytest.mark.parametrize("seed", range(40))
def test_least_squares_fulfil_the_conditions_of_kuhn_and_tucker(seed):
    rng = np.random.default_rng(seed)
    rows, columns = int(rng.integers(1, 9)), int(rng.integers(1, 60))
    matrix, right = rng.standard_normal((rows, columns)), rng.standard_normal(rows)
    if seed % 3 == 0:
        matrix[:, columns // 2 :] = matrix[:, : columns - columns // 2]  # Columns that are equal.
    if seed % 4 == 0:
        matrix = np.round(matrix)  # Columns that depend on each other, and zeros.
    x = _nonnegative(matrix, right)
    assert x is not None
    assert (x >= 0).all()
    slope = matrix.T @ (right - matrix @ x)
    assert (slope <= 1e-9).all()
    assert np.abs(slope[x > 0]).max(initial=0.0) <= 1e-9


def test_shortest_of_two_half_planes():
    corner = shortest(np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([2.0, 1.0]))
    np.testing.assert_allclose(corner, [2, 1], rtol=1e-12)
    np.testing.assert_allclose(shortest(np.array([[0.6, 0.8]]), np.array([1.0])), [0.6, 0.8])
    assert shortest(np.array([[1.0], [-1.0]]), np.array([1.0, 1.0])) is None
