"""A car that brakes by what a network reads, which errs in a known part of the space."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.addons.perception.compositional.region import AbstractLoop, sample_region
from verifai_jax.problem import ProblemError

STEPS, DT, NOTHING = 40, 0.1, 100.0
SPACE = {"speed": vj.Box(4.0, 12.0), "start": vj.Box(20.0, 30.0), "hue": vj.Box(0.0, 1.0)}
SAFE = "always gap > 0"
ERROR = "gap < trigger and reading > trigger"


def blind(features):
    """Whether the network sees nothing, wherever it is: 12 % of the space."""
    return jnp.abs(features["hue"] - 0.4) < 0.06


def network(features, gap):
    """Read the gap; nothing before a car of this colour, a little too much before others."""
    return jnp.where(blind(features), NOTHING, gap + 0.5 * features["hue"] ** 2)


def late(severity):
    """Read the truth, but not before the car is that near; 6 m of 15 m at the worst."""
    return lambda features, gap: jnp.where(gap < 15.0 - 9.0 * severity, gap, NOTHING)


def braking(perceive):
    """The car brakes at 6 m/s^2 once its reading is less than what braking takes, and 2 m."""

    def system(features, key=None):
        def step(carry, _):
            gap, speed, brakes = carry
            trigger = speed**2 / 12 + 2.0
            reading = perceive(features, gap)
            brakes = brakes | (reading < trigger)
            slower = jnp.where(brakes, jnp.maximum(speed - 6.0 * DT, 0.0), speed)
            sample = {"gap": gap, "reading": reading, "trigger": trigger}
            return (gap - DT * slower, slower, brakes), sample

        start = (features["start"], features["speed"], jnp.asarray(False))
        return vj.Trace(jax.lax.scan(step, start, None, STEPS)[1], dt=DT)

    return system


def frame(features, sample):
    reading = network(features, sample["gap"])
    return {"gap": sample["gap"], "trigger": sample["trigger"], "reading": reading}


def problem(perceive=network, spec=SAFE, name="braking"):
    return vj.Problem(name, SPACE, braking(perceive), spec)


def by_numpy(speed, start, perceive):
    """The least gap of the same loop, without JAX."""
    gap, brakes, least = start, False, start
    for _ in range(STEPS):
        least = min(least, gap)
        brakes = brakes or perceive(gap) < speed**2 / 12 + 2.0
        speed = max(speed - 6.0 * DT, 0.0) if brakes else speed
        gap -= DT * speed
    return least


def fails_at(speed, start, severity):
    return by_numpy(speed, start, lambda g: g if g < 15.0 - 9.0 * severity else NOTHING) <= 0


@pytest.mark.slow
def test_the_region_is_that_of_brute_force():
    loop = AbstractLoop(problem(), lambda s: braking(late(s)), vj.parse(ERROR), 0)
    region = sample_region(loop, 300, 0)
    severities = np.linspace(0, 1, 201)
    for row in region.to_dict("records"):
        fails = [fails_at(row["speed"], row["start"], s) for s in (0.0, 1.0)]
        assert row["kind"] == {(False, True): "uncertain", (False, False): "safe"}[tuple(fails)]
        assert np.isnan(row["severity"]) == (row["kind"] == "safe")
        if row["kind"] == "uncertain":
            first = next(s for s in severities if fails_at(row["speed"], row["start"], s))
            assert first - 0.006 <= row["severity"] <= first + 0.002
            assert row["erring"] >= 1
    assert {"uncertain", "safe"} == set(region["kind"])


@pytest.mark.slow
def test_what_is_confirmed_fails_because_the_network_errs():
    result = vj.perception.abstract(
        problem(), lambda s: braking(late(s)), frame, ERROR,
        search="uniform", budget=1000, samples=500, stop=vj.Stop(after=3), batch=40,
    )  # fmt: skip
    assert result.ended == "found"
    assert len(result.confirmed) == 3
    for row in result.confirmed.to_dict("records"):
        assert bool(blind(row))
        assert by_numpy(row["speed"], row["start"], lambda g: NOTHING) <= 0
    frames = result.frames
    assert frames["images"] == len(result.images.table)
    assert frames["simulations"] == STEPS * len(result.simulations)
    assert frames["total"] == frames["images"] + frames["simulations"] <= 1000
    assert result.confirmed["rendered"].iloc[-1] == frames["total"]
    # Images are rendered within the region only.
    assert all(fails_at(row.speed, row.start, 1.0) for row in result.images.table.all.itertuples())
    replay = result.replay()
    assert replay.violated
    assert replay.trace["reading"].max() == NOTHING
    assert "3 failures of the loop, after" in str(result)
    assert str(frames["images"]) in str(result)
    assert "speed" in str(result.rules())
    picture = result.plot()
    assert picture.axes[0].get_xlabel() == "speed"
    with pytest.raises(IndexError, match="has 3 confirmed failures; there is no number 7"):
        result.replay(7)
    again = vj.perception.abstract(
        problem(), lambda s: braking(late(s)), frame, ERROR,
        search="uniform", budget=1000, samples=500, stop=vj.Stop(after=3), batch=40,
    )  # fmt: skip
    pd.testing.assert_frame_equal(again.candidates, result.candidates)


@pytest.mark.slow
def test_a_perception_that_never_errs_uses_up_its_budget():
    def true(features, sample):
        return dict(sample, reading=sample["gap"])

    result = vj.perception.abstract(
        problem(late(0.0)), lambda s: braking(late(s)), true, ERROR,
        search="uniform", budget=100, samples=50, batch=32,
    )  # fmt: skip
    assert result.ended == "budget"
    assert result.frames == {"images": 100, "simulations": 0, "total": 100}
    assert "no failure of the loop found with 100 rendered images (budget)" in str(result)
    assert "the network errs on 0" in str(result)
    assert "simulations  none" in str(result)


@pytest.mark.slow
def test_a_finite_search_ends_with_all_of_its_candidates_simulated():
    points = [[0.9, v / 7, hue] for v in range(8) for hue in (0.39, 0.4, 0.9)]
    result = vj.perception.abstract(
        problem(), lambda s: braking(late(s)), frame, ERROR,
        search=vj.search.PointList(points), samples=50, batch=64, stop=vj.Stop(after=99),
    )  # fmt: skip
    assert result.ended == "exhausted"
    assert len(result.images.table) == len(points)
    assert len(result.candidates) == len(result.confirmed) == len(result.simulations) == 16


@pytest.mark.slow
def test_nothing_is_rendered_where_nothing_is_uncertain():
    for spec, kind in (("always gap > -99", "safe"), ("always gap > 99", "fails anyway")):
        result = vj.perception.abstract(
            problem(spec=spec), lambda s: braking(late(s)), frame, ERROR, samples=20
        )
        assert result.ended == "nothing uncertain"
        assert result.images is None
        assert result.frames["total"] == 0
        assert set(result.region["kind"]) == {kind}
        assert "nothing is uncertain, so no image was rendered" in str(result)
        assert not len(result.confirmed)
        assert result.plot().axes
    assert "20 fail with the best perception: not its fault" in str(result)


@pytest.mark.thorough
def test_what_has_no_verdict_is_said():
    def broken(severity):
        return braking(lambda features, gap: jnp.where(features["hue"] < 2, jnp.nan, gap))

    spec = "always (gap > 0 and reading < 999)"
    result = vj.perception.abstract(problem(spec=spec), broken, frame, ERROR, samples=20)
    assert set(result.region["kind"]) == {"no verdict"}
    assert "20 have no verdict" in str(result)


def test_parts_that_do_not_fit_are_refused_before_anything_compiles():
    good = (problem(), lambda s: braking(late(s)), frame)
    with pytest.raises(ProblemError, match="error must be a condition on one instant"):
        vj.perception.abstract(*good, "always gap < 3")
    with pytest.raises(TypeError, match="abstract needs a Problem; got str"):
        vj.perception.abstract("braking", *good[1:], ERROR)
    with pytest.raises(TypeError, match="abstraction must be a function severity -> system"):
        vj.perception.abstract(good[0], 0.5, frame, ERROR)
    with pytest.raises(ValueError, match="budget must be 56 at least, for a batch of 16 images"):
        vj.perception.abstract(*good, ERROR, budget=55)
    with pytest.raises(ValueError, match="glare"):
        vj.perception.abstract(*good, "glare > 0")
    with pytest.raises(ProblemError, match=r"braking, one image.*frame must return a dictionary"):
        vj.perception.abstract(*good[:2], lambda f, s: s["gap"], ERROR)
    with pytest.raises(ValueError, match="reading"):
        vj.perception.abstract(*good[:2], lambda f, s: {"gap": s["gap"]}, "gap < 3 or reading > 9")
    with pytest.raises(ValueError, match="unknown search 'crossentropy'"):
        vj.perception.abstract(*good, ERROR, search="crossentropy")
