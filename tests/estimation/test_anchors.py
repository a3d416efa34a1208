"""Regions keep the part of a proposal that their probability is known by."""

import numpy as np
import pytest
from closed_forms import Cells

from verifai_jax.estimation._estimate import one_thread
from verifai_jax.estimation.anchors import KINDS, anchors_of
from verifai_jax.estimation.components import Gaussian, Prior
from verifai_jax.estimation.exploration import explore
from verifai_jax.estimation.fitting import fit_diagonal
from verifai_jax.estimation.importance import fit_proposal
from verifai_jax.estimation.initial_proposal import proposal_from
from verifai_jax.estimation.methods import Plan, chains_for, estimate_automatically
from verifai_jax.estimation.mixture import Mixture


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
    assert len(mixture.components) == 1 + KINDS * len(anchors.regions)
    z, _ = mixture.sample(rng, 20_000)
    z = z[known(z).failing]
    owner, cell = anchors.owners(z), cells.of(z)
    assert len(np.unique(cell)) == 4
    # Each region of the anchors is in one cell, and so are the failures that it owns.
    purity = [np.bincount(cell[owner == k]).max() / np.sum(owner == k) for k in np.unique(owner)]
    assert min(purity) > 0.95


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


@pytest.mark.thorough
@pytest.mark.parametrize("gradient", [True, False])
def test_failures_that_need_a_few_of_many_features_have_their_probability(gradient):
    """Four cells in 20 dimensions, each in three coordinates of its own."""
    cells = Cells(20, 4, 3, seed=2)
    truth = cells.masses.sum()
    for seed in range(2):
        known = cells.limit_state(50_000, gradient)
        plan = Plan(0.95, chains_for(50_000, 0.06), np.zeros(20, bool))
        with one_thread():
            answer = estimate_automatically(known, np.random.default_rng(seed), plan)
        assert answer.method == "importance"
        assert answer.probability == pytest.approx(truth, rel=0.1)
        assert answer.low <= 1.01 * truth
        assert answer.high >= 0.99 * truth
        assert known.simulations <= 50_000
