"""A sequence of scenarios: its probability from those of its parts, and its counterexamples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj

STEPS = 20


def drift(name, fails):
    """A walk whose drift `w` is a feature: it fails beyond a distance that each part has."""

    def walk(features, key):
        noise = 0.05 * jax.random.normal(key, (STEPS,))
        moved = features["w"] * jnp.arange(1, STEPS + 1) / STEPS + jnp.cumsum(noise)
        x = features["x0"] + jnp.concatenate([jnp.zeros(1), moved])
        return vj.Trace({"x": x, "twice": jnp.stack([x, 2 * x], axis=1)}, dt=0.1)

    space = {"x0": vj.Box(-1, 1), "w": vj.Box(-1, 1)}
    return vj.Problem(name, space, walk, fails)


FIRST = drift("first", "always x < 1.2")
# What the first part hands over lies between -2.5 and 1.2.
SECOND = vj.Problem("second", {**FIRST.space.domains, "x0": vj.Box(-3, 2)}, FIRST.system,
                    "always abs(x) < 1.3")  # fmt: skip


def whole():
    """The two parts as one problem."""

    def both(features, key):
        one, two = jax.random.split(key)
        first = FIRST.system({"x0": features["x0"], "w": features["w"]}, one)
        x = first.signals["x"]
        second = FIRST.system({"x0": x[-1], "w": features["w2"]}, two)
        return vj.Trace({"a": x, "b": second.signals["x"]}, dt=0.1)

    space = {**FIRST.space.domains, "w2": vj.Box(-1, 1)}
    return vj.Problem("whole", space, both, "(always a < 1.2) and (always abs(b) < 1.3)")


@pytest.fixture(scope="module")
def truth():
    run = vj.falsify(whole(), "uniform", 200_000, batch=8192, confirm=False, progress=False)
    return run.failure_rate.estimate


@pytest.mark.slow
def test_the_interval_holds_the_probability_of_the_whole(truth):
    found = vj.sequence([FIRST, SECOND], {"x0": "x"}, samples=2000, progress=False)
    assert found.low < truth < found.high
    assert found.high - found.low < 0.12
    assert found.simulations == 2000 + found.parts[1].samples
    assert found.parts[1].samples == round(2000 * (1 - found.parts[0].probability))
    assert "first then second fails with probability" in str(found)
    failures = found.counterexamples
    assert set(failures["part"]) == {"first", "second"}
    later = failures[failures["part"] == "second"].iloc[0]
    assert np.isfinite(later[["first.x0", "first.w", "second.x0", "second.w"]].astype(float)).all()
    # An entry of a vector is handed over too, and a feature that the part before has.
    again = vj.sequence([FIRST, SECOND], {"x0": "twice[0]", "w": "w"}, samples=500, progress=False)
    kept = again.counterexamples.query("part == 'second'")
    np.testing.assert_allclose(kept["first.w"], kept["second.w"], atol=1e-5)


@pytest.mark.slow
def test_rows_of_runs_are_used_again(truth):
    runs = [
        vj.falsify(problem, "uniform", 4000, batch=2048, confirm=False, progress=False)
        for problem in (FIRST, SECOND)
    ]
    found = vj.sequence(runs, {"x0": "x"}, samples=2000, progress=False)
    assert found.parts[0].samples == 4000
    assert found.low < truth < found.high
    assert 50 < found.parts[1].effective < found.parts[1].samples
    # Only ends of the first part and some counterexamples are simulated.
    assert found.simulations <= 2000 + 16
    assert "the interval of second is approximate" in str(found)
    assert len(found.counterexamples.query("part == 'second'")) > 8


@pytest.mark.proves
def test_composed_probabilities_lie_in_the_intervals_of_the_whole():
    """In 19 of 20 seeds, by fresh samples and by the rows of runs. It takes two minutes."""
    problem, held = whole(), {"fresh": 0, "runs": 0}
    for seed in range(20):
        options = {"confirm": False, "progress": False, "seed": seed}
        rate = vj.falsify(problem, "uniform", 1000, **options).failure_rate
        runs = [vj.falsify(p, "uniform", 20_000, batch=4096, **options) for p in (FIRST, SECOND)]
        for name, parts in (("fresh", [FIRST, SECOND]), ("runs", runs)):
            found = vj.sequence(
                parts, {"x0": "x"}, samples=20_000, batch=4096, seed=100 + seed, progress=False
            )
            held[name] += rate.low <= found.probability <= rate.high
    assert min(held.values()) >= 18, held


@pytest.mark.thorough
def test_what_begins_outside_of_a_space_has_no_verdict():
    def simulate(features, seed):
        return vj.Trace({"x": features["x0"] + np.array([0.0, 1.0])}, dt=1.0)

    first = vj.Problem(
        "one", {"x0": vj.Box(0, 1)}, vj.blackbox(simulate, seeded=True), "always x < 9"
    )
    second = vj.Problem(
        "two", {"x0": vj.Box(0, 1.5)}, vj.blackbox(simulate, seeded=True), "always x < 9"
    )
    found = vj.sequence([first, second], {"x0": "x"}, samples=40, progress=False)
    part = found.parts[1]
    assert 10 < part.without < 30
    assert part.low == 0
    assert part.high > part.without / 40
    assert len(found.counterexamples) == 0


@pytest.mark.slow
def test_what_is_wrong_is_said():
    with pytest.raises(ValueError, match="a sequence has two parts or more"):
        vj.sequence([FIRST], {"x0": "x"})
    with pytest.raises(ValueError, match="the parts need different names; got first, first"):
        vj.sequence([FIRST, FIRST], {"x0": "x"})
    with pytest.raises(ValueError, match="handover is a dictionary, or a list of 1"):
        vj.sequence([FIRST, SECOND], [{"x0": "x"}, {"x0": "x"}])
    with pytest.raises(ValueError, match="unknown feature of second 'x1'"):
        vj.sequence([FIRST, SECOND], {"x1": "x"})
    with pytest.raises(ValueError, match="unknown signal or feature of first 'y'"):
        vj.sequence([FIRST, SECOND], {"x0": "y"})
    run = vj.falsify(SECOND, "cross_entropy", 64, batch=64, confirm=False, progress=False)
    with pytest.raises(ValueError, match="the rows of second are no samples of its prior"):
        vj.sequence([FIRST, run], {"x0": "x"})
