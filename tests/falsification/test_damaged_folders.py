"""Folders of runs with anything in them changed: the right table, or an error that names it."""

import json
import random
import shutil
import warnings

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.cli.json_output import describe_run
from verifai_jax.core.store.locks import LOCK
from verifai_jax.core.store.log import Log
from verifai_jax.falsification import segments
from verifai_jax.falsification.loop import Rounds
from verifai_jax.falsification.run_folder import RECORD, STATE
from verifai_jax.falsification.segments import TAIL
from verifai_jax.falsification.table import FINISHED, ErrorTable

SPACE = {"a": vj.Box(0, 1), "b": vj.Box(-1, 1)}
OPTIONS = {"search": "cross_entropy", "batch": 16, "confirm": False}


def ramp(features, key):
    return vj.Trace({"x": (features["a"] + 0.1 * features["b"]) * jnp.linspace(0, 1, 5)}, dt=0.25)


@pytest.fixture(scope="module")
def problem():
    return vj.Problem("ramp", SPACE, ramp, "always x <= 0.9")


@pytest.fixture(scope="module")
def whole(problem):
    return vj.falsify(problem, budget=160, **OPTIONS).table.all


class Killed(BaseException):
    """The process is no more."""


@pytest.fixture(scope="module")
def folders(problem, tmp_path_factory):
    """A run that ended, a long one that did, one that was cut off, and one of another seed."""
    place = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        vj.falsify(problem, budget=96, folder=place / "short", **OPTIONS)
        vj.falsify(problem, budget=96, folder=place / "other", seed=1, **OPTIONS)
        patch.setattr(segments, "SEGMENT_ROWS", 40)
        vj.falsify(problem, budget=96, folder=place / "long", **OPTIONS)
        killed_after(patch, 5, problem, place / "cut off")
    return place


def killed_after(patch, rounds, problem, folder):
    """Begin a run that dies in its next round, with a checkpoint of each before."""
    save, advance, left = Rounds.save, Rounds.advance, [rounds]

    def next_round(self, most, *limit):
        if not left[0]:
            raise Killed
        left[0] -= 1
        advance(self, most, *limit)

    patch.setattr(Rounds, "advance", next_round)
    patch.setattr(Rounds, "save", lambda self, seldom=False: save(self))
    with pytest.raises(Killed):
        vj.falsify(problem, budget=160, folder=folder, **OPTIONS)
    patch.setattr(Rounds, "advance", advance)
    patch.setattr(Rounds, "save", save)


def change_bytes(path, chance):
    content = bytearray(path.read_bytes())
    at, how = chance.randrange(len(content) + 1), chance.randrange(4)
    if how == 0 and at < len(content):
        content[at] ^= 1 << chance.randrange(8)
    elif how == 1:
        content[at:at] = chance.randbytes(chance.randrange(1, 9))
    elif how == 2:
        del content[at : at + chance.randrange(1, 40)]
    else:
        del content[at:]
    path.write_bytes(content)


def change_entries(path, chance):
    """Change an entry of the record, or a number of a table, in form or in content."""
    if path.name == RECORD:
        record = json.loads(path.read_text())
        name = chance.choice(sorted(record))
        value = [None, -1, 7, 0.5, "x", [], {}, [[["deep"]]], True, 10**30]
        record[name] = chance.choice(value)
        path.write_text(json.dumps(record))
    elif path.suffix == ".parquet":
        frame = pd.read_parquet(path)
        frame.iloc[chance.randrange(len(frame)), chance.randrange(3)] = 0.25
        frame.to_parquet(path)
    else:
        change_bytes(path, chance)


def change(folder, other, chance):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    path = chance.choice(files)
    how = chance.randrange(6)
    if how == 0:
        path.unlink()
    elif how == 1:
        path.unlink()
        path.mkdir()
    elif how == 2 and (other / path.name).exists():
        shutil.copy(other / path.name, path)
    elif how == 3:
        change_entries(path, chance)
    else:
        change_bytes(path, chance)


