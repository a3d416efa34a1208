"""Signals as features: knots, what a person may write, refinement, evaluation inside a rollout."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked

from verifai_jax.core.values.waveform import Waveform
from verifai_jax.features import (
    Array,
    Box,
    Categorical,
    DiscreteBox,
    FeatureSpace,
    LogUniform,
    Normal,
    Signal,
    Struct,
)
from verifai_jax.features.point_maps import features_of_rows
from verifai_jax.systems.ode import ode
from verifai_jax.testing import check_domain

SIGNALS = [
    Signal(Box(-1, 1), knots=4),
    Signal(Box(-1, 1), knots=1, hold="constant"),
    Signal(Box([0, -5], [1, 5]), knots=3, hold="constant", duration=2.0),
    Signal(Box([0, -5], [1, 5]), knots=2),
    Signal(Normal(0, 1), knots=3, hold="constant"),
    Signal(LogUniform(1, 10), knots=5, hold="linear", duration=1.5),
    Array(Signal(Box(0, 1), knots=2), length=2),
    Signal(Box(-1, 1), hold="pchip", times=[0, 0.5, 3]),
    Signal(Box(0, 3), hold="pulse", times=[2, 8], width=0.5, duration=10.0),
    Signal(Box([0, -5], [1, 5]), knots=3, hold="pulse"),
]


@pytest.mark.thorough
@pytest.mark.parametrize("domain", SIGNALS, ids=repr)
def test_the_laws_of_domains_hold(domain):
    check_domain(domain)


@pytest.mark.thorough
def test_knots_are_coordinates_and_columns():
    space = FeatureSpace({"wind": Signal(Box(-2, 2), 3), "push": Signal(Box([0, 0], [1, 1]), 2)})
    names = ("wind[0]", "wind[1]", "wind[2]", "push[0][0]", "push[0][1]", "push[1][0]")
    assert space.columns == space.coordinates == (*names, "push[1][1]")
    features = space.unflatten(jnp.array([0, 0.5, 1, 0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_allclose(features["wind"].knots, [-2, 0, 2])
    np.testing.assert_allclose(features["push"].knots, [[0.1, 0.2], [0.3, 0.4]], rtol=1e-6)
    assert float(features["wind"].over(2.0)(1.5)) == 1.0
    batch = jax.vmap(space.unflatten)(jax.random.uniform(jax.random.key(0), (5, space.dim)))
    table = pd.DataFrame(space.rows(batch))
    again = space.from_row(table.iloc[3])
    np.testing.assert_array_equal(again["push"].knots, batch["push"].knots[3])
    assert Signal(Box(0, 1)).size == 16


def test_what_a_person_writes():
    space = FeatureSpace({"w": Signal(Box(0, 4), 3), "p": Signal(Box([0, 0], [1, 2]), 2)})
    constant = space.coerce({"w": 1, "p": [1, 2]})
    assert constant["w"].knots.tolist() == [1, 1, 1]
    assert constant["p"].knots.tolist() == [[1, 2], [1, 2]]
    written = space.coerce({"w": [0, 1, 2], "p": [[1, 2], [0, 0]]})
    assert written["w"].knots.tolist() == [0, 1, 2]
    again = space.coerce(written)
    jax.tree.map(np.testing.assert_array_equal, again, written)
    np.testing.assert_allclose(space.flatten({"w": [0, 1, 2], "p": 0.5 * jnp.ones((2, 2))})[:3],
                               [0, 0.25, 0.5])  # fmt: skip
    two = FeatureSpace({"w": Array(Signal(Box(0, 1), 3), length=2)})
    assert two.coerce({"w": [0.25, 0.5]})["w"].knots.tolist() == [[0.25] * 3, [0.5] * 3]
    mixed = two.coerce({"w": [0.25, [0, 1, 0]]})["w"]
    assert mixed.knots.tolist() == [[0.25] * 3, [0, 1, 0]]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Signal(Categorical("a", "b"), 3), r"Box or a distribution; got Categorical\('a'"),
        (lambda: Signal(DiscreteBox(0, 3), 3), r"got DiscreteBox\(0, 3\)"),
        (lambda: Signal(Struct({"x": Box(0, 1)}), 3), "got Struct"),
        (lambda: Signal(Box(0, 1), 1), "linear hold needs at least 2 knots; got 1"),
        (lambda: Signal(Box(0, 1), 0, hold="constant"), "needs at least 1 knots; got 0"),
        (lambda: Signal(Box(0, 1), 2.5), "at least 2 knots; got 2.5"),
        (lambda: Signal(Box(0, 1), 3, hold="const"), "unknown hold 'const'; did you mean 'const"),
        (lambda: Signal(Box(0, 1), 3, duration=-1), "positive number of seconds; got -1"),
        (lambda: Signal(Box(0, 1), 3, duration="x"), "positive number of seconds; got 'x'"),
        (lambda: SIGNALS[0].check([0, 0.5], "w"), "w must have 4 control points; got 2"),
        (lambda: SIGNALS[0].check([0, 0, 0, 7], "w"), r"w\[3\] must lie in \[-1, 1\]; got 7"),
        (lambda: SIGNALS[0].check("up", "w"), "w must be a number; got 'up'"),
        (
            lambda: SIGNALS[0].check(Waveform(jnp.zeros(4), "constant"), "w"),
            "w must have hold='linear' and duration=None; got hold='constant'",
        ),
        (lambda: Signal(Box(0, 1), 3, times=[0, 1]), "each of its times; got 3 knots and 2 times"),
        (lambda: Signal(Box(0, 1), times=[0, 9], duration=4), "duration of 4 s; got 9"),
        (lambda: Signal(Box(0, 1), times=[1, 1]), "times must increase"),
        (lambda: Signal(Box(0, 1), times=[1]), "at least 2 knots; got 1"),
        (lambda: Signal(Box(0, 1), 3, "pchip").refined(2), "'pchip' has no refinement"),
        (
            lambda: SIGNALS[7].check(Waveform(jnp.zeros(3), "pchip"), "w"),
            r"times=\[0, 0.5, 3\]; got hold='pchip' and duration=None$",
        ),
        (lambda: SIGNALS[0].refined(0), "factor must be a positive integer; got 0"),
    ],
)
def test_what_is_wrong_is_refused_where_it_is_made(make, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        make()


@pytest.mark.slow
@pytest.mark.parametrize("hold", ["linear", "constant"])
def test_refined_spaces_hold_the_same_functions(hold):
    signal = Signal(Box(-1, 1), 4, hold=hold)
    space = FeatureSpace(
        {
            "wind": signal,
            "x": Box(0, 1),
            "inner": Struct({"s": signal}),
            "many": Array(signal, length=2),
            "some": Array(signal, length=(1, 2)),
        }
    )
    finer, refine = space.refined(3)
    u = jax.random.uniform(jax.random.key(2), (space.dim,))
    coarse = space.unflatten(u)
    fine = refine(coarse)
    finer.check(fine)
    size = {"linear": 10, "constant": 12}[hold]
    assert finer["wind"] == Signal(Box(-1, 1), size, hold=hold)
    assert finer.dim == space.dim + 6 * (size - 4)
    # What the finer space makes of the refined point is still the same function of time.
    again = finer.unflatten(finer.flatten(fine))
    times = jnp.linspace(-0.1, 2.1, 57)
    for pick in (
        lambda f: f["wind"],
        lambda f: f["inner"]["s"],
        lambda f: jax.tree.map(lambda leaf: leaf[1], f["many"]),
        lambda f: jax.tree.map(lambda leaf: leaf[0], f["some"].values),
    ):
        before, after = (jax.vmap(pick(f).over(2.0))(times) for f in (coarse, again))
        np.testing.assert_allclose(after, before, atol=1e-5)


@pytest.mark.thorough
def test_given_times_are_refined_in_spaces():
    space = FeatureSpace({"w": Signal(Box(-1, 1), times=[0, 0.5, 3], duration=4.0)})
    finer, refine = space.refined(2)
    assert finer["w"] == Signal(Box(-1, 1), times=[0, 0.25, 0.5, 1.75, 3], duration=4.0)
    coarse = space.coerce({"w": [0, 1, -1]})
    finer.check(refine(coarse))
    np.testing.assert_allclose(refine(coarse)["w"].knots, [0, 0.5, 1, 0, -1], atol=1e-6)


def test_json_and_tables_keep_times_and_widths():
    space = FeatureSpace({"w": SIGNALS[-2], "p": SIGNALS[-3], "x": Signal(Box(0, 1), 2)})
    again = FeatureSpace.from_json(space.to_json())
    assert again == space
    assert repr(again["w"]) == (
        "Signal(Box(0, 3), times=[2, 8], hold='pulse', width=0.5, duration=10)"
    )
    features = space.coerce({"w": [1, 2], "p": [0, 1, 0], "x": 0.5})
    rows = {
        name: np.asarray(column)
        for name, column in space.rows(jax.tree.map(lambda leaf: leaf[None], features)).items()
    }
    batch = features_of_rows(dict(space.root.fields), rows, "float32")
    assert (batch["w"].times, batch["w"].width, batch["p"].hold) == ((2.0, 8.0), 0.5, "pchip")


class TestInRollouts:
    """A cart that integrates its wind: x(T) is the integral of the signal."""

    SPACE = FeatureSpace({"wind": Signal(Box(-1, 1), 5), "gust": Signal(Box(-1, 1), 4, "constant")})

    @staticmethod
    def rollout(**options):
        def slope(time, state, control, features):
            return {"x": features["wind"](time), "y": features["gust"](time)}

        return ode(slope, lambda f, key: {"x": 0.0, "y": 0.0}, dt=0.05, duration=2.0, **options)

    def test_the_simulation_gives_the_duration(self):
        features = self.SPACE.coerce({"wind": [0, 1, 0, -1, 0.5], "gust": [1, 0, -1, 0.5]})
        trace = jax.jit(self.rollout(method="euler"))(features)
        clock = np.arange(40) * 0.05
        wind = np.interp(clock, np.linspace(0, 2, 5), [0, 1, 0, -1, 0.5])
        np.testing.assert_allclose(trace["x"][1:], np.cumsum(wind) * 0.05, atol=1e-5)
        gust = np.repeat([1, 0, -1, 0.5], 10)
        np.testing.assert_allclose(trace["y"][1:], np.cumsum(gust) * 0.05, atol=1e-5)

    @pytest.mark.parametrize("ends", [False, True])
    def test_gradients_of_batches_reach_the_knots(self, ends):
        options = {"terminate": lambda state, f: state["x"] > 10} if ends else {}
        system = self.rollout(method="euler", **options)
        last = jax.grad(lambda u: system(self.SPACE.unflatten(u))["y"][-1])
        slopes = jax.jit(jax.vmap(last))(jnp.full((3, 9), 0.4))
        # Each piece lasts half a second, and a unit of its coordinate is two of wind.
        np.testing.assert_allclose(slopes, [[0] * 5 + [1.0] * 4] * 3, atol=1e-5)

    @pytest.mark.thorough
    def test_its_own_duration_is_kept(self):
        space = FeatureSpace({"wind": Signal(Box(-1, 1), 2, duration=1.0), "gust": Box(0, 1)})
        system = ode(lambda t, s, c, f: f["wind"](t), lambda f, key: 0.0, dt=0.5, duration=2.0,
                     method="euler", signals=lambda t, s, c, f: {"w": f["wind"](t)})  # fmt: skip
        trace = system(space.coerce({"wind": [-1, 1], "gust": 0}))
        np.testing.assert_allclose(trace["w"], [-1, 0, 1, 1, 1])


def test_people_read_the_time_of_a_control_point():
    parts = {
        "a": Box(0, 1),
        "wind": Signal(Box(-1, 1), 5),
        "car": Struct({"throttle": Signal(Box([0, 0], [1, 1]), 2, "constant", duration=10.0)}),
    }
    space = FeatureSpace(parts)
    labels = space.labels(6.0)
    assert list(labels) == list(space.coordinates)
    assert labels["a"] == "a"
    assert labels["wind[1]"] == "wind at 1.5 s"
    assert labels["wind[4]"] == "wind at 6 s"
    uneven = FeatureSpace(
        {
            "p": Signal(Box(0, 1), hold="pchip", times=[0, 1, 4]),
            "c": Signal(Box(0, 1), hold="constant", times=[1, 2]),
            "k": Signal(Box(0, 1), hold="pulse", times=[1, 2], width=0.25),
        }
    )
    assert list(uneven.labels(6.0).values()) == [
        *("p at 0 s", "p at 1 s", "p at 4 s", "c from 0 s to 2 s", "c from 2 s to 6 s"),
        *("k from 1 s to 1.25 s", "k from 2 s to 2.25 s"),
    ]
    assert uneven.labels()["c[1]"] == "c from 2 s on"
    assert uneven["p"].spans(6.0) == [(0, 4), (0, 6), (0, 6)]
    assert labels["car.throttle[1][0]"] == "car.throttle[0] from 5 s to 10 s"
    assert space.labels()["wind[1]"] == "wind[1]"
    assert space.fixed(wind=0.0).labels(6.0).keys() == {"a", *list(labels)[-4:]}
