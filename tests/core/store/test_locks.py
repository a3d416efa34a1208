"""The lock of a folder that is being written."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from verifai_jax.core.store.locks import LOCK, FolderInUse, write_lock

fcntl = pytest.importorskip("fcntl")

HOLDS = """
import sys, time
from pathlib import Path
from verifai_jax.core.store.locks import write_lock
with write_lock(Path(sys.argv[1])):
    print("holds", flush=True)
    time.sleep(60)
"""


def test_the_second_writer_is_told_who_has_it(tmp_path):
    child = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == "holds\n"
        with (
            pytest.raises(FolderInUse, match=rf"being written by process {child.pid} on .+; wait"),
            write_lock(tmp_path),
        ):
            pass
        assert (tmp_path / LOCK).exists()
    finally:
        # The lock goes with the process, however it ends; what is left of the file is no lock.
        os.kill(child.pid, signal.SIGKILL)
        child.communicate()
    with write_lock(tmp_path):
        assert (tmp_path / LOCK).read_text().startswith(f"{os.getpid()} ")
    assert not (tmp_path / LOCK).exists()


def test_within_a_process(tmp_path):
    told = r"by this process .+ already"
    with write_lock(tmp_path), pytest.raises(FolderInUse, match=told), write_lock(tmp_path):
        pass
    with pytest.raises(KeyError), write_lock(tmp_path):
        raise KeyError
    with write_lock(tmp_path), write_lock(None):
        pass
    assert not list(tmp_path.iterdir())
    with write_lock(tmp_path / "made" / "here"):
        assert (tmp_path / "made" / "here" / LOCK).exists()


FORKS = """
import os, sys
from pathlib import Path
from verifai_jax.core.store.locks import write_lock
ends, goes = os.pipe()
with write_lock(Path(sys.argv[1])):
    child = os.fork()
    if child == 0:
        os.close(goes)
        os.read(ends, 1)
        os._exit(0)
with write_lock(Path(sys.argv[1])):
    os.close(goes)
    os.waitpid(child, 0)
print("locked again while the child lived")
"""


def test_a_forked_child_does_not_keep_it(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", FORKS, str(tmp_path)],
        check=True,
        timeout=60,
        capture_output=True,
        text=True,
    )
    assert done.stdout == "locked again while the child lived\n"


def test_a_lock_file_of_nonsense_is_no_owner(tmp_path):
    (tmp_path / LOCK).write_bytes(b"\xff\x1b[2J")
    with open(tmp_path / LOCK) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(FolderInUse, match="by another process;"), write_lock(tmp_path):
            pass
    with write_lock(tmp_path):
        pass


def test_a_link_is_not_followed(tmp_path):
    (tmp_path / "mine").write_text("dear")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / LOCK).symlink_to(tmp_path / "mine")
    with (
        pytest.raises(ValueError, match=r"run' cannot be written \(.* symbolic link"),
        write_lock(tmp_path / "run"),
    ):
        pass
    assert (tmp_path / "mine").read_text() == "dear"


def test_one_at_a_time(tmp_path):
    inside, most, turns = 0, 0, 0
    count = threading.Lock()

    def write():
        nonlocal inside, most, turns
        for _ in range(200):
            try:
                with write_lock(tmp_path):
                    with count:
                        inside, turns = inside + 1, turns + 1
                        most = max(most, inside)
                    with count:
                        inside -= 1
            except FolderInUse:
                pass

    threads = [threading.Thread(target=write) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1
    assert turns > 0
