from itertools import product

import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked
from sklearn.metrics import adjusted_rand_score

from verifai_jax.addons.analysis.clustering.clusters import clusters
from verifai_jax.addons.analysis.clustering.prototypes import prototypes
from verifai_jax.addons.analysis.data.samples import Samples

CENTRES = np.array([[0.2, 0.2], [0.8, 0.3], [0.5, 0.8]])


def blobs(n=240, seed=0, choices=True):
    """Failures of three kinds, in every second row, of sizes about 3 : 2 : 1."""
    rng = np.random.default_rng(seed)
    kind = rng.choice(3, n, p=[0.5, 0.3, 0.2])
    place = CENTRES[kind] + 0.04 * rng.normal(size=(n, 2))
    frame = pd.DataFrame({"x": place[:, 0], "size": place[:, 1]})
    if choices:
        frame["weather"] = np.array(["fog", "rain", "snow"])[kind]
        frame["road"] = np.array(["wet", "wet", "dry"])[kind]
    rho = np.where(np.arange(n) % 2 == 0, 1.0, -rng.uniform(0.1, 1, n))
    return frame.assign(rho=rho), pd.Series(kind)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["auto", "kmeans", "kmodes", "kprototypes", "dbscan"])
def test_finds_three_blobs(method):
    frame, kind = blobs()
    found = clusters(frame, method)
    labels = found.labels
    assert labels.index.tolist() == list(range(1, 240, 2))
    assert found.count == 3
    inside = labels >= 0
    assert inside.mean() > 0.9
    assert adjusted_rand_score(kind[labels.index][inside], labels[inside]) == 1
    assert found.silhouette > 0.7
    sizes = labels[inside].value_counts()
    assert found.table["size_" if "size" in found.samples.names else "size"][:3].tolist() == [
        sizes[0],
        sizes[1],
        sizes[2],
    ]
    assert sizes[0] >= sizes[1] >= sizes[2]
    again = clusters(frame, method)
    assert (found.assigned == again.assigned).all()


def test_table_of_clusters():
    frame, kind = blobs()
    table = clusters(frame).table
    failing = frame[frame["rho"] < 0]
    for cluster, true in ((0, 0), (1, 1), (2, 2)):
        row, part = table.loc[cluster], failing[kind[failing.index] == true]
        # The feature called size keeps its name.
        assert row["size_"] == len(part)
        assert row["share"] == pytest.approx(len(part) / len(failing))
        assert row["x"] == pytest.approx(part["x"].mean())
        assert row["size"] == pytest.approx(part["size"].mean())
        assert row["weather"] == ("fog", "rain", "snow")[true]
        assert row["worst"] == part["rho"].idxmin()
        assert row["worst_rho"] == part["rho"].min()
        span = frame[["x", "size"]].max() - frame[["x", "size"]].min()
        off = (part[["x", "size"]] - part[["x", "size"]].mean()) / span
        assert row["representative"] == (off**2).sum(axis=1).idxmin()


def test_rows_of_a_cluster_are_row_numbers():
    frame, kind = blobs()
    found = clusters(frame)
    assert set(kind[found.rows(1)]) == {1}
    assert (frame.loc[found.rows(1), "rho"] < 0).all()
    with pytest.raises(IndexError, match=r"there is no cluster 3 among \[0, 1, 2\]"):
        found.rows(3)


def test_no_structure_is_one_cluster():
    rng = np.random.default_rng(0)
    # Choices that are independent and many: nothing is near anything.
    frame = pd.DataFrame({c: rng.choice(list("pqrstuvw"), 300) for c in "abcdefgh"})
    found = clusters(frame)
    assert found.count == 1
    assert np.isnan(found.silhouette)
    assert str(found).startswith("1 cluster of 300 counterexamples of table (kmodes)")


def test_k_modes_reaches_the_least_cost():
    rng = np.random.default_rng(1)
    codes = rng.integers(0, 3, (7, 3))
    none = np.zeros((7, 0))

    def cost(labels):
        total = 0
        for c in set(labels):
            part = codes[np.array(labels) == c]
            total += sum(len(part) - np.bincount(column).max() for column in part.T)
        return total

    best = min(cost(labels) for labels in product(range(2), repeat=7))
    assert cost(prototypes(none, codes, 2, np.random.default_rng(0)).tolist()) == best


def test_prototypes_are_k_means_for_numbers():
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.normal(size=(20, 2)), rng.normal(size=(20, 2)) + 5])
    labels = prototypes(x, np.zeros((40, 0), int), 2, np.random.default_rng(0))
    assert adjusted_rand_score(labels, np.repeat([0, 1], 20)) == 1


