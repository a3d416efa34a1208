"""Paired differences against scipy's t test, and what too few pairs say."""

import math

import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.addons.training.paired import paired_difference


def test_interval_is_that_of_the_paired_t_test():
    from scipy.stats import ttest_rel

    rng = np.random.default_rng(0)
    one, other = rng.normal(0.1, 0.02, 6), rng.normal(0.13, 0.02, 6)
    found = paired_difference(one, other, 0.9)
    known = ttest_rel(one, other).confidence_interval(0.9)
    assert found.low == pytest.approx(known.low, rel=1e-9)
    assert found.high == pytest.approx(known.high, rel=1e-9)
    assert found.pairs == 6
    assert found.negative == (known.high < 0)


def test_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(1)
    draws = rng.normal(0.3, 1.0, (2000, 5))
    inside = [
        found.low <= 0.3 <= found.high
        for found in (paired_difference(row, np.zeros(5), 0.8) for row in draws)
    ]
    assert np.mean(inside) == pytest.approx(0.8, abs=4 * math.sqrt(0.16 / 2000))


def test_one_pair_gives_no_interval():
    found = paired_difference([1.0, math.nan, 3.0], [2.0, 1.0, math.nan])
    assert (found.mean, found.pairs) == (-1.0, 1)
    assert math.isnan(found.low)
    assert math.isnan(found.high)
    assert not found.negative
    assert not found.positive
    assert str(found) == "-1 (one pair gives no interval)"


def test_no_pair_is_unknown():
    found = paired_difference([math.nan], [1.0])
    assert found.pairs == 0
    assert str(found) == "unknown (no pair)"


def test_equal_differences_have_an_interval_of_no_width():
    found = paired_difference([1.5, 2.5, 3.5], [1.0, 2.0, 3.0])
    assert (found.low, found.mean, found.high) == (0.5, 0.5, 0.5)
    assert found.positive
    assert str(found) == "0.5 (95 % t interval of 3 paired differences 0.5 to 0.5)"


def test_lists_of_different_lengths_are_refused():
    with unchecked(), pytest.raises(ValueError, match=r"same length; got shapes \[2\] and \[1\]"):
        paired_difference([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="confidence must lie between 0 and 1; got 95"):
        paired_difference([1.0], [1.0], 95)
