"""What a problem is made of: its files with their hashes, and which of them have changed."""

import hashlib
import json
import linecache
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.user_code.sources import Sources, list_changes
from verifai_jax.core.user_code.targets import load_target
from verifai_jax.core.user_code.user_files import file_hash, is_user_file

SPEC = """
from pathlib import Path
import numpy as np
import verifai_jax as vj
from plant import car
from plant.limits import LIMIT

def helper_of_results(values):
    np.savez("result.npz", values=values)
    open("log.txt", "w").write("done")

system = vj.blackbox(car.simulate, files=sorted((Path(__file__).parent / "data").iterdir()))
space = {"a": vj.Box(0.0, 1.0)}
drive = vj.Problem("drive", space, system, f"always x < {LIMIT}", nominal={"a": 0.1})
"""
CAR = """
import json
from pathlib import Path

import numpy as np
import verifai_jax as vj
from . import gains as _gains

FOLDER = Path(__file__).parent.parent / "data"
TABLE = np.loadtxt(FOLDER / "table.csv", delimiter=",")
SETTINGS = json.loads((FOLDER / f"settings{_gains.NUMBER}.json").read_text())

def simulate(features):
    from plant.late import factor
    return vj.Trace({"x": np.full(3, features["a"] * factor * TABLE[0])}, dt=0.1)
"""


