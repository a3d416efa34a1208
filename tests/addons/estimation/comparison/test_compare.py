"""Comparisons with known differences: verdicts, pairs, what is refused, and where they differ."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.addons.estimation.comparison.result import judge
from verifai_jax.addons.estimation.paired_rates import PairedRates, paired_rates
from verifai_jax.cli.main import main
from verifai_jax.problem import ProblemError

SPACE = {"a": vj.Box(0.0, 1.0), "b": vj.Box(0.0, 1.0)}


def make(threshold, name="square", noise=0.0, space=SPACE, spec="always x < 1"):
    """A problem that fails where `a` is above the threshold (and `b` above a half)."""

    def system(f, key):
        shake = noise * (jax.random.uniform(key) - 0.5)
        fails = (f["a"] + shake > threshold) & (f["b"] > 0.5)
        return vj.Trace({"x": jnp.where(fails, 2.0, 0.0) * jnp.ones(2)}, dt=1.0)

    return vj.Problem(name, space, system, spec)


BASE = make(0.9)


@pytest.mark.slow
def test_a_pair_of_systems_that_draw_fails_again_under_its_key():
    sides = make(0.9, noise=0.4), make(0.8, name="candidate", noise=0.4)
    result = vj.compare(*sides, budget=4000)
    pair, row = next(iter(result.candidates[0].discordant.iterrows()))
    features = {name: jnp.float32(row[name]) for name in SPACE}
    key = result.random_key(pair)
    fails = [float(side.system(features, key).signals["x"].max()) >= 1 for side in sides]
    assert fails == [not row["worse"], bool(row["worse"])]


@pytest.mark.slow
def test_a_regression_is_found_and_lies_where_it_does():
    result = vj.compare(BASE, make(0.8))
    one = result.candidates[0]
    assert (result.verdict, result.regression, result.stopped) == ("worse", True, "decided")
    assert one.rates.low < 0.05 < one.rates.high
    assert one.rates.only_first == 0
    assert result.simulations == 2 * one.rates.pairs
    assert one.discordant["worse"].all()
    assert ((one.discordant["a"] > 0.8) & (one.discordant["a"] <= 0.9)).all()
    assert f"{one.rates.only_second:,} pairs fail with it only" in str(result)
    longer = vj.compare(BASE, make(0.8), margin=0.03)
    assert longer.verdict == "worse"
    assert longer.candidates[0].rates.pairs > one.rates.pairs
    assert "0.8 < a <= 0.9 and b > 0.5: covers 100 %" in str(longer.candidates[0].rules())
    assert vj.compare(make(0.8), BASE).verdict == "better"


@pytest.mark.slow
def test_equal_ones_differ_in_no_pair_and_several_hold_together():
    result = vj.compare(BASE, {"same": make(0.9), "bad": make(0.7)}, margin=0.01, budget=30_000)
    same, bad = result["same"], result["bad"]
    assert (same.rates.only_first, same.rates.only_second) == (0, 0)
    assert (same.verdict, bad.verdict, result.verdict) == ("the same", "worse", "worse")
    # The same random keys too: noise of the system cancels.
    noisy = vj.compare(make(0.9, noise=0.2), make(0.9, noise=0.2), budget=2_000)
    assert len(noisy.candidates[0].discordant) == 0
    assert noisy.stopped == "budget"
    assert noisy.verdict == "undecided"
    assert "all intervals hold together at 95 %" in str(result)


@pytest.mark.thorough
def test_simulations_without_a_verdict_widen_the_interval():
    def broken(f, key):
        x = jnp.where(f["a"] > 0.5, jnp.nan, 0.0)
        return vj.Trace({"x": x * jnp.ones(2)}, dt=1.0)

    result = vj.compare(BASE, replace(BASE, system=broken), budget=2_000)
    rates = result.candidates[0].rates
    assert rates.undecided == pytest.approx(500, abs=80)
    assert rates.low < -0.4
    assert rates.high > 0.4
    assert result.verdict == "undecided"
    assert f"{rates.undecided:,} without a verdict" in str(result)


@pytest.mark.slow
def test_pairs_depend_on_the_seed_alone():
    where = vj.FeatureSpace(SPACE, where=lambda f: f["a"] < f["b"])
    rows = []
    for budget in (600, 1_200):
        result = vj.compare(make(0.9, space=where), make(0.9, space=where), budget=budget)
        rows.append(result.candidates[0].pairs)
        assert (rows[-1]["a"] < rows[-1]["b"]).all()
    np.testing.assert_array_equal(rows[0]["a"], rows[1]["a"][: len(rows[0])])


@pytest.mark.parametrize(
    ("candidate", "options", "error", "message"),
    [
        (3, {}, TypeError, "candidate must be a Problem; got int"),
        ({}, {}, ValueError, "at least one candidate"),
        (BASE, {"margin": -0.1}, ValueError, "margin must be a probability"),
        (BASE, {"budget": 1}, ValueError, "budget must be 2 at least"),
        (
            make(0.9, space={"a": vj.Box(0.0, 2.0), "b": SPACE["b"]}),
            {},
            ProblemError,
            r"a is Box\(0, 1\), there Box\(0, 2\)",
        ),
        (make(0.9, space=vj.FeatureSpace(SPACE, where=lambda f: f["a"] < 1)), {}, ProblemError,
         "only one of 'candidate' and the baseline has a constraint"),
    ],
)  # fmt: skip
def test_what_is_refused(candidate, options, error, message):
    if candidate == 3:
        candidate = {"candidate": 3}
    with unchecked(), pytest.raises(error, match=message):
        vj.compare(BASE, candidate, **options)


def test_verdicts_of_intervals():
    def at(low, high):
        return PairedRates(1, 1, 10, low, high, 0.95)

    assert judge(at(0.01, 0.2), 0.0) == "worse"
    assert judge(at(0.01, 0.2), 0.02) == "undecided"
    assert judge(at(-0.01, 0.01), 0.02) == "the same"
    assert judge(at(-0.2, -0.01), 0.02) == "better"
    assert judge(at(0.0, 0.0), 0.0) == "undecided"


@pytest.mark.proves
@pytest.mark.parametrize(("first", "second"), [(0.001, 0.006), (0.01, 0.01), (0.0, 0.02)])
def test_intervals_hold_at_all_times(first, second):
    rng = np.random.default_rng(7)
    looks = np.unique(np.geomspace(16, 6000, 12).astype(int))
    missed = 0
    for _ in range(60):
        draw = rng.random(6000)
        one = np.cumsum(draw < first)
        two = np.cumsum((draw >= first) & (draw < first + second))
        bounds = [paired_rates(int(one[n - 1]), int(two[n - 1]), int(n)) for n in looks]
        missed += not all(b.low <= second - first <= b.high for b in bounds)
    # More than 8 of 60 happens with probability 0.003 if each has an error of 5 %.
    assert missed <= 8


def test_eight_discordant_pairs_of_eight_decide_however_many_others():
    for pairs in (100, 10_000, 1_000_000):
        assert paired_rates(0, 8, pairs).low > 0 > paired_rates(8, 0, pairs).high
        assert paired_rates(0, 7, pairs).low <= 0
    with pytest.raises(ValueError, match="counts of pairs must be at least 0"):
        paired_rates(3, 3, 5)


@pytest.mark.slow
def test_the_command_compares_two_targets(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.py").write_text(
        "import jax.numpy as jnp\nimport verifai_jax as vj\n"
        "def make(t):\n"
        "    system = lambda f, key: vj.Trace({'x': (f['a'] > t) * jnp.ones(2)}, dt=1.0)\n"
        "    return vj.Problem('ramp', {'a': vj.Box(0.0, 1.0)}, system, 'always x < 0.5')\n"
        "old, new = make(0.9), make(0.8)\n"
    )
    arguments = ["compare", "spec.py:old", "spec.py:new", "--fail-on", "regression"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 1, result.output
    assert "spec.py:new is WORSE: fails in " in result.output
    assert CliRunner().invoke(main, [*arguments, "--margin", "0.5"]).exit_code == 0
