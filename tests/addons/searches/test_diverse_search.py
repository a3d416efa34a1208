"""A search that is kept away from what it has found: the contract, the modes, distinct points."""

import math
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.addons.searches.diverse import Diverse, Points
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import CrossEntropy, Gradient, Observations, Search, Uniform, Wants
from verifai_jax.search.distances import apart, distinct
from verifai_jax.testing import check_search

MIXED = Cube((0, 4, 0, 3), ordered=(True, True, True, False))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("search", "cube"),
    [
        (CrossEntropy(), MIXED),
        (Uniform(), Cube((0, 0, 0))),
        pytest.param(CrossEntropy(), Cube((0, 0, 0)), marks=pytest.mark.thorough),
        pytest.param(Uniform(), MIXED, marks=pytest.mark.thorough),
        pytest.param(CrossEntropy(), Cube(()), marks=pytest.mark.thorough),
    ],
    ids=str,
)
def test_the_contract_of_searches_holds(search, cube):
    check_search(Diverse(search, capacity=8), cube)


class Descent(Search):
    """The plainest search with gradients."""

    wants = Wants(gradient=True)

    def init(self, key, cube, batch):
        return key, jax.random.uniform(key, (batch, cube.dim))

    def ask(self, state, cube, batch):
        return state[1], state

    def tell(self, state, cube, observations):
        step = jnp.where(observations.usable[:, None], observations.gradient, 0.0)
        return state[0], jnp.clip(state[1] - 0.1 * step, 0, 1)

    def warm_start(self, state, cube, observations):
        return state

    def temperature(self, state):
        return jnp.float32(0.1)


@pytest.mark.slow
def test_contract_with_gradients():
    check_search(Diverse(Descent(), capacity=8), Cube((0, 0)))


def test_it_is_what_the_search_inside_is():
    assert Diverse(Descent()).wants.gradient
    assert not Diverse(CrossEntropy()).wants.gradient
    assert Diverse(Gradient()).wants.clauses == Gradient().wants.clauses
    assert Diverse(Uniform()).samples_prior
    assert Diverse(Uniform()).learns


def test_what_cannot_work_is_refused_with_the_reason():
    with (
        unchecked(),
        pytest.raises(TypeError, match=r"Diverse needs a search like CrossEntropy\(\); got 'ce'"),
    ):
        Diverse("ce")
    with unchecked(), pytest.raises(ValueError, match=r"radius must be in \(0, 1\]; got 2"):
        Diverse(Uniform(), radius=2)
    with (
        unchecked(),
        pytest.raises(ValueError, match=r"min_radius must be at most radius, 0.1; got 0.2"),
    ):
        Diverse(Uniform(), radius=0.1, min_radius=0.2)
    with (
        unchecked(),
        pytest.raises(ValueError, match="patience must be an integer of at least 1; got 0"),
    ):
        Diverse(Uniform(), patience=0)


def balls(d, count, seed, largest, smallest):
    """Centres and radii of failing balls, unequal in size, a fifth apart or more."""
    rng, centres = np.random.default_rng(seed), []
    while len(centres) < count:
        centre = rng.uniform(0.15, 0.85, d)
        if all(np.linalg.norm(centre - other) > 0.2 * math.sqrt(d) for other in centres):
            centres.append(centre)
    radii = np.linspace(largest, smallest, count) * math.sqrt(d)
    return np.array(centres, np.float32), radii.astype(np.float32)


