"""The cones: the loop without a camera never fails, the networks do as was promised of them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from envs import cones as ec
from envs import train_cones
from envs.cones_drawing import film_strip
from specs import cones as specs
from verifai_jax.core.display.figure import new_figure
from verifai_jax.core.messages.errors import UnknownNameError

KEY = jax.random.key(0)
PROBLEMS = [p for name in dir(specs) if isinstance(p := getattr(specs, name), vj.Problem)]

PERFECT = [specs.perfectly, specs.braking_perfectly]


def pose(x: float, y: float = 0.0, heading: float = 0.0) -> ec.Pose:
    return ec.Pose(*(jnp.asarray(value) for value in (x, y, heading)))


@pytest.mark.thorough
def test_the_distance_is_that_of_the_nearest_cone_in_sight():
    place = {"cone_offset": (-1.0, 0.0, 0.5), "cone_spacing": (2.0, 2.0)}
    # The camera is 0.4 m ahead of the car's middle.
    assert float(ec.distance_of_nearest(place, pose(-10.4))) == pytest.approx(np.hypot(10, 1))
    assert float(ec.distance_of_nearest(place, pose(-2.4))) == pytest.approx(4.0)  # 1 m beside: no
    assert float(ec.distance_of_nearest(place, pose(10.0))) == ec.NOTHING


@pytest.mark.thorough
def test_the_gap_is_between_the_car_s_outline_and_a_cone():
    place = {"cone_offset": (-1.0, -1.0, -1.0)}
    ahead = float(ec.gap_to_cones(place, pose(-5.0, -1.0)))
    assert ahead == pytest.approx(5.0 - ec.LENGTH / 2 - ec.CONE_RADIUS)
    beside = float(ec.gap_to_cones(place, pose(1.0, 2.0)))
    assert beside == pytest.approx(3.0 - ec.BREADTH / 2 - ec.CONE_RADIUS)
    assert float(ec.gap_to_cones(place, pose(0.0, -1.0))) < -0.8


def test_an_unknown_network_is_met_with_the_nearest():
    with pytest.raises(UnknownNameError, match="unknown network 'narow'; did you mean 'narrow'"):
        ec.neural("narow")


def test_the_shipped_networks_see_the_images_of_the_problems():
    for name in ec.NETWORKS:
        network = ec.load_detector(ec.NETWORKS[name])
        assert network.shape == (ec.HEIGHT, ec.WIDTH)
        assert ec.NETWORKS[name].stat().st_size < 60_000


@pytest.mark.thorough
@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
def test_problems_are_sound(problem):
    problem.check()
    assert problem.nominal is not None
    assert problem.space.dim == (28 if "reaction_time" in problem.space.domains else 27)
    assert ("reaction_time" in problem.space.domains) == ("braking" not in problem.name)


@pytest.mark.slow
def test_the_car_goes_around_the_cones_or_stops_before_them(tmp_path):
    around = jax.jit(specs.perfectly.system)(specs.perfectly.nominal, KEY)
    assert around["offset"][0] == 0
    assert abs(around["offset"][-1] - ec.LANE) < 0.1
    assert around["cone_gap"].min() > 0.5
    stops = jax.jit(specs.braking_perfectly.system)(specs.braking_perfectly.nominal, KEY)
    assert stops["speed"][-1] == 0
    assert 0.5 < stops["cone_gap"][-1] < 8
    film = specs.perfectly.system.film(around, specs.perfectly.nominal)
    assert film.shape == (len(around["x"]), ec.HEIGHT, ec.WIDTH, 3)
    figure = film_strip(around, specs.perfectly.nominal, tmp_path / "strip.png", count=2)
    assert len(figure.axes) == 4
    assert (tmp_path / "strip.png").stat().st_size > 5000
    assert "cones at 26.0 m  seen at 26.0 m" in figure.axes[1].get_title()
    assert np.allclose(figure.axes[0].images[0].get_array(), film[0], atol=2e-3)
    axes = new_figure().subplots()
    specs.perfectly.draw(axes, around, 5, specs.perfectly.nominal)
    assert "1.25 s" in axes.get_title()
    begun = np.argmax(np.asarray(around["distance"]) == ec.NOTHING)
    assert ec.TRIGGER - 7 < around["distance"][begun - 1] < ec.TRIGGER


@pytest.mark.thorough
def test_one_look_is_what_the_loop_saw_there_and_late_is_too_late():
    def outcome(severity):
        system = ec.cones(ec.late(severity))
        features = {**specs.perfectly.nominal, "cruising_speed": 7.2}
        trace = system(features, KEY)
        looks = jax.vmap(lambda sample: system.frame(features, sample))(dict(trace.signals))
        wrong = [jnp.max(jnp.abs(seen - trace[name])) for name, seen in looks.items()]
        return trace["cone_gap"].min(), jnp.max(jnp.stack(wrong))

    (gap, late_gap), wrong = jax.jit(jax.vmap(outcome))(jnp.array([0.0, 1.0]))
    assert gap > 0.1 > late_gap
    assert wrong.max() < 1e-3


@pytest.mark.proves
@pytest.mark.parametrize("problem", PERFECT, ids=lambda p: p.name)
def test_nothing_fails_that_sees_perfectly(problem):
    run = vj.falsify(problem, "uniform", budget=10_000, seed=1)
    assert not len(run.table.counterexamples)
    assert run.failure_rate.high < 4e-4
    searched = vj.falsify(problem, budget=2000, seed=2)
    assert not len(searched.table.counterexamples)


@pytest.mark.proves
def test_the_narrow_network_does_not_see_cones_before_an_orange_car():
    run = vj.falsify(specs.narrow, "uniform", budget=2048, seed=1, confirm=False)
    table = run.table.all
    orange, fails = table["car_hue"] < ec.ORANGE, table["rho"] < 0
    counts = [(int(fails[rows].sum()), int(rows.sum())) for rows in (orange, ~orange)]
    of_orange, of_others = (vj.clopper_pearson(*count) for count in counts)
    assert of_orange.low > 2 * of_others.high
    rules = vj.analysis.rules(run).rules
    assert rules
    assert all("car_hue <= 0." in str(rule) for rule in rules)


@pytest.mark.proves
def test_the_wide_network_collides_after_few_images():
    collisions = replace(specs.wide, spec=specs.SAFE, priority=None)
    result = vj.perception.abstract(
        collisions,
        lambda severity: ec.cones(ec.late(severity)),
        collisions.system.frame,
        "distance < 15 and (estimate > 15 or logit < 0)",
        budget=1000,
    )
    # Uniform sampling takes 20 000 images: one simulation of 33 in 600 fails.
    assert len(result.confirmed) == 1
    assert result.frames["total"] < 500
    assert result.replay().violated


def test_the_file_of_one_network_is_not_that_of_two(capsys):
    with pytest.raises(SystemExit):
        train_cones.main(["wide", "narrow", "--out", "both.npz"])
    assert "--out is the file of one network" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        train_cones.main(["wied"])
    assert "there is no network wied" in capsys.readouterr().err
