"""The likeliest failure: equal to dynamic programming on grid worlds, and to closed forms."""

import math
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.features.density import NoDensityError, log_density
from verifai_jax.features.improbability import Improbability
from verifai_jax.search import CrossEntropy, Likeliest, Uniform, from_json, to_json

MOVES = np.array([[0, 0], [0, 1], [0, -1], [-1, 0], [1, 0]])
"""Slips of an agent: none, up, down, left, right."""


def follow(position, goal, slip, size, xp):
    """One step towards the goal, first along x, and a slip."""
    way = xp.sign(xp.asarray(goal) - position)
    along = xp.where(way[0] != 0, xp.asarray([1, 0]) * way[0], xp.asarray([0, 1]) * way[1])
    return xp.clip(position + along + xp.asarray(MOVES)[slip], 0, xp.asarray(size) - 1)


def grid_world(name, steps, size, pits, start, goal, weights):
    """An agent on its way to a goal that must not fall into a pit, with a slip at each step."""

    def system(features, key):
        slips = jnp.stack([features[f"slip{t}"] for t in range(steps)]).astype(int)

        def step(position, slip):
            position = follow(position, goal, slip, size, jnp)
            far = jnp.min(jnp.sum(jnp.abs(jnp.asarray(pits) - position), axis=1))
            return position, far.astype(float)

        return vj.Trace({"far": jax.lax.scan(step, jnp.asarray(start), slips)[1]}, dt=1.0)

    space = {f"slip{t}": vj.Categorical(*range(5), weights=weights(t)) for t in range(steps)}
    return vj.Problem(name, space, system, "always far > 0.5")


def by_dynamic_programming(steps, size, pits, start, goal, weights):
    """The greatest log-probability of a path into a pit."""
    logs = [np.log(weights(t)) for t in range(steps)]
    rest = [sum(log.max() for log in logs[t:]) for t in range(steps + 1)]

    @lru_cache(None)
    def best(t, position):
        if t == steps:
            return -math.inf
        found = -math.inf
        for slip, log in enumerate(logs[t]):
            after = tuple(follow(np.array(position), goal, slip, size, np).tolist())
            found = max(found, log + (rest[t + 1] if after in pits else best(t + 1, after)))
        return found

    return best(0, start)


def varied(t):
    raw = np.array([6.0, 1 + t % 3, 1 + 7 * t % 4, 0.5, 1.5])
    return (raw / raw.sum()).tolist()


WORLDS = {
    "corridor": (10, (11, 7), [(x, 0) for x in range(2, 9)], (0, 3), (10, 3),
                 lambda t: [0.8, 0.05, 0.05, 0.05, 0.05]),
    "gusts": (14, (15, 9), [(6, 1), (7, 7), (9, 2), (11, 8), (3, 8)], (0, 4), (14, 4), varied),
    "plain": (20, (14, 10), [(3, 7), (8, 6), (12, 9), (5, 9), (10, 8)], (0, 2), (13, 3),
              lambda t: [0.7, 0.02 + 0.01 * (t % 4), 0.1 - 0.01 * (t % 4), 0.1, 0.08]),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_it_is_that_of_dynamic_programming(name):
    world = WORLDS[name]
    problem = grid_world(name, *world)
    best = by_dynamic_programming(*world)
    run = vj.falsify(problem, "likeliest", budget=4000, progress=False)
    assert run.search.startswith("Likeliest(search=CrossEntropy(")
    small = vj.shrink(run, by="likelihood", budget=3000, progress=False)
    assert small.log_densities is not None
    assert small.log_densities.failure == pytest.approx(best, abs=1e-6)
    assert small.replay().violated
    lost = small.log_densities.likeliest - best
    assert small.distance == pytest.approx(math.sqrt(2 * lost), rel=1e-4)
    assert f"{name}: the likeliest failure found has log-likelihood" in str(small)
    assert f"row {small.row} has log-likelihood" in str(small)


def half_space(features, key):
    x = features["x"] + 2 * features["y"]
    return vj.Trace({"m": jnp.full((2,), 3.0 - x - 0.1 * features["even"])}, dt=1.0)


HALF = vj.Problem(
    "half",
    {"x": vj.Normal(0.0, 1.0), "y": vj.Normal(0.0, 0.5), "even": vj.Box(0.0, 1.0)},
    half_space,
    "always m >= 0",
)


@pytest.mark.slow
def test_it_is_the_nearest_point_of_a_half_space():
    run = vj.falsify(HALF, "likeliest", budget=1024, progress=False)
    small = vj.shrink(run, by="likelihood", budget=800, progress=False)
    # The even feature costs nothing: at its end the half space begins at 2.9 of sqrt(2) sigma.
    assert small.distance == pytest.approx(2.9 / math.sqrt(2), rel=2e-3)
    assert small.features["even"] == pytest.approx(1.0, abs=0.05)
    plain = vj.falsify(HALF, "cross_entropy", budget=1024, progress=False)
    likeliest = run.improbability()["log_density"].to_numpy().max()
    assert likeliest > plain.improbability()["log_density"].to_numpy().max() - 1e-6
    with pytest.raises(ValueError, match="leave out nominal="):
        vj.shrink(run, by="likelihood", nominal={"x": 0.0}, progress=False)


@pytest.mark.slow
def test_departures_are_those_of_the_density():
    space = vj.FeatureSpace({
        "a": vj.Normal(1.0, 2.0),
        "b": vj.TruncatedNormal(0.0, 1.0, -1.0, 2.0),
        "c": vj.Exponential(2.0),
        "d": vj.Array(vj.Categorical("x", "y", weights=[0.9, 0.1]), 2),
        "e": vj.Signal(vj.Normal(0.0, 1.0), knots=3),
        "f": vj.Box(0.0, 4.0),
    })  # fmt: skip
    found = Improbability(space)
    points = np.random.default_rng(0).uniform(0.02, 0.98, (64, space.dim)).astype(np.float32)
    density = log_density(space, space.rows(space.features_at(points)))
    lost = density - log_density(space, space.rows(space.features_at(found.likeliest[None])))
    np.testing.assert_allclose(found.square(points).sum(axis=1), -2 * lost, atol=2e-2)
    free = list(space.cube.continuous)
    back = found.point_at(found.departure(points))
    np.testing.assert_allclose(back[:, free], points[:, free], atol=1e-3)
    step = 1e-3
    rise = (found.departure(points + step) - found.departure(points - step)) / (2 * step)
    np.testing.assert_allclose(found.slope(points)[:, free], rise[:, free], rtol=0.05, atol=0.05)


def test_searches_for_likely_failures_are_checked():
    search = Likeliest(CrossEntropy())
    assert search.wants.likelihood
    data = to_json(search)
    assert data is not None
    assert from_json(data) == search
    with pytest.raises(ValueError, match="only a search that learns"):
        Likeliest(Uniform())
    with pytest.raises(ValueError, match="leave out one of them"):
        vj.search.Likeliest(vj.search.Diverse())
    with pytest.raises(ValueError, match="leave out one of them"):
        vj.search.Diverse(vj.search.Likeliest())
    assert vj.search.named("likeliest") == Likeliest(CrossEntropy())


@pytest.mark.addons
def test_sequences_of_events_have_no_density():
    drive = vj.events.Automaton("a", {("a", "a"): {"wait": vj.Box(0.1, 1.0)}}, max_events=2)
    with pytest.raises(NoDensityError, match="the prior of drive has no density"):
        Improbability(vj.FeatureSpace({"drive": drive}))
