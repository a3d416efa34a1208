"""Constraints under every search: only accepted points, at most once each, and none for nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import verifai_jax as vj
from verifai_jax.search import Search, named, names
from verifai_jax.search.proposals import ConstraintError, Proposals
from verifai_jax.testing import check_search

DOMAINS = {"x": vj.Box(0, 1), "y": vj.Box(0, 1), "kind": vj.Categorical("a", "b", "c")}

LARGE = ("bayes", "turbo", "trace_surrogate")


def below(features):
    """Below the diagonal, and not of the first kind: a third of the space."""
    return (features["y"] < features["x"]) & (features["kind"] > 0)


SPACE = vj.FeatureSpace(DOMAINS, where=below)
KEY = jax.random.key(4)


def play(proposals, rounds, gradient):
    """The points of some rounds, of which those near a corner of the allowed part fail."""
    seen = []
    for _ in range(rounds):
        points = np.asarray(proposals.next(16))
        seen.append(points)
        offset = points - np.array([1.0, 0.9, 0.5])
        rho = np.linalg.norm(offset[:, :2], axis=1) - 0.1
        slope = (offset * np.array([1, 1, 0])).astype(np.float32) if gradient else None
        proposals.tell(rho.astype(np.float32), np.ones(len(points), bool), slope)
    return np.concatenate(seen)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in LARGE else ())
        for name in names()
        if name != "grid"
    ],
)
def test_every_search(name):
    # A small model meets the constraint as a large one does.
    small = {"capacity": 64, "candidates": 64} if name in ("bayes", "turbo") else {}
    small |= {"capacity": 64} if name == "trace_surrogate" else {}
    search = named(name, **small)
    proposals = Proposals(search, SPACE.cube, 16, KEY, SPACE.constraint)
    points = play(proposals, 8, search.wants.gradient)
    features = jax.vmap(SPACE.unflatten)(jnp.asarray(points))
    assert np.all(jax.vmap(below)(features))
    # Differentiated rounds have few rows.
    assert len(points) >= (16 if search.wants.clauses else 64)
    assert proposals.accepted == len(points) <= proposals.proposed
    again = play(Proposals(search, SPACE.cube, 16, KEY, SPACE.constraint), 8, search.wants.gradient)
    np.testing.assert_array_equal(points, again)


@pytest.mark.thorough
def test_a_search_goes_on_from_its_checkpoint_under_a_constraint():
    for name in ("halton", "cross_entropy"):
        one = Proposals(named(name), SPACE.cube, 16, KEY, SPACE.constraint)
        play(one, 3, False)
        two = Proposals(named(name), SPACE.cube, 16, jax.random.key(99), SPACE.constraint)
        two.restore(one.checkpoint())
        np.testing.assert_array_equal(play(one, 3, False), play(two, 3, False))
        assert (one.proposed, one.accepted) == (two.proposed, two.accepted)


def test_accepted_samples_follow_the_prior_given_the_constraint():
    points = np.asarray(
        Proposals(named("uniform"), SPACE.cube, 512, KEY, SPACE.constraint).next(4096)
    )
    kinds = np.unique(np.floor(points[:, 2] * 3), return_counts=True)[1]
    assert stats.chisquare(kinds).pvalue > 1e-3
    # x has density 2 x below the diagonal, and y / x is uniform.
    assert stats.kstest(points[:, 0] ** 2, "uniform").pvalue > 1e-3
    assert stats.kstest(points[:, 1] / points[:, 0], "uniform").pvalue > 1e-3


@pytest.mark.thorough
def test_sequences_do_not_depend_on_the_batch():
    for name in ("uniform", "halton"):
        small, large = (
            Proposals(named(name), SPACE.cube, batch, KEY, SPACE.constraint) for batch in (8, 64)
        )
        parts = np.concatenate([np.asarray(small.next(n)) for n in (8, 3, 8, 5, 8)])
        np.testing.assert_array_equal(parts, np.asarray(large.next(32)))


@pytest.mark.addons
@pytest.mark.thorough
def test_a_grid_ends():
    grid = named("grid", points=5)
    proposals = Proposals(grid, SPACE.cube, 16, KEY, SPACE.constraint)
    assert proposals.total == 75
    points = np.concatenate([np.asarray(proposals.next(16)) for _ in range(5)])
    assert proposals.exhausted
    # 10 of 25 points lie below the diagonal, with two of three kinds.
    assert len(points) == len(np.unique(points, axis=0)) == 20
    assert len(proposals.next(16)) == 0
    problem = vj.Problem(
        "grid", SPACE, lambda f, key: vj.Trace({"x": f["x"][None]}, dt=1.0), "x < 2"
    )
    run = vj.falsify(problem, grid, batch=16)
    assert (run.stopped, run.simulations) == ("exhausted", 20)
    assert run.acceptance == pytest.approx(20 / 75)
    assert "let through 26.7 % of all proposals" in run.summary()
    assert vj.resume(run, budget=500).simulations == 20
    assert not any("cut short" in note for note in run.notes)
    part = vj.falsify(problem, grid, budget=8, batch=16)
    note = "grid cut short: 8 of its 75 points were simulated (11 %), in a random order over the"
    assert any(each.startswith(note) for each in part.notes)
    assert not any("cut short" in each for each in vj.resume(part, budget=75).notes)


def test_a_search_that_does_not_get_past_the_constraint_says_so():
    never = vj.FeatureSpace(DOMAINS, where=lambda f: f["x"] > 2)
    with pytest.raises(ConstraintError, match=r"where refused all proposals .* 0 of \d+ points"):
        Proposals(named("halton"), never.cube, 16, KEY, never.constraint).next(16)


def test_the_cube_of_a_space():
    space = vj.FeatureSpace(
        {
            "x": vj.Normal(0, 1),
            "kind": vj.Categorical("a", "b", weights=[0.9, 0.1]),
            "cars": vj.Array(vj.Struct({"x": vj.Box(0, 1)}), length=(1, 3)),
        }
    )
    cube = space.cube
    assert cube.levels == (0, 2, 3, 0, 0, 0)
    assert cube.weights[1] == (0.9, 0.1)
    assert cube.ordered == (True, False, True, True, True, True)
    assert cube.names[2:4] == ("cars.length", "cars[0].x")
    assert cube.lengths == (2,)


@dataclasses.dataclass(frozen=True)
class Own(Search):
    """A search of a user, who gets one thing wrong."""

    wrong: str = ""

    def init(self, key, cube, batch):
        # Weakly typed, as jnp.full of a Python number is.
        return {"key": key, "centre": jnp.full(cube.dim, 0.5)}

    def ask(self, state, cube, batch):
        key, now = jax.random.split(state["key"])
        u = jax.random.uniform(now, (batch, cube.dim))
        match self.wrong:
            case "shape":
                u = u.T
            case "dtype":
                u = (u > 0.5).astype(jnp.int32)
            case "range":
                u = u.at[3, 1].set(1.7)
            case "nan":
                u = u.at[2, 0].set(jnp.nan)
            case "no tuple":
                return u
            case "branch":
                u = u if u[0, 0] > 0.5 else 1 - u
        return u, {**state, "key": key}

    def tell(self, state, cube, observations):
        best = observations.u[jnp.argmin(observations.score)]
        if self.wrong == "state":
            best = best[0]
        return {**state, "centre": best}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("shape", r"must return points float32\[16, 2\].*\(a, b\); got float32\[2, 16\]"),
        ("dtype", r"must return points float32\[16, 2\].*got int32\[16, 2\]"),
        ("no tuple", r"ask of search Own\(wrong='no tuple'\) must return \(points, state\)"),
        ("state", r"tell.*its part \['centre'\] was float32\[2\] and became float32\[\]"),
        ("branch", r"ask.*test_proposals.py, line \d+, in ask \(`u = u if .*jnp.where.*jax.lax.c"),
    ],
)
def test_a_search_of_ones_own_with_wrong_forms(wrong, message):
    problem = vj.Problem("p", {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}, lambda f, key: None, "x < 2")
    with pytest.raises(ValueError, match=message) as raised:
        vj.falsify(problem, Own(wrong), 64)
    assert "\n" not in str(raised.value)
    assert "vj.blackbox" not in str(raised.value)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [("range", "in row 3 y is 1.7. Clip"), ("nan", "in row 2 x is nan. Clip")],
)
def test_a_search_of_ones_own_that_leaves_the_cube(wrong, message):
    cube = vj.FeatureSpace({"x": vj.Box(0, 1), "y": vj.Box(0, 1)}).cube
    with pytest.raises(ValueError, match=message):
        Proposals(Own(wrong), cube, 16, KEY).next(16)


@pytest.mark.slow
def test_a_search_of_ones_own_that_is_right():
    cube = vj.FeatureSpace({"x": vj.Box(0, 1), "y": vj.Box(0, 1)}).cube
    check_search(Own(), cube)
    proposals = Proposals(Own(), cube, 16, KEY)
    for _ in range(2):
        points = proposals.next(16)
        proposals.tell(np.ones(16, np.float32), np.ones(16, bool), None)
    assert points.shape == (16, 2)