def all_rows(table):
    """Return the rows of a table, which warns where it is damaged."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rows = table.all
    told = [str(each.message) for each in caught]
    assert told == ([f"the error table is damaged: {table.damage}"] if table.damage else [])
    return rows


def check(folder, problem, whole):
    """Load and resume a folder: the right rows, or an error in words."""
    try:
        run = vj.load(folder, problem)
    except (ValueError, OSError):  # All others are obscure.
        return
    rows = all_rows(run.table)
    right = whole.reindex(rows.index)
    if not run.damage:
        assert rows.equals(right)
        assert run.table.violating.equals(right.loc[right["violated"]])
    else:
        assert f"  damaged      {run.damage[:20]}" in run.summary()
    try:
        resumed = vj.resume(folder, problem, budget=160)
    except (ValueError, OSError):
        # Whatever was whole is still there.
        assert all_rows(vj.load(folder, problem).table).equals(rows)
        return
    assert not run.damage
    assert resumed.table.all.equals(whole)


@pytest.mark.slow
@pytest.mark.parametrize("turns", [12, pytest.param(250, marks=pytest.mark.thorough)])
def test_anything_changed_in_a_folder_is_right_or_told(
    problem, whole, folders, tmp_path, monkeypatch, turns
):
    for turn in range(turns):
        chance = random.Random(turn)
        kind = chance.choice(["short", "long", "cut off"])
        monkeypatch.setattr(segments, "SEGMENT_ROWS", 1 << 20 if kind == "short" else 40)
        folder = shutil.copytree(folders / kind, tmp_path / str(turn))
        for _ in range(chance.randrange(1, 3)):
            change(folder, folders / "other", chance)
        check(folder, problem, whole)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["short", "long", "cut off"])
def test_a_folder_that_is_whole_is_resumed(problem, whole, folders, tmp_path, monkeypatch, kind):
    monkeypatch.setattr(segments, "SEGMENT_ROWS", 1 << 20 if kind == "short" else 40)
    folder = shutil.copytree(folders / kind, tmp_path / kind)
    run = vj.load(folder, problem)
    assert not run.damage
    assert run.table.all.equals(whole.iloc[: len(run.table)])
    assert vj.resume(folder, problem, budget=160).table.all.equals(whole)
    assert vj.load(folder).table.all.equals(whole)


@pytest.mark.thorough
@pytest.mark.addons
def test_rows_that_are_not_those_of_the_checkpoint_are_told(problem, folders, tmp_path):
    folder = shutil.copytree(folders / "short", tmp_path / "run")
    frame = pd.read_parquet(folder / FINISHED)
    frame.loc[40, "a"] = np.float32(0.125)
    frame.to_parquet(folder / FINISHED)
    run = vj.load(folder, problem)
    told = "the first 96 rows of the table .* are not those that its search had seen"
    assert run.table.row(40)["a"] == 0.125
    with pytest.raises(ValueError, match=f"cannot go on: {told}.*begin anew, from what it has"):
        vj.resume(folder, problem, budget=160)
    assert run.failure_rate is None
    said = run.summary()
    assert said.startswith("ramp: its rows have changed since they were written, so they say noth")
    assert "violate" not in said
    # No count that the rows do not support is elsewhere either.
    for shown in (repr(run.table), run._repr_html_(), run.table._repr_html_()):
        assert "say nothing" in shown
        assert "counterexamples" not in shown
        assert "<td>" not in shown
    found = describe_run(run)
    names = ("violating", "counterexamples", "verdicts", "without_verdict", "failure_rate", "worst")
    assert {found[name] for name in names} == {None}
    with pytest.raises(ValueError, match=f"rows that have changed say nothing: {told}"):
        vj.analysis.coverage(run)
    with pytest.raises(ValueError, match=f"no report .* run of 'ramp', .* evidence: {told}"):
        run.report(tmp_path / "report.html")
    with pytest.warns(UserWarning, match=f"the error table is damaged: {told}"):
        again = vj.falsify(problem, vj.Start("cross_entropy", run=run), 32, batch=16)
    assert len(again.table) == 32
    # The checkpoint of another run, and the record of another one.
    shutil.copy(folders / "short" / FINISHED, folder / FINISHED)
    assert not vj.load(folder, problem).damage
    shutil.copy(folders / "other" / STATE, folder / STATE)
    with pytest.raises(ValueError, match=r"run.json is not the one that search.state was written"):
        vj.resume(folder, problem, budget=160)


@pytest.mark.parametrize(
    ("column", "values", "told"),
    [
        ("violated", None, "its column 'violated' must hold truth values; it holds values of type"),
        ("rho", "low", "its column 'rho' must hold floating-point numbers; it holds"),
        ("status", "fine", "its column 'status' must hold ok, nonfinite, .*; it holds 'fine'"),
        ("rho", np.float32("nan"), "its column 'rho' lacks the robustness of a row that ended"),
        ("violated", False, "its columns 'violated' and 'rho' contradict each other"),
        ("a", "left", "its column 'a' must hold numbers; it holds"),
    ],
)
def test_a_column_that_holds_what_it_cannot_is_named(
    problem, folders, tmp_path, column, values, told
):
    folder = shutil.copytree(folders / "short", tmp_path / "run")
    frame = pd.read_parquet(folder / FINISHED)
    assert frame["violated"].any()
    frame[column] = pd.Series([values] * len(frame), index=frame.index)
    if isinstance(values, np.floating):
        frame[column] = frame[column].astype(np.float32)
    frame.to_parquet(folder / FINISHED)
    with pytest.raises(ValueError, match=f"the table in .*run is damaged: {told}"):
        vj.load(folder, problem)


def test_a_run_is_not_written_over_what_somebody_has_added(problem, whole, folders, tmp_path):
    folder = shutil.copytree(folders / "short", tmp_path / "run")
    run = vj.load(folder, problem)
    vj.resume(folder, problem, budget=160)
    told = "the run in .*run has been continued: it has 160 simulations now, this one 96"
    with pytest.raises(ValueError, match=f"{told}; load it, .* or save this one elsewhere"):
        vj.resume(run, budget=128)
    with pytest.raises(ValueError, match=told):
        run.save(folder)
    assert vj.load(folder).table.all.equals(whole)
    # Elsewhere it is written, and goes on there.
    assert vj.resume(run.save(tmp_path / "copy"), problem, budget=160).table.all.equals(whole)
    shutil.rmtree(folder)
    shutil.copytree(folders / "other", folder)
    with pytest.raises(ValueError, match=r"now holds another run, of 'ramp'; load it"):
        vj.resume(run, budget=128)
    shutil.rmtree(folder)
    assert vj.resume(run, budget=160).table.all.equals(whole)


@pytest.mark.slow
def test_a_run_that_dies_between_any_two_operations_on_files_is_resumed(
    problem, whole, tmp_path, monkeypatch
):
    monkeypatch.setattr(segments, "SEGMENT_ROWS", 40)
    save = Rounds.save
    monkeypatch.setattr(Rounds, "save", lambda self, seldom=False: save(self))
    step, finished = 0, False
    while not finished:
        folder, done = tmp_path / str(step), []
        with monkeypatch.context() as patch:
            for owner, name in ((type(folder), "replace"), (type(folder), "unlink"),
                                (Log, "put")):  # fmt: skip
                patch.setattr(owner, name, counted(getattr(owner, name), done, step))
            try:
                vj.falsify(problem, budget=160, folder=folder, **OPTIONS)
                finished = True
            except Killed:
                pass
        step += 1
        if finished or not (folder / RECORD).exists():
            continue
        run = vj.load(folder, problem)
        assert not run.damage
        if run.stopped == "running" and len(run.table) < 160:
            assert vj.resume(run).table.all.equals(whole)
        assert ErrorTable.load(folder, ("a", "b")).all.equals(whole)
        assert not (folder / TAIL).exists() or run.stopped == "running"
    assert step > 30


def counted(call, done, step):
    def operation(owner, *args, **options):
        if getattr(owner, "name", "") == LOCK:  # It goes with the process.
            return call(owner, *args, **options)
        done.append(owner)
        if len(done) == step + 1:
            raise Killed
        return call(owner, *args, **options)

    return operation
