"""The stages of a portfolio: which members take part when, and that they do what the whole does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from playing import tell_of

from verifai_jax import search as searches
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Portfolio, descent
from verifai_jax.search.portfolio import MANY, PATIENT, PortfolioStage

CUBE = Cube((0,) * 3)
PLAIN = PortfolioStage(Portfolio(), descends=False)
DESCENDS = PortfolioStage(Portfolio(), descends=True)


def bowl(u):
    """A hollow that nowhere fails."""
    return 1.0 + jnp.sum((u - 0.3) ** 2)


def play(search, state, batch, rounds, value=bowl):
    """Yield the points of each round and the state after it."""

    @jax.jit
    def step(state):
        u, state = search.ask(state, CUBE, batch)
        told = tell_of(search, state, CUBE, u, jax.vmap(value)(u), jax.vmap(jax.grad(value))(u))
        return search.tell(state, CUBE, told), u

    for _ in range(rounds):
        state, u = step(state)
        yield np.asarray(u), state


def begin(batch, key=0):
    return Portfolio().init(jax.random.key(key), CUBE, batch)


def test_rounds_of_few_points_descend_from_the_first_on():
    assert Portfolio().stage(None, CUBE, MANY) == DESCENDS
    assert Portfolio().stage(begin(4), CUBE, 4) == DESCENDS


def test_rounds_of_many_points_begin_without_descents():
    many = MANY + 1
    assert Portfolio().stage(None, CUBE, many) == PLAIN
    state = begin(4)  # What decides is the same for all batches.
    assert Portfolio().stage(state, CUBE, many) == PLAIN
    assert not PLAIN.wants.clause_gradients
    rare = state._replace(barren=jnp.int32(PATIENT * many))
    assert Portfolio().stage(rare, CUBE, many) == DESCENDS
    assert DESCENDS.wants.clause_gradients


def test_descents_into_the_interior_come_last():
    state = begin(4)
    waited = state.interior._replace(cost=jnp.float32(descent.EARLY))
    assert Portfolio().stage(state._replace(interior=waited), CUBE, 4) == Portfolio()
    # Where they get nowhere they wait, and so they do where the others have failures.
    spent = waited._replace(since=jnp.float32(descent.TRIAL), spent=jnp.float32(descent.TRIAL))
    assert Portfolio().stage(state._replace(interior=spent), CUBE, 4) == DESCENDS
    failing = waited._replace(theirs=jnp.float32(0))
    assert Portfolio().stage(state._replace(interior=failing), CUBE, 4) == DESCENDS
    # But what they have earned they spend.
    saved = failing._replace(credit=jnp.float32(8))
    assert Portfolio().stage(state._replace(interior=saved), CUBE, 4) == Portfolio()


def test_without_gradients_there_is_one_stage():
    without = Portfolio(gradients=False)
    assert without.stage(None, CUBE, 1000) is without
    choices = Cube((3, 2))
    assert Portfolio().stage(None, choices, 1000) == Portfolio()


@pytest.mark.addons
def test_a_search_for_diverse_failures_has_the_stages_of_the_one_inside():
    search = searches.Diverse(Portfolio())
    state = search.init(jax.random.key(0), CUBE, 4)
    assert search.stage(state, CUBE, 4) == searches.Diverse(DESCENDS)
    inner = state.inner._replace(interior=state.inner.interior._replace(cost=jnp.float32(1e4)))
    assert search.stage(state._replace(inner=inner), CUBE, 4) is search


@pytest.mark.slow
def test_a_stage_proposes_what_the_whole_proposes():
    points, states = zip(*play(Portfolio(), begin(4), 4, 40), strict=True)
    same, others = zip(*play(DESCENDS, begin(4), 4, 40), strict=True)
    np.testing.assert_array_equal(points, same)
    whole, stage = states[-1], others[-1]
    # And what decides about the next stage is counted alike.
    assert descent.waits(whole.interior) == descent.waits(stage.interior)
    for name in ("cost", "spent", "idle", "own", "theirs", "credit"):
        np.testing.assert_array_equal(
            getattr(whole.interior, name), getattr(stage.interior, name), err_msg=name
        )
    assert int(whole.barren) == int(stage.barren) > 0


@pytest.mark.slow
def test_without_descents_it_is_the_portfolio_without_gradients():
    without = Portfolio(gradients=False)
    other = without.init(jax.random.key(0), CUBE, 64)
    points, _ = zip(*play(without, other, 64, 6), strict=True)
    same, states = zip(*play(PLAIN, begin(64), 64, 6), strict=True)
    np.testing.assert_array_equal(points, same)
    before, after = begin(64).gradient, states[-1].gradient
    assert before.starts == after.starts == 0
    assert bool(jnp.all(before.fresh == after.fresh))


@pytest.mark.slow
def test_a_failure_ends_the_count_of_barren_rounds():
    def cut(u):  # Fails where the first coordinate is great.
        return 0.9 - u[0]

    *_, (u, state) = play(PLAIN, begin(64), 64, 3, cut)
    assert (u[:, 0] > 0.9).any()
    assert int(state.barren) == 0
    *_, (_, state) = play(PLAIN, state, 64, 2)
    assert int(state.barren) == 128
