import contextlib
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.store.log import Log
from verifai_jax.falsification import segments
from verifai_jax.falsification.segments import TAIL
from verifai_jax.falsification.table import FINISHED, ErrorTable, TableError


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
    assert (tmp_path / "run" / TAIL).exists()
    assert growing.all.equals(table.all)
    table.close()
    assert not (tmp_path / "run" / TAIL).exists()
    finished = ErrorTable.load(tmp_path / "run", table.features)
    assert finished.all.equals(table.all)


def test_a_process_that_dies_loses_only_the_batch_in_flight(tmp_path):
    table = ErrorTable(("x",), tmp_path)
    for i in range(3):
        table.append(batch([i], x=[float(i)]))
    whole = (tmp_path / TAIL).read_bytes()
    for cut in (1, 9, 60, 150):
        (tmp_path / TAIL).write_bytes(whole[:-cut])
        rows = ErrorTable.load(tmp_path, ("x",)).all
        assert rows["rho"].tolist() == [0, 1]
    (tmp_path / TAIL).write_bytes(whole[:10])
    assert len(ErrorTable.load(tmp_path, ("x",))) == 0
    table.close()


def damaged_rows(table):
    """Return the rows of a table that warns where it is damaged."""
    if not table.damage:
        return table.all
    with pytest.warns(UserWarning, match="the error table is damaged: "):
        return table.all


def test_damaged_bytes_cost_rows_and_not_the_process(tmp_path):
    table = ErrorTable(("x", "color"), tmp_path)
    colors = np.array(["red", "blue", "green"] * 4, object)
    for i in range(4):
        table.append(batch([i] * 12, x=[i / 4] * 12, color=colors))
    whole, random = (tmp_path / TAIL).read_bytes(), np.random.default_rng(0)
    for turn in range(120):
        damaged = bytearray(whole)
        at = int(random.integers(len(damaged)))
        if turn % 2:
            damaged[at] ^= 1 << int(random.integers(8))
        else:
            damaged[at:at] = random.bytes(4)
        (tmp_path / TAIL).write_bytes(damaged)
        # Of four batches one is lost, told unless it is the last, and the others are right.
        read = ErrorTable.load(tmp_path, table.features)
        rows = damaged_rows(read)
        gone = next((i for i in range(4) if 12 * i not in rows.index), None)
        assert len(read) == 48 if gone is None else len(read) == 36
        if gone is not None and gone < 3:
            assert read.missing == (range(12 * gone, 12 * gone + 12),)
            assert f"rows {12 * gone} to {12 * gone + 11} are missing" in read.damage
        else:
            assert gone is not None or turn % 2 == 0  # Bytes between two batches belong to none.
        assert rows.equals(table.all.loc[rows.index])
        with contextlib.suppress(TableError):
            read.resumed(12)
    (tmp_path / TAIL).write_bytes(whole)
    assert len(ErrorTable.load(tmp_path, table.features)) == 48
    table.close()


def test_rows_that_are_missing_are_not_numbered_anew(tmp_path, short):
    table = ErrorTable(("x",), tmp_path)
    table.append(batch([1, -2, 3, -4, 5, 6, -7, 8, 9, -10], x=np.arange(10.0)))
    with pytest.raises(TableError, match="has no column 'y'"):
        ErrorTable.load(tmp_path, ("x", "y"))
    whole = table.all
    first, second = sorted((tmp_path / "table").iterdir())
    damaged = bytearray(first.read_bytes())
    damaged[100] ^= 4
    first.write_bytes(damaged)
    read = ErrorTable.load(tmp_path, ("x",))
    assert read.missing == (range(4),)
    assert "is damaged: its bytes have changed; rows 0 to 3 are missing" in read.damage
    assert damaged_rows(read).equals(whole.loc[4:])
    assert len(read) == 6
    assert read.counterexamples.index.tolist() == [6, 9]
    assert (read.row(6)["x"], read.row(9)["x"], read.counts.violating) == (6.0, 9.0, 2)
    with pytest.raises(IndexError, match=r"row 2 is not in the table of 6 .* rows 0 to 3 are mis"):
        read.row(2)
    second.unlink()
    read = ErrorTable.load(tmp_path, ("x",))
    assert read.missing == (range(8),)
    assert damaged_rows(read).index.tolist() == [8, 9]
    for refused in (read.resumed, read.save):
        with pytest.raises(TableError, match="rows 0 to 7 are missing"):
            refused(tmp_path / "other" if refused == read.save else 9)


