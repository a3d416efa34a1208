"""The memory of a sweep: what goes in comes out, and what is damaged or foreign is refused."""

import sqlite3

import hypothesis
import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import strategies

from verifai_jax.sweeps.cache import Store, StoreError

ABOUT = {"study": "s", "space": {"a": "Box(0, 1)"}, "seeds": [0, 1]}


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(
    strategies.dictionaries(
        strategies.text(min_size=1, max_size=5),
        strategies.one_of(
            arrays.arrays(dtype, arrays.array_shapes(min_dims=0, min_side=0, max_side=4))
            for dtype in ("float32", "float64", "int64", "uint8", "bool", "<U7", "complex64")
        ),
        max_size=4,
    )
)
def test_arrays_come_back_as_they_were(work):
    with Store() as store:
        if any(value.dtype.kind == "c" for value in work.values()):
            with pytest.raises(TypeError, match="a store keeps numbers and texts"):
                store.put({"x": work})
            assert store.get("x") is None
            return
        store.put({"x": work})
        found = store.get("x")
    assert found is not None
    assert found.keys() == work.keys()
    for name, value in work.items():
        assert found[name].dtype == value.dtype
        assert found[name].shape == value.shape
        assert found[name].tobytes() == value.tobytes()


def test_a_piece_of_work_is_done_once(tmp_path):
    done = []

    def compute():
        done.append(1)
        return {"x": np.float32(len(done))}

    for place in (tmp_path / "a", tmp_path / "a" / "sweep.sqlite"):
        with Store(place) as store:
            assert store.remember("piece", compute)["x"] == 1
    assert done == [1]
    assert (tmp_path / "a" / "sweep.sqlite").exists()


def test_all_of_a_transaction_or_nothing(tmp_path):
    with Store(tmp_path) as store:
        with pytest.raises(TypeError):
            store.put({"a": {"x": np.ones(2)}, "b": {"x": np.array([object()])}})
        assert store.get("a") is None
        store.put({"a": {"x": np.ones(2)}, "b": {"x": np.zeros(0)}})
        # Committed: another connection sees it while this one is open.
        with Store(tmp_path) as other:
            assert other.names() == ["a", "b"]


def test_a_store_knows_what_it_is_of(tmp_path):
    with Store(tmp_path) as store:
        store.belongs(ABOUT)
        store.belongs(dict(reversed(ABOUT.items())))
        other = {**ABOUT, "space": {"a": "Box(0, 2)", "b": "Box(0, 1)"}, "seeds": [0]}
        with pytest.raises(StoreError) as error:
            store.belongs(other)
    told = str(error.value)
    assert "seeds is [0], in the store [0, 1]" in told
    assert "space.a is Box(0, 2), in the store Box(0, 1)" in told
    assert "space.b is Box(0, 1), in the store null" in told
    assert "study" not in told.partition("different sweep")[2].partition("Give")[0]


def test_notes(tmp_path):
    with Store(tmp_path) as store:
        assert store.note("command") is None
        store.note("command", {"a": [1, None]})
    with Store(tmp_path) as store:
        assert store.note("command") == {"a": [1, None]}


def test_files_of_another_kind(tmp_path):
    text = tmp_path / "text.sqlite"
    text.write_text("no database, but longer than the header of one" * 10)
    with pytest.raises(StoreError, match=r"text\.sqlite is no store of a sweep: file is not"):
        Store(text)
    assert text.read_text().startswith("no database")
    foreign = tmp_path / "foreign.db"
    base = sqlite3.connect(foreign)
    base.execute("CREATE TABLE trials (number INTEGER)")
    base.commit()
    base.close()
    with pytest.raises(StoreError, match="is a database of something else, not of a sweep"):
        Store(foreign)
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(StoreError, match=r"notes.txt is a file of another kind; give a folder"):
        Store(tmp_path / "notes.txt")
    (tmp_path / "folder.db").mkdir()
    with pytest.raises(StoreError, match="is a folder; a store is a file"):
        Store(tmp_path / "folder.db")


def test_a_newer_format_is_not_guessed_at(tmp_path):
    Store(tmp_path).close()
    base = sqlite3.connect(tmp_path / "sweep.sqlite")
    base.execute("PRAGMA user_version=9")
    base.close()
    with pytest.raises(StoreError, match=r"newer verifai_jax \(format 9, this one reads 1\)"):
        Store(tmp_path)


def test_changed_bytes_are_noticed(tmp_path):
    with Store(tmp_path) as store:
        store.put({"piece": {"x": np.arange(8.0)}, "whole": {"x": np.arange(2.0)}})
    base = sqlite3.connect(tmp_path / "sweep.sqlite")
    base.execute("UPDATE work SET bytes = zeroblob(64) WHERE name = 'piece'")
    base.commit()
    base.close()
    with Store(tmp_path) as store:
        assert store.get("whole") is not None
        with pytest.raises(StoreError, match="is damaged in 'piece': its bytes have changed"):
            store.get("piece")


def test_a_file_cut_short_is_an_error_not_a_guess(tmp_path):
    with Store(tmp_path) as store:
        for i in range(50):
            store.put({str(i): {"x": np.full(500, float(i))}})
    file = tmp_path / "sweep.sqlite"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2] + b"\x00" * 100)

    def read():
        with Store(tmp_path) as store:
            return [store.get(str(i)) for i in range(50)]

    with pytest.raises(StoreError, match=r"sweep\.sqlite is"):
        read()


def test_a_store_that_cannot_be_written(tmp_path):
    with pytest.raises((StoreError, OSError)):
        Store("/proc/nowhere/x.sqlite")
    with Store(tmp_path) as store:
        store._base.execute("PRAGMA query_only=1")
        with pytest.raises(StoreError, match=r"cannot be used: attempt to write a readonly"):
            store.put({"a": {"x": np.ones(1)}})
