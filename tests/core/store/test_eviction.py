"""The size limit of the cache of compiled programs."""

import os
import threading

import pytest

from verifai_jax.core.compute.devices import cache_limit
from verifai_jax.core.store.eviction import evict

HASH = "0123456789abcdef" * 4


def filled(folder, count=10, size=1000):
    for sub in ("", "derived", "native"):
        (folder / sub).mkdir(exist_ok=True)
    files = []
    for i in range(count):
        name = (f"jit_f-{HASH}{i}-cache", f"derived/search-{HASH}{i}", f"native/m-{HASH}{i}.so")
        files.append(folder / name[i % 3])
        files[-1].write_bytes(bytes(size))
        os.utime(files[-1], (10**9 + i, 10**9 + i))
    return files


def test_the_oldest_go_first_and_others_stay(tmp_path):
    files = filled(tmp_path)
    users = [tmp_path / "thesis-final.tex", tmp_path / "notes", tmp_path / "native" / "my-own.so"]
    for each in users:
        each.write_bytes(bytes(10_000))
        os.utime(each, (0, 0))
    evict(tmp_path, 10_000)
    assert all(each.exists() for each in files)
    evict(tmp_path, 5_000)
    assert [each.exists() for each in files] == [False] * 6 + [True] * 4
    assert all(each.exists() for each in users)


def test_what_is_used_stays(tmp_path):
    files = filled(tmp_path)
    os.utime(files[0], (2 * 10**9, 10**9))
    evict(tmp_path, 5_000)
    assert files[0].exists()


def test_several_at_the_same_time(tmp_path):
    files = filled(tmp_path, 300)
    threads = [threading.Thread(target=evict, args=(tmp_path, 100_000)) for _ in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    # What one has removed the others do not remove again in place of newer ones.
    assert sum(each.exists() for each in files) >= 80
    assert all(each.exists() for each in files[-80:])


def test_a_folder_that_is_not_there(tmp_path):
    evict(tmp_path / "none", 1)


def test_the_limit(monkeypatch):
    monkeypatch.delenv("VERIFAI_JAX_CACHE_MIB", raising=False)
    assert cache_limit() == 2048 * 2**20
    monkeypatch.setenv("VERIFAI_JAX_CACHE_MIB", "10")
    assert cache_limit() == 10 * 2**20
    for wrong in ("0", "-1", "1.5", "much"):
        monkeypatch.setenv("VERIFAI_JAX_CACHE_MIB", wrong)
        with pytest.raises(ValueError, match="VERIFAI_JAX_CACHE_MIB must be a positive integer"):
            cache_limit()
