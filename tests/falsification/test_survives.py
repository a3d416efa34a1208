"""Runs that are killed, and disks that do not take what is written to them."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.store.files import sealed
from verifai_jax.core.store.locks import LOCK, FolderInUse, write_lock
from verifai_jax.core.store.log import Log
from verifai_jax.falsification.run_folder import (
    RECORD,
    RECORD_CHECKSUM,
    ROWS_CHECKSUM,
    STATE,
    write_checkpoint,
)
from verifai_jax.falsification.segments import TAIL

SPACE = {"a": vj.Box(0, 1), "b": vj.Box(-1, 1)}


def ramp(features, key):
    return vj.Trace({"x": (features["a"] + 0.1 * features["b"]) * jnp.linspace(0, 1, 5)}, dt=0.25)


@pytest.fixture(scope="module")
def problem():
    return vj.Problem("ramp", SPACE, ramp, "always x <= 0.9")


@pytest.fixture(scope="module")
def whole(problem):
    return vj.falsify(problem, "cross_entropy", 160, batch=16).table.all


def flip(at):
    """Change a bit of the byte at this place."""

    def write(file):
        content = bytearray(file.read_bytes())
        content[at] ^= 1
        file.write_bytes(content)

    return write


def full_disk(folder, name):
    """Let writing to this file of the folder fail as on a full disk."""
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    folder.mkdir(exist_ok=True)
    (folder / name).symlink_to("/dev/full")


@pytest.mark.thorough
def test_a_full_disk_stops_the_run_with_nothing_lost(problem, whole, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    rows = vj.ErrorTable.append

    def append(self, columns):
        # The disk is full from the fourth batch on: what is written goes nowhere.
        if len(self) == 48 and self._tail is not None:
            self._tail.close()
            self._tail.path = Path("/dev/full")
        rows(self, columns)

    monkeypatch.setattr(vj.ErrorTable, "append", append)
    with pytest.raises(vj.RunError, match=r"broke down after 64 .*[Nn]o space") as raised:
        vj.falsify(problem, "cross_entropy", 160, batch=16, folder=folder)
    monkeypatch.undo()
    assert "make room there and resume it, or save the run elsewhere" in str(raised.value)
    run = raised.value.run
    # In memory: all that was simulated. It can be saved elsewhere, and goes on there.
    assert run.table.all.equals(whole.iloc[:64])
    elsewhere = run.save(tmp_path / "elsewhere")
    assert vj.resume(elsewhere, problem).table.all.equals(whole)
    # On disk: whole batches, from which a resumed run gives the same table.
    assert vj.resume(folder, problem).table.all.equals(whole)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "name", [f".{STATE}.part", f".{RECORD}.part", ".table.parquet.part", f".{TAIL}.part"]
)
def test_a_disk_that_is_full_at_the_end(problem, whole, tmp_path, name):
    folder = tmp_path / "run"
    vj.falsify(problem, "cross_entropy", 64, batch=16, folder=folder)
    full_disk(folder, name)
    with pytest.raises((vj.RunError, ValueError), match=r"[Nn]o space") as raised:
        vj.resume(folder, problem, budget=160)
    if isinstance(raised.value, vj.RunError):
        rows = raised.value.run.table.all  # All, unless a checkpoint was due before the end.
        assert rows.equals(whole.iloc[: len(rows)])
    (folder / name).unlink(missing_ok=True)
    assert vj.resume(folder, problem, budget=160).table.all.equals(whole)


def test_a_folder_that_cannot_be_written_is_refused_before_anything_runs(problem, tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file" / "run", Path("/proc/run")):
        with pytest.raises(ValueError, match=r"folder '.*run' cannot be written \(.+\); give one"):
            vj.falsify(problem, "uniform", 32, folder=folder)


def test_a_damaged_folder_is_told(problem, tmp_path):
    run = vj.falsify(problem, "cross_entropy", 64, batch=16, folder=tmp_path / "run")
    assert run.folder is not None
    (run.folder / "table.parquet").unlink()
    (run.folder / TAIL).write_bytes(b"")
    with pytest.raises(ValueError, match="its search had seen 64 simulations, of which its table"):
        vj.resume(run.folder, problem, budget=160)


@pytest.fixture(scope="module")
def kept(problem, tmp_path_factory):
    """The folder of a finished run, not to be written to."""
    return vj.falsify(
        problem, "cross_entropy", 64, batch=16, folder=tmp_path_factory.mktemp("kept") / "run"
    ).folder


def snapshot(**changed):
    """Change arrays of a snapshot, with the right checksum of it."""

    def write(file):
        arrays = Log(file).get("search")
        checksums = (int(arrays.pop(each)) for each in (ROWS_CHECKSUM, RECORD_CHECKSUM))
        write_checkpoint({**arrays, **changed}, file.parent, *checksums)

    return write


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda file: file.write_bytes(b""), r"search.state is damaged: it holds no state of"),
        (lambda file: file.write_bytes(file.read_bytes()[:300]), r"search.state is damaged"),
        (lambda file: file.write_bytes(file.read_bytes()[:-1]), r"it holds no state of a search"),
        (lambda file: file.write_text("nonsense"), r"search.state is damaged: it holds no state"),
        (flip(-1), r"search.state is damaged: it holds no state of a search"),
        (flip(30), r"search.state is damaged: it holds no state of a search"),
        (snapshot(rows=np.array(-3)), r"does not say how many rows its search saw"),
        (snapshot(rows=np.array([1])), r"does not say how many rows its search saw"),
        (snapshot(rows=np.array(10**12)), r"seen 1000000000000 simulations, of whi"),
        (snapshot(rows=np.array(48)), r"the first 48 rows .* are not those that"),
    ],
)
def test_a_damaged_checkpoint_does_not_hide_the_table(problem, whole, kept, tmp_path, damage, told):
    folder = shutil.copytree(kept, tmp_path / "run")
    damage(folder / STATE)
    run = vj.load(folder, problem)
    told_too = pytest.warns(UserWarning, match="the error table is damaged: the first 48 rows")
    with told_too if run.table.changed else warnings.catch_warnings():
        assert run.table.all.equals(whole.iloc[:64])
    assert re.search(told, run.summary())
    assert run.replay(3).rho
    with pytest.raises(ValueError, match=rf"the run of 'ramp' cannot go on: .*{told}"):
        vj.resume(folder, problem, budget=160)
    # The rows are still there.
    assert len(vj.load(folder).table) == 64


def test_a_damaged_record_says_where_the_rows_are(kept, tmp_path):
    folder = shutil.copytree(kept, tmp_path / "run")
    record = json.loads((folder / RECORD).read_text())
    damaged = [{**record, "seed": value} for value in ("0", 1, None)]
    damaged += [{n: v for n, v in record.items() if n != name} for name in ("seed", "features")]
    for content in damaged:
        (folder / RECORD).write_text(json.dumps(content))
        with pytest.raises(ValueError, match=r"its content has changed since it was w.*; the rows"):
            vj.load(folder)
    for text in ("", "[" * 100_000, "[1]", "{", '{"lap": 1}'):
        (folder / RECORD).write_text(text)
        told = r"no run in .*run.json is damaged, or of another program: .*table.parquet, "
        with pytest.raises(ValueError, match=told):
            vj.load(folder)


def test_a_record_of_another_version_names_it(kept, tmp_path):
    folder = shutil.copytree(kept, tmp_path / "run")
    record = json.loads((folder / RECORD).read_text())
    (folder / RECORD).write_text(json.dumps(sealed({**record, "version": "9.0", "moon": 1})))
    told = r"run.json is of another version of verifai_jax, 9.0, .*: 'moon' is not .*; the rows are"
    with pytest.raises(ValueError, match=told):
        vj.load(folder)


@pytest.mark.parametrize("data", [{"options": {}}, {"name": [], "options": {}}, {"split": 3}])
def test_a_record_without_a_search_needs_one(problem, kept, tmp_path, data):
    folder = shutil.copytree(kept, tmp_path / "run")
    record = json.loads((folder / RECORD).read_text())
    (folder / RECORD).write_text(json.dumps(sealed({**record, "search_data": data})))
    with pytest.raises(
        ValueError, match=r"describes no search .*; give it: resume\(..., search=\)"
    ):
        vj.resume(folder, problem, budget=160)


def test_a_table_that_is_damaged_is_told_by_name(problem, kept, tmp_path):
    folder = shutil.copytree(kept, tmp_path / "run")
    table = folder / "table.parquet"
    content = table.read_bytes()
    for damage in (b"", content[:-100], b"nonsense" * 9):
        table.write_bytes(damage)
        with pytest.raises(ValueError, match=r"table.parquet is damaged: .+"):
            vj.load(folder)
    table.unlink()
    table.mkdir()
    with pytest.raises(ValueError, match=r"table.parquet is damaged: .*is a folder"):
        vj.load(folder)
    table.rmdir()
    with pytest.raises(FileNotFoundError, match="no error table in"):
        vj.load(folder)
    # Without any snapshot: a run that has ended had rows, or said that it had none.
    (folder / STATE).unlink()
    for garbage in (b"", b"garbage" * 50):
        (folder / TAIL).write_bytes(garbage)
        assert "rows.tail is damaged: it has no row" in vj.load(folder).summary()
        with pytest.raises(ValueError, match=r"cannot go on: .*rows.tail is damaged"):
            vj.resume(folder, problem, budget=160)


def test_a_kill_before_the_first_rows_is_resumed(problem, whole, tmp_path):
    run = vj.falsify(problem, "cross_entropy", 32, batch=16, folder=tmp_path)
    record = json.loads((tmp_path / RECORD).read_text())
    (tmp_path / RECORD).write_text(json.dumps(sealed({**record, "stopped": "running"})))
    (tmp_path / "table.parquet").unlink()
    (tmp_path / STATE).unlink()
    assert len(run.table) == 32
    assert vj.resume(tmp_path, problem, budget=160).table.all.equals(whole)


def test_a_kill_before_the_first_record_does_not_block_the_folder(problem, tmp_path):
    (tmp_path / f".{RECORD}.part").write_text("{")
    assert len(vj.falsify(problem, "uniform", 32, folder=tmp_path).table) == 32


def test_a_folder_has_one_writer(problem, whole, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    with write_lock(folder):
        for _ in range(2):
            with pytest.raises(FolderInUse, match=r"run' is being written by this process"):
                vj.falsify(problem, "uniform", 32, folder=folder)
    run = vj.falsify(problem, "cross_entropy", 64, batch=16, folder=folder)
    assert LOCK not in {path.name for path in folder.iterdir()}
    with write_lock(folder):
        # Reading needs no lock.
        assert len(vj.load(folder, problem).table) == 64
        for writes in (
            lambda: vj.resume(folder, problem, budget=160),
            lambda: vj.resume(run, budget=160),
            lambda: run.save(folder),
        ):
            with pytest.raises(FolderInUse, match="is being written by"):
                writes()
    # What a killed process leaves does not lock.
    (folder / LOCK).write_text("1 elsewhere")
    assert vj.resume(folder, problem, budget=160).table.all.equals(whole)
    with pytest.raises(FileNotFoundError, match=r"no run in .+: run.json is missing"):
        vj.resume(tmp_path / "none", problem)
    assert not (tmp_path / "none").exists()


KILLED = """
import sys
from pathlib import Path
import numpy as np
import verifai_jax as vj
from tests.falsification.test_survives import slow_problem

