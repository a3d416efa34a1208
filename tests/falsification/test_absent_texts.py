"""Texts that are absent from rows, of arrays of choices: on disk, in checksums, resumed."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.falsification.columns import column_checksum, column_to_arrow


@pytest.mark.thorough
@pytest.mark.parametrize("batch", [1, 16])
def test_an_array_of_choices_is_loaded_and_resumed(batch, tmp_path):
    colors = vj.Array(vj.Categorical("red", "blue"), length=(0, 3))
    problem = vj.Problem(
        "colors",
        {"colors": colors, "b": vj.Box(0, 1)},
        lambda f, key: vj.Trace({"x": jnp.full(2, f["b"])}, dt=1.0),
        "always x < 0.9",
    )
    run = vj.falsify(problem, "uniform", 32, batch=batch, folder=tmp_path, confirm=False)
    loaded = vj.load(tmp_path, problem)
    assert loaded.damage == ""
    pd.testing.assert_frame_equal(loaded.table.all, run.table.all)
    resumed = vj.resume(tmp_path, problem, budget=48)
    assert resumed.damage == ""
    again = vj.load(tmp_path, problem)
    whole = vj.falsify(problem, "uniform", 48, batch=batch, confirm=False)
    pd.testing.assert_frame_equal(again.table.all, whole.table.all)


@pytest.mark.parametrize("absent", [None, float("nan")])
def test_columns_with_absent_texts(absent):
    values = np.array([absent, "red", absent, "blue"], object)
    column = column_to_arrow(values)
    assert str(column.type) == "string"
    assert column.to_pylist() == [None, "red", None, "blue"]
    assert str(column_to_arrow(values[:1]).type) == "string"
    back = column.to_numpy(zero_copy_only=False)
    assert column_checksum(values) == column_checksum(back)
    # In any parts, the same.
    parts = column_checksum(values[:1])
    assert column_checksum(values[1:], parts) == column_checksum(values)
    numbers = np.array([1.0, np.nan])
    assert column_to_arrow(numbers).null_count == 0
