"""The shortest vector of linear inequalities, by the conditions that only it fulfils."""

import numpy as np
import pytest
from scipy.optimize import nnls

from verifai_jax.statistics.shortest_vector import shortest


@pytest.mark.parametrize("seed", range(40))
def test_shortest_is_a_sum_of_the_inequalities_that_bind(seed):
    rng = np.random.default_rng(seed)
    rows, size = int(rng.integers(1, 40)), int(rng.integers(1, 8))
    matrix = rng.standard_normal((rows, size))
    if seed % 3 == 0:
        matrix[rows // 2 :] = matrix[: rows - rows // 2]  # Some are equal.
    if seed % 4 == 0:
        matrix = np.round(matrix) + np.eye(rows, size)  # Some depend on each other.
    matrix /= np.maximum(np.linalg.norm(matrix, axis=1, keepdims=True), 1e-9)
    bound = matrix @ rng.standard_normal(size) - rng.exponential(0.1, rows)
    z = shortest(matrix, bound)
    assert z is not None
    slack = matrix @ z - bound
    assert (slack >= -1e-9).all()
    # Kuhn and Tucker: the inequalities that bind push against it, each in its own direction.
    binding = matrix[slack < 1e-7]
    if not len(binding):
        np.testing.assert_allclose(z, 0, atol=1e-9)
        return
    assert nnls(binding.T, z)[1] < 1e-7


def test_shortest_of_two_half_planes():
    corner = shortest(np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([2.0, 1.0]))
    np.testing.assert_allclose(corner, [2, 1], rtol=1e-12)
    np.testing.assert_allclose(shortest(np.array([[0.6, 0.8]]), np.array([1.0])), [0.6, 0.8])
    assert shortest(np.array([[1.0], [-1.0]]), np.array([1.0, 1.0])) is None
