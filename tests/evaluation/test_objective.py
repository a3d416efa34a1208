"""The robustness as a function of a point: the engine's number, with derivatives, for everyone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.compute.keys import run_keys, simulation_key
from verifai_jax.evaluation.evaluator import Evaluator

SPACE = {"x0": vj.Box(-1.0, 1.0), "v": vj.Normal(0.0, 0.5), "push": vj.Signal(vj.Box(-1, 1), 3)}
SPEC = {"near": "always[0, 2] abs(x) <= 1.5", "back": "eventually[1, 2] x <= 0.2"}
TIMES = np.arange(21) * 0.1


def drifting(features, key):
    """A position under a drift and a push; lost where it starts beyond 0.95."""
    pushed = features["push"].over(2.0)(jnp.asarray(TIMES))
    x = features["x0"] + features["v"] * TIMES + jnp.cumsum(pushed) * 0.1
    return vj.Trace({"x": jnp.where(features["x0"] > 0.95, jnp.nan, x)}, dt=0.1)


PROBLEM = vj.Problem("drifting", SPACE, drifting, SPEC)
POINTS = np.random.default_rng(0).uniform(size=(64, 5)).astype(np.float32)
SMOOTH = vj.mtl.smooth(0.05)


def test_it_is_the_robustness_of_the_engine():
    verdicts = Evaluator(PROBLEM, 64)(POINTS)
    found = jax.jit(jax.vmap(PROBLEM.objective()))(POINTS)
    np.testing.assert_allclose(found, verdicts.lowest, rtol=1e-5, atol=1e-6)
    assert np.isnan(found).any()
    for column, name in enumerate(SPEC):
        one = jax.jit(jax.vmap(PROBLEM.objective(formula=name)))(POINTS)
        np.testing.assert_allclose(one, verdicts.rho[:, column], rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_features_and_points_are_two_ways_to_say_the_same():
    of_unit = jax.jit(PROBLEM.objective(SMOOTH))
    of_features = jax.jit(PROBLEM.objective(SMOOTH, of="features"))
    u = POINTS[0]
    assert of_features(PROBLEM.space.unflatten(u)) == pytest.approx(float(of_unit(u)), rel=1e-5)
    written = {"x0": 0.5, "v": 0.1, "push": [0.0, 0.5, -0.5]}
    point = PROBLEM.space.flatten(written)
    assert of_features(written) == pytest.approx(float(of_unit(point)), rel=1e-4)
    trace = drifting(PROBLEM.space.coerce(written), None)
    least = min(float(vj.robustness(formula, trace, SMOOTH)) for formula in SPEC.values())
    assert of_features(written) == pytest.approx(least, rel=1e-5)


def differences(function, at, step=1e-6):
    """Central differences along each entry of an array."""
    sides = [(at + step * e, at - step * e) for e in np.eye(len(at))]
    return np.array([(float(function(a)) - float(function(b))) / (2 * step) for a, b in sides])


@pytest.mark.slow
def test_its_gradient_is_that_of_central_differences():
    with jax.enable_x64(True):
        of_unit = jax.jit(PROBLEM.objective(SMOOTH))
        u = POINTS[1].astype(np.float64)
        expected = differences(of_unit, u)
        np.testing.assert_allclose(jax.grad(of_unit)(u), expected, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(jax.jacfwd(of_unit)(u), expected, rtol=1e-6, atol=1e-8)

        of_features = jax.jit(PROBLEM.objective(SMOOTH, of="features"))
        knots = np.array([0.1, -0.4, 0.6])
        gradient = jax.grad(of_features)({"x0": 0.3, "v": -0.2, "push": knots})
        of_knots = lambda k: of_features({"x0": 0.3, "v": -0.2, "push": k})  # noqa: E731
        np.testing.assert_allclose(gradient["push"], differences(of_knots, knots), rtol=1e-6)
        assert np.isfinite([gradient["x0"], gradient["v"]]).all()


@pytest.mark.thorough
def test_where_there_is_no_verdict_the_gradient_is_no_step():
    lost = PROBLEM.space.flatten({"x0": 1.0, "v": 0.0, "push": [0, 0, 0]})
    rho, gradient = jax.jit(jax.value_and_grad(PROBLEM.objective(SMOOTH)))(lost)
    assert np.isnan(rho)
    assert not np.isfinite(gradient).all() or not np.any(gradient)


def noisy(features, key):
    return vj.Trace({"x": features["a"] + jax.random.normal(key, (5,))}, dt=1.0)


NOISY = vj.Problem("noisy", {"a": vj.Box(0, 1)}, noisy, "always x < 1")


def test_the_key_is_that_of_the_simulation():
    u = np.array([[0.25], [0.75]], np.float32)
    verdicts = Evaluator(NOISY, 2, seed=3)(u, first=7)
    keys = jnp.stack([simulation_key(run_keys(3)[1], row) for row in (7, 8)])
    rho = jax.jit(NOISY.objective())
    np.testing.assert_allclose(jax.vmap(rho)(u, keys), verdicts.lowest, rtol=1e-5)
    assert NOISY.objective(key=keys[0])(u[0]) == rho(u[0], keys[0]) != rho(u[0])
    assert rho(u[0]) == rho(u[0])


def test_choices_are_given_by_name():
    def system(features, key):
        values = jnp.array([0.5, 2.0])[features["kind"]] * features["a"]
        return vj.Trace({"x": values[None]}, dt=1.0)

    space = {"a": vj.Box(0, 1), "kind": vj.Categorical("calm", "gusty")}
    rho = vj.Problem("choice", space, system, "x < 1").objective(of="features")
    gradient = jax.grad(lambda a: rho({"a": a, "kind": "gusty"}))(0.5)
    assert gradient == pytest.approx(-2.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"of": "point"}, "unknown argument of an objective 'point'.*unit, features"),
        ({"formula": "neer"}, "unknown formula 'neer'; did you mean 'near'"),
    ],
)
def test_wrong_options_are_refused_at_once(options, words):
    with pytest.raises(ValueError, match=words):
        PROBLEM.objective(**options)


@pytest.mark.parametrize(
    ("features", "words"),
    [
        ({"x0": 0.0, "v": 0.0}, "feature 'push' is missing; got x0, v"),
        ({"x0": 0.0, "w": 0.0}, "unknown feature 'w'"),
        (POINTS[0], r"is a function of='features' and got an array; objective\(..., of='unit'\)"),
        (
            {"x0": 0.0, "v": 0.1, "push": [0.5, 0.5]},
            r"'push.knots' must have shape \[3\]; got \[2\]",
        ),
        ({"x0": [0.0, 0.0], "v": 0.1, "push": 0.5}, r"'x0' must have shape \[\]; got \[2\]"),
        (
            {"x0": 0.0, "v": 0.1, "push": vj.Waveform(np.zeros(3), hold="constant")},
            "a Signal with hold='linear' and duration=None cannot be Waveform.*constant",
        ),
    ],
)
def test_wrong_features_are_refused(features, words):
    with pytest.raises(ValueError, match=words):
        PROBLEM.objective(of="features")(features)


def test_semantics_are_no_text():
    with (
        unchecked(),
        pytest.raises(TypeError, match=r"mtl.hard or mtl.smooth\(0.1\); got 'smooth'"),
    ):
        PROBLEM.objective("smooth")  # pyright: ignore[reportArgumentType]


def test_features_in_place_of_a_point_are_refused():
    with pytest.raises(ValueError, match="of='unit' and got a dictionary"):
        PROBLEM.objective()({"x0": 0.0})


def test_a_host_system_has_none():
    def simulate(features):
        raise AssertionError("nothing is simulated")

    problem = vj.Problem("host", {"a": vj.Box(0, 1)}, vj.blackbox(simulate), "always x < 1")
    with pytest.raises(vj.ProblemError, match="'host' has no objective: its system runs on the"):
        problem.objective()


def test_what_does_not_fit_is_said_before_anything_compiles():
    problem = vj.Problem("wrong", SPACE, drifting, "always y < 1")
    with pytest.raises(ValueError, match="no signal 'y'"):
        problem.objective()
