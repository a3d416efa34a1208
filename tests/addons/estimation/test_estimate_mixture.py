"""Proposals are densities: what they say they are is how they sample."""

import numpy as np
import pytest

from verifai_jax.addons.estimation import fitting, mixture
from verifai_jax.addons.estimation.components import Prior
from verifai_jax.addons.estimation.splitting import run_splitting


@pytest.fixture(scope="module")
def failures():
    random = np.random.default_rng(0)
    z = random.standard_normal((400_000, 3))
    z = z[(z[:, 0] + z[:, 1] > 3.0) | (z[:, 2] < -2.6)][:800]
    return z, np.full(len(z), 1 / len(z))


def components(failures):
    z, weight = failures
    steps = fitting.fit_marginals(z, weight)
    return {
        "gaussian": fitting.fit_gaussian(z, weight),
        "smooth": steps,
        "copula": fitting.fit_copula(z, weight, steps),
        "alike": fitting.fit_common_marginal(z, weight),
        "shell": fitting.fit_shell(z, weight),
    }


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["gaussian", "smooth", "copula", "alike", "shell"])
def test_density_is_that_of_the_samples(failures, name):
    component = components(failures)[name]
    random = np.random.default_rng(1)
    # With the prior mixed in, the mean of prior over proposal density over a region is its
    # probability under the prior.
    both = mixture.Mixture((Prior(3), component), np.array([0.5, 0.5]))
    z, _ = both.sample(random, 200_000)
    for inside, truth in (
        (np.ones(len(z), bool), 1.0),
        (z[:, 0] > 1.0, 0.158655),
        (z[:, 0] + z[:, 1] > 2.0, 0.0786496),
        (np.sum(z * z, axis=1) > 6.2514, 0.1),
    ):
        x = inside / both.ratio(z)
        assert x.mean() == pytest.approx(truth, abs=5 * x.std() / np.sqrt(len(z)))


def test_fitted_mixture_covers_a_mode_that_only_one_chain_has_found():
    random = np.random.default_rng(0)
    many = random.standard_normal((400, 2)) * 0.3 + [4, 0]
    few = random.standard_normal((8, 2)) * 0.3 + [0, -4]
    chain_ids = np.append(np.arange(400), np.full(8, 400))
    made = mixture.fit_mixture(np.concatenate([many, few]), np.ones(408), chain_ids, random)
    assert made.shares.sum() == pytest.approx(1)
    assert made.shares[0] == pytest.approx(0.1)
    assert np.median(made.ratio(few)) > 1.0


def test_shares_minimise_the_second_moment():
    table = np.array([[4.0, 1.0], [1.0, 3.0]])
    weight = np.array([0.5, 0.5])
    share = mixture.optimal_shares(table, weight, 0.1)
    grid = np.linspace(0, 1, 2001)
    values = [weight @ (1 / (0.1 + 0.9 * table @ [s, 1 - s])) for s in grid]
    assert share[0] == pytest.approx(grid[int(np.argmin(values))], abs=0.01)


def test_levels_lead_down_and_their_product_is_about_right():
    from closed_forms import closed_form, half_space

    limit_state = closed_form(half_space(2, 1e-4), 2, 100_000)
    run = run_splitting(limit_state, np.random.default_rng(0), 4000, 400)
    assert run.stopped is None
    assert run.levels[-1] == -np.inf
    assert np.all(np.diff(run.levels) < 0)
    assert run.estimate == pytest.approx(1e-4, rel=0.6)
    assert all(0.2 < rate < 0.8 for rate in run.accepted)


def test_two_chains_of_one_feature_are_enough_for_a_proposal():
    z = np.array([[-3.5], [-3.6], [-3.7], [-4.0]])
    chains = np.array([0, 0, 1, 1])
    fitted = mixture.fit_mixture(z, np.full(4, 0.25), chains, np.random.default_rng(0))
    assert fitted.shares.sum() == pytest.approx(1.0)
    assert np.all(fitted.ratio(z) > 1)
