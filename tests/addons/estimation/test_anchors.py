"""Regions keep the part of a proposal that their probability is known by."""

from dataclasses import replace

import numpy as np
import pytest
from closed_forms import Cells, with_gradient
from scipy.stats import norm

from verifai_jax.addons.estimation._estimate import one_thread
from verifai_jax.addons.estimation.anchors import anchors_of, join_explorations
from verifai_jax.addons.estimation.answers import Plan, chains_for
from verifai_jax.addons.estimation.components import Gaussian, Prior
from verifai_jax.addons.estimation.exploration import explore
from verifai_jax.addons.estimation.fitting import fit_across, fit_diagonal
from verifai_jax.addons.estimation.importance import fit_proposal
from verifai_jax.addons.estimation.initial_proposal import proposal_from
from verifai_jax.addons.estimation.methods import estimate_automatically
from verifai_jax.addons.estimation.mixture import Mixture


def estimated(known, seed):
    """The answer of `estimate` with a budget of 50 000."""
    plan = Plan(0.95, chains_for(50_000, 0.06), np.zeros(known.dim, bool))
    with one_thread():
        return estimate_automatically(known, np.random.default_rng(seed), plan)


def test_coordinates_like_the_priors_are_the_priors():
    rng = np.random.default_rng(0)
    z = rng.standard_normal((60, 10))
    z[:, 3] = 2.0 + 0.01 * rng.standard_normal(60)
    fitted = fit_diagonal(z, np.full(60, 1 / 60))
    others = np.arange(10) != 3
    assert np.all(fitted.mean[others] == 0)
    assert np.all(fitted.stds[others] == 1)
    assert fitted.mean[3] == pytest.approx(2.0, abs=0.01)
    assert 0.01 < fitted.stds[3] < 0.02


def test_across_the_directions_that_decide_a_fit_is_the_prior():
    rng = np.random.default_rng(0)
    directions = np.linalg.qr(rng.standard_normal((40, 2)))[0]
    z = rng.standard_normal((30, 40))
    inside = np.array([2.5, -2.0]) + np.array([0.1, 0.3]) * rng.standard_normal((30, 2))
    z += (inside - z @ directions) @ directions.T
    fitted = fit_across(z, np.full(30, 1 / 30), directions)
    drawn, _ = Mixture((fitted,), np.ones(1)).sample(rng, 20_000)
    assert (drawn @ directions).mean(axis=0) == pytest.approx([2.5, -2.0], abs=0.2)
    assert (drawn @ directions).std(axis=0) == pytest.approx([0.13, 0.39], rel=0.35)
    others = drawn - (drawn @ directions) @ directions.T
    assert others.mean(axis=0) == pytest.approx(np.zeros(40), abs=0.04)
    assert np.sum(others**2, axis=1).mean() == pytest.approx(38, rel=0.02)