def modes_found(search, d, count, batch, rounds, seeds, after):
    """How many of the balls are met by the first `after` failures, or by the archive."""
    cube = Cube((0,) * d)

    def one(centres, radii, key):
        def rho(u):
            return jnp.min(jnp.linalg.norm(u - centres + 1e-9, axis=1) - radii)

        def step(state, _):
            u, state = search.ask(state, cube, batch)
            value = jax.vmap(rho)(u)
            told = Observations(u, value, jnp.ones(batch, bool))
            return search.tell(state, cube, told), (u, value)

        state, (u, value) = jax.lax.scan(step, search.init(key, cube, batch), None, length=rounds)
        if isinstance(search, Diverse):
            points, known = state.archive, jnp.arange(search.capacity) < state.count
        else:
            points, value = u.reshape(-1, d), value.reshape(-1)
            known = (value < 0) & (jnp.cumsum(value < 0) <= after)
        near = jnp.linalg.norm(points[:, None] - centres, axis=2) < radii
        return jnp.sum(jnp.any(near & known[:, None], axis=0))

    cases = [balls(d, count, seed, 0.06, 0.03) for seed in range(seeds)]
    centres, radii = (np.stack(part) for part in zip(*cases, strict=True))
    keys = jax.random.split(jax.random.key(5), seeds)
    return np.asarray(jax.jit(jax.vmap(one))(centres, radii, keys))


@pytest.mark.slow
def test_all_modes_are_found_where_the_plain_search_finds_few():
    d, count = 4, 6
    plain = modes_found(CrossEntropy(), d, count, 32, 120, 10, after=100)
    diverse = modes_found(Diverse(CrossEntropy(), capacity=64), d, count, 32, 120, 10, after=100)
    assert plain.mean() <= 3
    assert diverse.mean() >= 5.5
    assert np.sum(diverse == count) >= 7


@pytest.mark.proves
@pytest.mark.parametrize(("d", "count", "least"), [(2, 5, 4.8), (3, 8, 7.0), (10, 2, 1.5)])
def test_modes_in_other_dimensions(d, count, least):
    found = modes_found(Diverse(CrossEntropy(), capacity=64), d, count, 32, 200, 20, after=100)
    assert found.mean() >= least


@cache
def compiled_tell(search):
    return jax.jit(search.tell, static_argnums=1)


def told(search, state, cube, u, rho, gradient=None):
    u, rho = jnp.asarray(u, jnp.float32), jnp.asarray(rho, jnp.float32)
    return compiled_tell(search)(
        state, cube, Observations(u, rho, jnp.ones(len(u), bool), gradient)
    )


@pytest.mark.thorough
def test_the_archive_holds_failures_that_are_apart():
    cube, search = Cube((0, 0)), Diverse(Uniform(), radius=0.2, capacity=3)
    state = search.init(jax.random.key(0), cube, 4)
    u = [[0.1, 0.1], [0.15, 0.1], [0.9, 0.9], [0.5, 0.5]]
    state = told(search, state, cube, u, [-1.0, -2.0, -1.0, 1.0])
    assert int(Diverse.count(state)) == 2
    kept = Diverse.archive(state)
    assert np.any(np.isclose(kept, 0.9).all(axis=1))
    # Full is full.
    corners = [[0.0, 0.9], [0.9, 0.0], [0.5, 0.5], [0.5, 0.0]]
    state = told(search, state, cube, corners, [-1.0] * 4)
    assert int(Diverse.count(state)) == 3


@pytest.mark.thorough
def test_what_is_near_a_failure_is_told_as_worse_than_safe():
    cube, search = Cube((0, 0)), Diverse(CrossEntropy(), radius=0.2)
    state = search.init(jax.random.key(0), cube, 4)
    u = jnp.array([[0.2, 0.2], [0.25, 0.2], [0.35, 0.2], [0.9, 0.9]], jnp.float32)
    rho = jnp.array([-1.0, -0.5, 0.1, 0.3], jnp.float32)
    state = told(search, state, cube, u, rho)
    seen = search._deflate(state, cube, Observations(u, rho, jnp.ones(4, bool)))
    assert float(seen.rho[0]) > float(seen.rho[1]) > 0.3
    assert float(seen.rho[2]) > 0.1
    assert float(seen.rho[3]) == np.float32(0.3)


