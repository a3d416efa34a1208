"""Files that replace others are whole, or those before them stay."""

import contextlib
import errno
import resource

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.rl.policy import Policy, save_policy
from verifai_jax.core.store.atomic_files import append, replacing, unwritable
from verifai_jax.pictures.style import new_figure, show_or_save
from verifai_jax.systems.actions import Continuous


def test_a_file_is_replaced_once_it_is_whole(tmp_path):
    path = tmp_path / "deep" / "report.html"
    with replacing(path) as partial:
        assert partial.suffix == ".html"
        partial.write_text("first")
        assert not path.exists()

    def interrupted():
        with replacing(path) as partial:
            partial.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "first"
    assert list(path.parent.iterdir()) == [path]


def test_what_cannot_be_written_is_named_and_keeps_what_was_there(tmp_path, monkeypatch):
    layers = ((np.zeros((1, 1), np.float32), np.zeros(1, np.float32)),)
    policy = Policy(layers, None, None, None, Continuous(-1.0, 1.0))
    path, picture = tmp_path / "p.npz", tmp_path / "nofile" / "x.png"
    save_policy(policy, path)
    before = path.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(
        OSError, match=r"p.npz cannot be written \(No space left on device\); make room"
    ):
        save_policy(policy, path)
    assert path.read_bytes() == before
    (tmp_path / "nofile").write_text("")
    with pytest.raises(OSError, match=r"x.png cannot be written \("):
        show_or_save(new_figure(), picture)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["nofile", "p.npz"]


@contextlib.contextmanager
def full(size):
    """Let no file become longer than this, as if its disk was full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def files_of(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "make room on its disk"),
        (errno.EROFS, "on a disk that may be written"),
        (errno.EACCES, "that you may write"),
        (errno.ENOENT, "its folder is gone"),
        (errno.EIO, "give another path"),
    ],
)
def test_each_reason_has_its_remedy(number, remedy):
    error = unwritable("run", OSError(number, "reason"), "The rows are in memory")
    assert (error.errno, type(error)) == (number, type(OSError(number, "")))
    assert str(error).startswith("run cannot be written (")
    assert remedy in str(error)
    assert str(error).endswith(". The rows are in memory")
    # An error that is told once more, for the folder, keeps the reason.
    assert str(unwritable("folder", error)).count("cannot be written") == 1


def test_what_is_appended_is_there_whole_or_not_at_all(tmp_path):
    file = tmp_path / "deep" / "progress.csv"
    append(file, b"first\n")
    with full(8), pytest.raises(OSError, match=r"progress.csv cannot be written \("):
        append(file, b"second, which is longer\n")
    assert file.read_bytes() == b"first\n"


@pytest.fixture(scope="module")
def runs():
    def ramp(features, key):
        return vj.Trace({"x": features["a"] * jnp.linspace(0, 1, 5)}, dt=0.25)

    problem = vj.Problem("ramp", {"a": vj.Box(0, 1)}, ramp, "always x <= 0.9")
    small = vj.falsify(problem, "uniform", 20, progress=False)
    return small, vj.falsify(problem, "uniform", 2000, batch=500, progress=False)


@pytest.mark.thorough
def test_a_run_that_has_no_room_leaves_the_one_that_was_there(runs, tmp_path):
    small, big = runs
    small.save(tmp_path / "run")
    before = files_of(tmp_path)
    message = r"run cannot be written \(.*The results are still in memory"
    with full(20_000), pytest.raises(OSError, match=message):
        big.save(tmp_path / "run")
    assert files_of(tmp_path) == before
    assert vj.load(tmp_path / "run", small.problem).table.all.equals(small.table.all)
    with full(20_000), pytest.raises(OSError, match="elsewhere cannot be written"):
        big.save(tmp_path / "elsewhere")
    assert files_of(tmp_path) == before
    # Nothing was lost: it can be saved once there is room, in place of the other as well.
    big.save(tmp_path / "run")
    assert vj.load(tmp_path / "run", small.problem).table.all.equals(big.table.all)
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == sorted(
        {name.split("/")[1] for name in before}
    )


@pytest.mark.addons
@pytest.mark.slow
@pytest.mark.parametrize("what", ["picture", "report", "analysis", "counterexample"])
def test_results_that_have_no_room_leave_nothing_of_a_file(runs, tmp_path, what):
    small, _ = runs
    write = {
        "picture": lambda into: small.plot(into / "features.png"),
        "report": lambda into: small.report(into / "report.html"),
        "analysis": lambda into: small.analyze().save(into / "analysis"),
        "counterexample": lambda into: small.save_counterexamples(into / "corpus", max_count=1),
    }[what]
    write(tmp_path / "whole")  # What JAX compiles and keeps on disk is whole, then.
    assert files_of(tmp_path / "whole")
    with full(100), pytest.raises(OSError, match=r"cannot be written \(File too large\)"):
        write(tmp_path / "full")
    assert files_of(tmp_path / "full") == {}
