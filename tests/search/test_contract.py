"""Every search keeps the contract on every kind of cube; names, options and refusals."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from playing import tell_of

from verifai_jax.core.values.cube import Cube
from verifai_jax.search import (
    CrossEntropy,
    Descent,
    Gradient,
    Halton,
    Mutation,
    Uniform,
    named,
    names,
)
from verifai_jax.testing import check_batch_independence, check_search

# A small model says the same of the contract and compiles sooner.
SMALL = {
    "bayes": {"capacity": 48, "candidates": 32},
    "turbo": {"capacity": 48, "candidates": 32},
    "trace_surrogate": {"capacity": 48},
}
SEARCHES = [named(name, **SMALL.get(name, {})) for name in names()]
CUBES = {
    "empty": Cube(()),
    "continuous": Cube((0, 0, 0)),
    "mixed": Cube((0, 4, 0, 1, 1000)),
    "discrete": Cube((3, 2)),
    "weighted": Cube((3, 0, 2), weights=((0.7, 0.2, 0.1), None, None), ordered=(False, True, True)),
    "wide": Cube((0,) * 200),
}


REFUSED = {
    ("Gradient", CUBES["discrete"]): "at least one continuous feature; all 2 unit",
    ("Descent", CUBES["discrete"]): "at least one continuous feature; all 2 unit",
    ("Grid", CUBES["wide"]): "grid",
}


# These take seconds to compile for each cube; what is continuous alone is so in the wide one.
LARGE = ("Bandit", "Bayes", "Diverse", "Portfolio", "TuRBO", "TraceSurrogate")
QUICK = ("mixed",)
EACH = [
    pytest.param(
        search,
        cube,
        id=f"{search!r}-{name}",
        marks=pytest.mark.slow if type(search).__name__ in LARGE and name not in QUICK else (),
    )
    for search in SEARCHES
    for name, cube in CUBES.items()
    if not (type(search).__name__ in LARGE and name == "continuous")
]


@cache
def compiled(search):
    """Its `init`, `ask` and `tell`: call by call, hundreds of small programs would compile."""
    return (
        jax.jit(search.init, static_argnums=(1, 2)),
        jax.jit(search.ask, static_argnums=(1, 2)),
        jax.jit(search.tell, static_argnums=1),
    )


@pytest.mark.thorough
@pytest.mark.parametrize(("search", "cube"), EACH)
def test_the_contract_of_searches_holds(search, cube):
    refused = REFUSED.get((type(search).__name__, cube))
    if refused is not None:
        with unchecked(), pytest.raises(ValueError, match=refused):
            search.check(cube)
        return
    check_search(search, cube)


@pytest.mark.thorough
@pytest.mark.parametrize("search", [Uniform(), Halton(), Halton(scramble=True)], ids=repr)
def test_passive_searches_do_not_depend_on_the_batch(search):
    check_batch_independence(search, Cube((0, 0, 5)))


@pytest.mark.thorough
@pytest.mark.parametrize("search", [Uniform(), Halton(True), CrossEntropy(), Gradient()], ids=repr)
def test_the_key_decides(search):
    cube, (init, ask, _) = Cube((0, 0)), compiled(search)
    one, two = (ask(init(jax.random.key(k), cube, 8), cube, 8)[0] for k in (0, 1))
    assert not np.array_equal(one, two)


@pytest.mark.thorough
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_one_clause_is_taken_to_its_corner_at_once(sign):
    cube, search, key = Cube((0, 0, 0)), Gradient(), jax.random.key(3)
    init, ask, tell = compiled(search)
    u, state = ask(init(key, cube, 1), cube, 1)
    np.testing.assert_array_equal(u, 0.5)
    slope = sign * jnp.array([[1.0, 2.0, 3.0]])
    state = tell(state, cube, tell_of(search, state, cube, u, jnp.ones(1), slope))
    u, state = ask(state, cube, 1)
    np.testing.assert_array_equal(u, 0.5 - 0.5 * sign)


@pytest.mark.thorough
@pytest.mark.parametrize("search", [CrossEntropy()], ids=repr)
def test_active_searches_do_learn(search):
    # With the robustness turned around they go the other way.
    cube, key = Cube((0, 0)), jax.random.key(3)

    def late(sign):
        init, ask, tell = compiled(search)
        state = init(key, cube, 16)
        for _ in range(5):
            u, state = ask(state, cube, 16)
            rho = 3 + sign * jnp.sum(u, axis=1)
            told = tell_of(search, state, cube, u, rho, jnp.full_like(u, sign))
            state = tell(state, cube, told)
        return float(jnp.mean(u))

    assert late(1.0) < 0.35
    assert late(-1.0) > 0.65


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("search", "spoil"),
    [
        (CrossEntropy(), "invalid"),
        (Gradient(), "invalid"),
        (Gradient(), "nan gradient"),
        (Descent(), "invalid"),
        (Descent(), "nan gradient"),
    ],
    ids=str,
)
def test_useless_batches_leave_a_search_alive(search, spoil):
    cube = Cube((0, 3, 0))
    init, ask, tell = compiled(search)
    state = init(jax.random.key(0), cube, 8)
    for _ in range(3):
        u, state = ask(state, cube, 8)
        assert np.all(np.isfinite(u))
        planned = int(search.plan(state, cube, 8).rows) if search.wants.clauses else 8
        assert len(np.unique(np.asarray(u[:planned, 0]))) == planned
        rho = jnp.full(8, jnp.nan) if spoil == "invalid" else jnp.ones(8)
        told = tell_of(search, state, cube, u, rho, jnp.full((8, 3), jnp.nan))
        valid = told.valid & (spoil != "invalid")
        state = tell(state, cube, told._replace(valid=valid))


class TestNames:
    def test_every_name_makes_its_search(self):
        assert {"uniform", "halton", "cross_entropy", "gradient"} < set(names())
        for name in names():
            assert named(name) == type(named(name))()
        assert named("cross_entropy", elite=0.3) == CrossEntropy(elite=0.3)

    @pytest.mark.parametrize(
        ("name", "options", "message"),
        [
            ("halten", {}, "unknown search 'halten'; did you mean 'halton'"),
            ("gradient", {"descent": 1}, "'descent'; did you mean 'descents'"),
            ("uniform", {"elite": 1}, "option of search uniform 'elite'.*There is no"),
        ],
    )
    def test_a_misspelt_search_or_option_is_named(self, name, options, message):
        with unchecked(), pytest.raises(ValueError, match=message):
            named(name, **options)

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: Halton(scramble=1), "scramble must be True, False or None; got 1"),
            (lambda: CrossEntropy(elite=0), r"elite must be in \(0, 1\]; got 0"),
            (lambda: CrossEntropy(elite="many"), r"elite must be in \(0, 1\]; got 'many'"),
            (lambda: CrossEntropy(min_elite=1), "integer of at least 2; got 1"),
            (lambda: CrossEntropy(focus=1.5), r"focus must be in \[0, 1\]; got 1.5"),
            (lambda: CrossEntropy(exploration=0), r"exploration must be in \(0, 1\]; got 0"),
            (lambda: CrossEntropy(widening=0), "widening must be positive and finite; got 0"),
            (lambda: Gradient(shrinks=-0.1), r"shrinks must be in \(0, 1\]; got -0.1"),
            (lambda: Gradient(shrinks=1), "shrinks must be less than 1; got 1"),
            (lambda: Gradient(coldest=0), "coldest must be positive and finite; got 0"),
            (lambda: Gradient(temperatures=(0.1, float("nan"))), "temperatures must be positive"),
            (lambda: Gradient(temperatures=()), "temperatures must have at least one entry"),
            (lambda: Gradient(descents=0), "descents must be an integer of at least 1; got 0"),
            (lambda: Descent(kept=0), r"kept must be in \(0, 1\]; got 0"),
            (lambda: Descent(hottest=0), "hottest must be positive and finite; got 0"),
            (lambda: Mutation(kept=3), "kept must be an integer of at least 6; got 3"),
            (lambda: Cube((0, -1)), r"levels must not be negative; got \(0, -1\)"),
        ],
    )
    def test_values_out_of_range(self, make, message):
        with unchecked(), pytest.raises(ValueError, match=message):
            make()
