"""When a run compiles gradients: in large rounds only once these have found no failure for long."""

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.evaluation.engine import Engine
from verifai_jax.search.portfolio import MANY, PATIENT

BATCH = MANY + 1


def problem(level):
    """A bowl, lowest at (0.3, 0.3), which fails below a level."""

    def system(features, key):
        height = (features["x"] - 0.3) ** 2 + (features["y"] - 0.3) ** 2
        return vj.Trace({"height": height[None]}, dt=1.0)

    space = {"x": vj.Box(0.0, 1.0), "y": vj.Box(0.0, 1.0)}
    return vj.Problem("bowl", space, system, f"always height > {level}")


@pytest.mark.slow
def test_no_row_is_differentiated_while_failures_come(monkeypatch):
    monkeypatch.setattr(Engine, "_lower_gradient", None)  # Nothing is traced for it, either.
    run = vj.falsify(problem(0.2), budget=8 * BATCH, batch=BATCH, confirm=False)
    table = run.table.all
    assert (table["rho"] < 0).mean() > 0.2
    assert not table["differentiated"].any()
    assert table["gradient_finite"].all()


@pytest.fixture(scope="module")
def safe():
    """A run in which nothing fails."""
    return vj.falsify(problem(-1.0), budget=8 * BATCH, batch=BATCH, confirm=False)


@pytest.mark.slow
def test_descents_join_when_no_failure_comes(safe):
    differentiated = safe.table.all["differentiated"].to_numpy()
    assert not differentiated[: PATIENT * BATCH].any()
    # The first descent begins in the middle of the space.
    first = safe.table.all.iloc[np.flatnonzero(differentiated)[0]]
    assert np.flatnonzero(differentiated)[0] == PATIENT * BATCH
    assert (first["x"], first["y"]) == (0.5, 0.5)


@pytest.mark.slow
def test_small_rounds_begin_with_descents():
    run = vj.falsify(problem(-1.0), budget=MANY, batch=MANY, confirm=False)
    assert run.table.all["differentiated"].iloc[0]


FIRST_DESCENTS = BATCH // 4
"""Rows of the first round that is differentiated."""


@pytest.mark.thorough
@pytest.mark.parametrize("last", [-BATCH, 0, FIRST_DESCENTS])
def test_a_resumed_run_has_the_same_stages(last, safe, tmp_path):
    rows = PATIENT * BATCH + last
    assert safe.table.all["differentiated"].sum() >= FIRST_DESCENTS
    vj.falsify(problem(-1.0), budget=rows, batch=BATCH, confirm=False, folder=tmp_path / "run")
    run = vj.resume(tmp_path / "run", problem(-1.0), budget=8 * BATCH)
    for name in ("x", "y", "rho", "differentiated"):
        same = safe.table.all[name].to_numpy()[: len(run.table)]
        np.testing.assert_array_equal(run.table.all[name].to_numpy(), same, err_msg=name)
    assert len(run.table) == len(safe.table)


@pytest.mark.thorough
def test_clauses_that_have_to_fail_together_are_evaluated_in_every_stage():
    def system(features, key):
        return vj.Trace({"x": features["x"][None], "y": 1e4 * features["y"][None]}, dt=1.0)

    space = {"x": vj.Box(0.0, 1.0), "y": vj.Box(0.0, 1.0)}
    both = vj.Problem("both", space, system, "(always x < 0.9) | (always y < 9000)")
    run = vj.falsify(both, budget=4 * BATCH, batch=BATCH, confirm=False)
    rho = run.table.all["rho"].to_numpy()
    x, y = (jnp.asarray(run.table.all[name].to_numpy()) for name in "xy")
    np.testing.assert_allclose(rho, np.maximum(0.9 - x, 9000 - 1e4 * y), rtol=1e-4, atol=1e-3)
    assert (rho < 0).sum() > 0