def test_density_finds_what_k_means_cannot():
    rng = np.random.default_rng(0)
    turn = np.arange(600) * 2 * np.pi / 600
    radius = np.where(np.arange(600) % 2, 1.0, 0.3) + 0.02 * rng.normal(size=600)
    frame = pd.DataFrame({"x": radius * np.cos(turn), "y": radius * np.sin(turn)})
    lonely = pd.DataFrame({"x": [1.4, -1.4, 1.4], "y": [1.4, -1.4, -1.4]})
    found = clusters(pd.concat([frame, lonely], ignore_index=True), "dbscan")
    assert (found.labels[600:] == -1).all()
    inside = found.labels[:600] >= 0
    assert inside.mean() > 0.9
    for ring in (0, 1):
        most = found.labels[:600][inside][np.arange(600)[inside] % 2 == ring].mode()[0]
        part = found.labels[:600][np.arange(600) % 2 == ring]
        assert (part == most).mean() > 0.85
    assert found.table.index[-1] == -1


def test_density_of_many_rows(monkeypatch):
    frame, _ = blobs(2000)
    whole = clusters(frame, "dbscan")
    monkeypatch.setattr("verifai_jax.addons.analysis.clustering.clusters.MAX_ROWS", 300)
    part = clusters(frame, "dbscan")
    assert part.count == 3
    both = (whole.assigned >= 0) & (part.assigned >= 0)
    assert both.mean() > 0.8
    assert adjusted_rand_score(whole.assigned[both], part.assigned[both]) == 1


@pytest.mark.parametrize("method", ["auto", "dbscan"])
def test_few_and_equal_rows(method):
    one = clusters(pd.DataFrame({"x": [1.0]}), method)
    assert len(one.labels) == 1
    two = clusters(pd.DataFrame({"x": [1.0, 2.0], "a": ["p", "q"]}), method)
    assert len(two.labels) == 2
    equal = clusters(pd.DataFrame({"x": [1.0] * 9, "a": ["p"] * 9}), method)
    assert equal.assigned.tolist() == [0] * 9
    pairs = clusters(pd.DataFrame({"x": [1.0] * 9 + [2.0] * 9}), method)
    assert pairs.assigned.tolist() == [0] * 9 + [1] * 9
    for found in (one, two, equal, pairs):
        found.plot()
        str(found)


def test_absent_items_are_a_kind():
    rng = np.random.default_rng(0)
    frame = pd.DataFrame({"x": rng.uniform(size=60), "car.x": rng.uniform(size=60)})
    frame.loc[::2, "car.x"] = np.nan
    found = clusters(frame, count=2)
    assert adjusted_rand_score(found.assigned, frame["car.x"].isna()) == 1
    assert found.centres["car.x"].isna().sum() == 1
    assert set(found.table["representative"]) <= set(frame.index)


def test_what_is_wrong_is_refused_where_it_is_made():
    frame, _ = blobs()
    with (
        unchecked(),
        pytest.raises(ValueError, match=r"method must be one of 'auto', .*got 'means'"),
    ):
        clusters(frame, "means")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"k-means needs an ordered column.*weather is unordered"):
        clusters(frame, "kmeans", columns=["weather"])
    with pytest.raises(ValueError, match=r"k-modes needs an unordered column.*x is ordered"):
        clusters(frame, "kmodes", columns=["x"])
    with pytest.raises(ValueError, match="count must be from 1 to 3, the number of different rows"):
        clusters(frame, "kmodes", count=4)
    with pytest.raises(ValueError, match="count must be an integer of at least 1; got 0"):
        clusters(frame, count=0)
    with pytest.raises(ValueError, match="dbscan finds the number of clusters itself; got count=3"):
        clusters(frame, "dbscan", count=3)
    with pytest.raises(ValueError, match="radius must be positive and finite; got 0"):
        clusters(frame, "dbscan", radius=0.0)
    with pytest.raises(ValueError, match=r"a radius is for method='dbscan'; got 1.0 with 'kprot"):
        clusters(frame, radius=1.0)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["kmeans", "kmodes", "kprototypes", "dbscan"])
def test_tells_and_draws(method, tmp_path):
    found = clusters(blobs()[0], method, columns=["x", "size", "weather"])
    text = str(found)
    assert text.startswith(f"3 clusters of 120 counterexamples of table ({method}, silhouette ")
    assert "worst row" in text
    if method != "kmodes":
        assert "around x=0." in text
    found.plot(tmp_path / "clusters.png")
    assert (tmp_path / "clusters.png").stat().st_size > 1000
    assert Samples.of(blobs()[0]).rows.tolist() == found.labels.index.tolist()
