"""The usual families against scipy.stats: quantiles, probabilities, densities, tails, slopes."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats as stats
from checked_types import unchecked
from jax.scipy.special import ndtr, ndtri

from verifai_jax.features import (
    Beta,
    Distribution,
    Empirical,
    Exponential,
    FeatureSpace,
    Gamma,
    LogNormal,
    LogUniform,
    Normal,
    Signal,
    Triangular,
    TruncatedNormal,
    Weibull,
)
from verifai_jax.features.density import log_density, tails
from verifai_jax.testing import check_domain

FAMILIES = {
    LogNormal(1, 0.5): stats.lognorm(0.5, scale=np.e),
    LogNormal(-20, 3): stats.lognorm(3, scale=np.exp(-20)),
    Exponential(2.5): stats.expon(scale=2.5),
    Weibull(2, 3): stats.weibull_min(2, scale=3),
    Weibull(0.5, 3): stats.weibull_min(0.5, scale=3),
    Gamma(2, 3): stats.gamma(2, scale=3),
    Gamma(0.7, 10): stats.gamma(0.7, scale=10),
    Gamma(1000, 0.001): stats.gamma(1000, scale=0.001),
    Beta(2, 5): stats.beta(2, 5),
    Beta(0.5, 0.5, -1, 3): stats.beta(0.5, 0.5, -1, 4),
    Beta(300, 2): stats.beta(300, 2),
    Triangular(-1, 0, 3): stats.triang(0.25, -1, 4),
    Triangular(0, 0, 2): stats.triang(0, 0, 2),
    Triangular(0, 2, 2): stats.triang(1, 0, 2),
}
OLDER = {
    Normal(1, 2): stats.norm(1, 2),
    TruncatedNormal(0, 1, -1, 3): stats.truncnorm(-1, 3),
    TruncatedNormal(0, 1, 8, 9): stats.truncnorm(8, 9),
    LogUniform(1e-3, 1e2): stats.loguniform(1e-3, 1e2),
}
TAILS = np.float32([2**-24, 1e-6, 1e-4])
POINTS = np.concatenate([TAILS, np.linspace(0, 1, 257)[1:-1], 1 - TAILS]).astype(np.float32)


@pytest.mark.parametrize("domain", FAMILIES, ids=repr)
class TestEveryFamily:
    @pytest.mark.thorough
    def test_the_laws_of_domains_hold(self, domain):
        check_domain(domain)

    @pytest.mark.thorough
    def test_quantiles_probabilities_and_slopes(self, domain):
        law = FAMILIES[domain]
        slope = jax.grad(lambda u: domain.from_unit(u[None]))
        both = jax.jit(jax.vmap(lambda u: (domain.from_unit(u[None]), slope(u))))
        u = np.concatenate([POINTS, [0, 1]]).astype(np.float32)
        values, slopes = (np.asarray(part, np.float64) for part in both(u))
        wanted = law.ppf(POINTS.astype(np.float64))
        spread = np.ptp(law.ppf([0.25, 0.75]))
        np.testing.assert_allclose(values[:-2], wanted, rtol=5e-6, atol=2e-6 * spread)
        back = jax.jit(jax.vmap(domain.to_unit))(wanted.astype(np.float32))[:, 0]
        np.testing.assert_allclose(back, law.cdf(wanted.astype(np.float32)), atol=4e-5)
        # One over the density, and finite and positive at 0 and 1 too.
        middle = slice(len(TAILS), len(POINTS) - len(TAILS))
        np.testing.assert_allclose(slopes[middle], 1 / law.pdf(wanted[middle]), rtol=2e-3)
        assert np.all(np.isfinite(slopes))
        assert np.all(slopes > 0)
        # The coordinates 0 and 1 are values that the distribution has.
        assert np.all(domain.contains(values))
        assert values[-2] <= values[:-2].min() < values[:-2].max() <= values[-1]

    def test_as_json(self, domain):
        space = FeatureSpace({"x": domain, "s": Signal(domain, knots=2)})
        assert FeatureSpace.from_json(json.loads(json.dumps(space.to_json()))) == space


@pytest.mark.parametrize("domain", FAMILIES | OLDER, ids=repr)
def test_densities_and_tails(domain):
    law = (FAMILIES | OLDER)[domain]
    values = law.ppf(np.linspace(0.001, 0.999, 101))
    np.testing.assert_allclose(domain.log_density(values), law.logpdf(values), rtol=1e-6, atol=1e-9)
    wanted = 2 * np.minimum(law.cdf(values), law.sf(values))
    np.testing.assert_allclose(domain.tail(values), wanted, rtol=1e-6)
    low, high = domain.support
    outside = np.array([low - 1, high + 1])
    if np.isfinite(low):
        assert domain.log_density(outside)[0] == -np.inf
    if np.isfinite(high):
        assert domain.log_density(outside)[1] == -np.inf


@pytest.mark.slow
def test_an_unbounded_distribution_of_a_person_is_not_simulated_at_its_limits():
    own = Distribution(lambda u: jnp.exp(ndtri(u)), lambda x: ndtr(jnp.log(x)), name="own")
    logistic = Distribution(
        lambda u: jax.nn.sigmoid(ndtri(u)), lambda x: ndtr(jnp.log(x) - jnp.log1p(-x)), name="l"
    )
    wait = Distribution(lambda u: -jnp.log1p(-u), lambda x: -jnp.expm1(-x), name="wait")
    ends = jnp.float32([[0.0], [1.0]])
    for domain, low, high in ((own, 0, np.inf), (logistic, 0, 1), (wait, 0, np.inf)):
        first, last = np.asarray(jax.vmap(domain.from_unit)(ends), np.float64)
        assert low < first < last < high
        # The outermost probabilities that float32 tells from 0 and 1: 5.5 and 5.3 deviations.
        if domain is not wait:
            assert [float(domain.to_unit(x)[0]) for x in (first, last)] == pytest.approx(
                [2**-26, 1 - 2**-24], abs=1e-7
            )
    x = np.array([0.2, 1.0, 5.0])
    np.testing.assert_allclose(own.log_density(x), stats.lognorm(1).logpdf(x), rtol=1e-6)
    np.testing.assert_allclose(own.tail(x), 2 * stats.norm.sf(np.abs(np.log(x))), rtol=1e-6)
    assert "jnp.exp(ndtri(u))" in own.source


class TestEmpirical:
    DATA = np.random.default_rng(3).gamma(2.0, 1.0, 400)

    @pytest.mark.slow
    def test_is_the_data(self):
        domain = Empirical(self.DATA)
        check_domain(domain)
        values = np.asarray(jax.vmap(domain.from_unit)(POINTS[:, None]), np.float64)
        np.testing.assert_allclose(values, np.quantile(self.DATA, POINTS.astype(float)), rtol=1e-4)
        ends = np.asarray(jax.vmap(domain.from_unit)(jnp.float32([[0.0], [1.0]])))
        assert ends.tolist() == np.float32([self.DATA.min(), self.DATA.max()]).tolist()
        u = jax.random.uniform(jax.random.key(3), (4000, 1))
        drawn = np.asarray(jax.vmap(domain.from_unit)(u))
        assert stats.ks_2samp(drawn, self.DATA).pvalue > 1e-3
        # The density integrates to one.
        middles = np.linspace(*domain.support, 200_001)
        mass = np.exp(domain.log_density(middles)).mean() * np.ptp(domain.support)
        assert mass == pytest.approx(1, abs=2e-3)

    def test_numbers_that_come_several_times(self):
        domain = Empirical([1, 2, 2, 2, 5])
        assert (domain.values, domain.ranks) == ((1, 2, 5), (0.0, 0.5, 1.0))
        assert repr(domain) == "Empirical(5 numbers from 1 to 5)"
        space = FeatureSpace({"x": domain})
        assert FeatureSpace.from_json(json.loads(json.dumps(space.to_json()))) == space


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LogNormal(0, 0), r"std of a LogNormal must be positive; got LogNormal\(0, 0\)"),
        (lambda: LogNormal(0, 20), "must fit into float32"),
        (lambda: LogNormal(float("nan"), 1), "mean of a LogNormal must be finite"),
        (lambda: Exponential(-1), "mean of a Exponential must be positive"),
        (lambda: Exponential("a"), "mean of a Exponential must be a number; got 'a'"),
        (lambda: Weibull(0.01, 1), "must fit into float32"),
        (lambda: Weibull(2, 0), "scale of a Weibull must be positive"),
        (lambda: Gamma(0.01, 1), "shape of a Gamma must be at least 0.05"),
        (lambda: Gamma(2, 1e38), "must fit into float32"),
        (lambda: Beta(2, 0), "b of a Beta must be at least 0.05"),
        (lambda: Beta(2, 2, 1, 0), "low must be below high"),
        (lambda: Triangular(0, 3, 2), "the mode must lie between low and high"),
        (lambda: Empirical([1.0]), "needs 2 to 65536 different numbers.*; got 1"),
        (lambda: Empirical([1.0, float("nan")]), "must be finite numbers"),
        (lambda: Empirical.from_ranks([1, 2], [0, 0.5], 2), "ranks from 0 to 1"),
    ],
)
def test_refused_where_it_is_made(make, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("domain", "value", "message"),
    [
        (LogNormal(0, 1), 0.0, "x must be finite and above 0; got 0; the nearest value is 1.17"),
        (Gamma(2, 1), -1.0, "x must be finite and above 0; got -1"),
        (Beta(2, 2, 1, 3), 3.0, r"x must lie in \(1, 3\); got 3; the nearest value is 2.99"),
        (Empirical([1, 4]), 5.0, r"x must lie in \[1, 4\]; got 5; the nearest value is 4"),
        (Normal(0, 1), 1e39, r"x must fit into float32; got 1e\+39"),
    ],
)
def test_values_outside(domain, value, message):
    with pytest.raises(ValueError, match=message):
        domain.check(value, "x")


def test_improbability_of_rows():
    import verifai_jax as vj

    space = FeatureSpace(
        {
            "wind": Normal(0, 2),
            "kind": vj.Categorical("a", "b", weights=[0.2, 0.8]),
            "gusts": vj.Array(Exponential(3), length=(1, 2)),
            "steps": vj.DiscreteBox(1, 4),
            "box": vj.Box([0, 0], [2, 5]),
            "road": Signal(Normal(0, 1), knots=2),
        }
    )
    rows = {
        "wind": [0.0, 12.0],
        "kind": ["a", "b"],
        "gusts.length": [1, 2],
        "gusts[0]": [3.0, 1.0],
        "gusts[1]": [np.nan, 6.0],
        "steps": [1, 4],
        "box[0]": [1.0, 1.0],
        "box[1]": [1.0, 1.0],
        "road[0]": [0.0, 1.0],
        "road[1]": [0.0, -1.0],
    }
    wait, bell = stats.expon(scale=3), stats.norm()
    common = np.log(1 / 2) + np.log(1 / 4) + np.log(1 / 10)
    wanted = [
        stats.norm(0, 2).logpdf(0) + np.log(0.2) + wait.logpdf(3) + 2 * bell.logpdf(0) + common,
        stats.norm(0, 2).logpdf(12) + np.log(0.8) + wait.logpdf(1) + wait.logpdf(6)
        + 2 * bell.logpdf(1) + common,
    ]  # fmt: skip
    np.testing.assert_allclose(log_density(space, rows), wanted, rtol=1e-12)
    found = tails(space, rows)
    assert list(found) == ["wind", "gusts[0]", "gusts[1]", "road[0]", "road[1]"]
    np.testing.assert_allclose(found["wind"], [1.0, 2 * bell.sf(6)], rtol=1e-9)
    np.testing.assert_allclose(found["gusts[1]"], [np.nan, 2 * wait.sf(6)], rtol=1e-9)
    with pytest.raises(ValueError, match="row 1: wind must be finite; got nan"):
        log_density(space, rows | {"wind": [0.0, np.nan]})
