"""Compositions: every part does what it does alone, and sees its own coordinates only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from playing import tell_of

from verifai_jax.core.values.cube import Cube
from verifai_jax.search import (
    CrossEntropy,
    Gradient,
    Halton,
    Split,
    Uniform,
    from_json,
    split,
    to_json,
)
from verifai_jax.search.gradient import FIRST_BOX, WOBBLE
from verifai_jax.testing import check_search

CUBE = Cube(
    (0, 3, 0, 0),
    ordered=(True, False, True, True),
    names=("x", "colour", "cars[0].x", "cars[1].x"),
)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "search",
    [
        split({"cars": "halton"}),
        pytest.param(split({"x": "gradient", "cars": "cross_entropy"}), marks=pytest.mark.slow),
        split({"x, colour, cars": "cross_entropy"}),
    ],
    ids=repr,
)
def test_the_contract_of_searches_holds(search):
    check_search(search, CUBE)


@pytest.mark.thorough
def test_parts_are_what_they_are_alone():
    search, key = Split({"cars": Halton()}, Uniform()), jax.random.key(0)
    u, _ = search.ask(search.init(key, CUBE, 8), CUBE, 8)
    alone = Cube((0, 0))
    expected, _ = Halton().ask(Halton().init(key, alone, 8), alone, 8)
    np.testing.assert_array_equal(u[:, 2:], expected)
    assert len(np.unique(np.asarray(u[:, 0]))) == 8


@pytest.mark.slow
def test_parts_learn_from_their_own_coordinates():
    search = Split({"x": Gradient()}, Uniform())
    ask, tell = jax.jit(search.ask, static_argnums=(1, 2)), jax.jit(search.tell, static_argnums=1)
    state = search.init(jax.random.key(1), CUBE, 16)
    starts = np.zeros(0)
    for gradients in (True, False):
        u, state = ask(state, CUBE, 16)
        plan = search.plan(state, CUBE, 16)
        assert bool(plan.differentiate) == gradients
        gradient = jnp.zeros_like(u).at[:, 0].set(1.0).at[:, 2].set(-1.0)
        told = tell_of(search, state, CUBE, u, 1 + u[:, 0], gradient)
        state = tell(state, CUBE, told)
        if gradients:
            starts = u[: search.parts[0][1].at_once(16), 0]
    # The largest box of each descent, which is the whole cube for every second, and another part
    # as ever.
    boxes = np.where(np.arange(len(starts)) % 2 == 0, 1.0, FIRST_BOX)
    # Smaller boxes are up to a tenth less, by the seed.
    least, most = (np.maximum(starts - part * boxes, 0.0) for part in (1.0, 1 - WOBBLE))
    found = np.asarray(u[: len(starts), 0])
    assert np.all((found >= least - 1e-6) & (found <= np.where(boxes < 1, most, least) + 1e-6))
    assert 0.2 < float(jnp.mean(u[:, 2])) < 0.8


def test_what_the_whole_is():
    assert split({"x": "gradient"}).wants.clauses
    assert not split({"x": "halton"}).wants.clauses
    assert split({"x": "uniform"}).samples_prior
    assert not split({"x": "halton"}).samples_prior
    assert split({"x": "cross_entropy"}).learns
    assert not split({"x": "halton"}).learns
    assert split({"x": "halton"}).total(CUBE) is None


@pytest.mark.parametrize(
    "search", [Split({"x": Gradient(shrinks=0.5)}, CrossEntropy(elite=0.2)), Halton(scramble=True)]
)
def test_a_split_is_recorded_and_read_again(search):
    assert from_json(to_json(search)) == search


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: split({"car": "halton"}).check(CUBE),
            "unknown feature 'car'; did you mean 'cars'",
        ),
        (
            lambda: split({"cars": "halton", "cars[1].x": "uniform"}).check(CUBE),
            r"feature 'cars\[1\].x' is in two parts",
        ),
        (lambda: split({}), "at least one part; got none"),
        (lambda: split({"x": "halten"}), "unknown search 'halten'"),
        (lambda: split({"colour": "gradient"}).check(CUBE), "at least one continuous feature"),
        (lambda: from_json({"name": "halton"}), "does not describe a search"),
    ],
)
def test_bad_input(make, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        make()


def test_a_part_that_is_no_search():
    with (
        unchecked(),
        pytest.raises(TypeError, match="the part 'x' of a Split must be a search; got 3"),
    ):
        Split({"x": 3}, Uniform())
