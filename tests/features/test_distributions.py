"""Distributions against scipy.stats: quantiles, tails, samples, ends, slopes; what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from checked_types import unchecked
from hypothesis import given, settings
from hypothesis import strategies as st

from verifai_jax.features import Categorical, Distribution, LogUniform, Normal, TruncatedNormal
from verifai_jax.testing import check_domain

EXPONENTIAL = Distribution(lambda u: -jnp.log1p(-u), lambda x: -jnp.expm1(-x), name="exponential")
TRIANGLE = Distribution(lambda u: 3 * jnp.sqrt(u), lambda x: (x / 3) ** 2, name="triangle")
norm, truncnorm, loguniform = scipy.stats.norm, scipy.stats.truncnorm, scipy.stats.loguniform

REFERENCES = {
    Normal(1, 2): norm(1, 2),
    Normal(-1e6, 1e4): norm(-1e6, 1e4),
    TruncatedNormal(0, 1, -1, 3): truncnorm(-1, 3),
    TruncatedNormal(5, 0.5, 3, 9): truncnorm(-4, 8, loc=5, scale=0.5),
    TruncatedNormal(0, 1, 8, 9): truncnorm(8, 9),
    TruncatedNormal(0, 1, -9, -8): truncnorm(-9, -8),
    TruncatedNormal(0, 1, 10.5, 30): truncnorm(10.5, 30),
    TruncatedNormal(0, 1, 0, 0.2): truncnorm(0, 0.2),
    LogUniform(1e-3, 1e2): loguniform(1e-3, 1e2),
    LogUniform(1e-30, 1e30): loguniform(1e-30, 1e30),
    EXPONENTIAL: scipy.stats.expon(),
    TRIANGLE: scipy.stats.triang(1, 0, 3),
}
# Exact in float32, so that both sides speak of the same probability.
TAILS = np.float32([2**-24, 1e-6, 1e-4])
POINTS = np.concatenate([TAILS, np.linspace(0, 1, 257)[1:-1], 1 - TAILS]).astype(np.float32)


@pytest.mark.parametrize("domain", REFERENCES, ids=repr)
class TestEveryDistribution:
    @pytest.mark.thorough
    def test_the_laws_of_domains_hold(self, domain):
        check_domain(domain)

    @pytest.mark.thorough
    def test_quantiles(self, domain):
        values = jax.jit(jax.vmap(domain.from_unit))(POINTS[:, None])
        wanted = REFERENCES[domain].ppf(POINTS.astype(np.float64))
        spread = np.ptp(REFERENCES[domain].ppf([0.25, 0.75]))
        np.testing.assert_allclose(values, wanted, rtol=5e-6, atol=2e-6 * spread)

    @pytest.mark.thorough
    def test_probabilities(self, domain):
        values = REFERENCES[domain].ppf(POINTS.astype(np.float64)).astype(np.float32)
        u = jax.jit(jax.vmap(domain.to_unit))(values)[:, 0]
        wanted = REFERENCES[domain].cdf(values.astype(np.float64))
        np.testing.assert_allclose(u, wanted, atol=4e-5)

    @pytest.mark.thorough
    def test_samples(self, domain):
        u = jax.random.uniform(jax.random.key(3), (4000, 1))
        values = np.asarray(jax.vmap(domain.from_unit)(u), np.float64)
        assert scipy.stats.kstest(values, REFERENCES[domain].cdf).pvalue > 1e-3

    @pytest.mark.slow
    def test_ends_and_their_slopes_are_finite(self, domain):
        ends = jnp.array([0.0, 1.0], jnp.float32)
        slope = jax.grad(lambda u: domain.from_unit(u[None]))
        values, slopes = jax.vmap(lambda u: (domain.from_unit(u[None]), slope(u)))(ends)
        assert np.all(np.isfinite(values))
        assert np.all(np.isfinite(slopes))
        assert np.all(slopes > 0)
        inside = jax.vmap(domain.from_unit)(POINTS[:, None])
        assert values[0] <= inside.min() < inside.max() <= values[1]


def test_ends_are_exact():
    for low, high in ((-1, 3), (8, 9), (-9, -8), (-12, 12)):
        domain = TruncatedNormal(0, 1, low, high)
        assert [float(domain.from_unit(jnp.float32([u]))) for u in (0, 1)] == [low, high]
    assert float(LogUniform(0.5, 8).from_unit(jnp.ones(1))) == 8.0
    ends = [float(Normal(0, 1).from_unit(jnp.float32([u]))) for u in (0, 1)]
    assert ends == pytest.approx([-5.54, 5.54], abs=0.01)


@pytest.mark.thorough
def test_slope_is_one_over_the_density():
    domain = Normal(2, 3)
    u = jnp.linspace(0.01, 0.99, 99)
    slopes = jax.vmap(jax.grad(lambda u: domain.from_unit(u[None])))(u)
    density = norm(2, 3).pdf(norm(2, 3).ppf(np.asarray(u, np.float64)))
    np.testing.assert_allclose(slopes, 1 / density, rtol=1e-5)


@given(
    st.floats(-1e3, 1e3, width=32),
    st.floats(0.125, 1e3, width=32),
    st.floats(0, 1, width=32, allow_subnormal=False),
)
@settings(max_examples=60, deadline=None)
def test_normal_round_trips(mean, std, u):
    domain = Normal(mean, std)
    value = domain.from_unit(jnp.float32([u]))
    again = domain.from_unit(domain.to_unit(value))
    eps = np.finfo(np.float32).eps
    assert abs(float(again - value)) <= 8 * eps * (abs(mean) + 6 * std)
    domain.check(value, "f")


class TestWeights:
    DOMAIN = Categorical("a", "b", "c", weights=[0.7, 0.2, 0.1])

    def test_cells_are_as_wide_as_weights(self):
        u = jnp.float32([0, 0.69, 0.71, 0.89, 0.91, 1])
        assert jax.vmap(self.DOMAIN.from_unit)(u[:, None]).tolist() == [0, 0, 1, 1, 2, 2]
        middles = [float(self.DOMAIN.to_unit(jnp.int32(i))[0]) for i in range(3)]
        np.testing.assert_allclose(middles, [0.35, 0.8, 0.95], rtol=1e-6)
        assert (self.DOMAIN.weights, self.DOMAIN.ordered) == (((0.7, 0.2, 0.1),), (False,))

    def test_samples_have_these_frequencies(self):
        u = jax.random.uniform(jax.random.key(0), (20_000, 1))
        counts = np.bincount(jax.vmap(self.DOMAIN.from_unit)(u))
        assert scipy.stats.chisquare(counts, [14_000, 4000, 2000]).pvalue > 1e-3

    @pytest.mark.parametrize(
        ("weights", "message"),
        [
            ([0.9, 0.2], r"must sum to one; \[0.9, 0.2\] sum to 1.1"),
            ([1.2, -0.2], r"must be positive \(leave out .*; got \[1.2, -0.2\]"),
            ([1, 0], "must be positive"),
            ([float("nan"), 1], "must be positive"),
            ([1.0], "with 2 choices needs as many weights; got 1"),
            ([1 - 1e-8, 1e-8], "at least 1e-06.*got .*1e-08"),
            (["x", 1], "a weight of a Categorical must be a number; got 'x'"),
        ],
    )
    def test_what_is_wrong_is_refused_where_it_is_made(self, weights, message):
        with unchecked(), pytest.raises(ValueError, match=message):
            Categorical("a", "b", weights=weights)


def _fails(x):
    raise RuntimeError("no such table")


class TestRefused:
    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: Normal(0, -1), r"must be positive; got Normal\(0, -1\)"),
            (lambda: Normal(3, 0), r"single value is Constant\(3\)"),
            (lambda: Normal(float("nan"), 1), "mean of a Normal must be finite; got nan"),
            (lambda: Normal(0, float("inf")), "std of a Normal must be finite; got inf"),
            (lambda: Normal("a", 1), "mean of a Normal must be a number; got 'a'"),
            (lambda: Normal(0, 1e38), "must fit into float32"),
            (
                lambda: TruncatedNormal(0, 1, 3, -1),
                r"low must be below high; got TruncatedNormal\(0, 1, 3, -1\)",
            ),
            (lambda: TruncatedNormal(0, 1, 2, 2), r"zero width.*Constant\(2\)"),
            (lambda: TruncatedNormal(0, 1, -1, float("inf")), "high of a Trunc.* must be finite"),
            (lambda: TruncatedNormal(0, 1, 12, 13), "only 2e-33 of the normal distribution"),
            (lambda: TruncatedNormal(0, 1, 0, 0.001), r"uniform: use Box\(0, 0.001\)"),
            (lambda: LogUniform(0, 1), r"low of a LogUniform must be positive; got LogUniform\(0"),
            (lambda: LogUniform(-1, 1), "must be positive"),
            (lambda: LogUniform(2, 1), r"low must be below high; got LogUniform\(2, 1\)"),
            (lambda: LogUniform(2, 2), "zero width"),
            (lambda: LogUniform(1e-42, 1), "at least 1.17549e-38"),
            (lambda: LogUniform(1, float("inf")), "high of a LogUniform must be finite"),
            (lambda: Distribution(3, jnp.exp), "inverse_cdf of a Distribution must be a function"),
            (lambda: Distribution(jnp.exp, jnp.log, name=""), "name of a Distribution must be"),
            (
                lambda: Distribution(lambda u: -u, lambda x: -x, name="d"),
                r"inverse_cdf of Distribution\(name='d'\) must increase; it gives -0.00781 at",
            ),
            (
                lambda: Distribution(lambda u: 2 * u, lambda x: x),
                "must be the inverse of inverse_cdf",
            ),
            (lambda: Distribution(_fails, _fails), "raised RuntimeError on a number: no such tab"),
            (
                lambda: Distribution(lambda u: jnp.stack([u, u]), lambda x: x),
                r"must give one real number for one; got float32 of shape \[2\]",
            ),
            (lambda: Distribution(lambda u: jnp.log(u - 0.5), jnp.exp), "gives nan at u = 0.00781"),
        ],
    )
    def test_where_it_is_made(self, make, message):
        with unchecked(), pytest.raises((ValueError, TypeError), match=message):
            make()

    @pytest.mark.thorough
    @pytest.mark.parametrize(
        ("domain", "value", "message"),
        [
            (Normal(0, 1), 1e39, r"f must fit into float32; got 1e\+39"),
            (Normal(0, 1), float("nan"), "f must be finite; got nan"),
            (Normal(0, 1), [1, 2], r"f must be one number; got shape \[2\]"),
            (Normal(0, 1), "x", "f must be a number; got 'x'"),
            (TruncatedNormal(0, 1, -1, 1), 2, r"f must lie in \[-1, 1\]; got 2"),
            (LogUniform(1, 10), 0.5, r"f must lie in \[1, 10\]; got 0.5"),
            (EXPONENTIAL, -1, "f must be finite and at least 0; got -1"),
        ],
    )
    def test_values_outside(self, domain, value, message):
        with pytest.raises(ValueError, match=message):
            domain.check(value, "f")

    @pytest.mark.thorough
    def test_a_tail_that_no_coordinate_reaches(self):
        # It is simulated where it is given, and refused where only a coordinate will do.
        Normal(0, 1).check(7, "f")
        message = "f is so far in the tail of Normal.*nearest value is 5.54.*; got 7"
        with pytest.raises(ValueError, match=message):
            Normal(0, 1).check_reachable(7, "f")


@pytest.mark.parametrize(
    "domain",
    [
        Normal(-3.0, 0.01),
        TruncatedNormal(0.0, 1.0, 3.5, 4.5),
        TruncatedNormal(100.0, 30.0, -500.0, 500.0),
        LogUniform(1e-30, 1e30),
    ],
)
def test_coordinates_reach_central_values_which_are_not_tried(domain):
    low, high = domain.support
    if not isinstance(domain, LogUniform):
        low = max(low, domain.mean - 3.99 * domain.std)
        high = min(high, domain.mean + 3.99 * domain.std)
    lower, upper = (float(domain.quantile(jnp.float32(u))) for u in (0.25, 0.75))
    spread = 0.1 * (upper - lower)
    for share in (0.0, 0.1, 0.5, 0.9, 1.0):
        value = low + share * (high - low)
        if isinstance(domain, LogUniform):
            value = low * (high / low) ** share
        assert domain._is_central(value)
        reached = float(domain.from_unit(domain.to_unit(jnp.float32(value))))
        assert abs(reached - value) <= spread + 1e-5 * abs(value)
