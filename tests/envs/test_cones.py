"""The cones: the loop without a camera never fails, the networks do as was promised of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from envs import cones as ec
from envs import train_cones
from specs import cones as specs
from verifai_jax.core.errors import UnknownNameError

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


@pytest.mark.thorough
def test_the_car_goes_around_the_cones_or_stops_before_them():
    around = jax.jit(specs.perfectly.system)(specs.perfectly.nominal, KEY)
    assert around["offset"][0] == 0
    assert abs(around["offset"][-1] - ec.LANE) < 0.1
    assert around["cone_gap"].min() > 0.5
    stops = jax.jit(specs.braking_perfectly.system)(specs.braking_perfectly.nominal, KEY)
    assert stops["speed"][-1] == 0
    assert 0.5 < stops["cone_gap"][-1] < 8
    film = specs.perfectly.system.film(around, specs.perfectly.nominal)
    assert film.shape == (len(around["x"]), ec.HEIGHT, ec.WIDTH, 3)
    begun = np.argmax(np.asarray(around["distance"]) == ec.NOTHING)
    assert ec.TRIGGER - 7 < around["distance"][begun - 1] < ec.TRIGGER


@pytest.mark.slow
@pytest.mark.parametrize("problem", PERFECT, ids=lambda p: p.name)
def test_nothing_fails_that_sees_perfectly(problem):
    run = vj.falsify(problem, "uniform", budget=10_000, seed=1)
    assert not len(run.table.counterexamples)
    assert run.failure_rate.high < 4e-4
    searched = vj.falsify(problem, budget=2000, seed=2)
    assert not len(searched.table.counterexamples)


@pytest.mark.slow
def test_the_narrow_network_does_not_see_cones_before_an_orange_car():
    run = vj.falsify(specs.narrow, "uniform", budget=768, seed=1, confirm=False)
    table = run.table.all
    orange, fails = table["car_hue"] < ec.ORANGE, table["rho"] < 0
    counts = [(int(fails[rows].sum()), int(rows.sum())) for rows in (orange, ~orange)]
    of_orange, of_others = (vj.clopper_pearson(*count) for count in counts)
    assert of_orange.low > 2 * of_others.high


def test_the_file_of_one_network_is_not_that_of_two(capsys):
    with pytest.raises(SystemExit):
        train_cones.main(["wide", "narrow", "--out", "both.npz"])
    assert "--out is the file of one network" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        train_cones.main(["wied"])
    assert "there is no network wied" in capsys.readouterr().err