if __name__ == "__main__":
    folder = Path(sys.argv[2])
    if (folder / "run.json").exists():
        vj.resume(folder, slow_problem(sys.argv[1]))
    else:
        vj.falsify(
            slow_problem(sys.argv[1]), "cross_entropy", int(sys.argv[3]), batch=16, folder=folder
        )
"""


def simulate_slowly(features):
    time.sleep(0.0005)
    return vj.Trace({"x": (features["a"] + 0.1 * features["b"]) * np.linspace(0, 1, 5)}, dt=0.25)


def slow_problem(kind):
    system = ramp if kind == "traced" else vj.blackbox(simulate_slowly)
    return vj.Problem("ramp", SPACE, system, "always x <= 0.9")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "kills"), [("traced", 4), ("blackbox", 2)])
def test_killed_at_random_moments_and_resumed_the_table_is_the_same(kind, kills, tmp_path):
    script, folder = tmp_path / "killed.py", tmp_path / "run"
    script.write_text(KILLED)
    root = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": root, "VERIFAI_JAX_CACHE": str(tmp_path / "cache")}
    # More than any machine can do meanwhile: every one of the processes is killed.
    command = [sys.executable, str(script), kind, str(folder), str(100_000_000)]
    moments = random.Random(0)
    cut_off, killed = 0, 0
    # Some die while they import, the later ones of a slow machine in the middle of their rounds.
    while killed < kills or (cut_off <= 1000 and killed < kills + 10):
        most = 6.0 if killed < kills else 20.0
        child = subprocess.Popen(command, env=environment, cwd=root)
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(timeout=moments.uniform(1.0, most))
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
        killed += 1
        if (folder / RECORD).exists():
            cut_off = len(vj.load(folder).table)
    assert cut_off > 1000
    budget = 16 * (cut_off // 16 + 50)
    table = vj.resume(folder, slow_problem(kind), budget=budget).table.all
    whole = vj.falsify(slow_problem("traced"), "cross_entropy", budget, batch=16).table.all
    assert list(table.index) == list(range(budget))
    np.testing.assert_allclose(table["rho"], whole["rho"], atol=0 if kind == "traced" else 1e-6)
    assert table["a"].equals(whole["a"])
