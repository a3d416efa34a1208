"""Every search keeps the contract on every kind of cube; names, options and refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.search import (
    CrossEntropy,
    Cube,
    Evaluated,
    Gradient,
    Halton,
    Uniform,
    named,
    names,
)
from verifai_jax.testing import check_batch_independence, check_search

# A small model says the same of the contract and compiles sooner.
SMALL = {"bayes": {"capacity": 48, "candidates": 32}}
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
    ("Grid", CUBES["wide"]): "grid",
}


@pytest.mark.parametrize("cube", CUBES.values(), ids=CUBES.keys())
@pytest.mark.parametrize("search", SEARCHES, ids=repr)
def test_contract(search, cube):
    refused = REFUSED.get((type(search).__name__, cube))
    if refused is not None:
        with pytest.raises(ValueError, match=refused):
            search.check(cube)
        return
    check_search(search, cube)


@pytest.mark.parametrize("search", [Uniform(), Halton(), Halton(scramble=True)], ids=repr)
def test_passive_searches_do_not_depend_on_the_batch(search):
    check_batch_independence(search, Cube((0, 0, 5)))


@pytest.mark.parametrize("search", [Uniform(), Halton(True), CrossEntropy(), Gradient()], ids=repr)
def test_the_key_decides(search):
    cube = Cube((0, 0))
    one, two = (search.ask(search.init(jax.random.key(k), cube, 8), cube, 8)[0] for k in (0, 1))
    assert not np.array_equal(one, two)


@pytest.mark.parametrize("search", [CrossEntropy(), Gradient()], ids=repr)
def test_active_searches_do_learn(search):
    # With the robustness turned around they go the other way.
    cube, key = Cube((0, 0)), jax.random.key(3)

    def late(sign):
        state = search.init(key, cube, 16)
        ask = jax.jit(search.ask, static_argnums=(1, 2))
        tell = jax.jit(search.tell, static_argnums=1)
        for _ in range(5):
            u, state = ask(state, cube, 16)
            rho = 3 + sign * jnp.sum(u, axis=1)
            state = tell(state, cube, Evaluated(u, rho, rho > 0, jnp.full_like(u, sign)))
        return float(jnp.mean(u))

    assert late(1.0) < 0.35
    assert late(-1.0) > 0.65


@pytest.mark.parametrize(
    ("search", "spoil"),
    [(CrossEntropy(), "uncounted"), (Gradient(), "uncounted"), (Gradient(), "nan gradient")],
    ids=str,
)
def test_useless_batches_leave_a_search_alive(search, spoil):
    cube = Cube((0, 3, 0))
    state = jax.jit(search.init, static_argnums=(1, 2))(jax.random.key(0), cube, 8)
    ask = jax.jit(search.ask, static_argnums=(1, 2))
    tell = jax.jit(search.tell, static_argnums=1)
    for _ in range(3):
        u, state = ask(state, cube, 8)
        assert np.all(np.isfinite(u))
        assert len(np.unique(np.asarray(u[:, 0]))) == 8
        state = tell(
            state,
            cube,
            Evaluated(
                u,
                jnp.full(8, jnp.nan) if spoil == "uncounted" else jnp.ones(8),
                jnp.full(8, spoil != "uncounted"),
                jnp.full((8, 3), jnp.nan),
            ),
        )


class TestNames:
    def test_all(self):
        assert {"uniform", "halton", "cross_entropy", "gradient"} < set(names())
        for name in names():
            assert named(name) == type(named(name))()
        assert named("cross_entropy", elite=0.3) == CrossEntropy(elite=0.3)

    @pytest.mark.parametrize(
        ("name", "options", "message"),
        [
            ("halten", {}, "unknown search 'halten'; did you mean 'halton'"),
            ("gradient", {"learning": 1}, "'learning'; did you mean 'learning_rate'"),
            ("uniform", {"elite": 1}, "option of search uniform 'elite'.*There is no"),
        ],
    )
    def test_misspelt(self, name, options, message):
        with pytest.raises(ValueError, match=message):
            named(name, **options)

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: Halton(scramble=1), "scramble must be True, False or None; got 1"),
            (lambda: CrossEntropy(elite=0), r"elite must be in \(0, 1\]; got 0"),
            (lambda: CrossEntropy(elite="many"), r"elite must be in \(0, 1\]; got 'many'"),
            (lambda: CrossEntropy(least_elite=1), "integer of at least 2; got 1"),
            (lambda: CrossEntropy(focus=1.5), r"focus must be in \[0, 1\]; got 1.5"),
            (lambda: CrossEntropy(exploration=0), r"exploration must be in \(0, 1\]; got 0"),
            (lambda: CrossEntropy(widening=0), "widening must be positive and finite; got 0"),
            (lambda: Gradient(learning_rate=-0.1), r"learning_rate must be in \(0, 1\]; got -0.1"),
            (lambda: Gradient(cold=0), "cold must be positive and finite; got 0"),
            (lambda: Gradient(hot=float("nan")), "hot must be positive and finite; got nan"),
            (lambda: Gradient(cooling=0), "cooling must be an integer of at least 1; got 0"),
            (lambda: Cube((0, -1)), r"levels must not be negative; got \(0, -1\)"),
        ],
    )
    def test_values_out_of_range(self, make, message):
        with pytest.raises(ValueError, match=message):
            make()
