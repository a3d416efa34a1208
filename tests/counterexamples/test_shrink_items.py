"""Items of arrays: shrinking starts from those of nominal, and lists what rebuilds a failure."""

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.counterexamples.nominal import Nominal

CAR = vj.Struct({"x": vj.Box(0, 1000), "v": vj.Box(0, 40)})
SPACE = {"cars": vj.Array(CAR, length=(0, 4)), "b": vj.Box(0, 1)}
NOMINAL = {"cars": [{"x": 100.0, "v": 10.0}, {"x": 200.0, "v": 12.0}], "b": 0.5}
FAST, SLOW = {"x": 50.0, "v": 35.0}, {"x": 50.0, "v": 5.0}


def system(features, key):
    cars = features["cars"]
    fastest = jnp.max(jnp.where(cars.mask, cars.values["v"], 0.0))
    signals = {"fastest": fastest, "many": jnp.sum(cars.mask), "b": features["b"]}
    return vj.Trace({name: jnp.full(2, 1.0 * value) for name, value in signals.items()}, dt=1.0)


def shrunk(spec, cars, b=0.7):
    problem = vj.Problem("cars", SPACE, system, spec, nominal=NOMINAL)
    run = vj.simulate(problem, [{"cars": cars, "b": b}])
    assert run.table.all["violated"].all()
    return vj.shrink(run, 0, budget=600)


def rebuilt(small):
    """Return the features that a reader makes of nominal's and of what is listed."""
    columns = dict(small.problem.space.rows(small.problem.space.features_at(small.nominal[None])))
    row = {name: column[0] for name, column in columns.items()}
    return small.problem.space.from_row(row | {n: now for n, (_, now) in small.changed.items()})


def lists_what_rebuilds_it(small):
    u = np.asarray(small.problem.space.point_of(rebuilt(small)))
    settled = Nominal.of(small.problem).settle(u[None])
    np.testing.assert_allclose(settled[0], small.u, atol=1e-6)
    assert small.count == len(small.changed) <= small.start_count
    return True


@pytest.mark.slow
@pytest.mark.parametrize("cars", [[FAST], [SLOW, SLOW, FAST], [FAST] * 4])
def test_the_items_of_nominal_stay(cars):
    small = shrunk("always fastest < 30", cars)
    (name,) = small.changed
    assert name in ("cars[0].v", "cars[1].v")
    assert "1 of 10 features away" in str(small)
    assert "absent" not in str(small)
    assert lists_what_rebuilds_it(small)


@pytest.mark.slow
def test_added_items_are_counted_and_listed_wherever_they_are(tmp_path):
    small = shrunk("always many < 4", [SLOW] * 4)
    assert list(small.changed) == ["cars.length", *(f"cars[{i}].{n}" for i in (2, 3) for n in "xv")]
    assert small.changed["cars[2].x"][0] is None
    assert str(small).count("absent -> ") == 4
    assert small.count == 5
    assert lists_what_rebuilds_it(small)
    figure = small.plot(tmp_path / "small.png")
    drawn = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert any(text.startswith("absent to ") for text in drawn)
    assert not any("nan" in text for text in drawn)


@pytest.mark.slow
def test_items_that_go_count_once():
    small = shrunk("always many > 1", [])
    assert small.changed == {"cars.length": (2, 1)}
    assert small.start_count == 2
    assert lists_what_rebuilds_it(small)


@pytest.mark.slow
def test_it_says_which_formula_breaks():
    spec = {"slow": "always fastest < 30", "dim": "always b < 0.6"}
    # The other one is nearer to nominal.
    other = shrunk(spec, [FAST], b=0.55)
    assert (other.broken, other.start_broken) == (("dim",), ("slow",))
    assert "breaks dim; row 0 broke slow" in str(other)
    same = shrunk(spec | {"dim": "always b < 1.1"}, [FAST], b=0.55)
    assert (same.broken, same.start_broken) == (("slow",), ("slow",))
    assert "breaks slow, as the row did" in str(same)


def test_coordinates_that_mean_something():
    space = vj.FeatureSpace(SPACE)
    for count in range(5):
        features = space.coerce({"cars": [SLOW] * count, "b": 0.5})
        used = np.asarray(space.used(np.asarray(space.point_of(features))[None]))[0]
        names = [name for name, there in zip(space.coordinates, used, strict=True) if there]
        items = [f"cars[{i}].{n}" for i in range(count) for n in "xv"]
        assert names == ["cars.length", *items, "b"]
