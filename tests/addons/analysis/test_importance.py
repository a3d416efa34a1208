"""Importances of features whose influence is known."""

import numpy as np
import pytest
from failing_table import failing_table

from verifai_jax.addons.analysis._importance import importance


@pytest.fixture(scope="module")
def found():
    return importance(failing_table(3000))


@pytest.mark.thorough
def test_influence_is_found(found):
    assert set(found.ranked[:2]) == {"x", "colour"}
    rest = found.table.loc[["y", "lanes", "same"], ["failing", "rho"]]
    assert rest.abs().to_numpy().max() < 0.02
    assert found.table.loc["x", "failing"] > 0.2
    assert found.is_reliable("failing")
    assert found.is_reliable("rho")
    assert found.scores["failing"] > 0.98
    words = str(found).splitlines()
    assert words[0].startswith("failing depends on x (")
    assert words[1].startswith("robustness depends on colour (")
    assert "lanes" not in str(found)


def test_loss_is_what_theory_says(found):
    """Shuffling a feature of an additive model costs R^2 twice its share of the variance."""
    share = (4 * 2 / 9) / (4 * 2 / 9 + 1 / 12)
    assert found.table.loc["colour", "rho"] == pytest.approx(2 * share, rel=0.1)
    assert found.table.loc["x", "rho"] == pytest.approx(2 * (1 - share), rel=0.25)
    low, high = found.table.loc["colour", ["rho_low", "rho_high"]]
    assert low < found.table.loc["colour", "rho"] < high


@pytest.mark.thorough
def test_rare_failures_are_learned():
    frame = failing_table(20000)
    frame["violated"] = (frame.x > 0.97) & (frame.colour == "blue")
    assert frame["violated"].mean() < 0.015
    found = importance(frame)
    assert found.ranked[:2] == ["x", "colour"]
    assert found.scores["failing"] > 0.95


def test_noise_means_nothing():
    g = np.random.default_rng(5)
    frame = failing_table(1000)
    frame["rho"] = g.normal(size=1000)
    frame["violated"] = g.random(1000) < 0.4
    found = importance(frame)
    assert not found.is_reliable("failing")
    assert not found.is_reliable("rho")
    assert str(found).count("importances are meaningless") == 2


def test_without_failures_only_the_robustness_is_explained():
    frame = failing_table(500).assign(violated=False)
    found = importance(frame)
    assert found.missing == {"failing": "no failing row, too few to learn from"}
    assert "failing" not in found.table
    assert found.ranked[0] == "colour"
    assert str(found).startswith(
        "failing: no failing row, too few to learn from\nrobustness depends on colour"
    )
    few = importance(frame.assign(violated=np.arange(500) < 3))
    assert few.missing == {"failing": "3 failing rows, too few to learn from"}


def test_absence_is_information():
    frame = failing_table(2000)
    frame.loc[frame.x > 0.5, "x"] = np.nan
    frame["violated"] = frame.x.isna()
    frame.loc[frame.lanes == 3, "colour"] = None
    assert importance(frame).ranked[0] == "x"


@pytest.mark.slow
def test_the_same_seed_gives_the_same_table(found):
    assert importance(failing_table(3000)).table.equals(found.table)
    assert not importance(failing_table(3000), seed=1).table.equals(found.table)


def test_what_cannot_work_is_refused_with_the_reason():
    with pytest.raises(
        ValueError,
        match="no importance can be learned from 'table': failing: no failing row, too few to "
        "learn from; robustness: it is 1 in every row",
    ):
        importance(failing_table(100).assign(rho=1.0, violated=False))
    with pytest.raises(ValueError, match="repeats must be an integer of at least 2"):
        importance(failing_table(100), repeats=1)


def test_the_picture_is_drawn_and_written(found, tmp_path):
    from PIL import Image

    found.plot(tmp_path / "it.png")
    with Image.open(tmp_path / "it.png") as image:
        assert image.size[0] > 300
