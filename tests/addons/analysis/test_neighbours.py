import jax
import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked

from verifai_jax.addons.analysis import neighbours as module
from verifai_jax.addons.analysis.data.samples import Samples
from verifai_jax.addons.analysis.neighbours import k_closest, nearest, random_rows
from verifai_jax.core.messages.errors import UnknownNameError


def table(kind, n=120, seed=0):
    rng = np.random.default_rng(seed)
    columns = {}
    if kind in ("ordered", "mixed", "equal", "absent"):
        columns |= {"x": rng.uniform(0, 3, n), "y": rng.normal(size=n)}
    if kind in ("unordered", "mixed", "many"):
        columns |= {"a": rng.choice(list("pqr"), n), "b": rng.choice([True, False], n)}
    if kind == "many":
        columns |= {"x": rng.uniform(0, 3, n), "c": rng.choice(list("abcdefghijklmnop"), n)}
    if kind == "equal":
        columns["x"], columns["y"] = columns["x"].round(), columns["y"].round()
    if kind == "absent":
        columns["y"] = np.where(rng.uniform(size=n) < 0.3, np.nan, columns["y"])
    if kind == "wide":
        columns |= {f"w{i}": rng.uniform(size=n) for i in range(30)}
    # Every third row is safe: places and row numbers differ.
    return pd.DataFrame({**columns, "rho": np.where(np.arange(n) % 3 == 0, 1.0, -1.0)})


def brute_force(samples, k):
    """Least sum of distances to the k nearest, over all rows."""
    points = samples.points()
    distances = np.sqrt(((points[:, None] - points[None]) ** 2).sum(axis=2))
    return np.sort(distances, axis=1)[:, :k].sum(axis=1)


KINDS = ["ordered", "unordered", "mixed", "many", "equal", "absent", "wide"]


@pytest.mark.parametrize("k", [1, 2, 7, 40])
@pytest.mark.parametrize("kind", KINDS)
def test_k_closest_is_the_tightest_group(kind, k, monkeypatch):
    # Small blocks, so that there are several of them.
    monkeypatch.setattr(module, "_ENTRIES", 800)
    frame = table(kind)
    samples = Samples.of(frame)
    sums = brute_force(samples, k)
    found = k_closest(frame, k)
    assert len(found.rows) == len(set(found.rows.tolist())) == k
    assert found.rows[0] == found.centre
    assert found.distances[0] == 0
    assert (frame.loc[found.rows, "rho"] < 0).all()
    assert found.distances.sum() == pytest.approx(sums.min(), abs=1e-9)
    place = samples.rows.tolist().index(found.centre)
    assert sums[place] == pytest.approx(sums.min(), abs=1e-9)
    points = samples.points()
    expected = np.sort(np.linalg.norm(points - points[place], axis=1))[:k]
    np.testing.assert_allclose(found.distances, expected, atol=1e-9)


def test_k_closest_finds_a_planted_group():
    frame = table("mixed", 3000)
    frame.loc[[101, 502, 2003], ["x", "y"]] = [[0.5, 0.1], [0.5001, 0.1], [0.5, 0.1001]]
    frame.loc[[101, 502, 2003], "a"] = "p"
    frame.loc[[101, 502, 2003], "b"] = True
    assert set(k_closest(frame, 3).rows.tolist()) == {101, 502, 2003}


@pytest.mark.parametrize("k", [80, 200, None])
def test_k_of_all_or_more_gives_all(k):
    frame = table("mixed")
    found = k_closest(frame, k)
    assert sorted(found.rows) == Samples.of(frame).rows.tolist()
    assert str(found).startswith("All 80, 80 counterexamples of table: rows ")


@pytest.mark.parametrize("kind", KINDS)
def test_nearest_to_a_row_and_to_features(kind):
    frame = table(kind)
    everything = Samples.of(frame, "all")
    points = everything.points()
    failing = Samples.of(frame)
    far = np.linalg.norm(points[failing.rows] - points[3], axis=1)
    for point in (3, frame.loc[3], {name: frame.loc[3, name] for name in failing.names}):
        found = nearest(frame, point, 6)
        np.testing.assert_allclose(found.distances, np.sort(far)[:6], atol=1e-9)
        assert set(found.rows[found.distances < far.max()]) <= set(failing.rows)
    # A row among those looked at is its own nearest.
    assert nearest(frame, 4, 1).distances.tolist() == [0.0]


@pytest.mark.thorough
def test_random_rows():
    frame = table("mixed")
    draws = [random_rows(frame, 5, seed).rows.tolist() for seed in range(400)]
    assert draws[0] == random_rows(frame, 5, 0).rows.tolist()
    assert all(len(set(rows)) == 5 for rows in draws)
    # Each of 80 rows is drawn about 400 * 5 / 80 = 25 times.
    counts = pd.Series(np.ravel(draws)).value_counts()
    assert set(counts.index) == set(Samples.of(frame).rows.tolist())
    assert 5 < counts.min() < counts.max() < 50
    key = jax.random.key(0)
    assert random_rows(frame, 5, key).rows.tolist() == random_rows(frame, 5, key).rows.tolist()
    assert len(random_rows(frame, 500, 0)) == 80


def test_what_is_wrong_is_refused_where_it_is_made():
    frame = table("mixed")
    with pytest.raises(ValueError, match="k must be an integer of at least 1; got 0"):
        k_closest(frame, 0)
    with (
        unchecked(),
        pytest.raises(ValueError, match=r"k must be an integer of at least 1; got 2.5"),
    ):
        random_rows(frame, 2.5, 0)  # pyright: ignore[reportArgumentType]
    with pytest.raises(UnknownNameError, match=r"unknown feature 'y'.*Known: x, a, b"):
        nearest(frame, {"x": 1.0, "a": "p", "b": True})
    with pytest.raises(ValueError, match="'a' holds 's', which is not one of its choices 'p', 'q'"):
        nearest(frame, {"x": 1.0, "y": 0.0, "a": "s", "b": True})
    with pytest.raises(IndexError, match="row 120 is not in the table of 120 rows"):
        nearest(frame, 120)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_tables_and_pictures(kind, tmp_path):
    found = k_closest(table(kind), 3)
    assert found.table.index.tolist() == found.rows.tolist()
    assert found.table["distance"].tolist() == found.distances.tolist()
    found.plot(tmp_path / "rows.png")
    assert (tmp_path / "rows.png").stat().st_size > 1000
