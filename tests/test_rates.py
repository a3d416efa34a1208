import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, binomtest

from verifai_jax.rates import clopper_pearson


@given(st.integers(1, 5000), st.data(), st.sampled_from([0.9, 0.95, 0.99]))
def test_agrees_with_scipy(n, data, confidence):
    k = data.draw(st.integers(0, n))
    expected = binomtest(k, n).proportion_ci(confidence, method="exact")
    rate = clopper_pearson(k, n, confidence)
    np.testing.assert_allclose([rate.low, rate.high], [expected.low, expected.high], rtol=1e-9)


def test_covers_the_true_rate_at_least_as_often_as_promised():
    n, p = 200, 0.03
    covered = sum(
        binom.pmf(k, n, p)
        for k in range(n + 1)
        if clopper_pearson(k, n).low <= p <= clopper_pearson(k, n).high
    )
    assert covered >= 0.95


def test_reads_well():
    assert str(clopper_pearson(38, 1000)) == "3.80 % (95 % interval 2.70 % to 5.18 %)"
    assert str(clopper_pearson(0, 1000)) == "0.00 % (95 % interval 0.00 % to 0.37 %)"
    assert str(clopper_pearson(10, 10)) == "100 % (95 % interval 69.15 % to 100 %)"


@pytest.mark.parametrize("arguments", [(0, 0), (5, 4), (-1, 4), (1, 4, 1.0)])
def test_bad_counts_are_refused(arguments):
    with pytest.raises(ValueError, match="got"):
        clopper_pearson(*arguments)
