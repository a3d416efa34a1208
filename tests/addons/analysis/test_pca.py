import jax
import numpy as np
import pandas as pd
import pytest
from sklearn.decomposition import PCA

from verifai_jax.addons.analysis._pca import pca
from verifai_jax.addons.analysis.data.samples import Samples
from verifai_jax.features import Array, Box, Categorical, DiscreteBox, FeatureSpace

SPACE = FeatureSpace(
    {
        "speed": Box(0, 50),
        "gap": Box(0, 5),
        "slope": Box(-1, 1),
        "lanes": DiscreteBox(1, 9),
        "alg": Categorical("ppo", "sac"),
    }
)


def failures_on_a_line(n=400, seed=0):
    """Failures in every second row: where speed is high, the gap is narrow."""
    rng = np.random.default_rng(seed)
    along = rng.uniform(-1, 1, 2 * n)
    return pd.DataFrame(
        {
            "speed": 25 + 20 * along,
            "gap": 2.5 - 1.0 * along + 0.02 * rng.normal(size=2 * n),
            "slope": 0.02 * rng.normal(size=2 * n),
            "lanes": np.round(5 + 3 * along).astype(int),
            "alg": np.where(along > 0, "ppo", "sac"),
            "rho": np.tile([1.0, -1.0], n),
        }
    )


@pytest.mark.parametrize("scale", ["raw", "range", "standard", "rows"])
def test_agrees_with_scikit_learn(scale):
    frame = failures_on_a_line()
    found = pca(frame, scale=scale, space=SPACE)
    scaled = Samples.of(frame, space=SPACE).matrix(scale)
    theirs = PCA().fit(scaled)
    np.testing.assert_allclose(found.deviations**2, theirs.explained_variance_)
    np.testing.assert_allclose(found.shares, theirs.explained_variance_ratio_)
    np.testing.assert_allclose(np.abs(found.directions), np.abs(theirs.components_), atol=1e-9)
    np.testing.assert_allclose(
        np.abs(found.project().to_numpy()), np.abs(theirs.transform(scaled)), atol=1e-9
    )
    rows = np.arange(len(found.directions))
    largest = np.argmax(np.abs(found.directions), axis=1)
    assert (found.directions[rows, largest] > 0).all()


def test_finds_the_line():
    found = pca(failures_on_a_line(), components=1, space=SPACE)
    # In units of the range: 0.4 in speed, -0.2 in gap, 0.375 in lanes.
    expected = np.array([0.4, -0.2, 0.0, 0.375])
    np.testing.assert_allclose(found.directions[0], expected / np.linalg.norm(expected), atol=0.02)
    assert found.shares[0] > 0.99
    assert found.table.columns.tolist() == [
        "speed",
        "gap",
        "slope",
        "lanes",
        "deviation",
        "share",
    ]


def test_projects_rows_by_number():
    frame = failures_on_a_line()
    found = pca(frame, space=SPACE)
    assert found.project().index.tolist() == list(range(1, 800, 2))
    some = found.project([5, 1])
    pd.testing.assert_frame_equal(some, found.project().loc[[5, 1]])
    pd.testing.assert_frame_equal(some, found.project(frame.loc[[5, 1]]))
    assert np.abs(found.project().mean().to_numpy()).max() < 1e-9
    with pytest.raises(IndexError, match="row 800 is not in the table"):
        found.project([800])


def test_generated_samples_are_features_with_the_variance_of_the_rows():
    found = pca(failures_on_a_line(), space=SPACE)
    drawn = found.generate(0, 4000, spread=0.5)
    assert drawn.columns.tolist() == list(SPACE.columns)
    for _, row in drawn.head(50).iterrows():
        features = SPACE.from_row(row)
        SPACE.check(features)
    spread = found.project(drawn).std().to_numpy()
    # Rounding of the whole number of lanes adds to the later ones.
    np.testing.assert_allclose(spread[0], 0.5 * found.deviations[0], rtol=0.05)
    assert set(drawn["alg"]) == {"ppo", "sac"}
    # Choices come from the nearest row: the algorithm goes with the speed.
    assert ((drawn["speed"] > 25) == (drawn["alg"] == "ppo")).mean() > 0.95


def test_generated_samples_stay_inside_however_wide_the_spread():
    found = pca(failures_on_a_line(), components=1, space=SPACE)
    drawn = found.generate(0, 300, spread=50.0)
    for column, (low, high) in {"speed": (0, 50), "gap": (0, 5), "lanes": (1, 9)}.items():
        assert drawn[column].between(low, high).all()
    # Still on the line, not squeezed onto the faces.
    off = drawn[["speed", "gap"]].to_numpy() - found.pivot[:2]
    slope = found.directions[0, 1] * found.width[1] / (found.directions[0, 0] * found.width[0])
    np.testing.assert_allclose(off[:, 1], off[:, 0] * slope, atol=1e-9)