@pytest.fixture
def short(monkeypatch):
    """Segments of four rows."""
    monkeypatch.setattr(segments, "SEGMENT_ROWS", 4)


def test_a_long_table_is_segments_and_its_failures_are_read_alone(tmp_path, short, monkeypatch):
    table = ErrorTable(("x", "color"), tmp_path)
    whole = ErrorTable(("x", "color"))
    rho = np.array([3, 1, 2, 5, -1, -3, 4, 0.5, -2, 7, 8], np.float32)
    colors = np.array(["red", "blue"] * 6, object)[:11]
    verdict = np.where(rho < 0, "confirmed", "").astype(object)
    verdict[4] = "refuted"
    status = np.where(np.arange(11) == 6, "error", "ok").astype(object)
    rows = {**batch(rho, status, x=np.arange(11.0), color=colors), "verdict": verdict}
    for begin, end in ((0, 3), (3, 10), (10, 11)):
        part = {name: values[begin:end] for name, values in rows.items()}
        table.append(part)
        whole.append(part)
        assert sum(len(b["rho"]) for _, b in table._batches) == end % 4  # The others are on disk.
        growing = ErrorTable.load(tmp_path, table.features)
        for name in ("all", "counterexamples", "unconfirmed", "violating", "safe", "failed"):
            assert getattr(growing, name).equals(getattr(whole, name)), name
        assert growing.counts == whole.counts
    assert (table.path, len(table)) == (tmp_path / "table", 11)
    table.close()
    read = ErrorTable.load(tmp_path, table.features)
    for name in ("all", "counterexamples", "unconfirmed", "violating", "safe", "failed"):
        assert getattr(table, name).equals(getattr(whole, name)), name
        assert getattr(read, name).equals(getattr(whole, name)), name
    assert [len(block) for block in read.blocks(("rho",))] == [4, 4, 3]
    assert {path.name for path in tmp_path.iterdir()} == {"table", "failures"}
    # What people expect of a file that is called a table.
    assert pd.read_parquet(tmp_path / "table").equals(whole.all)
    assert set(pd.read_parquet(tmp_path / "failures").index) == {1, 4, 5, 6, 8}
    # Failures, counts and rows of them need no segment.
    read = ErrorTable.load(tmp_path, table.features)
    own = segments.Segment.read

    def read_failures(self, columns=None):
        assert self.path.parent.name == "failures"
        return own(self, columns)

    with monkeypatch.context() as patch:
        patch.setattr(segments.Segment, "read", read_failures)
        assert read.counterexamples.equals(whole.counterexamples)
        assert read.counts == whole.counts
        assert (read.counts.worst, read.counts.claimed, read.counts.verdicts["refuted"]) == (
            5,
            2,
            1,
        )
    # They are found without their index too.
    for file in (tmp_path / "failures").iterdir():
        file.write_bytes(file.read_bytes()[:-7])
    assert ErrorTable.load(tmp_path, table.features).violating.equals(whole.violating)
    # And a copy is the same, whether short or long.
    saved = read.save(tmp_path / "copy")
    names = sorted(file.name for file in (tmp_path / "table").iterdir())
    assert sorted(file.name for file in (tmp_path / "copy" / "table").iterdir()) == names
    assert [saved.digest(n) for n in range(12)] == [read.digest(n) for n in range(12)]
    assert saved.all.equals(whole.all)


class Killed(BaseException):
    """The process is no more."""


