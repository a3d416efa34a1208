"""The last chance on systems where it is known, its words and its errors."""

import jax.numpy as jnp
import numpy as np
import pytest
from known_systems import CAR, CURVATURE, SYSTEMS, WALL, wall
from scipy.optimize import brentq

import verifai_jax as vj
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Trace

SMALL = {"forks": 256, "rounds": 6, "progress": False}


def check(name: str, seed: int, forks: int) -> None:
    known = SYSTEMS[name](np.random.default_rng(seed))
    found = vj.last_chance(
        known.problem, known.features, actions=known.actions, forks=forks, proof_seconds=0,
        progress=False,
    )  # fmt: skip
    first, last = found.bracket
    assert first <= known.instant <= last, seed
    assert last - first < 0.05 * known.problem.system.duration
    escape = found.escape
    assert escape is not None
    assert escape.robustness >= 0
    assert escape.start == first
    for name, formula in known.problem.formulas.items():
        assert vj.robustness(formula, escape.trace) >= 0, name


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n == "wall" else pytest.mark.slow) for n in SYSTEMS]
)
def test_the_bracket_holds_the_known_instant(name):
    check(name, 3, 1024 if name == "grid" else 512)


@pytest.mark.proves
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_bracket_holds_the_known_instant_in_20_of_20_runs(name):
    for seed in range(20):
        check(name, seed, 1024 if name == "grid" else 512)


@pytest.fixture(scope="module")
def braked():
    known = wall(np.random.default_rng(0))
    return known, vj.last_chance(WALL, known.features, actions=known.actions, **SMALL)


@pytest.mark.slow
def test_what_is_proved_begins_after_the_known_instant_and_before_the_failure(braked):
    known, found = braked
    assert known.instant <= found.proved_from < found.failed
    assert found.no_escape_from <= found.proved_from


@pytest.mark.slow
def test_the_words_say_what_an_escape_had_to_do_and_the_picture_draws_it(braked, tmp_path):
    known, found = braked
    text = str(found)
    assert "the controller could avoid it until" in text
    assert "action at its lowest, -4, instead of 0 on average, from" in text
    assert "then the policy goes on" in text
    assert f"at {10 / known.features['v0']:.2f}"[:6] in text
    found.plot(tmp_path / "last.png")
    assert (tmp_path / "last.png").stat().st_size > 10_000


@pytest.mark.thorough
def test_actions_are_replayed_by_a_controller_that_takes_them(braked):
    """The witness, in a system that was made with it as its controller."""
    known, found = braked
    escape, dt = found.escape, 0.02
    assert escape.stop is not None
    plan = (
        jnp.zeros(200)
        .at[round(escape.start / dt) : round(escape.stop / dt)]
        .set(jnp.asarray(escape.actions[:, 0]))
    )
    taken = vj.ode(
        lambda t, s, u, f: jnp.stack([s[1], u]),
        initial=lambda f, key: jnp.stack([0.0, known.features["v0"]]),
        controller=lambda t, s, f: plan[jnp.round(t / dt).astype(int)],
        signals=lambda t, s, u, f: {"x": s[0]}, dt=dt, duration=3.0,
    )  # fmt: skip
    x = np.asarray(taken({}).signals["x"])
    np.testing.assert_allclose(x, escape.trace.signals["x"], atol=1e-4)
    assert x.max() <= 10


@pytest.mark.slow
def test_the_environment_avoids_it_by_a_feature_from_an_instant_on():
    """A fan that pushes back with a force: it must stop what the car has left to stop."""

    def system(gain):
        return vj.ode(
            lambda t, s, u, f: jnp.stack([s[1], u - f["wind"]]),
            initial=lambda f, key: jnp.stack([0.0 * f["v0"], f["v0"]]),
            controller=lambda t, s, f: gain * s[1],
            signals=lambda t, s, u, f: {"x": s[0]}, dt=0.02, duration=3.0,
        )  # fmt: skip

    problem = vj.Problem(
        "fan", {"v0": vj.Box(2, 8), "wind": vj.Box(0, 4)}, system(0.0), "always x <= 10"
    )
    features = {"v0": 6.0, "wind": 0.0}
    found = vj.last_chance(problem, features, by="environment", features=["wind"], **SMALL)
    known = (10 - 36 / 8) / 6
    assert found.avoidable_until <= known <= found.no_escape_from
    assert found.no_escape_from - found.avoidable_until < 0.05
    assert "wind" in found.escape.features
    # Braking in proportion to the speed, a = -2 v, goes v / 2 (1 - exp(-2 t)) in t seconds.
    other = vj.last_chance(problem, features, by=system(-2.0), **SMALL)
    known = brentq(lambda t: 6 * t + 3 * (1 - np.exp(-2 * (3 - t))) - 10, 0, 2)
    # Held between samples, it brakes a little more.
    assert other.avoidable_until - 0.01 <= known <= other.no_escape_from
    assert "the other policy could avoid it" in str(other)


