"""Whatever instant a process dies at, the old files are whole, or the new ones."""

import os
import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from killed import killed_everywhere

import verifai_jax as vj
from verifai_jax.core.store import replacements
from verifai_jax.core.store.atomic_files import held, replacing
from verifai_jax.core.store.cache import Cache
from verifai_jax.core.store.files import read_record, write_record
from verifai_jax.core.store.locks import LOCK, settled, write_lock
from verifai_jax.core.store.log import Log, write_log
from verifai_jax.core.store.replacements import WHOLE, replacing_all

NAMES = ("a", "b", "deep", "only old", "only new")


def contents(folder):
    """Return the texts of the files but for those of writers that were killed."""
    files = (p for p in folder.rglob("*") if p.is_file() and p.name != LOCK)
    named = {str(p.relative_to(folder)): p.read_text() for p in files}
    return {name: text for name, text in named.items() if not name.startswith(".part-")}


def write(folder, text):
    with write_lock(folder), replacing_all(folder, NAMES) as made:
        for name in ("a", "b", f"only {text}"):
            (made / name).write_text(text)
        (made / "deep").mkdir()
        (made / "deep" / text).write_text(text)


def leftovers(folder):
    return [p.name for p in folder.rglob("*") if p.name.startswith(".") or ".part" in p.name]


@pytest.mark.slow
def test_files_that_belong_together_are_replaced_together(tmp_path):
    folder, user = tmp_path / "link", tmp_path / "real"
    user.mkdir()
    folder.symlink_to(user)
    own = {"notes.txt": "mine", "mine/more": "mine"}
    (folder / "mine").mkdir()
    for name, text in own.items():
        (folder / name).write_text(text)
    write(folder, "old")
    old = contents(folder)
    write(folder, "new")
    new = contents(folder)
    assert set(own.items()) == set(old.items()) & set(new.items())
    seen = []

    def check():
        seen.append(contents(settled(folder)))
        assert not (folder / WHOLE).exists()
        assert seen[-1] in (old, new)
        write(folder, "old")
        assert contents(folder) == old
        assert not leftovers(user)

    write(folder, "old")
    assert killed_everywhere(lambda: write(folder, "new"), check) > 15
    assert seen.index(new) == len(seen) - seen.count(new)  # It was decided once.
    assert seen.count(old) > 3
    assert seen.count(new) > 3
    assert folder.is_symlink()


@pytest.mark.slow
def test_a_reader_who_is_killed_loses_nothing_either(tmp_path):
    folder, whole = tmp_path / "it", tmp_path / "cut"
    write(folder, "new")
    new = contents(folder)
    write(folder, "old")
    recover, replacements.recover = replacements.recover, lambda folder: None
    try:
        with replacing_all(folder, NAMES) as made:
            for name in new:
                (made / name).parent.mkdir(exist_ok=True)
                (made / name).write_text("new")
    finally:
        replacements.recover = recover
    shutil.copytree(folder, whole)

    def check():
        assert contents(settled(folder)) == new
        shutil.rmtree(folder)
        shutil.copytree(whole, folder)

    assert killed_everywhere(lambda: settled(folder), check) > 5


def test_what_a_stranger_says_is_gone_is_in_the_folder(tmp_path):
    whole = tmp_path / "it" / WHOLE
    whole.mkdir(parents=True)
    (tmp_path / "other").write_text("kept")
    (whole.parent / "own").write_text("gone")
    (whole / ".gone").write_text("\n".join(["..", "", ".", "../other", str(tmp_path), "own"]))
    settled(tmp_path / "it")
    assert contents(tmp_path) == {"other": "kept"}
    assert (tmp_path / "it").is_dir()
    (tmp_path / "it" / WHOLE).symlink_to(tmp_path)
    settled(tmp_path / "it")
    assert contents(tmp_path) == {"other": "kept"}


def test_a_mount_point_is_refused_by_name(tmp_path, monkeypatch):
    write(tmp_path, "old")
    monkeypatch.setattr(os.path, "ismount", lambda path: path.name == "deep")
    with pytest.raises(ValueError, match="deep is a mount point, which cannot be replaced"):
        write(tmp_path, "new")
    assert contents(tmp_path)["a"] == "old"


def test_parts_of_the_dead_are_removed_and_those_of_the_living_are_not(tmp_path):
    path = tmp_path / "it.txt"

    def write_it(text):
        with replacing(path) as partial:
            partial.write_text(text)

    write_it("old")

    def check():
        assert path.read_text() in ("old", "new")
        write_it("old")
        assert os.listdir(tmp_path) == ["it.txt"]

    assert killed_everywhere(lambda: write_it("new"), check) >= 3
    living, dead = tmp_path / ".it.1-2.part.txt", tmp_path / ".it.1-3.part.txt"
    dead.touch()
    with held(living):
        write_it("new")
        assert sorted(os.listdir(tmp_path)) == [living.name, path.name]
    write_it("newer")
    assert os.listdir(tmp_path) == ["it.txt"]


def put(folder, text):
    with write_lock(folder):
        Cache(folder).note("it", text)


def write_arrays(folder, text):
    write_log(folder / "log", {"t": {text: np.zeros(3)}})


KINDS = {
    "record": (
        lambda folder, text: write_record(folder / "r.json", {"t": text}, locked=False),
        lambda folder: read_record(folder / "r.json"),
    ),
    "log": (write_arrays, lambda folder: list(Log(folder / "log").get("t"))),
    "cache": (put, lambda folder: Cache(folder).note("it")),
}


@pytest.mark.thorough
@pytest.mark.parametrize(("save", "read"), KINDS.values(), ids=list(KINDS))
def test_each_kind_of_file_is_old_or_new(tmp_path, save, read):
    save(tmp_path, "old")
    old = read(tmp_path)
    save(tmp_path, "new")
    new = read(tmp_path)
    names = sorted(os.listdir(tmp_path))

    def check():
        assert read(tmp_path) in (old, new)
        save(tmp_path, "old")
        assert sorted(os.listdir(tmp_path)) == names

    save(tmp_path, "old")
    assert killed_everywhere(lambda: save(tmp_path, "new"), check) >= 1


@pytest.fixture(scope="module")
def runs():
    def ramp(features, key):
        return vj.Trace({"x": features["a"] * jnp.linspace(0, 1, 5)}, dt=0.25)

    problem = vj.Problem("ramp", {"a": vj.Box(0, 1)}, ramp, "always x <= 0.9")
    few = vj.falsify(problem, "uniform", 20, seed=1, progress=False)
    return problem, few, vj.falsify(problem, "cross_entropy", 64, batch=16, progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["another", "own"])
def test_a_saved_run_is_old_or_new(runs, tmp_path, what):
    problem, one, other = runs
    folder = tmp_path / "run"
    one.save(folder)
    if what == "own":
        other = one = vj.load(folder, problem)
    tables = [one.table.all, other.table.all]

    def check():
        run = vj.load(folder, problem)
        assert not run.damage
        assert any(run.table.all.equals(table) for table in tables)
        run.replay(3)
        one.save(folder)
        assert vj.load(folder, problem).table.all.equals(tables[0])
        assert not leftovers(folder)

    assert killed_everywhere(lambda: other.save(folder), check) > 5
