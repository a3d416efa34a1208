"""VerifAI 2.2.0's answers on one small table, where they are to be kept.

Names differ: VerifAI calls `x` of a Box over one number `point.x[0]`, stores choices as their
index and analyses `rho` unless told otherwise; here `rho` is a column if asked for.
"""

import numpy as np
import pandas as pd
import pytest

from verifai_jax.addons.analysis._pca import pca
from verifai_jax.addons.analysis.data.samples import Samples
from verifai_jax.addons.analysis.neighbours import k_closest, random_rows
from verifai_jax.features import Box, Categorical, FeatureSpace

SPACE = FeatureSpace({"c": Categorical("r", "g", "b"), "x": Box(0, 10), "y": Box(0, 1)})
FRAME = pd.DataFrame(
    {
        "c": ["r", "r", "g", "b", "g", "r"],
        "x": [1.0, 2.0, 2.2, 9.0, 8.0, 2.1],
        "y": [0.1, 0.2, 0.25, 0.9, 0.8, 0.15],
        "rho": [-1.0, -0.5, -0.6, -2.0, -1.5, -0.4],
    }
)
NUMBERS = ["x", "y", "rho"]


def test_table_01_kinds_of_columns_and_codes():
    for space in (SPACE, None):
        samples = Samples.of(FRAME, columns=["c", "x", "y", "rho"], space=space)
        assert [column.ordered for column in samples.columns] == [False, True, True, True]
        assert samples.values().tolist() == FRAME[NUMBERS].to_numpy().tolist()
    assert Samples.of(FRAME, space=SPACE).codes()[:, 0].tolist() == [0, 0, 1, 2, 1, 0]


def test_table_02_normalised():
    samples = Samples.of(FRAME, columns=NUMBERS, space=SPACE)
    expected = [
        [0.0, 0.0, 0.625],
        [0.125, 0.125, 0.9375],
        [0.15, 0.1875, 0.875],
        [1.0, 1.0, 0.0],
        [0.875, 0.875, 0.3125],
        [0.1375, 0.0625, 1.0],
    ]
    np.testing.assert_allclose(samples.matrix("rows"), expected, atol=1e-9)
    offset, width = samples.scaling("rows")
    np.testing.assert_allclose(offset, [1.0, 0.1, -2.0])
    np.testing.assert_allclose(offset + width, [9.0, 0.9, -0.4])


@pytest.mark.parametrize("columns", [["x", "y"], NUMBERS], ids=["table-04", "table-05"])
def test_table_04_and_05_k_closest(columns):
    found = k_closest(FRAME, 3, columns, scale="rows")
    assert sorted(found.rows) == [1, 2, 5]


def test_table_07_components_of_raw_columns():
    found = pca(FRAME, components=1, columns=NUMBERS, scale="raw")
    np.testing.assert_allclose(found.pivot, [4.05, 0.4, -1.0], atol=1e-9)
    expected = [[0.9820721184617867, 0.0992424266248049, -0.16026632490201662]]
    np.testing.assert_allclose(found.directions, expected, atol=1e-9)


def test_table_09_robustness_of_several_formulas_has_their_names():
    # VerifAI: rho_0, rho_1 and, for the last one, rho. Here: rho.NAME, and rho is the least.
    frame = pd.DataFrame(
        {"x": [0.5], "rho.a": [-1.0], "rho.b": [2.0], "rho.c": [0.25], "rho": [-1.0]}
    )
    assert Samples.of(frame).names == ("x",)
    assert Samples.of(frame, columns=["rho.b", "rho"]).values().tolist() == [[2.0, -1.0]]


def test_table_10_as_many_as_there_are():
    assert sorted(k_closest(FRAME, 6).rows) == list(range(6))
    assert sorted(k_closest(FRAME, 9).rows) == list(range(6))
    assert sorted(k_closest(FRAME, None).rows) == list(range(6))
    assert sorted(random_rows(FRAME, 9, 0).rows) == list(range(6))