@pytest.mark.slow
def test_what_never_comes_fails_where_its_window_ends():
    system = vj.ode(
        lambda t, s, u, f: jnp.stack([s[1], u]), initial=lambda f, key: jnp.zeros(2) * f["g"],
        controller=lambda t, s, f: f["g"], signals=lambda t, s, u, f: {"x": s[0]}, dt=0.02,
        duration=2.0,
    )  # fmt: skip
    late = "eventually[0, 1.8] always[0, 0.2] abs(x - 1) <= 0.15"
    problem = vj.Problem("reach", {"g": vj.Box(0.1, 0.4)}, system, late)
    found = vj.last_chance(problem, {"g": 0.2}, actions=(-4, 4), proof_seconds=0, **SMALL)
    assert found.failed == pytest.approx(1.8)
    # From x and v at t, full force must reach 0.85 by 1.8 s: x + v r + 2 r^2 with r = 1.8 - t.
    last = brentq(lambda t: 0.1 * t**2 + 0.2 * t * (1.8 - t) + 2 * (1.8 - t) ** 2 - 0.85, 0, 1.8)
    assert found.avoidable_until <= last + 0.02
    assert found.no_escape_from >= last - 0.06  # It has to stay for 0.2 s, too.
    assert "could avoid it until" in str(found)
    assert " 0 s before" not in str(found)


@pytest.mark.slow
def test_a_cart_pole_of_gymnax_is_saved_by_a_beam_over_its_states():
    pytest.importorskip("gymnax")

    def leaning(observation):
        return jnp.where(observation[2] > 0, 1, 0)

    system = vj.gymnax("CartPole-v1", leaning, steps=120, initial={"theta0": "theta"})
    problem = vj.Problem("upright", {"theta0": vj.Box(-0.1, 0.1)}, system, "always abs(theta) < .2")
    options = {"forks": 1024, "rounds": 4, "progress": False}
    for start in (-0.03, 0.05):  # Their failing traces differ in length.
        found = vj.last_chance(problem, {"theta0": start}, **options)
        escape = found.escape.trace.trim()
        assert np.abs(escape.signals["theta"]).max() < 0.2
        assert escape.length == 121
        assert found.failed - 0.25 < found.avoidable_until < found.failed


def test_a_row_that_does_not_fail_is_refused():
    with pytest.raises(ValueError, match=r"the simulation of 'wall' does not fail when simulated"):
        vj.last_chance(
            vj.Problem("wall", WALL.space, WALL.system, "always x <= 99"), {"v0": 5.0},
            actions=(-1, 1), progress=False,
        )  # fmt: skip


def test_a_system_that_cannot_fork_is_refused():
    box = vj.blackbox(lambda f: Trace({"x": np.full(3, f["v0"])}, dt=1.0))
    problem = vj.Problem("box", {"v0": vj.Box(4, 8)}, box, "always x <= 1")
    with pytest.raises(ValueError, match=r"the system of problem 'box' cannot fork: last_chance"):
        vj.last_chance(problem, {"v0": 5.0}, actions=(-1, 1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "the actions in problem 'car' have no bounds"),
        ({"actions": (1, -1)}, r"actions must be a pair \(lowest, highest\) of finite numbers"),
        ({"actions": 3}, r"actions must be a pair .* got 3"),
        ({"by": "enviroment"}, "unknown by 'enviroment'; did you mean 'environment'"),
        ({"by": "environment", "features": ["w"]}, "unknown feature 'w'"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, message):
    with pytest.raises((ValueError, UnknownNameError), match=message):
        vj.last_chance(CAR, {"v": 8.0, "r": 2.0}, **options)


def test_a_problem_needs_the_features():
    with pytest.raises(ValueError, match="row must be the features of a failing simulation"):
        vj.last_chance(CAR, 3, actions=(-CURVATURE, CURVATURE))
