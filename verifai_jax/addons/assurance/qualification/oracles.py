"""Oracles: results of the tool, compared with independent definitions.

    for name, check in ORACLES.items(): check()             # AssertionError where it is wrong

Each uses a definition, a closed form or another library, and takes seconds.
"""

import math
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from verifai_jax import mtl
from verifai_jax.addons.assurance.qualification.random_formulas import DT, brute, random_formulas
from verifai_jax.addons.assurance.qualification.recorded_oracles import (
    judgements,
    matrices,
    monitors,
    readings,
)
from verifai_jax.addons.estimation import estimate
from verifai_jax.addons.estimation.comparison import compare
from verifai_jax.addons.verification._verify import verify
from verifai_jax.core.values.trace import Trace
from verifai_jax.counterexamples import shrink
from verifai_jax.falsification import falsify, load, resume, simulate
from verifai_jax.features import (
    Box,
    Categorical,
    DiscreteBox,
    FeatureSpace,
    LogNormal,
    LogUniform,
    Normal,
)
from verifai_jax.problem import Problem
from verifai_jax.statistics.binomial import clopper_pearson, simulations_without_failure
from verifai_jax.statistics.confidence_sequences import anytime_interval
from verifai_jax.systems.blackbox import blackbox
from verifai_jax.systems.ode import ode

LIMIT = 0.6


def formulas() -> None:
    """Check that random formulas have the robustness of their definition, on random traces."""
    for formula, tree, values in random_formulas(1):
        found = float(mtl.robustness(formula, Trace(values, dt=DT)))
        assert found == brute(tree, values, 0), f"{formula}: {found}"
        assert mtl.parse(str(formula)) == formula, f"{formula} is read back as another formula"


def zeros() -> None:
    """Check that a comparison decides at zero: x >= 0 holds and x > 0 does not."""
    trace = Trace({"x": np.zeros(3)}, dt=DT)
    found = [bool(mtl.satisfied(mtl.parse(f"always x {sign} 0"), trace)) for sign in (">=", ">")]
    assert found == [True, False], found
    for sign, expected in ((">", [True, False]), (">=", [False, False])):
        problem = _problem(formula=f"always x {sign} 0")
        run = simulate(problem, [{"a": 0.0}, {"a": 0.25}], progress=False)
        assert run.table.all["violated"].tolist() == expected, sign


def gradients() -> None:
    """Check gradients of the smooth robustness by finite differences, and its limit."""
    formula = mtl.parse("always[0, 2] (x > -1 or eventually[0, 1] x < y)")
    values, smooth = np.random.default_rng(2).normal(size=(2, 7)), mtl.smooth(0.2)

    def value(v: object, semantics: mtl.Semantics = smooth) -> jax.Array:
        x, y = jnp.asarray(v)
        return mtl.robustness(formula, Trace({"x": x, "y": y}, dt=DT), semantics)

    with jax.enable_x64(True):
        found, step = np.asarray(jax.grad(value)(values)), 1e-6
        for k in range(values.size):
            move = step * np.eye(values.size)[k].reshape(values.shape)
            difference = float(value(values + move) - value(values - move)) / (2 * step)
            assert abs(found.flat[k] - difference) < 1e-6, (k, found.flat[k], difference)
        near = float(value(values, mtl.smooth(1e-4))) - float(value(values, mtl.hard))
    assert abs(near) < 1e-2, near


def _system(features: dict[str, jax.Array], key: jax.Array) -> Trace:
    return Trace({"x": features["a"] * jnp.ones(4)}, dt=0.1)


def _problem(limit: float = LIMIT, formula: str = "") -> Problem:
    return Problem("known", {"a": Box(0.0, 1.0)}, _system, formula or f"always x <= {limit}")


def table() -> None:
    """Check that every simulation is one row, with the verdict that its features have."""
    run = falsify(_problem(), "uniform", 700, batch=64, progress=False)
    rows: Any = run.table.all
    assert len(rows) == 700 == rows["a"].nunique(), (len(rows), rows["a"].nunique())
    assert np.allclose(rows["rho"], LIMIT - rows["a"], atol=1e-6)
    assert (rows["violated"] == (rows["a"] > np.float32(LIMIT))).all()
    assert run.table.counts.violating == int((rows["a"] > LIMIT).sum())
    rate = run.failure_rate
    assert rate is not None
    # One run in a million has a share that is so far from 0.4.
    assert abs(rate.estimate - (1 - LIMIT)) < 4.9 * math.sqrt(0.24 / 700), rate
    assert rate.low < rate.estimate < rate.high
    assert run.best["a"] == rows["a"].max()


