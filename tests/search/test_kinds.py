"""Regions of failures: how they are described, left for others, and counted in a table."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.falsification.kinds import regions_of
from verifai_jax.falsification.validation import adapt_search
from verifai_jax.search import Observations, Portfolio, Search, Wrapper, split
from verifai_jax.search.kinds import CAPACITY, ENOUGH, REACH, TAPER, Kinds

CENTRES = np.array([[0.15, 0.2], [0.8, 0.3], [0.5, 0.85]], np.float32)


def observed(u, rho):
    u = jnp.asarray(u, jnp.float32)
    return Observations(u, jnp.asarray(rho, jnp.float32), jnp.ones(len(u), bool))


def around(centre, n, seed=0):
    return centre + np.random.default_rng(seed).uniform(-0.02, 0.02, (n, 2)).astype(np.float32)


def test_failures_near_each_other_are_one_kind_and_it_takes_enough_of_them():
    kinds = Kinds.nothing(2)
    few = kinds.found(observed(around(CENTRES[0], ENOUGH - 1), -np.ones(ENOUGH - 1)))
    assert int(few.count.sum()) == int(few.count.max()) == ENOUGH - 1
    assert not few.described.any()
    u = np.concatenate([around(CENTRES[0], 1, 1), around(CENTRES[1], 1), CENTRES[2:]])
    more = few.found(
        observed(
            u,
            [
                -1.0,
                -1.0,
                3.0,
            ][: len(u)],
        )
    )
    assert np.sort(np.asarray(more.count))[-2:].tolist() == [1, ENOUGH]
    assert int(more.described.sum()) == 1
    assert float(more.highest) == 3.0


def test_the_boxes_are_those_of_the_rule_for_tables():
    rng = np.random.default_rng(3)
    u = rng.random((60, 2), np.float32)
    kinds = Kinds.nothing(2).found(observed(u, np.where(np.arange(60) % 3, -1.0, 1.0)))
    low, high = [], []
    for point in u[np.arange(60) % 3 > 0]:  # One failure after the other, by the definition.
        far = [
            np.sqrt(np.mean(np.clip(np.maximum(a - point, point - b), 0, None) ** 2))
            for a, b in zip(low, high, strict=True)
        ]
        if far and min(far) <= REACH:
            k = int(np.argmin(far))
            low[k], high[k] = np.minimum(low[k], point), np.maximum(high[k], point)
        else:
            low.append(point)
            high.append(point)
    assert len(low) < CAPACITY
    np.testing.assert_array_equal(kinds.low[: len(low)], low)
    np.testing.assert_array_equal(kinds.high[: len(high)], high)


def test_rows_that_are_not_usable_change_nothing():
    rows = observed(around(CENTRES[0], 12), np.full(12, np.nan))
    rows = rows._replace(valid=jnp.zeros(12, bool))
    same = Kinds.nothing(2).found(rows)
    jax.tree.map(np.testing.assert_array_equal, same, Kinds.nothing(2))


def test_robustness_rises_towards_a_described_kind_and_other_failures_keep_theirs():
    u = around(CENTRES[0], ENOUGH)
    kinds = Kinds.nothing(2).found(observed(np.vstack([u, CENTRES[1:]]), [*[-1.0] * ENOUGH, 2, 1]))
    right = u.max(axis=0) * [1, 0] + u.mean(axis=0) * [0, 1]
    steps = np.sqrt(2) * TAPER * np.array([0.0, 0.25, 0.5, 0.99, 1.01])  # Root mean squares.
    points = jnp.asarray(right + steps[:, None] * [1, 0], jnp.float32)
    raised = np.asarray(kinds.raised(points, jnp.full(5, 0.3)))
    assert (np.diff(raised) < 0).all()
    assert raised[0] > 2.0
    assert raised[-1] == np.float32(0.3)
    failing = np.asarray(kinds.raised(points, jnp.full(5, -0.3)))
    assert failing[0] >= 2.0  # In the box; farther than `REACH` it is another failure.
    assert (failing[2:] == np.float32(-0.3)).all()


def test_a_table_has_as_many_regions_as_were_planted():
    u = np.concatenate([around(c, 20, i) for i, c in enumerate(CENTRES)])
    order = np.random.default_rng(0).permutation(60)
    regions = regions_of(u[order])
    planted = np.repeat(np.arange(3), 20)[order]
    assert len(np.unique(regions)) == 3
    assert len({(a, b) for a, b in zip(regions, planted, strict=True)}) == 3
    # A point between two of them that have begun apart makes one of them.
    bar = np.array([[0.0, 0.5], [0.2, 0.5], [0.068, 0.5], [0.134, 0.5]], np.float32)
    assert len(np.unique(regions_of(bar[:2]))) == 2
    assert len(np.unique(regions_of(bar))) == 1


@dataclass(frozen=True)
class Around(Wrapper):
    """Another search, unchanged."""

    search: Search


def test_with_a_priority_the_search_stays_where_failures_are():
    def system(f, key):
        return vj.Trace({"x": f["x"][None], "y": f["y"][None]}, dt=0.1)

    problem = vj.Problem(
        "ranked", {"x": vj.Box(0, 1), "y": vj.Box(0, 1)}, system,
        {"a": "always x < 0.9", "b": "always y < 0.9"}, priority=[("a", "b")],
    )  # fmt: skip
    search, _ = adapt_search(problem, Portfolio())
    assert search == Portfolio(gradients=False, kinds=False)
    for around in (Around, lambda inner: split({"x": inner}, inner)):
        within, _ = adapt_search(problem, around(Portfolio(gradients=False)))
        assert within == around(search)


def wells(f, key):
    far = jnp.linalg.norm(f["u"] - jnp.asarray(CENTRES), axis=1)
    return vj.Trace({"out": jnp.min(far)[None] - 0.03}, dt=0.1)


@pytest.fixture(scope="module")
def runs():
    problem = vj.Problem("wells", {"u": vj.Box([0.0] * 2, [1.0] * 2)}, wells, "always out > 0")
    return [
        vj.falsify(problem, Portfolio(gradients=False, kinds=kinds), 1500, batch=16, progress=False)
        for kinds in (True, False)
    ]


@pytest.mark.slow
def test_the_default_search_leaves_what_it_has_described(runs):
    leaves, stays = (run.table.all for run in runs)
    first = int(np.flatnonzero(stays["violated"])[0])
    # Until then nothing differs.
    np.testing.assert_array_equal(leaves["rho"][: first + 1], stays["rho"][: first + 1])
    assert leaves["violated"].sum() < 0.3 * stays["violated"].sum()
    u = runs[0].table.violating[["u[0]", "u[1]"]].to_numpy()
    nearest = np.linalg.norm(u[:, None] - CENTRES, axis=2).argmin(axis=1)
    assert (np.bincount(nearest, minlength=3) >= ENOUGH).all()


@pytest.mark.thorough
def test_the_summary_counts_the_kinds_and_divides_the_budget(runs):
    run = runs[0]
    lines = run.summary().splitlines()
    index = next(i for i, line in enumerate(lines) if line.startswith("  kinds"))
    failing = np.flatnonzero(run.table.all["violated"])
    assert f"3 regions with {ENOUGH} failures or more: {len(failing)};" in lines[index]
    numbers = [int(w.replace(",", "")) for w in lines[index + 1].split() if w[0].isdigit()]
    assert numbers[0] == failing[0] + 1
    assert numbers[0] + numbers[1] + numbers[-1] == run.simulations
