"""`verifai-jax sweep`, as a person uses it."""

import json
import shlex
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner
from drifting import quick_certificates

from verifai_jax.addons.training.sweeps import Study
from verifai_jax.addons.training.sweeps import running as driver
from verifai_jax.cli.main import main
from verifai_jax.core.display import progress
from verifai_jax.core.store.cache import Cache
from verifai_jax.core.user_code.targets import TargetError, definitions, load_target

STUDY = """
import verifai_jax as vj
from drifting import Drift, Point, closed_loop, drifting
from dataclasses import replace

safe = replace(drifting({"rate": vj.LogUniform(0.01, 1.0), "noise": vj.Box(0.0, 0.1)}),
               name="safe", description="drifts that stay")
other = replace(safe, name="other")
"""


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(Path(__file__).parents[3] / "training" / "sweeps")
    monkeypatch.setattr(driver, "certify", quick_certificates)
    # However slow the machine is, no command takes so long that it says how to go on.
    monkeypatch.setattr(progress, "MOMENT", 3600.0)
    (tmp_path / "specs").mkdir()
    (tmp_path / "specs" / "drift.py").write_text(STUDY)

    def run(*arguments, code=0):
        result = CliRunner().invoke(main, ["sweep", *map(str, arguments)])
        assert result.exit_code == code, result.output
        return result.output

    return run


SMALL = ("--configurations", 3, "--samples", 64, "--no-pictures")


@pytest.mark.slow
def test_sweep_and_what_it_writes(call, tmp_path):
    output = call("specs/drift.py:safe", *SMALL, "--seed", 2)
    assert output.startswith("safe: 3 configurations")
    assert "rate" in output
    assert "nominal_return" in output
    folder = tmp_path / "sweeps" / "safe-1"
    assert "table        sweeps/safe-1/table.parquet" in output
    assert {"table.parquet", "sweep.json", "policies", "sweep.cache"} <= {
        path.name for path in folder.iterdir()
    }
    call("specs/drift.py:safe", *SMALL)
    assert (tmp_path / "sweeps" / "safe-2").exists()


@pytest.mark.slow
def test_resume_goes_on_with_what_was_asked_for(call, tmp_path, monkeypatch):
    asked = ("--search", "cross_entropy", "--set", "elite=0.5", "--halving", 2, "--seed", 3)
    whole = call("specs/drift.py:safe", *SMALL, *asked, "--folder", "whole")
    stopped = _Stopping(after=7)
    monkeypatch.setattr("verifai_jax.core.store.cache.Cache", stopped)
    part = call("specs/drift.py:safe", *SMALL, *asked, "--folder", "part", "--cache", "work done")
    assert "NOT FINISHED" in part
    (printed,) = (line for line in part.splitlines() if line.startswith("  resume "))
    words = shlex.split(printed)[1:]
    assert words == ["verifai-jax", "sweep", "--resume", "part", "--cache", "work done"]
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(Path(__file__).parents[3] / "training" / "sweeps")
    monkeypatch.setattr(driver, "certify", quick_certificates)
    again = call(*words[2:], "--no-pictures")

    def rows(output):
        return [line for line in output.splitlines() if line.endswith(("safe@0.01", "unsafe"))]

    assert rows(again) == rows(whole)
    import pandas as pd

    one, other = (pd.read_parquet(f"{name}/table.parquet") for name in ("whole", "part"))
    pd.testing.assert_frame_equal(
        one.drop(columns="training_seconds"), other.drop(columns="training_seconds")
    )


class _Stopping:
    """A cache that is interrupted once so much is done."""

    def __init__(self, after):
        self.after = after

    def __call__(self, folder, kind):
        cache, put = Cache(folder, kind), Cache.put

        def stopped(work):
            put(cache, work)
            if cache.computed >= self.after:
                raise KeyboardInterrupt

        cache.put = stopped
        return cache