def statuses() -> None:
    """Check that a simulation that raises or is not finite gets a status and is no failure."""

    def broken(features: dict[str, float]) -> Trace:
        if features["a"] > 0.8:
            raise RuntimeError("out of order")
        value = math.nan if features["a"] < 0.2 else features["a"]
        return Trace({"x": np.full(3, value)}, dt=0.1)

    problem = replace(_problem(), system=blackbox(broken))
    run = falsify(problem, "uniform", 60, progress=False, confirm=False)
    rows: Any = run.table.all
    expected = np.where(rows["a"] > 0.8, "error", np.where(rows["a"] < 0.2, "nonfinite", "ok"))
    assert (rows["status"] == expected).all()
    assert not rows["violated"][rows["status"] != "ok"].any()
    rate = run.failure_rate
    assert rate is not None
    assert rate.high >= (rate.failures + int((rows["status"] != "ok").sum())) / 60


def intervals() -> None:
    """Check that intervals of rates are binomial, and that any-time intervals hold at all times."""
    from scipy.stats import binom

    for failures, count in ((0, 50), (3, 200), (7, 7), (40, 90)):
        found = clopper_pearson(failures, count)
        if failures:
            assert abs(binom.sf(failures - 1, count, found.low) - 0.025) < 1e-6, found
        if failures < count:
            assert abs(binom.cdf(failures, count, found.high) - 0.025) < 1e-6, found
        always = anytime_interval(failures, count)
        assert always.low <= found.low + 1e-9, (always, found)
        assert always.high >= found.high - 1e-9, (always, found)
    rng, missed = np.random.default_rng(3), 0
    for _ in range(200):
        totals = np.cumsum(rng.random(400) < 0.1)
        checked = (anytime_interval(int(totals[n - 1]), n) for n in (20, 60, 150, 400))
        missed += any(not each.low <= 0.1 <= each.high for each in checked)
    # Five in a hundred may be missed; so many are not by chance, but once in ten million.
    assert missed <= 28, missed
    assert simulations_without_failure(0.001) == 2995


def probabilities() -> None:
    """Check that the probability 2.33e-4 of a half-space is in its interval and below its bound."""
    problem = Problem(
        "half-space", {"a": Normal(0.0, 1.0), "b": Normal(0.0, 1.0)},
        lambda f, key: Trace({"x": (f["a"] + f["b"]) / jnp.sqrt(2.0) * jnp.ones(1)}, dt=1.0),
        "always x < 3.5",
    )  # fmt: skip
    found = estimate(problem, budget=6000, confidence=0.9999, progress=False)
    assert found.probability is not None
    assert found.low <= 2.326e-4 <= found.high, found
    assert found.upper_bound >= 2.326e-4
    assert found.high < 1e-3, found


def priors() -> None:
    """Check that points of the cube become features with the quantiles of their distributions."""
    from scipy.stats import lognorm, norm

    u = np.linspace(0.02, 0.98, 25, dtype=np.float32)
    domains = {
        "box": (Box(-2.0, 3.0), -2.0 + 5.0 * u),
        "normal": (Normal(1.0, 2.0), norm.ppf(u, 1.0, 2.0)),
        "log": (LogUniform(1.0, 100.0), 100.0**u),
        "lognormal": (LogNormal(0.0, 0.5), lognorm.ppf(u, 0.5)),
    }
    for name, (domain, quantiles) in domains.items():
        space = FeatureSpace({name: domain})
        found = np.asarray(space.features_at(u[:, None])[name])
        assert np.allclose(found, quantiles, rtol=2e-3, atol=1e-3), name
    space = FeatureSpace({"c": Categorical("p", "q", weights=[0.8, 0.2])})
    rows = space.rows(space.sample(jax.random.key(0), 4000))["c"]
    assert abs(float(np.mean(np.asarray(rows) == "p")) - 0.8) < 0.04


