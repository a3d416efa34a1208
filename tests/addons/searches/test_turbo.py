"""Trust-region Bayesian optimization: many dimensions, its region, and what it forgets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from playing import asked, jitted

from verifai_jax.addons.searches.turbo import SIDES, TuRBO, trust_box
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations, named
from verifai_jax.search.halton import halton_points

KEY = jax.random.key(0)
SMALL = TuRBO(capacity=128, candidates=256)
TINY = TuRBO(capacity=32, candidates=32)


def corner(u):
    """Positive but in the corner of forty dimensions where a weighted sum is large."""
    weights = 1 / (1 + np.arange(40) / 5)
    towards = np.where(np.arange(40) % 3 == 0, u, 1 - u)
    return 0.72 * weights.sum() - towards @ weights


@pytest.mark.proves
def test_needs_fewer_simulations_in_forty_dimensions():
    # Uniform sampling meets one of these failures in thousands; cross-entropy needs more too.
    first = {}
    for name in ("turbo", "cross_entropy"):
        search, needed = named(name), []
        for seed in range(5):
            u, _ = asked(search, Cube((0,) * 40), corner, 16, key=jax.random.key(seed))
            failing = corner(u) < 0
            needed.append(int(np.argmax(failing)) + 1 if failing.any() else 200)
        first[name] = np.median(needed)
    assert first["turbo"] < first["cross_entropy"]
    assert np.mean(corner(np.random.default_rng(0).random((100_000, 40))) < 0) < 1e-3


@pytest.mark.slow
def test_closes_in_on_the_best_point():
    def bowl(u):
        return 0.1 + jnp.sum((u - 0.3) ** 2, axis=1)

    u, _ = asked(SMALL, Cube((0,) * 6), bowl, 14)
    assert np.median(np.linalg.norm(u[-16:] - 0.3, axis=1)) < 0.2
    # A uniform point is about 0.9 away.


@pytest.mark.slow
def test_begins_with_the_prior_and_stays_there_while_nothing_differs():
    u, _ = asked(TINY, Cube((0, 3)), lambda u: np.ones(8), 3)
    expected = halton_points(jnp.arange(1, 25, dtype=jnp.uint32), 2, KEY)
    np.testing.assert_allclose(u, expected, atol=1e-6)


@pytest.mark.thorough
def test_the_region_grows_with_progress_shrinks_without_and_is_left():
    cube, (_, tell) = Cube((0, 0)), jitted(TINY)
    state = TINY.init(KEY, cube, 8)
    u = jnp.asarray(np.random.default_rng(1).random((8, 2)), jnp.float32)
    valid = jnp.ones(8, bool)
    value = 100.0

    def told(state, value):
        return tell(state, cube, Observations(u, jnp.full(8, value) + u[:, 0], valid))

    for _ in range(5):  # Two rounds until it begins, then three with progress.
        value *= 0.5
        state = told(state, value)
    assert float(state.side) == pytest.approx(2 * SIDES[1])
    sides = []
    while int(state.memory.verdicts) > 0 and len(sides) < 40:
        state = told(state, 200.0)
        sides.append(float(state.side))
    # Eight points without progress are more than the four of two dimensions: half, every round.
    assert sides[:3] == pytest.approx([SIDES[1], SIDES[1] / 2, SIDES[1] / 4])
    # Left at last, with all that was known of it.
    assert len(sides) == 8
    assert sides[-1] == pytest.approx(SIDES[1])
    assert not np.isfinite(state.memory.score).any()


def test_sides_follow_the_length_scales():
    cube = Cube((0, 0, 5, 3), ordered=(True, True, True, False))
    state = TINY.init(KEY, cube, 4)
    lengths = jnp.log(jnp.array([0.5, 2.0, 1.0, 1.0]))
    hyper = state.memory.hyper._replace(lengths=lengths)
    state = state._replace(memory=state.memory._replace(hyper=hyper), side=jnp.float32(0.1))
    low, high = trust_box(state, cube, jnp.full(4, 0.5))
    # 0.1 times 0.5 and 2; one cell to either side; any of the unordered ones.
    np.testing.assert_allclose(high - low, [0.05, 0.2, 0.6, 1.0], rtol=1e-5)


def test_names_and_values_out_of_range():
    assert named("turbo", patience=0.5) == TuRBO(patience=0.5)
    with unchecked(), pytest.raises(ValueError, match="initial must be an integer of at least 2"):
        TuRBO(initial=1)
    with unchecked(), pytest.raises(ValueError, match="patience must be positive"):
        TuRBO(patience=0)
