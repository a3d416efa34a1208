"""Points before the search, and callbacks: what they see, and that they change nothing else."""

import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.statistics.stopping import Within

FIRST = [{"a": 0.1, "b": 0.9}, {"a": 0.95, "b": 0.2}, {"a": 0.4, "b": 0.4}]


def system(f, key):
    return vj.Trace({"x": (f["a"] - f["b"])[None].repeat(3)}, dt=1.0)


PROBLEM = vj.Problem(
    "ramp", {"a": vj.Box(0.0, 1.0), "b": vj.Box(0.0, 1.0)}, system, "always x < 0.7"
)


@pytest.mark.thorough
def test_first_points_come_first_and_the_search_goes_on_as_ever():
    plain = vj.falsify(PROBLEM, "uniform", 32, batch=16)
    run = vj.falsify(PROBLEM, vj.Start("uniform", rows=FIRST), 35, batch=16)
    table = run.table.all
    np.testing.assert_array_equal(table["a"][:3], np.float32([0.1, 0.95, 0.4]))
    assert table["rho"][1] == pytest.approx(-0.05, abs=1e-6)
    np.testing.assert_array_equal(table["a"][3:35], plain.table.all["a"][:32])
    assert run.failure_rate is None
    assert plain.failure_rate is not None
    rows = pd.DataFrame(FIRST)
    again = vj.falsify(PROBLEM, vj.Start("uniform", rows=rows), 35, batch=16)
    assert again.table.all.equals(table)
    # More points than the budget, and than a batch.
    many = vj.falsify(PROBLEM, vj.Start("uniform", rows=FIRST), 2, batch=1)
    assert many.table.all["a"].tolist() == table["a"][:2].tolist()
    with pytest.raises(ValueError, match=r"Stop\(when=\) needs independent samples"):
        vj.falsify(PROBLEM, vj.Start("uniform", rows=FIRST), stop=vj.Stop(when=Within(0.1)))
    space = vj.FeatureSpace(PROBLEM.space.domains, where=lambda f: f["a"] > 0.2)
    narrow = vj.Problem("ramp", space, system, "always x < 0.7")
    with pytest.raises(ValueError, match="breaks the constraint of this space"):
        vj.falsify(narrow, vj.Start(rows=FIRST))
    with pytest.raises(ValueError, match="row 0: it breaks the constraint of this space"):
        vj.falsify(narrow, vj.Start(rows=pd.DataFrame(FIRST)))
    with pytest.raises(ValueError, match="a"):
        vj.falsify(PROBLEM, vj.Start(rows=[{"a": 2.0, "b": 0.0}]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "search", ["cross_entropy", pytest.param("coverage", marks=pytest.mark.addons), "portfolio"]
)
def test_a_search_learns_from_them_and_resuming_keeps_them(search, tmp_path):
    options, search = {"batch": 8, "seed": 3}, vj.Start(search, rows=FIRST)
    whole = vj.falsify(PROBLEM, search, 40, **options)
    vj.falsify(PROBLEM, search, 2, folder=tmp_path / "run", **options | {"batch": 2})
    stored = vj.load(tmp_path / "run", PROBLEM)
    assert len(stored.first) == 3
    resumed = vj.resume(tmp_path / "run", PROBLEM, budget=12)
    np.testing.assert_allclose(resumed.table.all["a"][:3], [0.1, 0.95, 0.4], atol=1e-6)
    assert not resumed.prior

    def stop(step, values):
        if step >= 11:
            raise KeyboardInterrupt

    part = vj.falsify(PROBLEM, search, 40, callbacks=[stop], **options)
    assert (part.stopped, len(part.table) < 40) == ("interrupted", True)
    assert vj.resume(part, budget=40).table.all.equals(whole.table.all)
    if search.search == "cross_entropy":
        # Its first proposals are drawn near the elite of what it was told.
        told = [{"a": 0.98, "b": 0.02 * i} for i in range(8)]
        near = vj.falsify(PROBLEM, vj.Start(search.search, rows=told), 16, batch=8).table.all[8:]
        assert near["a"].mean() > 0.8


@pytest.mark.thorough
def test_callbacks_see_each_round_and_change_nothing(tmp_path):
    seen = []
    log = vj.CSVLogger(tmp_path / "run.csv")
    run = vj.falsify(
        PROBLEM, "uniform", 40, batch=16, callbacks=[lambda *call: seen.append(call), log]
    )
    assert [step for step, _ in seen] == [16, 32, 40]
    assert seen[-1][1]["counterexamples"] == run.table.counts.claimed
    assert seen[-1][1]["least_robustness"] == run.best["rho"]
    assert pd.read_csv(log.path)["simulations"].tolist() == [16, 32, 40]
    plain = vj.falsify(PROBLEM, "uniform", 40, batch=16)
    assert plain.table.all.equals(run.table.all)
    resumed = vj.resume(run, budget=50, callbacks=[lambda *call: seen.append(call)])
    assert seen[-1][0] == len(resumed.table) == 50

    def broken(step, values):
        raise OSError("no route to the server")

    with pytest.raises(vj.RunError, match="no route to the server") as caught:
        vj.falsify(PROBLEM, "uniform", 40, batch=16, callbacks=[broken])
    assert caught.value.run.simulations == 16
