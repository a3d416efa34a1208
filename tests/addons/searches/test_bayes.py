"""Bayesian optimization: quality on known landscapes, what it keeps, and what it never does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from playing import asked, gain, jitted, play

from verifai_jax.addons.searches.bayes import Bayes
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations
from verifai_jax.search.halton import halton_points
from verifai_jax.testing import check_search

KEY = jax.random.key(0)
SMALL = Bayes(capacity=96, candidates=128)
IMPROVEMENT = Bayes("expected_improvement", capacity=96, candidates=128)
FLAT = ("ball", "ripples")


@pytest.mark.proves
@pytest.mark.parametrize("names", [FLAT, ("mixed",), ("few_of_many",)], ids="-".join)
def test_beats_uniform(names):
    values = play(SMALL, names, 8, 11, 9, together=False)[1]
    for name, value in zip(names, values, strict=True):
        assert gain(name, value) > 5, name


@pytest.mark.proves
def test_expected_improvement_beats_uniform():
    (value,) = play(IMPROVEMENT, ("ball",), 8, 11, 9, together=False)[1]
    assert gain("ball", value) > 5


@pytest.mark.slow
def test_goes_on_failing():
    u, value = play(SMALL, FLAT, 8, 11, 9, together=False)
    late = value[0, :, -40:] < 0
    assert late.mean() > 0.3
    # At different points.
    for points, failing in zip(u[0, :, -40:], late, strict=True):
        assert len(np.unique(points[failing], axis=0)) == failing.sum()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("value", "valid"),
    [
        (np.nan, True),
        *(
            pytest.param(*case, marks=pytest.mark.thorough)
            for case in [(1.0, True), (-1.0, True), (np.inf, True), (np.nan, False)]
        ),
    ],
)
def test_the_same_robustness_everywhere_gives_the_prior(value, valid):
    u, _ = asked(SMALL, Cube((0, 3)), lambda u: np.full(8, value), 3, valid=valid)
    expected = halton_points(jnp.arange(1, 25, dtype=jnp.uint32), 2, KEY)
    np.testing.assert_allclose(u, expected, atol=1e-6)


@pytest.mark.slow
def test_a_space_of_few_points_is_searched_through():
    # Eleven of twelve choices are tried before any is tried again, but for exploration.
    cube = Cube((4, 3), ordered=(False, False))

    def rho(u):
        cells = np.asarray(cube.cells(u))
        return 1.0 + (cells[:, 0] * 7 + cells[:, 1] * 5) % 12

    u, state = asked(Bayes(capacity=64, candidates=64, initial=4), cube, rho, 8, batch=4)
    cells = np.asarray(cube.cells(jnp.asarray(u)))
    assert len(np.unique(cells[:16], axis=0)) >= 11
    assert int(state.memory.verdicts) == 32


@pytest.mark.slow
def test_huge_values_do_not_hide_the_others():
    # The process sees a bowl whether or not a far part of it is enormous.
    def rho(u):
        distance = jnp.sum((u - 0.3) ** 2, axis=1)
        return jnp.where(distance > 0.3, 1e20, distance + 0.1)

    u, _ = asked(SMALL, Cube((0, 0)), rho, 8)
    assert np.median(np.linalg.norm(u[-24:] - 0.3, axis=1)) < 0.1


@pytest.mark.thorough
def test_what_is_kept():
    cube, search = Cube((0,)), Bayes(capacity=32, candidates=32)
    _, tell = jitted(search)
    state = search.init(KEY, cube, 50)
    u = np.random.default_rng(0).permutation(200)[:, None].astype(np.float32) / 200
    for part in np.split(u, 4):
        state = tell(state, cube, Observations(part, 1 + part[:, 0], jnp.ones(50, bool)))
    kept = np.sort(np.asarray(state.memory.u[:, 0]))
    np.testing.assert_allclose(kept[:16], np.arange(16) / 200, atol=1e-6)
    # The others are from everywhere and from all times.
    assert kept[16] < 0.3
    assert kept[-1] > 0.8
    order = np.searchsorted(np.sort(u[:, 0]), kept[16:])
    times = np.argsort(u[:, 0])[order] // 50
    assert set(times.tolist()) == {0, 1, 2, 3}


@pytest.mark.slow
def test_explores_for_ever_and_more_when_it_leads_nowhere():
    cube, search = Cube((0, 0)), Bayes(capacity=32, candidates=32)
    ask, _ = jitted(search)
    _, state = asked(search, cube, lambda u: 1 + u[:, 0], 1, batch=40)
    for stale, share in ((0, 0.1), (80, 0.5), (720, 0.9)):
        state = state._replace(stale=jnp.int32(stale), explored=jnp.uint32(0))
        for _ in range(5):
            _, state = ask(state, cube, 40)
        assert abs(int(state.explored) / 200 - share) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 48])
@pytest.mark.parametrize("search", [SMALL, IMPROVEMENT], ids=["thompson", "improvement"])
def test_small_and_large_batches(search, batch):
    cube = Cube((0, 3, 0), ordered=(True, False, True))
    small = Bayes(search.acquisition, capacity=32, candidates=32)
    u, _ = asked(small, cube, lambda u: jnp.sum(u, axis=1), 20 if batch == 1 else 2, batch)
    assert np.all(np.isfinite(u))
    assert len(np.unique(u, axis=0)) > 0.8 * len(u)
    # It has gone where the robustness is small.
    late = u[-6:] if batch == 1 else u[48:]
    assert np.mean(late[:, ::2]) < 0.3


@pytest.mark.slow
def test_contract_of_expected_improvement():
    """That of Thompson sampling, the default, is among those of all searches."""
    cube = Cube((3, 0, 9), weights=((0.7, 0.2, 0.1), None, None), ordered=(False, True, True))
    check_search(Bayes("expected_improvement", capacity=32, candidates=32), cube)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"acquisition": "ei"},
            "acquisition must be 'thompson' or 'expected_improvement'; got 'ei'",
        ),
        ({"capacity": 8}, "capacity must be an integer of at least 16; got 8"),
        ({"candidates": 1}, "candidates must be an integer of at least 32; got 1"),
        ({"initial": 0}, "initial must be an integer of at least 2; got 0"),
        ({"exploration": 0}, r"exploration must be in \(0, 1\]; got 0"),
    ],
)
def test_values_out_of_range(options, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        Bayes(**options)
