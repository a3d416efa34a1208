"""Problems at revisions of git: their own modules and files, in a checkout that stays as it is."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.addons.estimation.revisions import lies_in, load_at_revision, split_revision
from verifai_jax.cli.main import main
from verifai_jax.core.user_code.targets import TargetError

SPEC = """
from pathlib import Path

import jax.numpy as jnp
import verifai_jax as vj
from control.limit import LIMIT

SCALE = float((Path(__file__).parent / "scale.txt").read_text())


def system(f, key):
    return vj.Trace({"x": SCALE * (f["a"] > LIMIT) * jnp.ones(2)}, dt=1.0)


ramp = vj.Problem("ramp", {"a": vj.Box(0.0, 1.0)}, system, "always x < 0.5")
"""


def git(folder, *words):
    options = ("-c", "user.name=n", "-c", "user.email=e@x", "-c", "commit.gpgsign=false")
    done = subprocess.run(
        ["git", *options, *words], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout


@pytest.fixture
def project(tmp_path, monkeypatch):
    (tmp_path / "specs").mkdir()
    (tmp_path / "control").mkdir()
    (tmp_path / "specs" / "ramp.py").write_text(SPEC)
    (tmp_path / "specs" / "scale.txt").write_text("1.0")
    (tmp_path / "control" / "limit.py").write_text("LIMIT = 0.9\n")
    git(tmp_path, "init", "-q", "-b", "main")
    # Python writes these for whoever imports a module of the checkout.
    (tmp_path / ".gitignore").write_text("__pycache__/\n")
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-q", "-m", "first")
    (tmp_path / "control" / "limit.py").write_text("LIMIT = 0.7\n")
    git(tmp_path, "commit", "-q", "-a", "-m", "second")
    # What is not committed, half of it in the index.
    (tmp_path / "control" / "limit.py").write_text("LIMIT = 0.4\n")
    git(tmp_path, "add", "control/limit.py")
    (tmp_path / "specs" / "scale.txt").write_text("2.0")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in [name for name in sys.modules if name.partition(".")[0] == "control"]:
        del sys.modules[name]


def state(project):
    files = sorted(str(path) for path in (project / ".git").rglob("*") if path.is_file())
    return (
        git(project, "status", "--porcelain"), git(project, "rev-parse", "HEAD"), files,
        (project / ".git" / "index").read_bytes(),
    )  # fmt: skip


def test_targets_are_split_behind_the_file():
    assert split_revision("specs/a.py:b@main") == ("specs/a.py:b", "main")
    assert split_revision("specs/a.py@HEAD@{1}") == ("specs/a.py", "HEAD@{1}")
    assert split_revision("me@home/a.py:b") == ("me@home/a.py:b", None)
    assert split_revision("specs.a:b") == ("specs.a:b", None)


def test_each_revision_has_its_own_modules_and_the_checkout_stays(project):
    before = state(project)
    with (
        load_at_revision("specs/ramp.py:ramp", vj.Problem) as now,
        load_at_revision("specs/ramp.py:ramp@HEAD", vj.Problem) as second,
        load_at_revision(f"{project}/specs/ramp.py:ramp@HEAD~1", vj.Problem) as first,
    ):
        names = [problem.system.function.__globals__ for problem in (now, second, first)]
        limits = [(own["LIMIT"], own["SCALE"]) for own in names]
        assert limits == [(0.4, 2.0), (0.7, 1.0), (0.9, 1.0)]
        place = Path(names[2]["__file__"])
        assert place.exists()
    assert not place.exists()
    assert sys.modules["control.limit"].LIMIT == 0.4
    assert Path.cwd() == project
    assert state(project) == before
    files = [getattr(module, "__file__", None) or "" for module in sys.modules.values()]
    assert not any(file.startswith(str(place.parents[1])) for file in files)


def test_what_cannot_be_loaded(project, tmp_path_factory, monkeypatch):
    def load(target):
        with load_at_revision(target, vj.Problem):
            pass

    with pytest.raises(TargetError, match="git knows no revision 'mian' in"):
        load("specs/ramp.py:ramp@mian")
    with pytest.raises(TargetError, match="git knows no revision '--all' in"):
        load("specs/ramp.py:ramp@--all")
    with pytest.raises(TargetError, match="at revision main: no file specs/new"):
        load("specs/new.py:ramp@main")
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    with pytest.raises(TargetError, match="git rev-parse failed: fatal: not a git"):
        load("ramp.py:ramp@main")


@pytest.mark.slow
def test_command_compares_revisions(project):
    arguments = ["compare", "specs/ramp.py:ramp@HEAD~1", "specs/ramp.py:ramp@HEAD"]
    result = CliRunner().invoke(main, [*arguments, "specs/ramp.py:ramp", "--fail-on", "regression"])
    assert result.exit_code == 1, result.output
    assert "against specs/ramp.py:ramp@HEAD~1, on the same samples" in result.output
    assert "specs/ramp.py:ramp@HEAD is WORSE" in result.output
    assert "all intervals hold together at 95 %" in result.output
    again = vj.compare("specs/ramp.py:ramp@HEAD", "specs/ramp.py:ramp@HEAD~1")
    assert again.candidates[0].name == "specs/ramp.py:ramp@HEAD~1"
    assert again.verdict == "better"


def test_what_a_failed_import_left_behind_is_in_no_folder(project, monkeypatch):
    """A package without an `__init__.py` asks its parent for its folders."""
    (project / "half" / "part").mkdir(parents=True)
    monkeypatch.syspath_prepend(str(project))
    part = importlib.import_module("half.part")
    monkeypatch.delitem(sys.modules, "half")
    assert not lies_in(part, project)
