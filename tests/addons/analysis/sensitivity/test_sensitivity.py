"""Sensitivity against functions whose indices are known exactly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.addons.analysis.sensitivity.gradients import gradient_sensitivity
from verifai_jax.addons.analysis.sensitivity.morris import elementary_steps, morris
from verifai_jax.addons.analysis.sensitivity.sensitivity import Coordinates
from verifai_jax.addons.analysis.sensitivity.sobol import NOISE, sobol_indices


def problem(function, space, name="p", **options):
    """A problem whose robustness is a function of the features."""

    def system(features, key):
        y = jnp.asarray(function(features, key), jnp.float32)
        return vj.Trace({"y": y[None]}, dt=1.0)

    return vj.Problem(name, space, system, options.pop("spec", "y >= 0"), **options)


@pytest.fixture(scope="module")
def ishigami():
    """Ishigami and Homma 1990, with a = 7 and b = 0.1."""
    names = ("x1", "x2", "x3")

    def function(f, key):
        return jnp.sin(f["x1"]) + 7 * jnp.sin(f["x2"]) ** 2 + 0.1 * f["x3"] ** 4 * jnp.sin(f["x1"])

    return problem(function, {name: vj.Box(-np.pi, np.pi) for name in names}, "ishigami")


def known_ishigami():
    a, b = 7.0, 0.1
    v1 = 0.5 * (1 + b * np.pi**4 / 5) ** 2
    v2 = a**2 / 8
    v13 = b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    v = v1 + v2 + v13
    return {"x1": v1 / v, "x2": v2 / v, "x3": 0.0}, {
        "x1": (v1 + v13) / v,
        "x2": v2 / v,
        "x3": v13 / v,
    }


def test_sobol_of_ishigami(ishigami):
    found = sobol_indices(ishigami, samples=4096)
    first, total = known_ishigami()
    assert found.simulations == 4096 * 5 + 1024  # one batch more looks for noise
    assert found.dropped == 0
    for name in first:
        row = found.table.loc[name]
        assert row["first"] == pytest.approx(first[name], abs=0.02)
        assert row["total"] == pytest.approx(total[name], abs=0.02)
        assert row["first_low"] - 0.01 <= first[name] <= row["first_high"] + 0.01
        assert row["total_low"] - 0.01 <= total[name] <= row["total_high"] + 0.01
        assert row["total_high"] - row["total_low"] < 0.12
    assert list(found.table.index) == ["x1", "x2", "x3"]  # by total: 0.558, 0.442, 0.244
    assert "x1  " in str(found)
    assert "alone" in str(found)


def test_sobol_of_the_g_function():
    """Saltelli and Sobol 1995: four factors of falling importance."""
    a = np.array([0.0, 1.0, 4.5, 9.0])

    def function(f, key):
        return jnp.prod((jnp.abs(4 * f["x"] - 2) + a) / (1 + a))

    partial = 1 / (3 * (1 + a) ** 2)
    variance = np.prod(1 + partial) - 1
    total = partial * np.prod(1 + partial) / (1 + partial) / variance
    space = {"x": vj.Box([0.0] * 4, [1.0] * 4)}
    found = sobol_indices(problem(function, space), samples=4096).table
    assert list(found.index) == ["x[0]", "x[1]", "x[2]", "x[3]"]
    np.testing.assert_allclose(found["first"], partial / variance, atol=0.02)
    np.testing.assert_allclose(found["total"], total, atol=0.02)


@pytest.fixture(scope="module")
def mixed():
    """Robustness 2 real + 3 place of the choice + integer / 2, and NaN for large real."""

    def function(f, key):
        y = 2 * f["real"] + 3 * f["kind"] + 0.5 * f["whole"]
        return jnp.where(f["real"] > 0.9, jnp.nan, y)

    space = {
        "real": vj.Box(0, 1),
        "kind": vj.Categorical("a", "b"),
        "whole": vj.DiscreteBox(0, 4),
        "none": vj.Box(-1, 1),
    }
    return problem(function, space, "mixed")


def test_simulations_without_a_verdict_are_dropped_with_their_partners(mixed):
    found = sobol_indices(mixed, samples=2048)
    # A tenth of A's, B's and every swapped block; where real is swapped, a tenth of B's.
    assert found.dropped == pytest.approx(0.1 * (2048 * 6 + 1024), rel=0.1)
    assert "had no verdict" in str(found)
    # Given real <= 0.9 the features are still independent: their variances add.
    variances = {"real": 4 * 0.9**2 / 12, "kind": 9 / 4, "whole": 0.25 * 2, "none": 0.0}
    for name, variance in variances.items():
        row = found.table.loc[name]
        assert row["first"] == pytest.approx(variance / sum(variances.values()), abs=0.03)
        assert row["total"] == pytest.approx(variance / sum(variances.values()), abs=0.03)
    assert found.table.loc["kind", "pairs"] == pytest.approx(0.81 * 2048, rel=0.02)


def test_noise_is_an_input_of_its_own():
    def function(f, key):
        return f["x"] + 2 * (jax.random.uniform(key) < 0.5)

    found = sobol_indices(problem(function, {"x": vj.Box(0, 1)}), samples=2048)
    share = (1 / 12) / (1 / 12 + 1)
    assert found.table.loc["x", "total"] == pytest.approx(share, abs=0.02)
    assert found.table.loc["x", "first"] == pytest.approx(share, abs=0.03)
    assert found.table.loc[NOISE, "total"] == pytest.approx(1 - share, abs=0.03)


def test_elementary_effects_of_a_linear_function_are_its_slopes(mixed):
    result = morris(mixed, trajectories=64)
    found = result.table
    assert "moves the robustness by 3 (3 to 3) over its range" in str(result)
    assert ", up on average" in str(result)
    # Over the whole range: 2 for real, 3 between the choices, 2 for whole from 0 to 4.
    for name, effect in {"real": 2.0, "kind": 3.0, "whole": 2.0, "none": 0.0}.items():
        assert found.loc[name, "mu_star"] == pytest.approx(effect, abs=1e-4)
    assert found.loc["real", "mu"] == pytest.approx(2.0, abs=1e-4)
    assert np.isnan(found.loc["kind", "mu"])  # no order, no direction
    assert found.loc["real", "sigma"] < 1e-3


def test_elementary_effects_against_all_steps_of_the_grid(ishigami):
    found = morris(ishigami, trajectories=1024)
    assert found.simulations == 1024 * 4
    place = np.linspace(-np.pi, np.pi, 9)[1::2]  # the middles of four cells
    x1, x2, x3 = np.meshgrid(place, place, place, indexing="ij")
    y = np.sin(x1) + 7 * np.sin(x2) ** 2 + 0.1 * x3**4 * np.sin(x1)
    for axis, name in enumerate(("x1", "x2", "x3")):
        lower, upper = np.split(y, 2, axis=axis)
        effects = (upper - lower) / 0.5
        row = found.table.loc[name]
        assert row["mu_star"] == pytest.approx(np.mean(np.abs(effects)), rel=0.1, abs=1e-3)
        assert row["sigma"] == pytest.approx(np.std(effects), rel=0.1, abs=1e-3)
        assert row["mu"] == pytest.approx(np.mean(effects), rel=0.1, abs=0.3)


def test_gradients_of_ishigami(ishigami):
    found = gradient_sensitivity(ishigami, samples=4096)
    # Of E[(df/dx)^2] by hand, times (2 pi)^2 for unit coordinates.
    b, mean4, mean8, mean6 = 0.1, np.pi**4 / 5, np.pi**8 / 9, np.pi**6 / 7
    exact = {
        "x1": 0.5 * (1 + 2 * b * mean4 + b**2 * mean8),
        "x2": 49 / 2,
        "x3": 16 * b**2 * mean6 * 0.5,
    }
    _, total = known_ishigami()
    for name, squared in exact.items():
        row = found.table.loc[name]
        assert row["mean_squared"] == pytest.approx(squared * 4 * np.pi**2, rel=0.03)
        assert row["bound"] == pytest.approx(row["mean_squared"] / np.pi**2 / found.variance)
        assert row["low"] <= row["bound"] <= row["high"]
        assert row["bound"] >= total[name]
    assert found.simulations == 4096


def test_discrete_coordinates_have_no_gradient(mixed):
    found = gradient_sensitivity(mixed, samples=256)
    assert np.isnan(found.table.loc["kind", "bound"])
    assert found.table.loc["real", "slope"] == pytest.approx(2.0, rel=1e-4)
    assert found.dropped > 0
    assert "kind   discrete: has no gradient" in str(found)


def test_the_same_seed_gives_the_same_table(mixed):
    one, other = (sobol_indices(mixed, samples=256, batch=b) for b in (256, 100))
    assert one.table.equals(other.table)
    assert not one.table.equals(sobol_indices(mixed, samples=256, seed=1).table)


def test_black_boxes_are_simulated_and_have_no_gradient():
    @vj.blackbox
    def system(features):
        return vj.Trace({"y": np.array([features["a"] + 0.0])}, dt=1.0)

    black = vj.Problem("black", {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}, system, "y >= 0")
    found = sobol_indices(black, samples=64).table
    assert found.loc["a", "total"] == pytest.approx(1.0, abs=0.1)
    assert found.loc["b", "total"] == 0
    with pytest.raises(ValueError, match="black box, which has no gradient; use sobol_indices"):
        gradient_sensitivity(black)


def test_what_cannot_work_is_refused_with_the_reason(mixed, ishigami):
    with pytest.raises(ValueError, match="samples must be an integer of at least 16; got 3"):
        sobol_indices(mixed, samples=3)
    with pytest.raises(ValueError, match="levels must be an even number of at least 2; got 5"):
        morris(mixed, levels=5)
    with pytest.raises(ValueError, match="unknown formula 'safe'"):
        sobol_indices(mixed, of="safe")
    with unchecked(), pytest.raises(TypeError, match="needs a Problem; got str"):
        morris("balance")
    flat = problem(lambda f, key: 0.0 * f["x"] + 2.0, {"x": vj.Box(0, 1)}, "flat")
    with pytest.raises(ValueError, match="robustness of problem 'flat' is 2 in all of"):
        sobol_indices(flat, samples=16)
    never = problem(lambda f, key: f["x"] * jnp.nan, {"x": vj.Box(0, 1)}, "never")
    with pytest.raises(ValueError, match="none of 64 simulations of problem 'never' has a verdict"):
        morris(never)
    fixed = problem(lambda f, key: f["x"], {"x": vj.Constant(1.0)})
    with pytest.raises(ValueError, match="nothing varies"):
        morris(fixed)
    space = vj.FeatureSpace({"x": vj.Box(0, 1)}, where=lambda f: f["x"] > 0.5)
    tied = problem(lambda f, key: f["x"], space, "tied")
    for analysis in (sobol_indices, morris, gradient_sensitivity):
        with pytest.raises(ValueError, match=r"has a constraint \(where\), so its features depend"):
            analysis(tied)


@pytest.mark.slow
def test_pictures_are_drawn_and_written(ishigami, mixed, tmp_path):
    from PIL import Image

    for name, found in {
        "sobol": sobol_indices(mixed, samples=256),
        "morris": morris(mixed, trajectories=64),
        "gradient": gradient_sensitivity(mixed, samples=256),
    }.items():
        path = tmp_path / f"{name}.png"
        found.plot(path)
        with Image.open(path) as image:
            assert image.size[0] > 300


def test_steps_of_discrete_coordinates():
    space = Coordinates(
        ("c", "n", "one"), (3, 5, 1), (False, True, True), ((0.5, 0.3, 0.2), None, None)
    )
    start, stop, step = elementary_steps(np.array([3, 5, 1]), space, np.random.default_rng(0), 6000)
    pairs, counts = np.unique(np.stack([start[:, 0], stop[:, 0]]), axis=1, return_counts=True)
    # Every choice is left for every other one equally often, never for itself.
    assert pairs.T.tolist() == [[0, 1], [0, 2], [1, 0], [1, 2], [2, 0], [2, 1]]
    np.testing.assert_allclose(counts, 1000, rtol=0.15)
    assert (step[:, 0] == 1).all()
    # Whole numbers move by half of the range, inside of it.
    assert (abs(stop[:, 1] - start[:, 1]) == 2).all()
    np.testing.assert_array_equal(step[:, 1], (stop[:, 1] - start[:, 1]) / 4)
    assert set(stop[:, 1]) | set(start[:, 1]) == set(range(5))
    assert (step[:, 2] == 0).all()
    middles = space.centres(np.array([[0, 2, 0], [2, 0, 0]]), np.array([3, 5, 1]))
    np.testing.assert_allclose(middles, [[0.25, 0.5, 0.5], [0.9, 0.1, 0.5]])
