"""The cache of a sweep: arrays come back as they were; damaged and foreign files are refused."""

import sqlite3

import hypothesis
import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import strategies

from verifai_jax.core.cache import Cache, CacheError, locked_cache
from verifai_jax.core.locks import FolderInUse

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
    with Cache() as cache:
        if any(value.dtype.kind == "c" for value in work.values()):
            with pytest.raises(TypeError, match="a cache stores numbers and texts"):
                cache.put({"x": work})
            assert cache.get("x") is None
            return
        cache.put({"x": work})
        found = cache.get("x")
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
        with Cache(place) as cache:
            assert cache.remember("piece", compute)["x"] == 1
    assert done == [1]
    assert (tmp_path / "a" / "sweep.sqlite").exists()


def test_all_of_a_transaction_or_nothing(tmp_path):
    with Cache(tmp_path) as cache:
        with pytest.raises(TypeError):
            cache.put({"a": {"x": np.ones(2)}, "b": {"x": np.array([object()])}})
        assert cache.get("a") is None
        cache.put({"a": {"x": np.ones(2)}, "b": {"x": np.zeros(0)}})
        # Committed: another connection sees it while this one is open.
        with Cache(tmp_path) as other:
            assert other.names() == ["a", "b"]


def test_a_cache_knows_what_it_is_of(tmp_path):
    with Cache(tmp_path) as cache:
        cache.claim(ABOUT)
        cache.claim(dict(reversed(ABOUT.items())))
        other = {**ABOUT, "space": {"a": "Box(0, 2)", "b": "Box(0, 1)"}, "seeds": [0]}
        with pytest.raises(CacheError) as error:
            cache.claim(other)
    told = str(error.value)
    assert "seeds is [0], in the cache [0, 1]" in told
    assert "space.a is Box(0, 2), in the cache Box(0, 1)" in told
    assert "space.b is Box(0, 1), in the cache null" in told
    assert "study" not in told.partition("different sweep")[2].partition("Give")[0]


def test_a_note_is_kept_with_the_cache(tmp_path):
    with Cache(tmp_path) as cache:
        assert cache.note("command") is None
        cache.note("command", {"a": [1, None]})
    with Cache(tmp_path) as cache:
        assert cache.note("command") == {"a": [1, None]}


def test_files_of_another_kind(tmp_path):
    text = tmp_path / "text.sqlite"
    text.write_text("no database, but longer than the header of one" * 10)
    with pytest.raises(CacheError, match=r"text\.sqlite is no cache of a sweep: it is a file"):
        Cache(text)
    assert text.read_text().startswith("no database")
    # So short that SQLite takes it for an empty database.
    text.write_text("keep me")
    with pytest.raises(CacheError, match="it is a file of another kind"):
        Cache(text)
    assert text.read_text() == "keep me"
    foreign = tmp_path / "foreign.db"
    base = sqlite3.connect(foreign)
    base.execute("CREATE TABLE trials (number INTEGER)")
    base.commit()
    base.close()
    with pytest.raises(CacheError, match="is a database of something else, not of a sweep"):
        Cache(foreign)
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(CacheError, match=r"notes.txt is a file of another kind; give a folder"):
        Cache(tmp_path / "notes.txt")
    (tmp_path / "folder.db").mkdir()
    with pytest.raises(CacheError, match="is a folder; a cache is a file"):
        Cache(tmp_path / "folder.db")


@pytest.mark.parametrize("form", [2, 9])
def test_another_format_is_refused(form, tmp_path):
    Cache(tmp_path).close()
    base = sqlite3.connect(tmp_path / "sweep.sqlite")
    base.execute(f"PRAGMA user_version={form}")
    base.close()
    with pytest.raises(CacheError, match=rf"has format {form}, .* reads format 3; resume"):
        Cache(tmp_path)


