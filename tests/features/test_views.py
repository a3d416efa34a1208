"""Constraints, samples that honour them, and views in which some features are fixed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.features import Array, Box, Categorical, Constant, FeatureSpace, Normal, Signal

BOXES = {"x": Box(-1, 1), "y": Box(-1, 1)}


def below(f):
    return f["x"] < f["y"]


def fails(f):
    raise RuntimeError("no such road")


SPACE = FeatureSpace(BOXES, where=below)


class TestConstraints:
    def test_a_constraint_accepts_one_value_and_a_batch(self):
        assert bool(SPACE.accepts(SPACE.unflatten(jnp.array([0.2, 0.7]))))
        assert not bool(SPACE.accepts(SPACE.unflatten(jnp.array([0.7, 0.2]))))
        assert bool(FeatureSpace(BOXES).accepts({"x": 3, "y": 1}))
        u = jax.random.uniform(jax.random.key(0), (50, 2))
        many = jax.jit(jax.vmap(lambda u: SPACE.accepts(SPACE.unflatten(u))))(u)
        np.testing.assert_array_equal(many, u[:, 0] < u[:, 1])

    def test_the_rate_is_measured(self):
        assert SPACE.check_where() == SPACE.check_where(0) == pytest.approx(0.5, abs=0.05)
        assert SPACE.check_where(jax.random.key(1)) == pytest.approx(0.5, abs=0.05)
        rare = FeatureSpace(BOXES, where=lambda f: f["x"] > 0.99)
        assert rare.check_where() == pytest.approx(0.005, rel=0.3)
        assert FeatureSpace(BOXES).check_where() == 1.0

    def test_samples_are_those_of_the_prior_that_it_accepts(self):
        features = SPACE.sample(jax.random.key(0), 2000)
        assert features["x"].shape == (2000,)
        assert bool(jnp.all(features["x"] < features["y"]))
        # In the triangle x < y the means are -1/3 and 1/3, the standard deviations 0.47.
        assert float(features["x"].mean()) == pytest.approx(-1 / 3, abs=0.05)
        assert float(features["y"].mean()) == pytest.approx(1 / 3, abs=0.05)
        again = SPACE.sample(jax.random.key(0), 2000)
        np.testing.assert_array_equal(again["x"], features["x"])
        with pytest.raises(ValueError, match="positive integer; got 0"):
            SPACE.sample(jax.random.key(0), 0)

    def test_features_that_break_it(self):
        assert float(SPACE.coerce({"x": 0, "y": 1})["y"]) == 1.0
        message = r"\{'x': 1, 'y': 0\} breaks the constraint of this space, below"
        with pytest.raises(ValueError, match=message):
            SPACE.check({"x": 1, "y": 0})
        with pytest.raises(ValueError, match="breaks the constraint"):
            SPACE.coerce({"x": 1, "y": 0})

    @pytest.mark.parametrize(
        ("where", "message"),
        [
            (fails, r"test_views.py, line \d+, in fails .*: RuntimeError: no such road"),
            (lambda f: f["z"] > 0, "there is no feature 'z'. The features are x, y"),
            (
                lambda f: f["x"] > 0 and f["y"] > 0,
                "jnp.where.*join conditions by & and . instead of and and or$",
            ),
            (lambda f: np.sin(f["x"]) > 0, r"Use jnp in place of np$"),
            (lambda f: f["x"], r"must return one truth value; got shape \[\] of float32"),
            (lambda f: jnp.ones(2) > f["x"], r"one truth value; got shape \[2\] of bool"),
            (lambda f: (f["x"] > 0, f["y"] > 0), "one truth value; got tuple"),
            (lambda f: None, "one truth value; got NoneType"),
            (
                lambda f: f["x"] > 2,
                "accepted none of 65536 samples of the space, so fewer than 0.00457 %.*95 %",
            ),
        ],
    )
    def test_what_is_wrong_is_refused_where_it_is_made(self, where, message):
        space = FeatureSpace(BOXES, where=where)
        with unchecked(), pytest.raises(ValueError, match=message):
            space.check_where()

    def test_never_true_is_found_before_sampling(self):
        with pytest.raises(ValueError, match="accepted none"):
            FeatureSpace(BOXES, where=lambda f: f["x"] > 2).sample(jax.random.key(0), 3)
        with (
            unchecked(),
            pytest.raises(TypeError, match="must be a function of the features; got 3"),
        ):
            FeatureSpace(BOXES, where=3)

    def test_are_shown_and_compared(self):
        assert SPACE == FeatureSpace(BOXES, where=below) != FeatureSpace(BOXES)
        assert hash(SPACE) == hash(FeatureSpace(BOXES, where=below))
        assert repr(SPACE).endswith("}, where=below)")
        assert SPACE.describe().splitlines()[-1].split() == ["where", "below"]
        assert "<td>below</td>" in SPACE._repr_html_()
        nameless = FeatureSpace(BOXES, where=lambda f: f["x"] > 0).describe()
        assert "of test_views.py" in nameless
        assert "/" not in nameless


FULL = FeatureSpace(
    {
        "x": Box(0, 1),
        "n": Normal(0, 2),
        "alg": Categorical("ppo", "sac", weights=[0.9, 0.1]),
        "wind": Signal(Box(-1, 1), 3),
        "cars": Array(Box(0, 1), length=(0, 2)),
        "g": Constant(9.8),
    }
)
NOMINAL = {"x": 0.5, "n": 1, "alg": "sac", "wind": [0, 1, 0], "cars": [0.25]}


class TestViews:
    @pytest.mark.thorough
    def test_only_the_chosen_features_vary(self):
        view = FULL.only("wind", "x", nominal=NOMINAL)
        assert (view.dim, view.columns) == (4, FULL.columns)
        assert view.coordinates == ("x", "wind[0]", "wind[1]", "wind[2]")
        features = view.unflatten(jnp.array([0.25, 0, 0.5, 1]))
        assert [float(features["x"]), float(features["n"]), int(features["alg"])] == [0.25, 1, 1]
        assert features["wind"].knots.tolist() == [-1, 0, 1]
        assert (int(features["cars"].length), float(features["cars"][0])) == (1, 0.25)
        full = FULL.coerce({**NOMINAL, "x": 0.25, "wind": [-1, 0, 1]})
        jax.tree.map(np.testing.assert_array_equal, features, full)
        assert jax.tree.map(jax.typeof, features) == jax.tree.map(jax.typeof, full)
        np.testing.assert_allclose(view.flatten(full), [0.25, 0, 0.5, 1])

    @pytest.mark.thorough
    def test_the_table_keeps_its_columns(self):
        view = FULL.fixed(**{k: v for k, v in NOMINAL.items() if k != "x"})
        features = jax.vmap(view.unflatten)(jnp.array([[0.25], [0.75]]))
        rows = view.rows(features)
        assert tuple(rows) == FULL.columns
        assert rows["alg"].tolist() == ["sac", "sac"]
        assert rows["wind[1]"].tolist() == [1, 1]
        again = view.from_row({name: column[1] for name, column in rows.items()})
        assert (float(again["x"]), float(again["n"])) == (0.75, 1.0)
        assert view.coerce({"x": 0.25})["alg"] == 1  # What is fixed may be left out.

    def test_everything_fixed(self):
        view = FULL.fixed(**NOMINAL)
        assert (view.dim, view.columns) == (0, FULL.columns)
        assert view.flatten(view.unflatten(jnp.zeros(0))).shape == (0,)
        assert view == FULL.fixed(**NOMINAL) != FULL.fixed(**{**NOMINAL, "cars": []})
        assert hash(view) == hash(FULL.fixed(**NOMINAL))

    def test_views_of_views(self):
        view = FULL.fixed(x=0.25).fixed(x=0.75, n=0)
        assert float(view.unflatten(jnp.zeros(view.dim))["x"]) == 0.75
        assert view.only("wind", nominal=NOMINAL).dim == 3
        assert "0.75, fixed in Box(0, 1)" in view.describe()

    def test_with_a_constraint(self):
        view = SPACE.only("x", nominal={"y": 0.5})
        assert view.check_where() == pytest.approx(0.75, abs=0.05)
        assert bool(jnp.all(view.sample(jax.random.key(0), 100)["x"] < 0.5))
        with pytest.raises(ValueError, match="accepted none"):
            SPACE.fixed(x=1).check_where()

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: FULL.fixed(winds=0), "unknown feature 'winds'; did you mean 'wind'"),
            (lambda: FULL.fixed(x=7), r"x must lie in \[0, 1\]; got 7"),
            (lambda: FULL.only("winds", nominal=NOMINAL), "unknown feature 'winds'; did you mean"),
            (lambda: FULL.only("x", nominal={**NOMINAL, "ns": 1}), "unknown feature 'ns'"),
            (lambda: FULL.only("x", nominal={"n": 0}), "nominal value; alg, wind, cars have none"),
            (lambda: FULL.only(), "at least one feature that varies"),
            (
                lambda: FULL.fixed(x=0.25).check({**NOMINAL, "x": 0.5}),
                "x is fixed, 0.25; got 0.5",
            ),
        ],
    )
    def test_what_is_wrong_is_refused_where_it_is_made(self, make, message):
        with unchecked(), pytest.raises(ValueError, match=message):
            make()