def killed_at(monkeypatch, step):
    """Die before the operation on files with this number; return those made, and by what."""
    done = []

    def before(call):
        def counted(owner, *args, **options):
            if len(done) == step:
                raise Killed
            done.append(owner)
            return call(owner, *args, **options)

        return counted

    for owner, name in ((Path, "replace"), (Path, "unlink"), (Path, "rmdir"), (Log, "put")):
        monkeypatch.setattr(owner, name, before(getattr(owner, name)))
    return done


def files(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("stride", [9, pytest.param(1, marks=pytest.mark.thorough)])
def test_a_process_may_die_between_any_two_operations_on_files(
    tmp_path, short, monkeypatch, stride
):
    def rows(begin, end):
        x = np.arange(begin, end, dtype=float)
        return batch(np.where(x % 3, 1.0, -1.0) * (x + 1), x=x)

    def write(folder, table, written):
        for end in (3, 6, 7, 16, 18, 21, 22):
            if end > len(table):
                table.append(rows(len(table), end))
                written.append(end)
        table.close()

    def interrupted(folder, written):
        table = ErrorTable(("x",), folder)
        write(folder, table, written)
        # A snapshot of an earlier moment: what came since is dropped, and simulated again.
        written.append(-1)
        write(folder, ErrorTable.load(folder, ("x",)).resumed(7, folder), written)

    interrupted(tmp_path / "whole", [])
    whole, expected = files(tmp_path / "whole"), rows(0, 22)
    step, finished = 0, False
    while not finished:
        folder, written = tmp_path / str(step), []
        with monkeypatch.context() as patch:
            killed_at(patch, step)
            with contextlib.suppress(Killed):
                interrupted(folder, written)
                finished = True
        step += stride
        again = -1 in written
        after = written[written.index(-1) + 1 :] if again else written
        kept = max([*after, 7 if again else 0])
        if not ErrorTable.exists(folder):
            assert not kept
            continue
        table = ErrorTable.load(folder, ("x",))
        assert not table.missing
        assert len(table) >= kept
        assert table.all["x"].tolist() == list(range(len(table)))
        assert table.all["rho"].tolist() == expected["rho"][: len(table)].tolist()
        assert table.violating.index.tolist() == list(range(0, len(table), 3))
        write(folder, table.resumed(kept, folder), [])
        assert files(folder) == whole
    assert step > 40


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
    assert not (tmp_path / TAIL).exists()
    assert ErrorTable.load(tmp_path, ("x",)).all.equals(resumed.all)
    assert len(earlier.resumed(0)) == 0


def test_a_process_that_dies_while_it_finishes_leaves_no_row_twice(tmp_path):
    table = ErrorTable(("x",), tmp_path)
    table.append(batch([1, -1], x=[0.1, 0.2]))
    stream = (tmp_path / TAIL).read_bytes()
    table.close()
    (tmp_path / TAIL).write_bytes(stream)
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


@pytest.mark.thorough
def test_numbers_of_numpy_are_as_good_as_pythons(tmp_path):
    def simulator(features):
        return vj.Trace({"a": np.array([features["x"]])}, dt=1.0)

    problem = vj.Problem("t", {"x": vj.Box(0.0, 1.0)}, vj.blackbox(simulator), "a < 0.5")
    numbers = {"budget": np.int64(32), "batch": np.int32(8), "seed": np.uint8(3)}
    run = vj.falsify(
        problem, "uniform", folder=tmp_path / "run", stop=vj.Stop(seconds=np.float32(60)),
        progress=False, **numbers,
    )  # fmt: skip
    assert vj.load(tmp_path / "run", problem).budget == run.simulations == 32
    row = np.int64(run.table.counterexamples.index[0])
    assert vj.confirm(run, row).confirmed
    assert run.replay(row).violated
    with unchecked():
        for no_row in ([0], True, "0"):
            with pytest.raises(TypeError, match="a row must be the number of a row of the table"):
                vj.confirm(run, no_row)
            with pytest.raises(TypeError, match="a row must be the number of a row of the table"):
                run.replay(no_row)
