import pytest

from verifai_jax.systems.clock import count_periods


def test_whole_numbers_of_periods_are_counted():
    assert count_periods(4.0, 0.02, "duration") == 200
    assert count_periods(0.3, 0.1, "duration") == 3


@pytest.mark.parametrize("seconds", [0.0, -1.0, 0.05, 0.25, float("nan"), float("inf")])
def test_anything_else_is_refused_by_name(seconds):
    with pytest.raises(
        ValueError, match=r"control_period must be a positive multiple of step; got"
    ):
        count_periods(seconds, 0.1, "control_period", "step")