def steps() -> None:
    """Check that integrators converge to exp(-1) with their order, and smaller steps err less."""
    for method, order in (("euler", 1), ("rk4", 4)):
        errors = []
        for dt in (0.25, 0.125):
            system = ode(
                lambda t, s, c, f: -s, lambda f, key: jnp.ones(1), dt=dt, duration=1.0,
                method=method, signals=lambda t, s, c, f: {"x": s[0]},
            )  # fmt: skip
            with jax.enable_x64(True):
                last: Any = system({}, jax.random.key(0)).signals["x"]
                finer: Any = system.refined(2)({}, jax.random.key(0)).signals["x"]
            errors.append([abs(float(each[-1]) - math.exp(-1)) for each in (last, finer)])
        assert abs(math.log2(errors[0][0] / errors[1][0]) - order) < 0.3, (method, errors)
        assert math.isclose(errors[0][1], errors[1][0], rel_tol=1e-6), (method, errors)


def replays() -> None:
    """Check that a seed determines the table, and that a replayed row has the same robustness."""

    def noisy(features: dict[str, jax.Array], key: jax.Array) -> Trace:
        return Trace({"x": features["a"] + 0.1 * jax.random.normal(key, (4,))}, dt=0.1)

    problem = replace(_problem(), system=noisy)
    run = falsify(problem, "uniform", 200, progress=False, confirm=False)
    again = falsify(problem, "uniform", 200, progress=False, confirm=False)
    other = falsify(problem, "uniform", 200, seed=1, progress=False, confirm=False)
    pd.testing.assert_frame_equal(run.table.all, again.table.all, check_exact=True)
    assert not run.table.all["a"].equals(other.table.all["a"])
    for row in (0, 77, 199):
        seen = run.replay(row)
        assert seen.rho["spec"] == run.table.row(row)["rho"], row
        values = np.asarray(seen.trace.signals["x"])
        assert np.float32(LIMIT) - values.max() == np.float32(seen.rho["spec"]), row


KILLED = """
import os, signal, sys
sys.path[:0] = {path!r}
import verifai_jax as vj
from verifai_jax.addons.assurance.qualification.oracles import _problem
def end(step, values):
    if step >= 300: os.kill(os.getpid(), signal.SIGKILL)
vj.falsify(_problem(), "cross_entropy", 900, batch=100, progress=False, folder={folder!r},
           callbacks=[end])
"""


def kills() -> None:
    """Check that a killed and resumed run has the same table as an undisturbed run."""
    with tempfile.TemporaryDirectory() as folder:
        into = str(Path(folder) / "run")
        code = KILLED.format(path=sys.path, folder=into)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
        assert done.returncode == -signal.SIGKILL, done.stderr.decode()[-500:]
        run = resume(into, _problem(), progress=False, even_if_changed=True)
        whole = falsify(_problem(), "cross_entropy", 900, batch=100, progress=False)
        pd.testing.assert_frame_equal(run.table.all, whole.table.all, check_exact=True)
        pd.testing.assert_frame_equal(
            load(into).table.all.reset_index(drop=True),
            whole.table.all.reset_index(drop=True), check_exact=True,
        )  # fmt: skip
        record = Path(into) / "run.json"
        record.write_text(record.read_text().replace('"seed": 0', '"seed": 5'))
        try:
            load(into)
        except ValueError:
            return
        raise AssertionError("a record that somebody has changed is read as if it were whole")


def searches() -> None:
    """Check that searches find a failure of volume 1e-3, and that claimed failures are real."""

    def hidden(features: dict[str, jax.Array], key: jax.Array) -> Trace:
        away = sum((features[n] - c) ** 2 for n, c in (("a", 0.8), ("b", 0.3), ("c", 0.6)))
        return Trace({"x": jnp.sqrt(away) * jnp.ones(2)}, dt=1.0)

    space = {name: Box(0.0, 1.0) for name in "abc"}
    nominal = dict.fromkeys("abc", 0.0)
    problem = Problem("hidden", space, hidden, "always x > 0.062", nominal=nominal)
    for search in ("portfolio", "cross_entropy"):
        run = falsify(problem, search, 3000, progress=False)
        # As many uniform samples meet three of them on average, and 30 never.
        assert run.table.counts.violating > 30, search
        rows: Any = run.table.counterexamples
        away = np.sqrt(sum((rows[n] - c) ** 2 for n, c in (("a", 0.8), ("b", 0.3), ("c", 0.6))))
        assert (away < 0.0621).all(), search
        assert run.failure_rate is None, f"{search} draws no independent samples"
    small = shrink(run, progress=False)
    assert small.rho < 0
    assert small.count == 3, "no feature at its nominal value is part of a failure"


