"""Every domain's laws, values known in advance, and what is refused and how."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from verifai_jax.features import Array, Box, Categorical, Constant, DiscreteBox, Struct
from verifai_jax.testing import check_domain

DOMAINS = [
    Box(-0.05, 0.05),
    Box(1e6, 1e6 + 2),
    Box([0, -1, 5], [10, 1, 5.5]),
    Box(0, 61.2, closed="left"),
    DiscreteBox(1, 4),
    DiscreteBox(-3, -3),
    DiscreteBox(0, 2**20 - 1),
    DiscreteBox([0, 0], [3, 5]),
    DiscreteBox([-(2**31), 7], [-(2**31) + 9, 7]),
    Array(DiscreteBox([1, 2, 3], [3, 2, 5]), length=2),
    Categorical("ppo", "sac"),
    Categorical(0.1, 0.25, 7),
    Categorical(3, 1, 2),
    Categorical(True, False),
    Categorical(None, 0.5, "auto"),
    Constant(9.8),
    Constant("red"),
    Constant([1, 2, 3]),
    Struct({"b": Box(0, 1), "a": Box(2, 3), "n": DiscreteBox(1, 2), "k": Constant(1)}),
    Array(Box(0, 1), length=3),
    Array(Categorical("r", "g", "b"), length=2),
    Array(Array(DiscreteBox(0, 1), length=2), length=3),
    Array(Struct({"x": Box(0, 50), "p": Box([0, 0], [1, 2]), "c": Constant(4)}), length=2),
]


@pytest.mark.thorough
@pytest.mark.parametrize("domain", DOMAINS, ids=repr)
def test_the_laws_of_domains_hold(domain):
    check_domain(domain)


@pytest.mark.parametrize("domain", DOMAINS, ids=repr)
def test_printed_as_written(domain):
    names = {c.__name__: c for c in (Array, Box, Categorical, Constant, DiscreteBox, Struct)}
    assert eval(repr(domain), names) == domain


@pytest.mark.thorough
def test_laws_hold_in_float64():
    with jax.enable_x64():
        for domain in (Box([0, -1, 5], [10, 1, 5.5]), DOMAINS[-1]):
            u = np.random.default_rng(0).random(domain.size)
            value = domain.from_unit(jnp.asarray(u))
            back = domain.to_unit(value)
            continuous = np.array(domain.levels) == 0
            np.testing.assert_allclose(back[continuous], u[continuous], atol=1e-9)
        assert Box(0.1, 0.3).from_unit(jnp.ones(1)).dtype == jnp.float64
        # The precision of u decides, not the mode JAX runs in.
        assert Box(0.1, 0.3).from_unit(jnp.ones(1, jnp.float32)).dtype == jnp.float32
        assert float(Box(0.1, 0.3).from_unit(jnp.ones(1))) == 0.3


class TestKnownValues:
    def test_box(self):
        box = Box(-2, 6)
        assert float(box.from_unit(jnp.array([0.25]))) == 0.0
        assert float(box.to_unit(jnp.float32(4.0))[0]) == 0.75
        np.testing.assert_array_equal(
            Box([0, 10], [1, 30]).from_unit(jnp.array([0.5, 0.25])), [0.5, 15.0]
        )

    def test_discrete(self):
        die = DiscreteBox(1, 6)
        u = jnp.array([0.0, 1 / 6 - 1e-4, 1 / 6 + 1e-4, 0.5, 0.999, 1.0])
        values = jax.vmap(die.from_unit)(u[:, None])
        assert values.tolist() == [1, 1, 2, 4, 6, 6]
        assert values.dtype == jnp.int32
        assert float(die.to_unit(jnp.int32(1))[0]) == pytest.approx(1 / 12)

    def test_vectors_of_integers(self):
        domain = DiscreteBox([0, -2], [3, 5])
        assert domain.levels == (4, 8)
        assert domain.columns("at") == ("at[0]", "at[1]")
        value = domain.from_unit(jnp.array([0.5, 1.0]))
        assert (value.tolist(), value.dtype) == ([2, 5], jnp.int32)
        np.testing.assert_allclose(domain.to_unit(value), [2.5 / 4, 7.5 / 8])
        np.testing.assert_array_equal(domain.coerce((1, -1)), [1, -1])
        rows = domain.to_columns(np.array([[2, 5], [0, -2]], np.int32), "at")
        assert {name: rows[name].tolist() for name in rows} == {"at[0]": [2, 0], "at[1]": [5, -2]}
        stored = domain.from_columns({"at[0]": 2, "at[1]": 5.0}, "at")
        assert (stored.tolist(), stored.dtype) == ([2, 5], jnp.int32)
        assert DiscreteBox.from_intervals((0, 3), (5, -2.5)) == domain
        assert DiscreteBox(np.array([0, -2]), np.array([3, 5])) == domain

    def test_choices(self):
        u = jnp.array([[0.1], [0.5], [1.0]])
        assert jax.vmap(Categorical("a", "b").from_unit)(u).tolist() == [0, 1, 1]
        numbers = jax.vmap(Categorical(0.5, 8, 2).from_unit)(u)
        assert numbers.tolist() == [0.5, 8.0, 2.0]
        assert numbers.dtype == jnp.float32
        assert jax.vmap(Categorical(7, 5).from_unit)(u).dtype == jnp.int32
        assert jax.vmap(Categorical(False, True).from_unit)(u).tolist() == [False, True, True]

    def test_the_table_shows_choices(self):
        def shown(domain, values):
            return domain.to_columns(np.array(values), "c")["c"].tolist()

        assert shown(Categorical("a", "b"), [1, 0]) == ["b", "a"]
        assert shown(Categorical(0.1, 0.2), np.float32([0.2, 0.1])) == [0.2, 0.1]
        assert shown(Categorical(None, 3), [0, 1]) == ["None", "3"]

    def test_the_prior_is_uniform_on_the_cube(self):
        u = jax.random.uniform(jax.random.key(0), (6000, 1))
        counts = np.bincount(jax.vmap(Categorical("a", "b", "c").from_unit)(u))
        # Binomial standard deviation 36.5; five of them.
        assert np.all(np.abs(counts - 2000) < 183)

    def test_gradients_reach_the_corner(self):
        slope = jax.vmap(jax.grad(lambda u: Box(-1, 3).from_unit(u[None])))
        np.testing.assert_allclose(slope(jnp.array([0.0, 0.3, 0.5, 0.9, 1.0])), 4.0, rtol=1e-6)

    def test_compound_values_keep_the_order_written(self):
        struct = Struct({"b": Box(0, 1), "a": Box(0, 10), "n": DiscreteBox(0, 9)})
        value = struct.from_unit(jnp.array([0.5, 0.5, 0.95]))
        assert list(value) == ["b", "a", "n"]
        assert [float(leaf) for leaf in value.values()] == [0.5, 5.0, 9]
        assert struct.columns("s") == ("s.b", "s.a", "s.n")
        assert struct["a"] == Box(0, 10)

    def test_arrays_are_stacked(self):
        cars = Array(Struct({"x": Box(0, 50), "v": Box([0, 0], [1, 1])}), length=2)
        value = cars.from_unit(jnp.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
        np.testing.assert_allclose(value["x"], [5, 20], rtol=1e-6)
        np.testing.assert_allclose(value["v"], [[0.2, 0.3], [0.5, 0.6]], rtol=1e-6)
        assert cars.columns("cars") == (
            "cars[0].x", "cars[0].v[0]", "cars[0].v[1]", "cars[1].x", "cars[1].v[0]", "cars[1].v[1]"
        )  # fmt: skip


finite = st.floats(-1e6, 1e6, width=32, allow_subnormal=False)
boxes = (
    st.tuples(finite, finite)
    .map(sorted)
    .filter(lambda e: e[1] - e[0] > 1e-37)
    .map(lambda e: Box(*e))
)
units = st.floats(0, 1, width=32, allow_subnormal=False)


@given(boxes, units)
@settings(max_examples=60, deadline=None)
def test_box_round_trips(box, u):
    value = float(box.from_unit(jnp.float32([u])))
    assert box.low <= value <= box.high
    eps = 4 * np.finfo(np.float32).eps
    scale = max(abs(box.low), abs(box.high))
    back = box.to_unit(jnp.float32(value))
    assert 0 <= float(back[0]) <= 1
    # A unit coordinate cannot be told more exactly than the values are apart.
    assert abs(float(back[0]) - u) <= eps * (1 + scale / (box.high - box.low))
    assert abs(float(box.from_unit(back)) - value) <= eps * scale


@given(st.integers(-(2**31), 2**31 - 2**20), st.integers(1, 2**20), st.data())
@settings(max_examples=60, deadline=None)
def test_integers_round_trip(low, count, data):
    domain = DiscreteBox(low, low + count - 1)
    value = data.draw(st.integers(low, low + count - 1))
    assert int(domain.from_unit(domain.to_unit(jnp.int32(value)))) == value


scalars = st.one_of(st.integers(-1000, 1000), st.floats(-1e3, 1e3, width=32), st.text(max_size=3))


@pytest.mark.thorough
@given(st.lists(scalars, min_size=1, max_size=6, unique_by=str), st.data())
@settings(max_examples=60, deadline=None)
def test_choices_round_trip(choices, data):
    numbers = [np.float32(choice) for choice in choices if not isinstance(choice, str)]
    assume(len(set(numbers)) == len(numbers))  # 1 and 1.0 are one choice
    # Compiled programs take numbers too small to be normal for zero.
    assume(all(n == 0 or abs(n) > 1e-37 for n in numbers))
    domain = Categorical(*choices)
    place = data.draw(st.integers(0, len(choices) - 1))
    value = domain.from_unit(jnp.float32([(place + 0.5) / len(choices)]))
    assert domain.numeric == all(not isinstance(c, str) for c in choices)
    assert (value == choices[place]) if domain.numeric else (int(value) == place)
    shown = domain.to_columns(np.asarray(value)[None], "c")
    assert shown["c"][0] == (choices[place] if domain.numeric else str(choices[place]))
    stored = domain.from_columns({"c": shown["c"][0]}, "c")
    assert (stored, stored.dtype) == (value, value.dtype)
    assert int(domain.to_unit(stored)[0] * len(choices)) == place


class TestRefused:
    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: Box(3, 1), r"low must be below high in a Box; got \(low=3, high=1\)"),
            (lambda: Box(2, 2), r"zero width has one value: use Constant\(2\); got \(low=2, high"),
            (lambda: Box(0, float("nan")), r"must be finite; got \(low=0, high=nan\)"),
            (lambda: Box(0, float("inf")), "must be finite"),
            (lambda: Box(-3e38, 3e38), "fit into float32"),
            (lambda: Box(0, 1e-42), "fit into float32, as must its width"),
            (lambda: Box("a", 1), "low of a Box must be a number; got 'a'"),
            (lambda: Box(False, True), "low of a Box must be a number; got False"),
            (lambda: Box([0, 0], [1]), r"one length; got \(low=\[0, 0\], high=\[1\]\)"),
            (lambda: Box(0, [1, 2]), "both ends of a Box are numbers, or both are sequences"),
            (lambda: Box([0, 3], [1, 2]), r"below high in a Box; got \(low=\[0, 3\]"),
            (lambda: Box([], []), "at least one entry"),
            (lambda: DiscreteBox(4, 1), r"not be above high.*got \(low=4, high=1\)"),
            (lambda: DiscreteBox(0.2, 3), r"must be integers; got \(low=0.2, high=3\)"),
            (lambda: DiscreteBox(0, float("nan")), "must be integers"),
            (lambda: DiscreteBox(0, [1, 2]), "both ends of a DiscreteBox are numbers, or both are"),
            (lambda: DiscreteBox([0], [1, 2]), r"one length; got \(low=\[0\], high=\[1, 2\]\)"),
            (lambda: DiscreteBox([], []), "a vector DiscreteBox needs at least one entry"),
            (lambda: DiscreteBox([0, 4], [1, 2]), r"not be above high.*got \(low=\[0, 4\]"),
            (lambda: DiscreteBox([0, 0.5], [1, 2]), r"must be integers; got \(low=\[0, 0.5\]"),
            (lambda: DiscreteBox([0, 0], [1, 2**20]), "at most 1048576 values"),
            (lambda: DiscreteBox.from_intervals((0, 1, 2)), "an interval is a pair of numbers"),
            (lambda: DiscreteBox(0, 2**31), "fit into 32 bits"),
            (lambda: DiscreteBox(0, 2**20), "at most 1048576 values"),
            (lambda: Categorical(), "at least one choice; got none"),
            (lambda: Categorical(["a", "b"]), r"one by one.*got \['a', 'b'\]"),
            (lambda: Categorical("a", "b", "a"), "'a' is given twice in 'a', 'b', 'a'"),
            (lambda: Categorical(1, True), "True is given twice"),
            (lambda: Categorical(1.0, float("inf")), "must be finite.*got inf"),
            (lambda: Constant(float("nan")), "finite number.*got nan"),
            (lambda: Constant(object()), "finite number, an array of them, or a text"),
            (lambda: Constant([[1], [2, 3]]), "finite number"),
            (lambda: Struct({}), "at least one field"),
            (lambda: Struct({"": Box(0, 1)}), "must be a text; got ''"),
            (lambda: Struct({"x": (0, 1)}), r"x must be a domain, such as Box.*got \(0, 1\)"),
            (lambda: Struct({"x": {"y": Box(0, 1)}}), "a dictionary of them goes into Struct"),
            (lambda: Struct([Box(0, 1)]), "as a dictionary of domains"),
            (lambda: Array(Box(0, 1), length=0), "positive integer; got 0"),
            (lambda: Array(Box(0, 1), length=(3, 1)), r"0 <= shortest <= longest.*got \(3, 1\)"),
            (lambda: Array(Box(0, 1), length=(1, 2, 3)), r"a pair of integers.*got \(1, 2, 3\)"),
            (lambda: Array(Box(0, 1), length=1.5), "positive integer; got 1.5"),
            (lambda: Array(3, length=2), "an Array needs a domain, such as Box.*got 3"),
        ],
    )
    def test_where_it_is_made(self, make, message):
        with unchecked(), pytest.raises((ValueError, TypeError), match=message):
            make()

    @pytest.mark.parametrize(
        ("domain", "value", "message"),
        [
            (Box(-1, 1), 1.5, r"^f must lie in \[-1, 1\]; got 1.5"),
            (Box(-1, 1), float("nan"), "got nan"),
            (Box(-1, 1), "fast", "f must be a number; got 'fast'"),
            (Box(-1, 1), [0, 0], r"f must have shape \[\]; got \[2\]"),
            (Box([0, 0], [1, 1]), [0, 2], r"f\[1\] must lie in \[0, 1\]; got 2"),
            (DiscreteBox(1, 4), 2.5, "f must be an integer from 1 to 4; got 2.5"),
            (DiscreteBox(1, 4), 5, "f must be an integer from 1 to 4; got 5"),
            (Categorical("a", "b"), "c", "f must be one of 'a', 'b'; got 'c'"),
            (Categorical("a", "b"), 2, "f must be one of 'a', 'b'; got 2"),
            (Categorical(0.1, 0.2), 0.15, "f must be one of 0.1, 0.2; got 0.15"),
            (Constant(3), 4, "f is a constant, 3; got 4"),
            (Struct({"x": Box(0, 1)}), {"y": 0}, "unknown feature 'f.y'.*Known: f.x"),
            (Struct({"x": Box(0, 1), "y": Box(0, 1)}), {"x": 0}, "f.y is missing"),
            (Struct({"x": Box(0, 1)}), 0.5, "f must be a dictionary; got 0.5"),
            (Array(Box(0, 1), length=3), [0, 1], r"f must have 3 entries; got \[0, 1\]"),
            (Array(Box(0, 1), length=2), [0, 7], r"f\[1\] must lie in \[0, 1\]; got 7"),
            (
                Array(Struct({"x": Box(0, 1)}), length=2),
                {"x": [0.5, -1]},
                r"f\[1\].x must lie in \[0, 1\]; got -1",
            ),
        ],
    )
    def test_values_outside(self, domain, value, message):
        with pytest.raises(ValueError, match=message):
            domain.check(value, "f")

    @pytest.mark.thorough
    def test_what_a_person_writes_is_taken(self):
        cars = Array(Struct({"x": Box(0, 1), "color": Categorical("r", "g")}), length=2)
        written = {"x": [0.25, 1], "color": ["g", "r"]}
        cars.check(written, "cars")
        value = cars.coerce(written)
        assert value["color"].tolist() == [1, 0]
        np.testing.assert_allclose(cars.to_unit(value), [0.25, 0.75, 1.0, 0.25])
        # float32(0.1) is above 0.1, and still inside.
        Box(0, 0.1).check(np.float32(0.1), "f")
        Categorical(0.1, 0.2).check(np.float32(0.1), "f")
