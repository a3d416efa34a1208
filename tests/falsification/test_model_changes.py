"""Runs whose model changes: what goes on, what is refused, and rows that give other numbers."""

import json
import sys
from dataclasses import replace
from importlib.machinery import EXTENSION_SUFFIXES

import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.store.files import sealed
from verifai_jax.core.user_code.targets import load_target

SPEC = """
import numpy as np
import verifai_jax as vj

STEEP = 1.0

def simulate(features):
    return vj.Trace({"x": np.full(3, STEEP * features["a"] + features["b"])}, dt=0.1)

slope = vj.Problem("slope", {"a": vj.Box(0.0, 1.0), "b": vj.Box(0.0, 1.0)},
                   vj.blackbox(simulate), "always x < 1.2", nominal={"a": 0.0, "b": 0.0})
"""
STEEPER = SPEC.replace("STEEP = 1.0", "STEEP = 1.5")
COUNTING = """
from pathlib import Path
import numpy as np
import verifai_jax as vj

calls = []
COUNTER = Path(__file__).parent / "counter.txt"

def with_memory(features):
    calls.append(1)
    return vj.Trace({"x": np.full(3, features["a"] + 0.1 * len(calls))}, dt=0.1)

def with_counter(features):
    count = int(COUNTER.read_text()) + 1 if COUNTER.exists() else 1
    COUNTER.write_text(str(count))
    return vj.Trace({"x": np.full(3, features["a"] + 0.1 * count)}, dt=0.1)

def with_table(features):
    gain = float((Path(__file__).parent / ("ga" "in" + ".txt")).read_text())
    return vj.Trace({"x": np.full(3, gain * features["a"])}, dt=0.1)

space = {"a": vj.Box(0.0, 1.0)}
memory = vj.Problem("memory", space, vj.blackbox(with_memory), "always x < 0.5")
counter = vj.Problem("counter", space, vj.blackbox(with_counter), "always x < 0.5")

def table():
    return vj.Problem("table", space, vj.blackbox(with_table, files=["gain.txt"]), "always x < 0.5")
"""


