"""Logs: entries come back as they were, whatever became of those beside them."""

import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path

import hypothesis
import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import strategies

from verifai_jax.core.store.files import DamagedError, checksum
from verifai_jax.core.store.log import HEADER, MARK, Log, write_log


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
    with tempfile.TemporaryDirectory() as folder:
        for log in (Log(None), Log(Path(folder) / "a.log")):
            if any(value.dtype.kind == "c" for value in work.values()):
                with pytest.raises(TypeError, match="numbers and texts can be stored"):
                    log.put({"y": {}, "x": work})
                assert log.get("x") is log.get("y") is None
                continue
            log.put({"y": {}, "x": work})
            for read in (log, log if log.path is None else Log(log.path)):
                found = read.get("x")
                assert found.keys() == work.keys()
                for name, value in work.items():
                    assert found[name].dtype == value.dtype
                    assert found[name].shape == value.shape
                    assert found[name].tobytes() == value.tobytes()


def three(path):
    log = Log(path)
    for i in range(3):
        log.put({str(i): {"x": np.full(3, i)}, f"{i}+": {"text": np.array("é")}})
    return path.read_bytes()


def read(path):
    return {name: entry for name, entry in Log(path).entries() if "x" in entry}


def test_a_byte_that_has_changed_costs_its_frame_alone(tmp_path):
    path = tmp_path / "a.log"
    whole = three(path)
    size = len(whole) // 3
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
        found = read(path)
        assert [*found] == [name for name in "012" if int(name) != at // size]
        assert all((entry["x"] == int(name)).all() for name, entry in found.items())
    path.write_bytes(whole[:size] + b"VJX1, and what not" + whole[size:])
    assert [*read(path)] == ["0", "1", "2"]
    assert Log(path).damaged


def test_a_log_that_is_cut_off_goes_on(tmp_path):
    path = tmp_path / "a.log"
    whole = three(path)
    for at in range(0, len(whole), 7):
        path.write_bytes(whole[:at])
        log = Log(path)
        log.put({"9": {"x": np.full(3, 9)}})
        assert [*read(path)] == [*"012"[: 3 * at // len(whole)], "9"]
        log.clear()
        assert not path.exists()


def test_the_last_entry_of_a_name_counts(tmp_path):
    log = Log(tmp_path / "a.log")
    assert (log.get_json("note"), log.names(), log.damaged) == (None, [], False)
    for i in range(3):
        log.put_json("note", {"i": i})
        assert log.get_json("note") == Log(log.path).get_json("note") == {"i": i}
    write_log(log.path, {"only": {"x": np.zeros(2)}})
    assert Log(log.path).names() == ["only"]
    write_log(log.path, {})
    assert not Log(log.path).names()
    assert [file.name for file in tmp_path.iterdir()] == ["a.log"]


def test_a_forged_log_is_damaged_in_words(tmp_path):
    path = tmp_path / "a.log"
    for form in (
        3, [], [3], [["a", 3]], [["a", 8, [3]]], [["b", 0, []]], [[["a"], []]], [["a", -1, []]],
        [["a", 10**18, []]], *(
            [["a", 8, [["x", kind, shape]]]]
            for kind, shape in (
                ("O", [1]), ("f8", [3]), ("f8", [10**30]), ("U9999999", [1]), ({}, []), ("(2", [1])
            )
        ),
    ):  # fmt: skip
        head, body = json.dumps(form).encode(), b"12345678"
        begin = HEADER.pack(MARK, len(head), len(body), 0)[:-4]
        own = checksum(head + body, checksum(begin))
        path.write_bytes(HEADER.pack(MARK, len(head), len(body), own) + head + body)
        assert not Log(path).damaged
        assert Log(path).get("a") is None
        assert dict(Log(path).entries()).keys() <= {"b"}
    path.unlink()
    path.mkdir()
    with pytest.raises(DamagedError, match=r"a\.log is damaged: it is a folder"):
        Log(path).names()


WRITES = """
import os, sys, time
from pathlib import Path
import numpy as np
from verifai_jax.core.store.log import Log
log = Log(Path(sys.argv[1]))
log.put({"-1": {"x": np.full(5_000, -1)}})
if os.fork() == 0:
    os._exit(0)
print("writes", flush=True)
for i in range(500):
    log.put({str(i): {"x": np.full(5_000, i)}})
time.sleep(60)
"""


def test_killed_and_copied_at_any_moment_it_has_what_was_put_before(tmp_path):
    path = tmp_path / "a.log"
    for _ in range(2):
        before = len(Log(path).names())
        child = subprocess.Popen(
            [sys.executable, "-c", WRITES, str(path)], stdout=subprocess.PIPE, text=True
        )
        copies = []
        try:
            assert child.stdout.readline() == "writes\n"
            for i in range(5):
                copies.append(Path(shutil.copy(path, tmp_path / f"copy {i}")))
                time.sleep(0.001)
        finally:
            os.kill(child.pid, signal.SIGKILL)
            child.communicate()
        for file in (*copies, path):
            found = {name: entry["x"] for name, entry in Log(file).entries()}
            assert [*found] == [str(i) for i in range(-1, len(found) - 1)]
            assert all((x == int(name)).all() for name, x in found.items())
        assert len(found) >= max(before, 1)


def test_a_reader_meets_whole_entries_while_it_grows(tmp_path):
    path, seen = tmp_path / "a.log", []

    def write():
        log = Log(path)
        for i in range(300):
            log.put({str(i): {"x": np.full(1000, i)}})

    writer = threading.Thread(target=write)
    writer.start()
    while writer.is_alive():
        found = read(path)
        assert [*found] == [str(i) for i in range(len(found))]
        seen.append(len(found))
    writer.join()
    assert sorted(seen) == seen
    assert len(read(path)) == 300


def test_it_needs_no_right_to_write_to_be_read(tmp_path):
    path = tmp_path / "a.log"
    three(path)
    path.chmod(0o444)
    tmp_path.chmod(0o555)
    try:
        assert [*read(path)] == ["0", "1", "2"]
        assert [file.name for file in tmp_path.iterdir()] == ["a.log"]
    finally:
        tmp_path.chmod(0o755)


def test_a_full_disk_is_named(tmp_path):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    path = tmp_path / "a.log"
    path.symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"a\.log cannot be written \(No space left"):
        Log(path).put({"a": {"x": np.zeros(3)}})


@pytest.mark.slow
def test_a_log_in_a_cycle_is_closed_before_its_file_is_collected(tmp_path):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        for number in range(20):
            file_first, log = [], Log(tmp_path / f"{number}.rows")
            log.put({"0": {"x": np.arange(3.0)}})
            file_first.extend((log._file, log, file_first))
            del file_first, log
            gc.collect()
    assert not [each for each in seen if each.category is ResourceWarning]
    assert Log(tmp_path / "0.rows").names() == ["0"]