def test_what_is_damaged_is_computed_anew(tmp_path, caplog):
    with Cache(tmp_path) as cache:
        cache.put({"piece": {"x": np.arange(8.0)}, "whole": {"x": np.arange(2.0)}})
    base = sqlite3.connect(tmp_path / "sweep.sqlite")
    base.execute("UPDATE work SET bytes = zeroblob(64) WHERE name = 'piece'")
    base.commit()
    base.close()
    with Cache(tmp_path) as cache:
        assert cache.get("whole") is not None
        assert cache.get("piece") is None
        assert "is damaged in 'piece': its bytes have changed" in caplog.text
        assert "it is computed anew" in caplog.text
        assert cache.remember("piece", lambda: {"x": np.arange(8.0)})["x"][7] == 7
        caplog.clear()
        np.testing.assert_array_equal(cache.get("piece")["x"], np.arange(8.0))
        assert not caplog.text


@pytest.mark.parametrize("table", ["work", "about"])
def test_entries_that_are_exchanged_are_noticed(tmp_path, table, caplog):
    with Cache(tmp_path) as cache:
        cache.put({"one": {"x": np.zeros(3)}, "other": {"x": np.ones(3)}})
        cache.note("one", [1])
        cache.note("other", [2])
    base = sqlite3.connect(tmp_path / "sweep.sqlite")
    for name, other in (("one", "between"), ("other", "one"), ("between", "other")):
        base.execute(f"UPDATE {table} SET name = ? WHERE name = ?", (other, name))
    base.commit()
    base.close()
    with Cache(tmp_path) as cache:
        for name in ("one", "other"):
            if table == "work":
                assert cache.get(name) is None
                assert f"is damaged in '{name}': " in caplog.text
                continue
            with pytest.raises(CacheError, match=rf"is damaged in .*'{name}': .* another note"):
                cache.note(name)


def test_a_file_cut_short_is_an_error_not_a_guess(tmp_path):
    with Cache(tmp_path) as cache:
        for i in range(50):
            cache.put({str(i): {"x": np.full(500, float(i))}})
    file = tmp_path / "sweep.sqlite"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2] + b"\x00" * 100)

    def read():
        with Cache(tmp_path) as cache:
            return [cache.get(str(i)) for i in range(50)]

    with pytest.raises(CacheError, match=r"sweep\.sqlite is"):
        read()


def test_a_cache_that_cannot_be_written(tmp_path):
    with pytest.raises((CacheError, OSError)):
        Cache("/proc/nowhere/x.sqlite")
    with Cache(tmp_path) as cache:
        cache._base.execute("PRAGMA query_only=1")
        with pytest.raises(CacheError, match=r"cannot be used: attempt to write a readonly"):
            cache.put({"a": {"x": np.ones(1)}})


@pytest.mark.parametrize("name", ["kept", "kept/some.sqlite"])
def test_a_cache_has_one_writer(tmp_path, name):
    with locked_cache(tmp_path / name):
        with Cache(tmp_path / name) as cache:
            cache.put({"x": {"a": np.arange(3)}})
        told = f"{name}' is being written by this process"
        with pytest.raises(FolderInUse, match=told), locked_cache(str(tmp_path / name)):
            pass
        with Cache(tmp_path / name) as cache:  # Reading needs no lock.
            assert cache.names() == ["x"]
    with locked_cache(tmp_path / name), locked_cache(None):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(CacheError, match="cannot be written"), locked_cache(tmp_path / "file/in"):
        pass


def test_a_full_disk_is_no_damage_and_loses_nothing(tmp_path):
    path = tmp_path / "small.sqlite"
    with Cache(path) as cache:
        cache.remember("first", lambda: {"x": np.zeros(8)})
        cache._base.execute("PRAGMA max_page_count = 8")
        with pytest.raises(
            CacheError, match=r"cannot be written: .* full; what was finished is in"
        ):
            cache.remember("large", lambda: {"x": np.random.default_rng(0).normal(size=10_000)})
    with Cache(path) as cache:
        assert cache.names() == ["first"]
        cache.remember("large", lambda: {"x": np.zeros(10_000)})