def oblique_slabs(dim, budget):
    """Failures within an interval in each of two oblique directions, for each of three modes."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.standard_normal((dim, dim)))[0].T[:6].reshape(3, 2, dim)
    centres = np.array([[2.4, 2.6], [-2.5, 2.2], [2.7, -2.3]])
    reach = np.array([[0.2, 0.3], [0.25, 0.2], [0.3, 0.35]])

    def parts(z):
        away = np.einsum("kmd,nd->nkm", axes, z) - centres
        margins = np.abs(away) - reach
        mode = margins.max(axis=2).argmin(axis=1)
        rows, side = np.arange(len(z)), margins[np.arange(len(z)), mode].argmax(axis=1)
        slope = np.sign(away[rows, mode, side])[:, None] * axes[mode, side]
        return margins[rows, mode, side], slope

    masses = np.prod(norm.cdf(centres + reach) - norm.cdf(centres - reach), axis=1)
    return with_gradient(lambda z: parts(z)[0], lambda z: parts(z)[1], dim, budget), masses.sum()


@pytest.mark.thorough
def test_failures_that_need_two_oblique_conditions_are_hit():
    known, _ = oblique_slabs(40, 100_000)
    found = explore(known, np.random.default_rng(0), 3000)
    hits = {}
    for normals in (True, False):
        of = found if normals else replace(found, normals=())
        drawn, _ = anchors_of([of], 0.1).fit().sample(np.random.default_rng(1), 10_000)
        hits[normals] = known(drawn).failing.mean()
    assert hits[True] > 0.1
    assert hits[True] > 1.3 * hits[False]


def test_explorations_together_have_all_normals():
    known, _ = oblique_slabs(20, 100_000)
    found = [explore(known, np.random.default_rng(seed), 1500) for seed in range(2)]
    together = join_explorations(found)
    assert len(together.normals) == len(together.nearest)
    last = together.normals[-1]
    assert np.array_equal(last, found[1].normals[-1])
    assert np.linalg.norm(last, axis=1) == pytest.approx(1.0)


@pytest.mark.proves
def test_failures_that_need_two_oblique_conditions_have_their_probability():
    for seed in range(3):
        known, truth = oblique_slabs(40, 50_000)
        answer = estimated(known, seed)
        assert answer.method == "importance"
        assert answer.probability == pytest.approx(truth, rel=0.15)
        assert answer.low <= 1.02 * truth
        assert answer.high >= 0.98 * truth


def test_other_shares_leave_the_priors():
    mixture = Mixture(
        (Prior(2), *(Gaussian(np.full(2, k), np.eye(2), np.ones(2)) for k in (1.0, 2.0))),
        np.array([0.2, 0.4, 0.4]),
    )
    assert mixture.with_shares(np.array([0.1, 0.3])).shares == pytest.approx([0.2, 0.2, 0.6])


def test_failures_belong_to_the_region_that_they_are_in_whatever_is_nearest():
    cells, rng = Cells(20, 4, 3), np.random.default_rng(0)
    known = cells.limit_state(50_000)
    anchors = anchors_of([explore(known, rng, 5000)], 0.1)
    mixture = anchors.fit()
    # The prior, five components of each region, and one in the directions that decide.
    assert len(mixture.components) == 1 + 6 * len(anchors.regions)
    z, _ = mixture.sample(rng, 20_000)
    z = z[known(z).failing]
    owner, cell = anchors.owners(z), cells.of(z)
    assert len(np.unique(cell)) == 4
    # Each region of the anchors is in one cell, and so are the failures that it owns.
    purity = [np.bincount(cell[owner == k]).max() / np.sum(owner == k) for k in np.unique(owner)]
    assert min(purity) > 0.95


@pytest.mark.slow
def test_a_region_a_hundred_times_less_probable_has_samples():
    cells, rng = Cells(12, 2, 2), np.random.default_rng(1)
    for row, mass in enumerate((1e-4, 1e-6)):
        cells.reach[row, cells.reach[row] < 1] = np.sqrt(mass) / 2
        cells.masses[row] = mass
    known = cells.limit_state(50_000)
    found = explore(known, rng, 5000)
    initial, anchors = proposal_from(found, rng, 0.1), anchors_of([found], 0.1)
    fitted = fit_proposal(known, rng, found.points, found.chain_ids, 30_000, initial, anchors)
    z, _ = fitted.proposal.sample(rng, 10_000)
    fails = known(z).failing
    weight = 1 / fitted.proposal.ratio(z[fails])
    masses = np.bincount(cells.of(z[fails]), weight, 2) / len(z)
    assert masses == pytest.approx(cells.masses, rel=0.25)
    # By its own part of the failures it would have some 40.
    assert np.sum(cells.of(z[fails]) == 1) > 150


@pytest.mark.proves
@pytest.mark.parametrize("gradient", [True, False])
def test_failures_that_need_a_few_of_many_features_have_their_probability(gradient):
    """Four cells in 20 dimensions, each in three coordinates of its own."""
    cells = Cells(20, 4, 3, seed=2)
    truth = cells.masses.sum()
    for seed in range(2):
        known = cells.limit_state(50_000, gradient)
        answer = estimated(known, seed)
        assert answer.method == "importance"
        assert answer.probability == pytest.approx(truth, rel=0.1)
        assert answer.low <= 1.01 * truth
        assert answer.high >= 0.99 * truth
        assert known.simulations <= 50_000
