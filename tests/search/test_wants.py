"""What a search wants of the loop, and wrappers that pass on all that they do not change."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import (
    CrossEntropy,
    Gradient,
    Halton,
    Observations,
    PointList,
    Portfolio,
    Search,
    Split,
    Uniform,
    Wants,
    Wrapper,
    named,
    names,
)
from verifai_jax.testing import check_search

CUBE = Cube((0, 0))


@dataclass(frozen=True)
class Rounded(Wrapper):
    """Another search, whose points are rounded to two digits."""

    search: Search

    def ask(self, state, cube, batch):
        u, state = super().ask(state, cube, batch)
        return jnp.round(u, 2), state


DERIVED = {"needs_derivatives"}
"""Members of a search that follow from others."""


def members(kind: type) -> set[str]:
    return {name for name in vars(kind) if not name.startswith("_")}


def test_a_wrapper_forwards_every_member_of_a_search():
    assert members(Search) - DERIVED <= members(Wrapper)


@pytest.mark.parametrize("name", names())
def test_around_any_search_a_wrapper_is_what_that_one_is(name):
    search = named(name)
    around = Rounded(search)
    for each in ("wants", "learns", "samples_prior", "origin", "sequence", "needs_derivatives"):
        assert getattr(around, each) == getattr(search, each)
    inner = search.fallback
    assert around.fallback == (None if inner is None else Rounded(inner))
    assert around.stage(None, CUBE, 8) == Rounded(search.stage(None, CUBE, 8)) or (
        around.stage(None, CUBE, 8) is around
    )


@pytest.mark.addons
@pytest.mark.parametrize("name", [name for name in names() if name != "likeliest"])
def test_a_search_kept_away_from_failures_wants_what_it_is_around_wants(name):
    wants = named(name).wants
    for by in ("inputs", "behaviour"):
        around = vj.search.Diverse(named(name), by=by).wants
        assert around.no_verdict_rows == wants.no_verdict_rows
        assert around.max_batch == min(wants.max_batch, 16)
        assert around.outcomes == (by == "behaviour")
        assert around.traces is None
        assert around.only(FULL)._fields == wants.only(FULL)._fields


FULL = Wants(gradient=True, clauses=True, coverage_ids=True, outcomes=True).form(CUBE, 4, 2)


def test_observations_have_what_is_wanted():
    nothing = Wants().only(FULL)
    assert [name for name, each in nothing._asdict().items() if each is not None] == [
        "u",
        "rho",
        "valid",
    ]
    clauses = Wants(clauses=True).form(CUBE, 4, 2)
    assert clauses.clauses is not None
    assert clauses.clause_gradients is not None
    assert clauses.gradient is None
    assert Wants(coverage_ids=True).form(CUBE, 4, 2).coverage_ids.shape == (4, 2)


@pytest.mark.addons
def test_two_searches_want_what_either_does_in_the_smaller_rounds():
    both = named("coverage").wants | named("bayes").wants
    assert both == Wants(coverage_ids=True, no_verdict_rows=True, max_batch=16)


@pytest.mark.slow
def test_parts_of_a_space_get_what_each_wants():
    class Noting(Search):
        seen: ClassVar[list[Observations]] = []
        wants: ClassVar[Wants] = Wants(coverage_ids=True)

        def init(self, key, cube, batch):
            return ()

        def ask(self, state, cube, batch):
            return jnp.full((batch, cube.dim), 0.5), state

        def tell(self, state, cube, observations):
            self.seen.append(observations)
            return state

    cube = Cube((0, 0), names=("x", "y"))
    search = Split({"x": Noting()}, Portfolio())
    assert search.wants == Wants(clauses=True, clause_gradients=True, coverage_ids=True)
    plain = Split({"x": Noting()}, CrossEntropy())
    state = plain.init(jax.random.key(0), cube, 4)
    marks = jnp.arange(8).reshape(4, 2)
    told = Observations(jnp.full((4, 2), 0.25), jnp.ones(4), jnp.ones(4, bool), coverage_ids=marks)
    plain.tell(state, cube, told)
    (seen,) = Noting.seen
    assert seen.u.shape == (4, 1)
    np.testing.assert_array_equal(seen.coverage_ids, marks)


def test_what_takes_the_place_of_a_search():
    without = Portfolio(gradients=False)
    assert Portfolio().fallback == without
    assert without.fallback is None
    assert Gradient().fallback is None
    assert Split({"x": Portfolio()}, Halton()).fallback == Split({"x": without}, Halton())
    assert Split({"x": Gradient()}, Portfolio()).fallback is None
    assert Split({"x": Uniform()}, Halton()).fallback is None
    assert Gradient().needs_derivatives
    assert Split({"x": Gradient()}, Portfolio()).needs_derivatives
    around = Rounded(Portfolio())
    assert around.fallback == Rounded(without)
    assert not around.needs_derivatives


def test_a_wrapper_of_given_points_is_one_of_given_points():
    assert Rounded(PointList([[0.5, 0.5]])).origin == "given"


@pytest.mark.addons
def test_searches_of_add_ons_have_a_fallback_and_words_of_their_own():
    assert named("trace_surrogate", initial=5).fallback == named("turbo", initial=5)
    assert Rounded(named("grid", points=3)).sequence[0] == "grid"


def test_a_wrapper_that_moves_points_has_none_of_the_prior():
    @dataclass(frozen=True)
    class Moved(Rounded):
        samples_prior: ClassVar[bool] = False

    assert Rounded(Uniform()).origin == "prior"
    assert Moved(Uniform()).origin == "sequence"
    assert Rounded(Moved(Uniform())).origin == "sequence"


def test_a_wrapper_needs_a_search():
    with (
        unchecked(),
        pytest.raises(TypeError, match=r"Rounded needs a search like CrossEntropy\(\); got 'ce'"),
    ):
        Rounded("ce")


@pytest.mark.slow
def test_a_wrapper_keeps_the_contract():
    check_search(Rounded(CrossEntropy()), CUBE)


@pytest.mark.addons
@pytest.mark.slow
def test_a_diverse_portfolio_does_without_gradients_of_a_black_box():
    space = vj.FeatureSpace({"x": vj.Box(-1, 1)})

    @vj.blackbox
    def system(features):
        return vj.Trace({"z": np.full(3, features["x"])}, dt=1.0)

    problem = vj.Problem("black", space, system, "always (z > -0.5)")
    run = vj.falsify(problem, vj.search.Diverse(Portfolio()), 24, batch=8, progress=False)
    assert run.search == repr(vj.search.Diverse(Portfolio(gradients=False)))
    assert any("without gradients: the system is a black box" in note for note in run.notes)
