from functools import cache

import numpy as np
import pytest
from checked_types import unchecked
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, binomtest

from verifai_jax.statistics.binomial import clopper_pearson, simulations_without_failure
from verifai_jax.statistics.confidence_sequences import anytime_interval
from verifai_jax.statistics.stopping import Decided, Within


@given(st.integers(1, 5000), st.data(), st.sampled_from([0.9, 0.95, 0.99]))
def test_is_the_interval_of_its_definition(n, data, confidence):
    k = data.draw(st.integers(0, n))
    rate, tail = clopper_pearson(k, n, confidence), (1 - confidence) / 2
    low, high = binom.sf(k - 1, n, rate.low), binom.cdf(k, n, rate.high)
    np.testing.assert_allclose([low, high], [tail if k else 1, tail if k < n else 1], rtol=1e-9)
    # SciPy finds the same bounds as roots, up to an absolute tolerance of 2e-12.
    expected = binomtest(k, n).proportion_ci(confidence, method="exact")
    np.testing.assert_allclose([rate.low, rate.high], [expected.low, expected.high], 1e-9, 1e-11)


def test_covers_the_true_rate_at_least_as_often_as_promised():
    n, p = 200, 0.03
    covered = sum(
        binom.pmf(k, n, p)
        for k in range(n + 1)
        if clopper_pearson(k, n).low <= p <= clopper_pearson(k, n).high
    )
    assert covered >= 0.95


def test_reads_well():
    assert str(clopper_pearson(38, 1000)) == "3.8 % (95 % interval 2.7 % to 5.18 %)"
    assert str(clopper_pearson(0, 1000)) == "0 % (95 % interval 0 % to 0.368 %)"
    assert str(clopper_pearson(10, 10)) == "100 % (95 % interval 69.2 % to 100 %)"


@pytest.mark.parametrize("arguments", [(0, 0), (5, 4), (-1, 4), (1, 4, 1.0)])
def test_bad_counts_are_refused(arguments):
    with pytest.raises(ValueError, match="got"):
        clopper_pearson(*arguments)


class TestStopping:
    @pytest.mark.thorough
    def test_interval_holds_at_all_times_together(self):
        # 400 runs of 1000 samples, looked at after every twentieth one: the fixed-size interval
        # would be wrong at some time in about a third of them.
        rate, random = 0.1, np.random.default_rng(5)
        failures = np.cumsum(random.random((400, 1000)) < rate, axis=1)[:, 19::20]

        def wrong(interval):
            @cache  # Of all these looks, few see counts that none has seen before.
            def misses(k, n):
                found = interval(k, n)
                return not found.low <= rate <= found.high

            return sum(any(misses(int(k), 20 * (i + 1)) for i, k in enumerate(r)) for r in failures)

        with unchecked():
            assert wrong(anytime_interval) <= 0.05 * 400
            assert wrong(clopper_pearson) > 0.15 * 400

    @pytest.mark.parametrize(("failures", "simulations"), [(0, 1), (0, 500), (7, 7), (31, 1000)])
    def test_interval_by_integration(self, failures, simulations):
        from scipy import integrate, stats

        found = anytime_interval(failures, simulations)
        assert found.low <= failures / simulations <= found.high
        assert found.low <= clopper_pearson(failures, simulations).low
        assert found.high >= clopper_pearson(failures, simulations).high

        def ratio(rate):
            # q = sin(x)^2 has the prior Beta(1/2, 1/2) for a uniform angle x.
            mean = integrate.quad(
                lambda x: stats.binom.pmf(failures, simulations, np.sin(x) ** 2) * 2 / np.pi,
                0,
                np.pi / 2,
                limit=200,
            )[0]
            return mean / stats.binom.pmf(failures, simulations, rate)

        for border in {found.low, found.high} - {0.0, 1.0}:
            assert ratio(border) == pytest.approx(20, rel=1e-3)

    @pytest.mark.parametrize(("rate", "confidence"), [(0.001, 0.95), (0.01, 0.99), (0.5, 0.9)])
    def test_without_failure(self, rate, confidence):
        n = simulations_without_failure(rate, confidence)
        assert (1 - rate) ** n <= 1 - confidence < (1 - rate) ** (n - 1)

    def test_stopping_rules_end_when_the_interval_is_narrow_or_decided(self):
        assert not Within(0.01).done(0, 0)
        assert not Within(0.01).done(30, 1000)
        assert Within(0.01).done(300, 10_000)
        assert not Decided(0.02).done(30, 1000)
        assert Decided(0.02).done(600, 20_000)
        assert Decided(0.02).done(0, 1000)

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: Within(0), "half_width must lie between 0 and 0.5; got 0"),
            (lambda: Within(0.1, confidence=1), "confidence must lie between 0 and 1; got 1"),
            (lambda: Decided(1.0), "rate must lie between 0 and 1; got 1.0"),
            (lambda: simulations_without_failure(0), "rate must lie between 0 and 1; got 0"),
            (lambda: anytime_interval(2, 1), "0 <= failures <= simulations"),
        ],
    )
    def test_bad_input(self, make, message):
        with pytest.raises(ValueError, match=message):
            make()