def test_an_interruption_outside_of_the_work_prints_the_command_too(call, monkeypatch):
    def interrupted(study, *, folder, **_):
        folder.mkdir(exist_ok=True)
        Cache(folder).note("command", {})
        raise KeyboardInterrupt

    monkeypatch.setattr("verifai_jax.addons.training.sweeps._sweep.sweep", interrupted)
    output = call("specs/drift.py:safe", *SMALL, "--folder", "part", code=130)
    assert "  resume       verifai-jax sweep --resume part\n" in output


def test_errors_in_one_line(call, tmp_path):
    for arguments, told in (
        (("specs/drift.py:sfae",), "Error: unknown study in specs/drift.py 'sfae'; did you mean"),
        (("specs/drift.py",), "Error: specs/drift.py has 2 studies; name one: specs/drift.py:safe"),
        (("specs/none.py:safe",), "Error: no file specs/none.py"),
        (("specs/drift.py:safe", "--search", "halten"), "did you mean 'halton'"),
        (("specs/drift.py:safe", "--set", "elite=2"), "unknown option of search halton 'elite'"),
        (("specs/drift.py:safe", "--halving", 0.5), "reduction must be greater than 1; got 0.5"),
        (("specs/drift.py:safe", "--only", "raet"), "did you mean 'rate'"),
        (("specs/drift.py:safe", "--only", "rate"), "noise has none"),
        (("--resume", "nowhere"), "Error: no sweep to resume in nowhere"),
        (("specs/drift.py:safe", "--samples", 0), "samples must be an integer"),
    ):
        output = call(*arguments, code=2)
        assert told in output
        assert len(output.strip().splitlines()) == 1
    for arguments, told in (
        ((), "Missing argument 'TARGET'"),
        (("--resume", "x", "--seed", 3), "--seed is fixed in the sweep that --resume goes on with"),
        (("--resume", "x", "--halving", 3), "--halving is fixed in the sweep"),
        (("specs/drift.py:safe", "--halving-by", "safety"), "--halving-by goes with --halving"),
    ):
        assert told in call(*arguments, code=2)
    # Nothing was begun.
    assert not (tmp_path / "sweeps").exists()


@pytest.mark.thorough
def test_only_some_vary(call):
    output = call(
        "specs/drift.py:safe",
        *SMALL,
        "--only",
        "rate",
        "--nominal",
        "noise=0.05",
        "--folder",
        "some",
    )
    assert output.count(" 0.05 ") >= 3
    call("--resume", "some", "--no-pictures")


@pytest.mark.thorough
def test_another_sweep_in_the_same_folder_is_refused(call):
    call("specs/drift.py:safe", *SMALL, "--folder", "kept")
    output = call("specs/drift.py:safe", *SMALL, "--seed", 9, "--folder", "kept", code=2)
    assert "kept/sweep.cache holds a different sweep: options.seed is 9, in the cache 0" in output


@pytest.mark.thorough
def test_a_folder_from_elsewhere_names_no_code(call, tmp_path):
    call("specs/drift.py:safe", *SMALL, "--folder", "kept")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    shutil.move(tmp_path / "specs", tmp_path / "kept" / "specs")
    cache = Cache(tmp_path / "kept")
    note = json.dumps(cache.note("command")).replace("specs/", "kept/specs/")
    cache.note("command", json.loads(note))
    output = call("--resume", "kept", code=2)
    assert "kept does not record to which study of this project it belongs" in output


def test_studies_are_found_as_problems_are(call):
    assert set(definitions("specs/drift.py", Study)) == {"safe", "other"}
    assert load_target("specs/drift.py:safe", Study).description == "drifts that stay"
    Path("specs/empty.py").write_text("x = 1\n")
    with pytest.raises(TargetError, match=r"specs/empty.py defines no Study"):
        load_target("specs/empty.py", Study)


def test_list_names_studies_beside_problems(call):
    listed = CliRunner().invoke(main, ["list"])
    assert listed.exit_code == 0, listed.output
    assert "specs/drift.py:safe  drifts that stay" in listed.output
    assert "a study of training runs, for sweep, over rate, noise" in listed.output
