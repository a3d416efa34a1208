import contextlib
import shutil

import numpy as np
import pytest

from verifai_jax.falsification.table import FINISHED, STREAM, ErrorTable, TableError


def batch(rho, status=None, **features):
    rho = np.array(rho, np.float32)
    status = np.array(["ok"] * len(rho) if status is None else status, dtype=object)
    return {
        **{name: np.array(values) for name, values in features.items()},
        "rho": rho,
        "violated": rho < 0,
        "status": status,
    }


def test_every_row_once_in_order():
    table = ErrorTable(("x",))
    table.append(batch([1, -1], x=[0.1, 0.2]))
    assert len(table.counterexamples) == 1
    table.append(batch([np.nan, -2, 3], ["nonfinite", "ok", "ok"], x=[0.3, 0.4, 0.5]))
    assert table.all.index.tolist() == [0, 1, 2, 3, 4]
    assert table.all["x"].tolist() == [0.1, 0.2, 0.3, 0.4, 0.5]
    assert table.counterexamples.index.tolist() == [1, 3]
    assert table.safe.index.tolist() == [0, 4]
    assert table.failed.index.tolist() == [2]
    assert len(table.all) == len(table.counterexamples) + len(table.safe) + len(table.failed)


def test_a_row_without_a_verdict_is_never_a_counterexample():
    table = ErrorTable(("x",))
    table.append(batch([-5, -1], ["error", "ok"], x=[0, 1]))
    assert table.counterexamples.index.tolist() == [1]


def test_disk_and_memory_agree(tmp_path):
    table = ErrorTable(("x", "color"), tmp_path / "run")
    table.append(batch([1, -1], x=[0.1, 0.2], color=np.array(["red", "blue"], object)))
    table.append(batch([2], x=[0.3], color=np.array(["red"], object)))
    growing = ErrorTable.load(tmp_path / "run", table.features)
    assert (tmp_path / "run" / STREAM).exists()
    assert growing.all.equals(table.all)
    table.close()
    assert not (tmp_path / "run" / STREAM).exists()
    finished = ErrorTable.load(tmp_path / "run", table.features)
    assert finished.all.equals(table.all)


def test_a_process_that_dies_loses_only_the_batch_in_flight(tmp_path):
    table = ErrorTable(("x",), tmp_path)
    for i in range(3):
        table.append(batch([i], x=[float(i)]))
    whole = (tmp_path / STREAM).read_bytes()
    for cut in (1, 9, 60, 150):
        (tmp_path / STREAM).write_bytes(whole[:-cut])
        rows = ErrorTable.load(tmp_path, ("x",)).all
        assert rows["rho"].tolist() == [0, 1]
    (tmp_path / STREAM).write_bytes(whole[:10])
    assert len(ErrorTable.load(tmp_path, ("x",))) == 0
    table.close()


def test_damaged_bytes_cost_rows_and_not_the_process(tmp_path):
    table = ErrorTable(("x", "color"), tmp_path)
    colors = np.array(["red", "blue", "green"] * 4, object)
    for i in range(4):
        table.append(batch([i] * 12, x=[0.5] * 12, color=colors))
    whole, random = (tmp_path / STREAM).read_bytes(), np.random.default_rng(0)
    for turn in range(300):
        damaged = bytearray(whole)
        at = int(random.integers(len(damaged)))
        if turn % 2:
            damaged[at] ^= int(random.integers(1, 256))
        else:
            damaged[at:at] = random.bytes(4)
        (tmp_path / STREAM).write_bytes(damaged)
        # Offsets of texts that point outside of their buffer ended the process.
        with contextlib.suppress(TableError):
            rows = ErrorTable.load(tmp_path, table.features).all
            assert len(rows) % 12 == 0
            assert all(isinstance(each, str) for each in rows["color"])
    (tmp_path / STREAM).write_bytes(whole)
    assert len(ErrorTable.load(tmp_path, table.features)) == 48
    table.close()


def test_rows_that_are_missing_are_not_numbered_anew(tmp_path):
    table = ErrorTable(("x",), tmp_path)
    table.append(batch([1, 2, 3], x=[0.1, 0.2, 0.3]))
    table.close()
    resumed = table.resumed(2, tmp_path)
    resumed.append(batch([7], x=[7.0]))
    assert len(ErrorTable.load(tmp_path, ("x",))) == 3
    with pytest.raises(TableError, match="has no column 'y'"):
        ErrorTable.load(tmp_path, ("x", "y"))
    (tmp_path / FINISHED).unlink()
    with pytest.raises(TableError, match=r"where row 0 should be, there is 2; table.parquet is"):
        ErrorTable.load(tmp_path, ("x",))
    resumed.close()


def test_resuming_drops_what_came_later_and_goes_on(tmp_path):
    table = ErrorTable(("x",), tmp_path / "first")
    for i in range(3):
        table.append(batch([i, -i], x=[float(i), 0.5]))
    # As it is on disk while it grows, or if the process dies.
    tmp_path = shutil.copytree(tmp_path / "first", tmp_path / "cut off")
    table.close()
    earlier = ErrorTable.load(tmp_path, ("x",))
    resumed = earlier.resumed(3, tmp_path)
    assert ErrorTable.load(tmp_path, ("x",)).all.equals(earlier.all.iloc[:3])
    resumed.append(batch([7], x=[7.0]))
    rows = ErrorTable.load(tmp_path, ("x",)).all
    assert rows["rho"].tolist() == [0, 0, 1, 7]
    assert rows.index.tolist() == [0, 1, 2, 3]
    resumed.close()
    assert not (tmp_path / STREAM).exists()
    assert ErrorTable.load(tmp_path, ("x",)).all.equals(resumed.all)
    assert len(earlier.resumed(0)) == 0


def test_a_process_that_dies_while_it_finishes_leaves_no_row_twice(tmp_path):
    table = ErrorTable(("x",), tmp_path)
    table.append(batch([1, -1], x=[0.1, 0.2]))
    stream = (tmp_path / STREAM).read_bytes()
    table.close()
    (tmp_path / STREAM).write_bytes(stream)
    assert ErrorTable.load(tmp_path, ("x",)).all.equals(table.all)


def test_an_empty_table_is_a_table(tmp_path):
    table = ErrorTable(("x",), tmp_path)
    assert len(table.all) == len(table.counterexamples) == len(table.safe) == 0
    table.close()
    assert (tmp_path / FINISHED).exists()
    assert list(ErrorTable.load(tmp_path, ("x",)).all.columns) == list(table.all.columns)


def test_reserved_and_missing_names(tmp_path):
    with pytest.raises(ValueError, match="a feature may not be called 'rho'"):
        ErrorTable(("rho",))
    with pytest.raises(FileNotFoundError, match="no error table in"):
        ErrorTable.load(tmp_path, ("x",))