@pytest.fixture(autouse=True)
def project(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.py").write_text(SPEC)
    (tmp_path / "counting.py").write_text(COUNTING)
    yield tmp_path
    sys.path[:] = [path for path in sys.path if path != str(tmp_path)]


def slope(text=None):
    if text is not None:
        with open("spec.py", "w") as file:
            file.write(text)
    return load_target("spec.py:slope", vj.Problem)


def falsified(problem, budget=8, **options):
    options = {"batch": 4, "confirm": False, "progress": False, **options}
    return vj.falsify(problem, "uniform", budget, **options)


@pytest.fixture
def folder(tmp_path):
    falsified(slope(), folder=tmp_path / "run")
    return tmp_path / "run"


def test_a_run_records_what_its_model_is_made_of(folder):
    run = vj.load(folder, slope())
    (part,) = run.sources
    assert [file[:2] for file in part["files"]] == [["spec.py", "the problem"]]
    assert part["versions"]["verifai_jax"] == run.version
    assert run.changes() == ()
    assert run.changed_since() == ""


def test_another_model_is_not_gone_on_with(folder):
    steeper = slope(STEEPER)
    with pytest.raises(ValueError, match=r"its model has changed since it ran: spec\.py") as error:
        vj.resume(folder, steeper, budget=12, progress=False)
    assert "--even-if-changed" in str(error.value)
    assert len(vj.load(folder).table) == 8
    (change,) = vj.load(folder).changes()
    assert change.was[:12] in str(error.value)
    assert change.now[:12] in str(error.value)


@pytest.mark.thorough
def test_it_is_gone_on_with_where_that_is_meant(folder):
    steeper = slope(STEEPER)
    run = vj.resume(folder, steeper, budget=12, progress=False, even_if_changed=True)
    assert len(run.table) == 12
    assert run.prior
    assert run.failure_rate is None
    assert "they are of several models" in run.summary().splitlines()[0]
    loaded = vj.load(folder, steeper)
    assert [part["first"] for part in loaded.sources] == [0, 8]
    assert any(note.startswith("from row 8 on with another model: spec.py") for note in run.notes)
    # Each row knows its own model, and the second one is that of now.
    assert "has changed since row 3" in loaded.replay(3).changed
    assert loaded.replay(9).warnings == ()
    again = vj.resume(folder, steeper, budget=16, progress=False)
    assert [part["first"] for part in again.sources] == [0, 8]
    assert any(note.startswith("from row 8 on") for note in again.notes)


def test_other_versions_are_noted(folder):
    run = vj.load(folder, slope())
    older = json.loads(json.dumps(run.sources[0]))
    older["versions"]["jax"] = "0.0.1"
    again = vj.resume(replace(run, sources=(older,), folder=None), budget=12, progress=False)
    (note,) = [note for note in again.notes if note.startswith("from row 8")]
    assert note.startswith("from row 8 on with other versions: jax 0.0.1 then, ")
    assert not again.has_several_models
    assert again.failure_rate is not None


@pytest.mark.thorough
def test_a_run_that_recorded_no_model_says_so(folder):
    record = json.loads((folder / "run.json").read_text())
    record["sources"] = []
    record.pop("checksum", None)
    (folder / "run.json").write_text(json.dumps(sealed(record)))
    steeper = slope(STEEPER)
    run = vj.load(folder, steeper)
    assert not run.sources
    assert run.changes() == ()
    assert "were not recorded" in run.replay(0).finding
    assert not vj.resume(folder, steeper, budget=12, progress=False).sources


def test_a_damaged_record_of_it_is_refused(folder):
    record = json.loads((folder / "run.json").read_text())
    record["sources"] = [{"files": 3}]
    (folder / "run.json").write_text(json.dumps(sealed(record)))
    with pytest.raises(ValueError, match="the files of a model has another form"):
        vj.load(folder)


@pytest.mark.thorough
def test_a_replay_that_gives_the_row_its_number_says_nothing(folder):
    run = vj.load(folder, slope())
    for row in (0, 5, run.table.all.iloc[3]):
        for precision in (None, "float64"):
            assert run.replay(row, precision).warnings == ()
    # Other features are another simulation.
    other = run.table.all.iloc[3].copy()
    other["a"] = 0.9
    assert run.replay(other).finding == ""


@pytest.mark.thorough
@pytest.mark.parametrize("precision", [None, "float64"])
def test_a_replay_of_another_model_says_so_at_once(folder, precision):
    run = vj.load(folder, slope(STEEPER))
    row = int(np.argmax(run.table.all["a"]))
    lines = str(run.replay(row, precision)).splitlines()
    assert lines[0].startswith(f"The model has changed since row {row} was simulated: spec.py")
    assert lines[1].startswith(f"Row {row} does not give its number again: robustness ")


def test_a_system_with_memory_is_found_out():
    run = falsified(load_target("counting.py:memory", vj.Problem))
    seen = run.replay(2)
    assert seen.changed == ""
    assert "no file of its model has changed: the system has memory" in seen.finding
    assert str(seen).startswith("Row 2 does not give its number again")


def test_a_simulation_that_ends_otherwise_is_a_finding(folder):
    failing = STEEPER.replace("    return", "    raise RuntimeError('no road')\n    return")
    run = vj.load(folder, slope(STEEPER.replace("STEEP * ", "float('nan') * ")))
    assert "does not end as it did: nonfinite here, ok in the table" in run.replay(0).finding
    assert failing != STEEPER


@pytest.mark.thorough
def test_state_in_a_file_is_no_part_of_the_model_and_declared_data_are(project):
    (project / "counter.txt").write_text("0")
    (project / "gain.txt").write_text("1.0")
    run = falsified(load_target("counting.py:counter", vj.Problem))
    assert not [file for file in run.sources[0]["files"] if file[0] == "counter.txt"]
    assert vj.resume(run, budget=12, progress=False).simulations == 12
    assert "state of its own" in run.replay(0).finding
    counting = sys.modules["_target_counting"]
    run = falsified(counting.table(), folder=project / "table")
    assert ["gain.txt", "declared"] in [file[:2] for file in run.sources[0]["files"]]
    (project / "gain.txt").write_text("2.0")
    changed = counting.table()
    assert [c.name for c in vj.load(project / "table", changed).changes()] == ["gain.txt"]
    with pytest.raises(ValueError, match=r"gain\.txt"):
        vj.resume(project / "table", changed, budget=12, progress=False)


def test_a_run_without_a_folder_asks_for_its_model_when_somebody_does(monkeypatch):
    asked = []
    sources = vj.Problem.sources
    monkeypatch.setattr(
        vj.Problem, "sources", lambda self, first=0: asked.append(1) or sources(self, first)
    )
    with unchecked():  # The annotations are checked by looking at a part.
        run = falsified(slope(), confirm=True)
        assert str(run)
    assert not asked
    assert [file[0] for file in run.sources[0]["files"]] == ["spec.py"]
    assert asked
    assert list(vj.load(run.save("saved")).sources) == list(run.sources)


@pytest.mark.slow
def test_studies_of_a_row_begin_with_it(folder):
    run = vj.load(folder, slope(STEEPER))
    assert len(run.table.counterexamples)
    begin = "The model has changed since "
    for found in (
        vj.explain(run),
        vj.shrink(run, budget=40),
        vj.confirm(run),
        vj.confirm(run, int(run.best.name)),
    ):
        lines = str(found).splitlines()
        assert lines[0].startswith(begin)
        assert lines[1].startswith("Row ")
    run = vj.load(folder, slope(SPEC))
    for found in (vj.explain(run), vj.shrink(run, budget=40), vj.confirm(run)):
        assert begin not in str(found)
        assert "its number again" not in str(found)


@pytest.mark.thorough
@pytest.mark.addons
def test_a_saved_counterexample_knows_its_model(folder, tmp_path):
    run = vj.load(folder, slope())
    (path, *_) = run.save_counterexamples(tmp_path / "corpus", shrink=False)
    saved = json.loads(path.read_text())["found"]["sources"]
    assert [file[0] for file in saved["files"]] == ["spec.py"]
    assert saved["root"] == ""
    same = vj.replay_counterexamples(slope(), tmp_path / "corpus")
    assert "has changed" not in str(same)
    other = vj.replay_counterexamples(slope(STEEPER), tmp_path / "corpus")
    assert f"the model has changed since {len(other.replayed)} of them were saved" in str(other)


@pytest.mark.addons
def test_a_counterexample_that_gives_another_number_of_itself(tmp_path):
    problem = load_target("counting.py:memory", vj.Problem)
    run = falsified(problem)
    run.save_counterexamples(tmp_path / "corpus", shrink=False, max_count=1)
    (one,) = vj.replay_counterexamples(problem, tmp_path / "corpus").replayed
    assert not one.changed
    assert "it does not give its number again, though no file of its model has changed" in one.note


LATE = """
import numpy as np
import verifai_jax as vj

def simulate(features):
    from late_gain import GAIN
    return vj.Trace({"x": np.full(3, GAIN * features["a"])}, dt=0.1)

late = vj.Problem("late", {"a": vj.Box(0.0, 1.0)}, vj.blackbox(simulate), "always x < 3")
"""


def test_what_is_imported_while_it_runs_is_part_of_the_model(project, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (project / "late.py").write_text(LATE)
    (project / "late_gain.py").write_text("GAIN = 1.0\n")
    run = falsified(load_target("late.py:late", vj.Problem), folder=project / "run")
    assert "late_gain.py" in [file[0] for file in run.sources[0]["files"]]
    sys.modules.pop("late_gain", None)
    (project / "late_gain.py").write_text("GAIN = 2.0\n")
    again = vj.load(project / "run", load_target("late.py:late", vj.Problem))
    assert [change.name for change in again.changes()] == ["late_gain.py"]
    sys.modules.pop("late_gain", None)


@pytest.mark.thorough
def test_a_compiled_module_is_part_of_the_model(project):
    (project / f"plant{EXTENSION_SUFFIXES[0]}").write_bytes(b"\0as built\0")
    problem = slope("try:\n    import plant\nexcept ImportError:\n    pass\n" + SPEC)
    assert f"plant{EXTENSION_SUFFIXES[0]}" in [name for name, *_ in problem.sources().files]