def confirmations() -> None:
    """Check that a failure caused by a coarse step is refuted, and a real one confirmed."""
    system = ode(
        lambda t, s, c, f: -4.0 * s, lambda f, key: f["a"] * jnp.ones(1), dt=0.4, duration=2.0,
        method="euler", signals=lambda t, s, c, f: {"x": s[0]},
    )  # fmt: skip
    for formula, verdict in (("always x > -0.1", "refuted"), ("always x < 0.9", "confirmed")):
        problem = Problem("step", {"a": Box(1.0, 2.0)}, system, formula)
        run = falsify(problem, "uniform", 32, progress=False)
        assert run.table.counts.violating == 32, formula
        assert set(run.verdict_counts) == {verdict}, (formula, run.verdict_counts)


def comparisons() -> None:
    """Check that equal systems never count as worse, and that one with 5 points more does."""
    problem = _problem()
    same = compare(problem, {"same": _problem()}, budget=4000, progress=False)["same"]
    assert same.rates.only_first == same.rates.only_second == 0, same
    worse = compare(problem, {"b": _problem(LIMIT - 0.05)}, budget=4000, progress=False)["b"]
    assert worse.verdict == "worse", worse
    assert worse.rates.low <= 0.05 <= worse.rates.high, worse
    assert worse.rates.only_first == 0, worse


def divergences() -> None:
    """Check the worst prior against all two-valued priors within the divergence."""
    from verifai_jax.addons.estimation.divergence import radius_of, worst_probability

    q = np.linspace(0.01, 0.99, 9801)
    for p, radius in ((0.01, 0.1), (0.3, 0.02)):
        kl = q * np.log(q / p) + (1 - q) * np.log((1 - q) / (1 - p))
        assert abs(worst_probability(p, radius) - q[kl <= radius].max()) < 2e-4, (p, radius)
        assert abs(radius_of(p, worst_probability(p, radius)) - radius) < 1e-6


def proofs() -> None:
    """Check proofs against all values of whole numbers that wrap around, and with a constraint."""

    def whole(f: Any, key: Any) -> Trace:
        numbers = jnp.stack([9 * f["a"], 5 * f["b"] + 1]).astype(jnp.int8)
        return Trace({"x": jnp.sum(numbers, dtype=jnp.int8) * jnp.ones(2)}, dt=1.0)

    space = FeatureSpace({"a": DiscreteBox(0, 19), "b": DiscreteBox(0, 19)})
    problem = Problem("whole", space, whole, "always x >= 0")
    found: Any = verify(problem, boxes=60, samples=64, progress=False)
    a, b = np.mgrid[:20, :20]
    fails = (9 * a + 5 * b + 1).astype(np.int8) < 0
    for _, box in found.table[found.table["verdict"] == "proved"].iterrows():
        part = fails[box["a from"] : box["a to"] + 1, box["b from"] : box["b to"] + 1]
        assert not part.any(), dict(box)
    low, high = found.probability
    assert low <= fails.mean() <= high, (fails.mean(), low, high)
    band = FeatureSpace({"a": Box(-1, 1), "b": Box(-1, 1)}, lambda f: abs(f["a"] - f["b"]) < 0.05)
    for limit, truth in ((-2.0, 1.0), (0.0, 0.5), (2.0, 0.0)):
        problem = Problem("band", band, _system, f"always x <= {limit}")
        low, high = verify(problem, boxes=40, samples=400, progress=False).probability
        assert low <= truth <= high, (truth, low, high)


ORACLES: dict[str, Callable[[], None]] = {
    each.__name__: each
    for each in (
        formulas, zeros, gradients, table, statuses, intervals, probabilities, priors, steps,
        replays, kills, searches, confirmations, comparisons, divergences,
        proofs,
        readings, judgements, monitors, matrices,
    )
}  # fmt: skip
