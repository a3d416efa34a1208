from itertools import combinations

import numpy as np
import pandas as pd
import pytest

from verifai_jax.addons.analysis._diverse import diverse
from verifai_jax.addons.analysis.data.samples import Samples


def mixed(n=60, seed=0):
    rng = np.random.default_rng(seed)
    return pd.DataFrame(
        {
            "x": rng.uniform(0, 3, n),
            "distance": rng.normal(size=n),
            "a": rng.choice(list("pq"), n),
            "rho": np.where(np.arange(n) % 3 == 0, 1.0, -rng.uniform(0, 1, n)),
        }
    )


def distances_of(samples):
    points = samples.points()
    return np.sqrt(((points[:, None] - points[None]) ** 2).sum(axis=2))


def test_each_is_farthest_from_those_before():
    frame = mixed()
    samples = Samples.of(frame)
    between = pd.DataFrame(distances_of(samples), samples.rows, samples.rows)
    found = diverse(frame, 12)
    rows = found.rows.tolist()
    assert rows[0] == frame["rho"].idxmin()
    assert found.distances[0] == np.inf
    for i in range(1, 12):
        to_chosen = between[rows[:i]].min(axis=1)
        assert to_chosen[rows[i]] == pytest.approx(to_chosen.max())
        assert found.distances[i] == pytest.approx(to_chosen.max())
    assert found.radius == pytest.approx(between[rows].min(axis=1).max())
    assert (np.diff(found.distances[1:]) <= 1e-12).all()


def test_within_twice_the_best_radius():
    frame = mixed(21)
    between = distances_of(Samples.of(frame))
    best = min(between[list(some)].min(axis=0).max() for some in combinations(range(14), 3))
    assert best <= diverse(frame, 3).radius <= 2 * best


def test_one_of_each_far_group():
    rng = np.random.default_rng(0)
    group = rng.integers(0, 4, 200)
    frame = pd.DataFrame({"x": 10 * group + rng.uniform(size=200), "y": rng.uniform(0, 30, 200)})
    frame["y"] = 0.1 * frame["y"]
    frame["z"] = 0.0
    found = diverse(frame, 4, columns=["x", "z"])
    assert sorted(group[found.rows]) == [0, 1, 2, 3]


def test_all_and_equal_rows():
    frame = mixed()
    everything = diverse(frame, 99)
    assert sorted(everything.rows) == Samples.of(frame).rows.tolist()
    assert everything.radius == 0
    equal = pd.DataFrame({"x": [1.0, 1.0, 2.0, 1.0]})
    found = diverse(equal, 4)
    assert found.rows.tolist() == [0, 2, 1, 3]
    assert found.distances.tolist() == [np.inf, 1.0, 0.0, 0.0]


def test_starts_where_told():
    frame = mixed()
    assert diverse(frame, 3, start=4).rows[0] == 4
    with pytest.raises(IndexError, match="row 3 is not among the 40 counterexamples of table"):
        diverse(frame, 3, start=3)
    with pytest.raises(ValueError, match="k must be an integer of at least 1; got 0"):
        diverse(frame, 0)


@pytest.mark.slow
def test_tells_and_draws(tmp_path):
    found = diverse(mixed(), 5)
    # A feature is called distance too: it keeps its name.
    assert found.table["distance"].tolist() == mixed().loc[found.rows, "distance"].tolist()
    assert found.table["distance_"].tolist() == found.distances.tolist()
    assert str(found).startswith("5 diverse rows, 40 counterexamples of table: ")
    assert f"within {found.radius:.3g} of one of them" in str(found)
    found.plot(tmp_path / "rows.png")
    assert (tmp_path / "rows.png").stat().st_size > 1000
    for columns in (["a"], ["x"]):
        diverse(mixed(), 1, columns=columns).plot()