@pytest.fixture
def project(tmp_path, monkeypatch):
    files = {
        "spec.py": SPEC,
        "plant/__init__.py": "",
        "plant/car.py": CAR,
        "plant/gains.py": "NUMBER = 7\n",
        "plant/limits.py": "LIMIT = 0.5\n",
        "plant/late.py": "factor = 1.0\n",
        "plant/unused.py": "",
        "data/table.csv": "1.0,2.0\n",
        "data/settings7.json": "{}",
        "result.npz": "of an earlier run",
        "log.txt": "of an earlier run",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    forget()


def forget():
    """Let the modules of the project be imported anew, as another process does."""
    for name in [name for name in sys.modules if name.partition(".")[0] in ("plant", "studio")]:
        del sys.modules[name]


def loaded(target="spec.py:drive"):
    forget()
    return load_target(target, vj.Problem)


def edit(file, text=None):
    file = Path(file)
    file.write_text(f"{file.read_text()}\n" if text is None else text)


def test_the_files_of_a_problem_are_the_users_alone(project):
    sources = loaded().sources()
    found = {file.name: file.role for file in sources.files}
    assert found == {
        "spec.py": "the problem",
        "plant/__init__.py": "imported",
        "plant/car.py": "imported",
        "plant/gains.py": "imported",
        "plant/limits.py": "imported",
        "plant/late.py": "imported",
        "data/table.csv": "declared",
        "data/settings7.json": "declared",
    }
    hashes = {file.name: file.sha256 for file in sources.files}
    assert hashes["spec.py"] == hashlib.sha256((project / "spec.py").read_bytes()).hexdigest()
    assert sources.versions["verifai_jax"] == vj.__version__
    assert {"Python", "jax", "jaxlib", "numpy"} <= set(sources.versions)


@pytest.mark.parametrize(
    "name",
    ["spec.py", "plant/car.py", "plant/gains.py", "plant/limits.py", "plant/late.py",
     "data/table.csv", "data/settings7.json"],
)  # fmt: skip
def test_an_edit_of_any_of_them_is_found(project, name):
    before = loaded().sources()
    assert before.changes(loaded().sources()) == ()
    edit(name)
    (change,) = before.changes(loaded().sources())
    assert (change.name, change.now) == (name, file_hash(project / name))
    assert list_changes([change]) == (
        f"{name} (SHA-256 {change.was[:12]} then, {change.now[:12]} now)"
    )
    # Without the problem, what lies on the disk counts.
    assert before.changes() == (change,)
    os.remove(name)
    assert before.changes()[0].now is None
    assert "missing now" in str(before.changes()[0])


def test_results_and_files_that_are_not_imported_have_no_part(project):
    before = loaded().sources()
    for name in ("result.npz", "log.txt", "plant/unused.py"):
        edit(name)
    assert before.changes(loaded().sources()) == ()


def test_packages_without_a_file_are_followed_though_they_are_not_imported(project):
    (project / "wide" / "deep").mkdir(parents=True)
    (project / "wide" / "deep" / "gain.py").write_text("GAIN = 1.0\n")
    text = SPEC.replace("system =", "def late():\n    import wide.deep.gain\n\nsystem =")
    edit("spec.py", text)
    before = loaded().sources()
    assert "wide/deep/gain.py" in {file.name for file in before.files}
    edit("wide/deep/gain.py")
    assert [change.name for change in before.changes(loaded().sources())] == ["wide/deep/gain.py"]


def test_a_module_is_what_it_was_imported_as(project):
    problem = loaded()
    before = problem.sources()
    edit("spec.py")
    edit("plant/car.py")
    assert before.changes(problem.sources()) == ()
    assert [c.name for c in before.changes(loaded().sources())] == ["spec.py", "plant/car.py"]


def test_a_copy_of_the_file_is_another_model(project):
    before = loaded().sources()
    edit("copy.py", SPEC.replace("LIMIT}", "LIMIT / 2}"))
    (change,) = before.changes(loaded("copy.py:drive").sources())
    assert str(change) == "copy.py makes it now, and had no part in it then"


def test_what_is_made_of_a_problem_is_made_where_that_was(project):
    problem = loaded()
    for other in (problem.only("a"), replace(problem, description="the same")):
        assert other.made_in == problem.made_in
        assert problem.sources().changes(other.sources()) == ()


def test_whoever_calls_what_makes_a_problem_may_be_another_one(project):
    (project / "studio.py").write_text(
        "import verifai_jax as vj\nfrom plant import car\n"
        "def make(limit):\n"
        "    return vj.Problem('drive', {'a': vj.Box(0.0, 1.0)}, vj.blackbox(car.simulate), "
        "f'always x < {limit}')\n"
    )
    for name in ("one.py", "two.py"):
        (project / name).write_text("from studio import make\ndrive = make(0.5)\n")
    one, two = loaded("one.py:drive").sources(), loaded("two.py:drive").sources()
    assert [f.name for f in one.files if f.role == "the problem"] == ["studio.py"]
    assert one.changes(two) == ()
    edit("one.py", "from studio import make\ndrive = make(0.7)\n")
    assert [c.name for c in one.changes(loaded("one.py:drive").sources())] == ["one.py"]


def test_files_are_found_from_another_folder_too(project, monkeypatch):
    before = loaded().sources()
    monkeypatch.chdir(project / "data")
    there = loaded("../spec.py:drive").sources()
    assert before.changes(there) == ()
    assert before.changes() == ()
    edit(project / "plant" / "car.py")
    assert [c.name for c in before.changes(loaded("../spec.py:drive").sources())] == [
        "plant/car.py"
    ]


CELL = """
import numpy as np
import verifai_jax as vj
LIMIT = {limit}
def scaled(a):
    return {factor} * a
def simulate(features):
    return vj.Trace({{"x": np.full(3, scaled(features["a"]) / LIMIT)}}, dt=0.1)
problem = vj.Problem("cell", {{"a": vj.Box(0.0, 1.0)}}, vj.blackbox(simulate), "always x < 0.5")
"""


def run_cell(number, **values):
    """Execute a cell as a notebook does: its text is known, and no file holds it."""
    file, text = f"/tmp/ipykernel_{number}/{number}.py", CELL.format(**values)
    linecache.cache[file] = (len(text), None, text.splitlines(True), file)
    variables = {"__name__": "__main__"}
    exec(compile(text, file, "exec"), variables)
    return variables["problem"]


def test_functions_of_a_notebook_are_recorded_by_their_text():
    before = run_cell(1, limit=1.0, factor=2).sources()
    names = {file.name for file in before.files if file.role == "a function"}
    assert names == {"simulate (notebook)", "scaled (notebook)"}
    assert before.without_file == ("the problem is made in no file, as in a notebook",)
    assert before.changes(run_cell(2, limit=1.0, factor=2).sources()) == ()
    (change,) = before.changes(run_cell(3, limit=1.0, factor=3).sources())
    assert change.name == "scaled (notebook)"
    # A number that the function takes from around it.
    (change,) = before.changes(run_cell(4, limit=1.5, factor=2).sources())
    assert change.name == "simulate (notebook)"


@pytest.mark.addons
def test_a_revision_of_git_has_its_own_files(project):
    from verifai_jax.addons.estimation.revisions import load_at_revision

    who = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    for command in (("init", "-q"), ("add", "-A"), (*who, "commit", "-qm", "first")):
        subprocess.run(["git", *command], check=True)
    then = {file.name: file.sha256 for file in loaded().sources().files}
    edit("plant/car.py")
    forget()
    with load_at_revision("spec.py:drive@HEAD", vj.Problem) as problem:
        sources = problem.sources()
    found = {file.name: file.sha256 for file in sources.files if not file.name.startswith("data/")}
    assert {"spec.py", "plant/car.py"} <= set(found)
    assert found.items() <= then.items()
    assert len(sources.revision) == 40
    assert sources.changes() == ()


def test_the_commit_is_recorded_and_whether_files_differ_from_it(project):
    assert loaded().sources().commit == ""
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    for command in (("init", "-q"), ("add", "-A"), (*who, "commit", "-qm", "first")):
        subprocess.run(["git", *command], check=True)
    head = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True).stdout
    clean = loaded().sources()
    assert (clean.commit, clean.dirty) == (head.strip(), False)
    edit("plant/unused.py", "x = 1\n")
    assert loaded().sources().dirty


