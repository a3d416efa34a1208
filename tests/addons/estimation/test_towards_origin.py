"""Ways towards the origin leave the coordinates alone that decide, and stay in their region."""

import numpy as np
import pytest
from closed_forms import Cells, closed_form, normal
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtri

from verifai_jax.addons.estimation.towards_origin import (
    approach_origin,
    come_in,
    come_in_by_parts,
    redraw_by_parts,
)
from verifai_jax.addons.estimation.walks import walk_among_failures


def inside(cells, rng, n):
    """Points of normal space, each anywhere inside of one of the cells."""
    own = rng.integers(0, len(cells.masses), n)
    low = np.maximum(cells.centres - cells.reach, 0.0)[own]
    high = np.minimum(cells.centres + cells.reach, 1.0)[own]
    return ndtri(rng.uniform(low, high)), own


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(1, 3), st.integers(0, 1000))
def test_what_does_not_decide_is_set_to_zero(dim, deciding, seed):
    cells = Cells(dim, 3, min(deciding, dim), seed)
    known, rng = cells.limit_state(10**6), np.random.default_rng(seed)
    z, own = inside(cells, rng, 20)
    found = come_in_by_parts(known, rng, z)
    assert known(found).failing.all()
    assert np.array_equal(cells.of(found), own)
    needed = cells.reach[own] < 1
    stays = np.all((found == z) | (found == 0), axis=1)
    assert stays.all()
    # Where halves and quarters hold something that decides, nothing more is tried.
    spared = np.all((found == 0) | needed, axis=1)
    assert np.all(spared | np.all(found == z, axis=1))
    if dim >= 4 * deciding:
        assert spared.mean() > 0.7


def test_a_coordinate_that_has_to_be_near_zero_decides():
    cells = Cells(12, 1, 2, seed=3)
    own = np.flatnonzero(cells.reach[0] < 1)
    cells.centres[0, own[0]] = 0.5
    known, rng = cells.limit_state(10**6), np.random.default_rng(0)
    z, _ = inside(cells, rng, 30)
    z = come_in_by_parts(known, rng, z)
    assert np.all(z[:, own[0]] == 0)
    drawn, deciding = redraw_by_parts(known, rng, z)
    assert known(drawn).failing.all()
    assert np.all(np.flatnonzero(deciding.any(axis=0)) == own)
    assert np.std(drawn[:, ~deciding[0]]) == pytest.approx(1.0, abs=0.15)


def test_points_that_need_all_coordinates_stay_as_they_are():
    known = closed_form(lambda u: 4.0 - normal(u).sum(axis=1) / np.sqrt(16), 16, 10**6)
    rng = np.random.default_rng(0)
    z = np.full((10, 16), 1.001)
    assert np.array_equal(come_in_by_parts(known, rng, z), z)
    # Two halves and four quarters each.
    assert known.simulations == 60


def test_no_part_leads_into_another_region():
    def robustness(u):
        z = normal(u)
        return np.minimum(*(np.linalg.norm(z - c, axis=1) - 0.2 for c in ([3, 0], [3, 0.5])))

    known, rng = closed_form(robustness, 2, 10**6), np.random.default_rng(0)
    found = come_in_by_parts(known, rng, np.array([[3.0, 0.5], [3.0, 0.45], [3.0, 0.1]]))
    assert found.tolist() == [[3.0, 0.5], [3.0, 0.45], [3.0, 0.0]]


def test_a_step_that_leads_nowhere_ends_the_way_to_the_origin():
    cells = Cells(10, 1, 3)
    known, rng = cells.limit_state(10**6), np.random.default_rng(0)
    z, _ = inside(cells, rng, 5)
    found = approach_origin(known, z, 100)
    assert known(found).failing.all()
    assert np.all(np.linalg.norm(found, axis=1) <= np.linalg.norm(z, axis=1))
    assert known.simulations < 5 * 100


def test_walks_move_what_does_not_decide_as_the_prior_does():
    cells = Cells(20, 2, 3, seed=1)
    known, rng = cells.limit_state(10**6, gradient=False), np.random.default_rng(0)
    z, own = inside(cells, rng, 40)
    z = come_in_by_parts(known, rng, come_in(known, z))
    drawn, deciding = redraw_by_parts(known, rng, z)
    states, nearest = walk_among_failures(known, rng, drawn, deciding, own, 24)
    assert len(states) == 12
    for state in states:
        assert known(state).failing.all()
        assert np.array_equal(cells.of(state), own)
    free = cells.reach[own] == 1
    everything = np.concatenate([state[free] for state in states])
    assert everything.mean() == pytest.approx(0.0, abs=0.1)
    assert everything.std() == pytest.approx(1.0, abs=0.1)
    # Those that decide move too, by as little as they can.
    needed = np.stack([state[~free] for state in states])
    assert np.mean(np.ptp(needed, axis=0) > 0) > 0.7
    assert np.all(np.sum(nearest**2, axis=1) <= np.sum(drawn**2, axis=1))
