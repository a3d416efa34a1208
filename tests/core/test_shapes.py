import numpy as np
import pytest

from verifai_jax.core.compute.compilation import pad_rows, power_of_two


@pytest.mark.parametrize(
    ("count", "power"), [(0, 1), (1, 1), (2, 2), (3, 4), (64, 64), (65, 128), (1000, 1024)]
)
def test_the_least_power_of_two_that_is_enough(count, power):
    assert power_of_two(count) == power


def test_rows_are_followed_by_copies_of_the_last():
    rows = np.arange(6, dtype=np.int32).reshape(3, 2)
    assert pad_rows(rows).tolist() == [[0, 1], [2, 3], [4, 5], [4, 5]]
    assert pad_rows(rows, 5).tolist() == [[0, 1], [2, 3], [4, 5], [4, 5], [4, 5]]
    assert pad_rows(rows).dtype == np.int32
    assert pad_rows(rows, 3).tolist() == rows.tolist()
    assert pad_rows(rows[:0]).shape == (0, 2)