@pytest.mark.addons
def test_a_model_of_mujoco_has_its_includes_and_meshes(tmp_path):
    from verifai_jax.addons.simulators.mujoco.model import files_referred_to

    (tmp_path / "parts" / "meshes").mkdir(parents=True)
    (tmp_path / "arm.xml").write_text(
        '<mujoco><compiler meshdir="parts/meshes"/><include file="parts/hand.xml"/></mujoco>'
    )
    (tmp_path / "parts" / "hand.xml").write_text(
        '<mujoco><asset><mesh name="palm" file="palm.obj"/><texture file="none.png"/></asset>'
    )
    (tmp_path / "parts" / "meshes" / "palm.obj").write_text("v 0 0 0\n")
    found = [path.relative_to(tmp_path) for path in files_referred_to(tmp_path / "arm.xml")]
    assert {*map(Path.as_posix, found)} == {"parts/hand.xml", "parts/meshes/palm.obj"}
    assert files_referred_to(tmp_path / "parts" / "meshes" / "palm.obj") == []


def test_the_record_is_plain_data(project):
    sources = loaded().sources(first=12)
    assert Sources.from_json(json.loads(json.dumps(sources.to_json()))) == sources
    for damaged in ({}, {"files": 3}, None, {**sources.to_json(), "files": [["a", "b"]]}):
        with pytest.raises(ValueError, match="another form"):
            Sources.from_json(damaged)


def test_what_is_installed_is_no_file_of_a_user():
    assert not is_user_file(pytest.__file__)
    assert not is_user_file(json.__file__)
    assert not is_user_file(vj.__file__)
    assert not is_user_file("/usr/lib/python3/dist-packages/yaml/__init__.py")
    assert is_user_file(__file__)


ARM = """
import verifai_jax as vj

system = vj.mujoco("arm.xml", duration=0.2, control_period=0.02, backend="native")
swing = vj.Problem("swing", {"a": vj.Box(0.0, 1.0)}, system, "always hinge < 1")
"""


@pytest.mark.addons
def test_a_problem_in_mujoco_has_the_files_that_it_was_loaded_from(tmp_path, monkeypatch):
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text('<mujoco><include file="body.xml"/></mujoco>')
    body = (
        '<mujoco><worldbody><body><joint name="hinge" type="hinge"/><geom size="{size}"/></body>'
        "</worldbody></mujoco>"
    )
    (tmp_path / "body.xml").write_text(body.format(size=0.1))
    (tmp_path / "arm.py").write_text(ARM)
    problem = load_target("arm.py:swing", vj.Problem)
    before = problem.sources()
    assert [file[:2] for file in before.files] == [
        ("arm.py", "the problem"), ("arm.xml", "declared"), ("body.xml", "declared")
    ]  # fmt: skip
    assert "mujoco" in before.versions
    (tmp_path / "body.xml").write_text(body.format(size=0.2))
    assert before.changes(problem.sources()) == ()
    again = load_target("arm.py:swing", vj.Problem).sources()
    assert [change.name for change in before.changes(again)] == ["body.xml"]


def test_functions_that_a_decorator_makes_are_no_part(project):
    scope = {}
    exec("def made(function):\n    return lambda features: function(features)", scope)
    problem = loaded()
    wrapped = vj.Problem(
        "w", problem.space, vj.blackbox(scope["made"](problem.check)), "always x<1"
    )
    assert not [file for file in wrapped.sources().files if file.role == "a function"]


TRACED = """
import numpy as np
import verifai_jax as vj

GAINS = np.load("gains.npy")

def simulate(features, key):
    return vj.Trace({"x": GAINS * features["a"]}, dt=0.1)

drive = vj.Problem("drive", {"a": vj.Box(0.0, 1.0)}, simulate, "always x < 2")
"""


def test_a_traced_system_is_known_by_its_program_with_its_constants(project):
    np.save("gains.npy", np.ones(3))
    edit("traced.py", TRACED)
    before = loaded("traced.py:drive").sources()
    assert [file.role for file in before.files] == ["the problem", "the traced program"]
    assert before.changes(loaded("traced.py:drive").sources()) == ()
    # Who asks in another precision asks for the same.
    with jax.enable_x64(True):
        assert before.changes(loaded("traced.py:drive").sources()) == ()
    np.save("gains.npy", np.full(3, 1.5))
    (change,) = before.changes(loaded("traced.py:drive").sources())
    assert change.name == "the traced program"
    # Another version of JAX traces otherwise, which says nothing of the model.
    older = replace(before, versions={**before.versions, "jax": "0.0.1"})
    assert older.changes(loaded("traced.py:drive").sources()) == ()


def test_declared_files_have_to_be_there():
    with pytest.raises(FileNotFoundError, match=r"files names 'none\.csv', which is no file"):
        vj.blackbox(print, files=["none.csv"])
    with unchecked(), pytest.raises(ValueError, match=r"a list of files, files=\['a\.csv'\]"):
        vj.blackbox(print, files="a.csv")


def test_importing_the_package_installs_no_audit_hook_and_runs_no_git(project):
    program = (
        "import sys; hooks = []; sys.addaudithook(lambda event, a: hooks.append(event)); "
        "import verifai_jax; verifai_jax.Box; "
        "assert not {'sys.addaudithook', 'subprocess.Popen'} & set(hooks), set(hooks)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
