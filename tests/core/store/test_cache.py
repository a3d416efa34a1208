"""The cache of finished work: what is damaged is computed anew, what is foreign is refused."""

import shutil

import numpy as np
import pytest

from verifai_jax.core.store.cache import Cache, CacheError, locked_cache
from verifai_jax.core.store.locks import FolderInUse
from verifai_jax.core.store.log import Log

resource = pytest.importorskip("resource")

ABOUT = {"study": "s", "space": {"a": "Box(0, 1)"}, "seeds": [0, 1]}


def test_a_piece_of_work_is_done_once(tmp_path):
    done = []

    def compute():
        done.append(1)
        return {"x": np.float32(len(done))}

    for _ in range(2):
        assert Cache(tmp_path).remember("piece", compute)["x"] == 1
    assert done == [1]
    assert [file.name for file in tmp_path.iterdir()] == ["sweep.cache"]


def test_all_of_a_transaction_or_nothing(tmp_path):
    cache = Cache(tmp_path)
    with pytest.raises(TypeError):
        cache.put({"a": {"x": np.ones(2)}, "b": {"x": np.array([object()])}})
    assert cache.get("a") is None
    cache.put({"a": {"x": np.ones(2)}, "b": {"x": np.zeros(0)}})
    # Committed: another connection sees it while this one is open.
    other = Cache(tmp_path)
    assert other.names() == ["a", "b"]


def test_a_cache_knows_what_it_is_of(tmp_path):
    cache = Cache(tmp_path)
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


def test_notes(tmp_path):
    cache = Cache(tmp_path)
    assert cache.note("command") is None
    cache.note("command", {"a": [1, None]})
    cache = Cache(tmp_path)
    assert cache.note("command") == {"a": [1, None]}


def test_files_of_another_kind(tmp_path):
    file = tmp_path / "sweep.cache"
    for content in ("keep me", "no cache, but longer than its header" * 10):
        file.write_text(content)
        with pytest.raises(CacheError, match=r"sweep\.cache is not a cache: it is another kind"):
            Cache(tmp_path)
        assert file.read_text() == content
    file.unlink()
    Log(file).put({"trials": {"number": np.arange(3)}})
    with pytest.raises(CacheError, match="is damaged: it lacks the record that identifies"):
        Cache(tmp_path).claim(ABOUT)
    file.unlink()
    Cache(tmp_path).claim(ABOUT)
    shutil.copy(file, tmp_path / "augmentation.cache")
    with pytest.raises(CacheError, match="a different augmentation: seeds is 3, in the cache"):
        Cache(tmp_path, "augmentation").claim({"seeds": 3})
    file.unlink()
    file.mkdir()
    with pytest.raises(CacheError, match=r"sweep\.cache is damaged: it is a folder"):
        Cache(tmp_path)


def changed(path, old, new):
    content = path.read_bytes()
    assert content.count(old) == 1
    path.write_bytes(content.replace(old, new))


def test_what_is_damaged_is_computed_anew(tmp_path, caplog):
    cache = Cache(tmp_path)
    cache.put({"piece": {"x": np.arange(8.0)}})
    cache.put({"whole": {"x": np.arange(2.0)}})
    changed(tmp_path / "sweep.cache", np.arange(8.0).tobytes(), bytes(64))
    cache = Cache(tmp_path)
    assert cache.names() == ["whole"]
    assert cache.get("piece") is None
    assert "is damaged: its unreadable parts are computed again" in caplog.text
    assert cache.remember("piece", lambda: {"x": np.arange(8.0)})["x"][7] == 7
    caplog.clear()
    np.testing.assert_array_equal(cache.get("piece")["x"], np.arange(8.0))
    assert not caplog.text


def test_entries_that_are_exchanged_are_noticed(tmp_path, caplog):
    cache = Cache(tmp_path)
    cache.put({"one": {"x": np.zeros(3)}})
    cache.put({"two": {"x": np.ones(3)}})
    cache.put({"four": {"x": np.ones(3)}})
    changed(tmp_path / "sweep.cache", b'"one"', b'"six"')
    changed(tmp_path / "sweep.cache", b'"two"', b'"one"')
    changed(tmp_path / "sweep.cache", b'"six"', b'"two"')
    cache = Cache(tmp_path)
    assert "is damaged: its unreadable parts are computed again" in caplog.text
    assert cache.names() == ["four"]


@pytest.mark.parametrize("what", [b"note:about", b'"work"'])
def test_a_cache_that_does_not_say_what_it_is_of_is_refused(tmp_path, what):
    cache = Cache(tmp_path, "augmentation")
    cache.claim(ABOUT)
    cache.put({"one": {"x": np.zeros(3)}})
    changed(tmp_path / "augmentation.cache", what, what.upper())
    told = r"augmentation\.cache is damaged: it lacks the record that identifies its computation"
    with pytest.raises(CacheError, match=told):
        Cache(tmp_path, "augmentation").claim(ABOUT)


def test_a_cache_cut_short_has_what_is_before(tmp_path):
    cache = Cache(tmp_path)
    cache.claim(ABOUT)
    for i in range(50):
        cache.put({str(i): {"x": np.full(500, float(i))}})
    file = tmp_path / "sweep.cache"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2] + b"\x00" * 100)
    cache = Cache(tmp_path)
    cache.claim(ABOUT)
    found = [i for i in range(50) if cache.get(str(i)) is not None]
    assert found == list(range(len(found)))
    assert 20 < len(found) < 30
    for i in range(50):
        x = cache.remember(str(i), lambda i=i: {"x": np.full(500, float(i))})["x"]
        assert (x == i).all()
    cache = Cache(tmp_path)
    assert all(cache.get(str(i)) is not None for i in range(50))


def test_a_cache_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "in", "/proc/nowhere"):
        with pytest.raises(ValueError, match="cannot be written"), locked_cache(folder):
            pass
    with pytest.raises(CacheError, match=r"sweep\.cache cannot be written: No such file or dir"):
        Cache(tmp_path / "none").put({"a": {"x": np.ones(1)}})


def test_a_cache_has_one_writer(tmp_path):
    with locked_cache(tmp_path / "kept") as cache:
        cache.put({"x": {"a": np.arange(3)}})
        told = "kept' is being written by this process"
        with pytest.raises(FolderInUse, match=told), locked_cache(str(tmp_path / "kept")):
            pass
        assert Cache(tmp_path / "kept").names() == ["x"]  # Reading needs no lock.
    with locked_cache(tmp_path / "kept"), locked_cache(None):
        pass


def test_a_full_disk_is_no_damage_and_loses_nothing(tmp_path):
    with locked_cache(tmp_path) as cache:
        cache.remember("first", lambda: {"x": np.zeros(8)})
        size = cache.path.stat().st_size
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 1000, limits[1]))
        try:
            told = r"sweep\.cache cannot be written: File too large; what was finished is in it"
            with pytest.raises(CacheError, match=told):
                cache.remember("large", lambda: {"x": np.zeros(10_000)})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert cache.path.stat().st_size == size
    cache = Cache(tmp_path)
    assert cache.names() == ["first"]
    cache.remember("large", lambda: {"x": np.zeros(10_000)})