@pytest.mark.slow
def test_the_gradient_is_that_of_the_raised_robustness():
    cube, search = Cube((0, 0, 0)), Diverse(Descent(), radius=0.3)
    state = search.init(jax.random.key(0), cube, 4)
    first = jnp.full((4, 3), 0.3, jnp.float32)
    state = told(search, state, cube, first, [-1.0] * 4, jnp.zeros((4, 3)))

    def rho(u):
        return jnp.sum(u**2) + 0.2

    u = jax.random.uniform(jax.random.key(1), (4, 3), jnp.float32)
    told_of = Observations(u, jax.vmap(rho)(u), jnp.ones(4, bool), jax.vmap(jax.grad(rho))(u))
    seen = search._deflate(state, cube, told_of)
    wanted = jax.vmap(
        jax.grad(lambda p: search._raise(state, cube, Points(p[None], None), rho(p)[None])[0])
    )(u)
    assert seen.gradient is not None
    np.testing.assert_allclose(seen.gradient, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_clauses_and_their_gradients_are_raised_alike():
    cube, search = Cube((0, 0, 0)), Diverse(Uniform(), radius=0.3)
    state = search.init(jax.random.key(0), cube, 4)
    state = told(search, state, cube, jnp.full((4, 3), 0.3), [-1.0] * 4)

    def clauses(u):
        return jnp.stack([jnp.sum(u**2), u[0] - 2.0, jnp.float32(-1e9)])

    u = jax.random.uniform(jax.random.key(1), (4, 3), jnp.float32)
    seen = search._deflate(
        state,
        cube,
        Observations(
            u,
            jnp.ones(4),
            jnp.ones(4, bool),
            clauses=jax.vmap(clauses)(u),
            clause_gradients=jax.vmap(jax.jacobian(clauses))(u),
        ),
    )

    def raised(point):
        near, _ = search._nearness(state, cube, Points(point[None], None))
        return jnp.where(
            near[0] > 0, jnp.maximum(clauses(point)[:2], 0) + near[0], clauses(point)[:2]
        )

    assert seen.clauses is not None
    assert seen.clause_gradients is not None
    np.testing.assert_allclose(seen.clauses[:, :2], jax.vmap(raised)(u), rtol=1e-5)
    assert np.all(np.asarray(seen.clauses[:, 2]) == -1e9)
    np.testing.assert_allclose(
        seen.clause_gradients[:, :2], jax.vmap(jax.jacobian(raised))(u), rtol=1e-4, atol=1e-5
    )


@pytest.mark.thorough
def test_the_radius_shrinks_when_nothing_new_comes():
    cube, search = Cube((0, 0)), Diverse(Uniform(), radius=0.2, patience=3, shrink=0.5)
    state = search.init(jax.random.key(0), cube, 2)
    u = jnp.full((2, 2), 0.4)
    radii = []
    for _ in range(12):
        state = told(search, state, cube, u, [1.0, 1.0])
        radii.append(float(state.radius))
    assert radii[0] == pytest.approx(0.2)
    assert radii[-1] <= 0.05
    assert min(radii) >= search.min_radius


@pytest.mark.thorough
def test_distances_count_places_and_choices():
    cube = Cube((0, 3, 4), ordered=(True, True, False))
    one, other = jnp.array([[0.2, 0.1, 0.1]]), jnp.array([[0.5, 0.9, 0.9]])
    assert float(apart(cube, one, other)[0, 0]) == pytest.approx(math.sqrt((0.09 + 1 + 1) / 3))
    assert float(apart(cube, one, one)[0, 0]) == 0.0


@pytest.mark.thorough
def test_distinct_points():
    points = np.array([[0.1, 0.1], [0.11, 0.1], [0.8, 0.8], [0.1, 0.12]])
    assert distinct(points, 0.1).tolist() == [0, 2]
    assert distinct(points, 0.1, order=[3, 2, 1, 0]).tolist() == [3, 2]
    assert distinct(points, 1e-4).tolist() == [0, 1, 2, 3]
