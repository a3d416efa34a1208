"""No value is outside its interval, in either precision, and half-open ranges have no end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.features.ends import ends_within

# In single precision 61.2 is rounded up, -0.3 down, 0.1 up and 0.7 down.
INTERVALS = {
    "box": (0.0, 61.2),
    "left": (-0.3, 61.2),
    "vector[0]": (0.1, 0.9),
    "vector[1]": (-0.3, 61.2),
    "items[0]": (-0.3, 61.2),
    "items[1]": (-0.3, 61.2),
    "some[0]": (-0.3, 61.2),
    "some[1]": (-0.3, 61.2),
    "wind[0]": (-0.3, 61.2),
    "wind[1]": (-0.3, 61.2),
    "bell": (-0.3, 61.2),
    "mass": (0.9, 61.2),
    "own": (0.0, 61.2),
    "narrow": (1.0 + 1e-8, 1.0 + 2.3e-7),
}
SPACE = vj.FeatureSpace(
    {
        "box": vj.Box(0.0, 61.2),
        "left": vj.Box(-0.3, 61.2),
        "vector": vj.Box([0.1, -0.3], [0.9, 61.2]),
        "items": vj.Array(vj.Box(-0.3, 61.2), length=2),
        "some": vj.Array(vj.Box(-0.3, 61.2), length=(1, 2)),
        "wind": vj.Signal(vj.Box(-0.3, 61.2), knots=2, duration=1.0),
        "bell": vj.TruncatedNormal(0.0, 30.0, -0.3, 61.2),
        "mass": vj.LogUniform(0.9, 61.2),
        "own": vj.Distribution(lambda u: 61.2 * u, lambda x: x / 61.2, name="own"),
        "narrow": vj.Box(1.0 + 1e-8, 1.0 + 2.3e-7),
    }
)


def inside(rows):
    for name, (low, high) in INTERVALS.items():
        values = np.asarray(rows[name], np.float64)
        values = values[~np.isnan(values)]
        assert values.size, name
        assert np.all((values >= low) & (values <= high)), (name, values)


@pytest.mark.thorough
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_no_value_is_outside_in_either_precision(precision):
    with in_precision(precision):
        u = np.linspace(0, 1, 5, dtype=precision)[:, None] * np.ones(SPACE.dim, precision)
        u[1], u[3] = np.finfo(np.float32).eps, 1 - np.finfo(np.float32).eps / 2
        features = jax.jit(jax.vmap(SPACE.unflatten))(u)
        rows = SPACE.rows(jax.tree.map(np.asarray, features))
        inside(rows)
        # A row on the border comes from the border.
        back = jax.jit(jax.vmap(SPACE.flatten))(features)
        free = [i for i, name in enumerate(SPACE.coordinates) if "some" not in name]
        np.testing.assert_array_equal(np.asarray(back)[4][free], 1.0)
        free.remove(SPACE.coordinates.index("narrow"))
        np.testing.assert_array_equal(np.asarray(back)[0][free], 0.0)
    # The replay of a table's rows in another precision, and one rounding away.
    for replayed in ("float32", "float64"):
        features = SPACE.features_of(rows, replayed)
        with in_precision(replayed):
            inside(SPACE.rows(features))
            inside(SPACE.rows(SPACE.nudged(features)))
            last = {name: column[4] for name, column in rows.items()}
            again = jax.tree.map(lambda leaf: np.asarray(leaf)[None], SPACE.from_row(last))
            inside(SPACE.rows(again))


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("column", ["box", "vector[1]", "bell", "mass", "own"])
def test_an_end_that_a_person_or_a_file_wrote_is_rounded_inwards(column, precision):
    name = column.split("[")[0]
    space = vj.FeatureSpace({name: SPACE.domains[name]})
    for high in (61.2, np.float32(61.2), float(np.float32(61.2))):
        given = np.asarray([0.5, high]) if name == "vector" else high
        with in_precision(precision):
            for value in (
                space.coerce({name: given})[name],
                space.features_of(
                    {c: np.asarray([high if c == column else 0.5]) for c in space.columns},
                    precision,
                )[name],
            ):
                value = np.ravel(np.asarray(value))[-1]
                assert 61.199996 < float(value) <= 61.2
    with pytest.raises(ValueError, match=r"61\.2000"):
        space.check({name: np.asarray([0.5, 61.20001]) if name == "vector" else 61.20001})


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_sum_that_is_an_end_but_for_rounding_is_that_end(precision):
    assert 0.1 + 0.2 > 0.3
    with in_precision(precision):
        for domain in (vj.Box(0, 0.3), vj.TruncatedNormal(0, 1, -1, 0.3), vj.Box(0.1 + 0.2, 1)):
            space = vj.FeatureSpace({"x": domain})
            value = float(space.coerce({"x": 0.1 + 0.2})["x"])
            low, high = domain.ends(precision)
            assert low <= value <= high
        with pytest.raises(ValueError, match=r"must lie in \[0, 0.3\)"):
            vj.FeatureSpace({"x": vj.Box(0, 0.3, closed="left")}).check({"x": 0.1 + 0.2})


def test_a_run_and_its_table_stay_inside():
    def system(features, key):
        return vj.Trace({"x": features["x"] * jnp.ones(2)}, dt=1.0)

    problem = vj.Problem("edge", {"x": vj.Box(0, 61.2)}, system, "always x <= 61.2")
    for value in (61.2, np.float32(61.2)):
        table = vj.simulate(problem, [{"x": value}]).table.all
        assert float(table["x"][0]) <= 61.2
        assert float(table["rho"][0]) >= 0


@pytest.mark.thorough
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(
    ("closed", "has_low", "has_high"),
    [("left", True, False), ("right", False, True), ("neither", False, False)],
)
def test_half_open_ranges(closed, has_low, has_high, precision):
    box = vj.Box([0, 0.25], [1, 0.5], closed=closed)
    with in_precision(precision):
        first, last = (box.from_unit(jnp.full(2, u, precision)) for u in (0.0, 1.0))
        np.testing.assert_array_equal(first == np.array([0, 0.25]), has_low)
        np.testing.assert_array_equal(last == np.array([1, 0.5]), has_high)
        assert np.all((first >= np.array([0, 0.25])) & (last <= np.array([1, 0.5])))
        np.testing.assert_array_equal(box.to_unit(first), 0.0)
        np.testing.assert_array_equal(box.to_unit(last), 1.0)
        # The derivative leads back inside.
        slope = jax.grad(lambda u: box.from_unit(u)[0])(jnp.ones(2, precision))
        np.testing.assert_allclose(slope, [1.0, 0.0])
    brackets = {"left": r"\[0, 1\)", "right": r"\(0, 1\]", "neither": r"\(0, 1\)"}
    with pytest.raises(ValueError, match=brackets[closed]):
        box.check([0.0 if closed != "left" else 1.0, 0.3], "x")
    # Single precision has nothing between the last number and the end.
    assert float(vj.Box(0, 1, closed="left").coerce(0.999999999)) < 1


def test_half_open_ranges_keep_to_themselves():
    space = vj.FeatureSpace(
        {"a": vj.Box(0, 1), "b": vj.Box(0, 1, closed="left"), "c": vj.Box(0, 1, closed="left")}
    )
    values = space.unflatten(jnp.ones(3))
    assert [float(values[name]) < 1 for name in "abc"] == [False, True, True]
    assert vj.FeatureSpace.from_json(space.to_json()).domains == space.domains
    assert "closed" not in str(vj.FeatureSpace({"a": vj.Box(0, 1)}).to_json())
    assert vj.Box(0, 1, closed="left") != vj.Box(0, 1)


def test_what_is_wrong_is_refused_where_it_is_made():
    with pytest.raises(ValueError, match=r"lef.*did you mean 'left'"):
        vj.Box(0, 1, closed="lef")
    with pytest.raises(ValueError, match="a Box must have a float32 number inside"):
        vj.Box(1 + 1e-9, 1 + 2e-9)


def test_subnormal_ends_are_zero_or_normal_numbers():
    first, last = ends_within((-1e-40, 1e-40), (1e-40, 1.0), np.float32)
    np.testing.assert_array_equal(first, [0.0, np.finfo(np.float32).tiny])
    np.testing.assert_array_equal(last, [0.0, 1.0])


@pytest.mark.thorough
def test_a_line_between_two_knots_stays_between_them():
    high = np.float32(61.199997)
    times = np.linspace(0, 1, 301, dtype=np.float32)
    for low in (high, np.float32(0.1), -high):
        knots = jnp.asarray([low, high])
        wave = Waveform(knots, duration=1.0)
        values = np.concatenate([wave(times), wave.refined(7).knots, [wave(0.3)]])
        assert values.min() >= low
        assert values.max() <= high
        on_host = Waveform(np.asarray([low, high]), duration=1.0)
        assert all(low <= on_host(float(time)) <= high for time in times[:50])
    slope = jax.grad(lambda knots: Waveform(knots, duration=1.0)(0.25))(jnp.asarray([high, high]))
    np.testing.assert_allclose(slope, [0.75, 0.25])


@pytest.mark.thorough
def test_a_feature_fixed_at_its_end_stays_inside():
    with in_precision("float64"):
        space = vj.FeatureSpace({"x": vj.Box(0, 61.2), "y": vj.Box(0, 1)}).fixed(x=61.2)
        for precision in ("float32", "float64"):
            assert 61.199996 < float(space.unflatten(jnp.zeros(1, precision))["x"]) <= 61.2