def test_generates_the_same_for_the_same_seed():
    found = pca(failures_on_a_line(), space=SPACE)
    pd.testing.assert_frame_equal(found.generate(1, 5), found.generate(1, 5))
    key = jax.random.key(1)
    pd.testing.assert_frame_equal(found.generate(key, 5), found.generate(key, 5))
    assert not found.generate(1, 5).equals(found.generate(2, 5))
    assert len(found.generate(1, 0)) == 0


def test_constant_columns_have_no_loading():
    frame = failures_on_a_line().assign(speed=0.1)
    found = pca(frame, space=SPACE)
    assert len(found.directions) == 3
    assert (found.directions[:, 0] == 0).all()
    assert (found.generate(0, 10)["speed"] == 0.1).all()


def test_rows_that_do_not_vary():
    for frame in (failures_on_a_line().head(2), pd.DataFrame({"x": [0.1] * 7, "y": [0.3] * 7})):
        found = pca(frame)
        assert found.directions.shape[0] == 0
        assert "do not vary" in str(found)
        row = Samples.of(frame).frame.iloc[0]
        for _, drawn in found.generate(0, 3).iterrows():
            assert drawn.to_dict() == row[drawn.index.to_list()].to_dict()
        found.plot()


def test_absent_items_add_nothing():
    frame = failures_on_a_line(20)
    frame.loc[frame.index[-10:], "slope"] = np.nan
    found = pca(frame)
    present = frame["slope"][frame["rho"] < 0].dropna()
    np.testing.assert_allclose(found.pivot[2], present.mean())
    drawn = found.generate(0, 200)
    assert 0 < drawn["slope"].isna().mean() < 1


@pytest.mark.slow
def test_generated_samples_keep_lengths_and_constraints():
    space = FeatureSpace(
        {"x": Box(0, 1), "y": Box(0, 1), "cars": Array(DiscreteBox(1, 4), length=(1, 3))},
        where=lambda features: features["x"] < features["y"],
    )
    rng = np.random.default_rng(0)
    low, high = np.sort(rng.uniform(size=(2, 60)), axis=0)
    length = rng.integers(1, 4, 60)
    rows = {"x": low, "y": high, "cars.length": length}
    for i in range(3):
        rows[f"cars[{i}]"] = np.where(i < length, rng.integers(1, 5, 60), np.nan)
    frame = pd.DataFrame(rows)
    free = FeatureSpace(space.domains)
    found = pca(frame, space=space)
    assert (found.generate(0, 40)["x"] < found.generate(0, 40)["y"]).all()
    unconstrained = pca(frame, space=free).generate(0, 40)
    assert not (unconstrained["x"] < unconstrained["y"]).all()
    for _, row in found.generate(1, 40).iterrows():
        space.check(space.from_row(row))
    # Where no draw can keep it, the row nearest to the draw is taken.
    narrow = FeatureSpace(space.domains, where=lambda features: features["x"] > 2)
    taken = pca(frame, space=narrow).generate(0, 5).astype(float)
    known = frame.astype(float).fillna(-1).to_numpy().tolist()
    assert all(row in known for row in taken.fillna(-1).to_numpy().tolist())


def test_what_is_wrong_is_refused_where_it_is_made():
    frame = failures_on_a_line(3)
    with pytest.raises(ValueError, match=r"needs an ordered column.*alg is unordered"):
        pca(frame, columns=["alg"])
    with pytest.raises(ValueError, match=r"from 1 to 3, the lesser of 3 rows and 4 .*got 4"):
        pca(frame, components=4)
    with pytest.raises(ValueError, match="components must be an integer of at least 1; got 0"):
        pca(frame, components=0)
    with pytest.raises(ValueError, match="spread must be positive and finite; got -1"):
        pca(frame).generate(0, 3, spread=-1)


def test_tells_and_draws(tmp_path):
    found = pca(failures_on_a_line(), space=SPACE)
    assert "400 counterexamples of table, over 4 ordered columns" in str(found)
    assert "+0.68 speed, +0.6" in str(found)
    found.plot(tmp_path / "pca.png")
    assert (tmp_path / "pca.png").stat().st_size > 1000


def test_a_component_that_explains_no_more_than_chance_is_said_to():
    rng = np.random.default_rng(0)
    names = list("abcde")
    for n in (20, 200, 5000):
        alone = pd.DataFrame(rng.uniform(size=(n, 5)), columns=names)
        found = pca(alone)
        assert found.telling == 0
        assert str(found).count("of variance, no more than chance") == 5
        assert "no direction explains more than chance" in str(found)
    # Different spreads of unrelated columns are no relation either.
    wide = alone * [1.0, 0.5, 0.2, 0.2, 0.1]
    assert pca(wide, scale="raw").telling == 0
    related = alone.assign(b=0.7 * alone["a"] + 0.3 * alone["b"])
    found = pca(related)
    assert found.telling == 1
    first, second = str(found).splitlines()[1:3]
    assert "chance" not in first
    assert "chance" in second
    assert "no direction" not in str(found)
