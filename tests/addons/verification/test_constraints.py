"""With a constraint all numbers of a proof are about accepted points, of known probability."""

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.verification.boxes import OUTSIDE


def problem(where, margin, **space):
    domains = {"x": vj.Box(-1, 1), "y": vj.Box(-1, 1)} | space
    return vj.Problem(
        "cut", vj.FeatureSpace(domains, where),
        lambda f, key: vj.Trace({"m": margin(f) * jnp.ones(2)}, dt=1.0), "always m >= 0",
    )  # fmt: skip


def contradictions(found, accepts, fails, count=200_000):
    """Return what a result says of accepted points that is not so, counted on a grid of draws.

    `accepts` and `fails` are functions of the features' values `x`, `y`.
    """
    boxes, random = found.boxes, np.random.default_rng(1)
    rows = random.choice(len(boxes), count, p=boxes.mass / boxes.mass.sum())
    u = boxes.low[rows] + random.random((count, 2)) * (boxes.high[rows] - boxes.low[rows])
    x, y = 2 * u.T - 1
    good = accepts(x, y)
    bad = good & fails(x, y)
    words, wrong = found.verdicts[rows], []
    if (bad & (words == "proved")).any() or (good & (words == "outside")).any():
        wrong.append("a box")
    if (good & ~bad & (boxes.state[rows] == 2)).any():
        wrong.append("a box that fails throughout")
    table = found.table.sort_index()
    for name in ("proved", "broken", "undecided"):
        part, share = getattr(found, name), np.mean(words[good] == name)
        off = 4 * np.sqrt(share * (1 - share) / good.sum()) + 1e-9
        if not part.low - off <= share <= part.high + off:
            wrong.append(f"{name}: {share} is not in {part}")
        if abs(table["mass"][table["verdict"] == name].sum() - part.mass) > 1e-9:
            wrong.append(f"{name}: the table has another mass")
    return wrong


CASES = {
    "half": (lambda f: f["x"] > f["y"], lambda f: f["x"] + f["y"], 0.5,
             lambda x, y: x > y, lambda x, y: x + y < 0),
    "band": (lambda f: jnp.abs(f["x"] - f["y"]) < 0.05, lambda f: f["x"] - 10.0, 1.0,
             lambda x, y: np.abs(x - y) < 0.05, lambda x, y: x < 10),
    "none fails": (lambda f: jnp.abs(f["x"] - f["y"]) < 0.05, lambda f: f["x"] + 10.0, 0.0,
                   lambda x, y: np.abs(x - y) < 0.05, lambda x, y: x > 10),
    "or": (lambda f: (f["x"] < -0.5) | ((f["x"] > 0.5) & (f["y"] > 0)), lambda f: f["y"] - 0.5,
           (0.5 * 1.5 + 0.5 * 0.5) / 1.5,
           lambda x, y: (x < -0.5) | ((x > 0.5) & (y > 0)), lambda x, y: y < 0.5),
    "disc": (lambda f: f["x"] ** 2 + f["y"] ** 2 < 1, lambda f: f["x"], 0.5,
             lambda x, y: x * x + y * y < 1, lambda x, y: x < 0),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("boxes", [20, 250])
@pytest.mark.parametrize("name", CASES)
def test_bounds_contain_the_probability_given_the_constraint(name, boxes):
    where, margin, truth, accepts, fails = CASES[name]
    found = vj.verify(problem(where, margin), boxes=boxes, samples=1000, progress=False)
    low, high = found.probability
    assert low <= truth <= high
    parts = found.proved, found.broken, found.undecided
    assert sum(part.mass for part in parts) == pytest.approx(1.0)
    assert all(part.low <= part.mass <= part.high for part in parts)
    assert contradictions(found, accepts, fails) == []
    assert "of the accepted prior" in str(found)
    if name == "half" and boxes == 250:
        assert high - low < 0.25


@pytest.mark.slow
def test_intervals_hold_as_often_as_they_say():
    """Of a band that the constraint accepts half of what lies in the box fails, at any seed."""
    made, misses = problem(lambda f: f["x"] > f["y"], lambda f: f["x"] + f["y"]), 0
    for seed in range(16):
        found = vj.verify(made, boxes=12, samples=300, seed=seed, progress=False)
        misses += not found.probability[0] <= 0.5 <= found.probability[1]
    assert misses == 0


def test_a_constraint_that_accepts_nothing_is_an_error():
    for where in (lambda f: f["x"] > 2, lambda f: f["x"] == f["y"] + 0.123456):
        with pytest.raises(ValueError, match="where accepted none of 65536 samples"):
            vj.verify(problem(where, lambda f: f["x"]), boxes=4, progress=False)


@pytest.mark.slow
def test_an_estimate_weighs_what_a_proof_leaves_by_what_is_accepted():
    """Few boxes are cut, and none is refused as a whole: the rest is half as probable as it is."""
    made = problem(lambda f: f["x"] > f["y"], lambda f: f["x"] + f["y"])
    proved = vj.verify(made, boxes=6, samples=0, progress=False)
    assert not (proved.boxes.state == OUTSIDE).all()
    found = vj.estimate(made, "monte_carlo", 2000, proved=proved, progress=False)
    assert found.low <= 0.5 <= found.high


@pytest.mark.slow
def test_tables_and_pictures_have_values_and_tails_are_named(tmp_path):
    def system(f, key):
        return vj.Trace({"m": (f["gain"] * f["n"] + f["wind"]) * jnp.ones(2)}, dt=1.0)

    made = vj.Problem(
        "values", {"gain": vj.Box(-3, 5), "n": vj.DiscreteBox(2, 5), "wind": vj.Normal(0, 2),
                   "kind": vj.Categorical("up", "down")}, system, "always m >= 0",
    )  # fmt: skip
    found = vj.verify(made, boxes=60, samples=64, progress=False)
    table = found.table
    assert table["gain from"].min() == -3
    assert table["gain to"].max() == 5
    assert table["wind to"].max() == pytest.approx(11.08, abs=0.01)
    assert set(table["kind from"]) == {"up", "down"}
    assert (table["n from"].min(), table["n to"].max()) == (2, 5)
    proved = table[table["verdict"] == "proved"]
    assert (proved["gain from"] * proved["n from"] + proved["wind from"] >= -1e-5).all()
    assert found.tails == {"wind": 2 * 2.0**-26}
    assert "  tails        nothing is known of the outermost tails of wind" in str(found)
    axes = found.plot().axes
    assert {axis.get_xlim() for axis in axes if axis.get_xlabel() == "gain"} == {(-3.0, 5.0)}
    page = found.report(tmp_path / "values.html", problem=made, units={"gain": "1/s"}).read_text()
    assert "gain [1/s] from" in page
    assert "Nothing is known of the outermost tails of wind" in page
    again = vj.load_verification(found.save(tmp_path / "values.json"))
    assert again.table.equals(table)
    assert str(again) == str(found)
