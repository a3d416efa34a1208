"""What is killed goes on by the command that it has said, with the undisturbed result."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.cli.main import main
from verifai_jax.evaluation.kept_work import present
from verifai_jax.evaluation.unfinished import keeping

MODEL = """
import os
import time

import numpy as np
import verifai_jax as vj

space = {"a": vj.Box(0, 2), "b": vj.Box(0, 1)}
nominal = {"a": 1.0, "b": 0.25}

def simulated(weight):
    def system(features):
        time.sleep(float(os.environ["SLOW"]))
        with open(os.environ["COUNTER"], "a") as file:
            file.write(".")
        return vj.Trace({"x": (features["a"] + weight * features["b"]) * np.ones(4)}, dt=0.5)
    return system

def problem(weight):
    system = vj.blackbox(simulated(weight))
    return vj.Problem("ramp", space, system, "always x <= 2.2", nominal=nominal)

old, new = problem(1.0), problem(0.8)
"""
VERBS = {
    "estimate": "estimate spec.py:old --method monte_carlo --budget 1200",
    "compare": "compare spec.py:old spec.py:new --budget 1200",
    "modes": "modes spec.py:old --budget 1200",
    "synthesize": "synthesize spec.py:old --parameters b --budget 800 --held-out 400",
    "repair": "repair spec.py:old --parameters b --budget 800 --held-out 400",
    "shrink": "shrink runs/failing --no-pictures --budget 600",
    "falsify": "falsify spec.py:old --budget 1200 --no-pictures --no-confirm --folder runs/a",
    "fuzz": "fuzz spec.py:old --budget 1200 --no-pictures --folder runs/a",
}
DIFFERENT = ("seconds", "folder", "table", "notes")
"""What another process finds otherwise: times, paths, and what it says of them."""


def begun(words, folder, slow):
    environment = {
        **os.environ, "SLOW": str(slow), "COUNTER": str(folder / "counter"),
        "PYTHONPATH": str(Path(vj.__file__).parents[1]),
    }  # fmt: skip
    return subprocess.Popen(
        [sys.executable, "-m", "verifai_jax", *words],
        cwd=folder, env=environment, text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def finished(words, folder):
    process = begun(words, folder, 0.0)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return json.loads(output), errors


def simulations(folder):
    """Count the simulations so far, and begin anew."""
    counter = folder / "counter"
    count = counter.stat().st_size
    counter.unlink()
    return count


def plain(result):
    """Return what does not depend on when and where."""
    if isinstance(result, dict):
        kept = {name: value for name, value in result.items() if not name.endswith(DIFFERENT)}
        return {name: plain(value) for name, value in kept.items() if name != "sources"}
    return [plain(each) for each in result] if isinstance(result, list) else result


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
def test_a_killed_command(tmp_path, verb):
    (tmp_path / "spec.py").write_text(MODEL)
    words = [*shlex.split(VERBS[verb]), "--json"]
    if verb == "shrink":
        failing = "falsify spec.py:old --search uniform --budget 40 --folder runs/failing --json"
        finished(shlex.split(failing), tmp_path)
        (tmp_path / "counter").unlink()
    process = begun(words, tmp_path, 0.1 if verb == "shrink" else 0.01)
    assert process.stderr is not None
    line = next(line for line in process.stderr if "go on with" in line)
    enough = 20 if verb == "shrink" else 100
    while not (counter := tmp_path / "counter").exists() or counter.stat().st_size < enough:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    before = simulations(tmp_path)
    (command,) = re.findall(r"go on with: (verifai-jax .+)$", line)
    again = shlex.split(command)[1:]
    result, errors = finished([*again, *([] if "--json" in again else ["--json"])], tmp_path)
    assert "anew" not in errors
    after = simulations(tmp_path)
    if verb in ("falsify", "fuzz"):
        (tmp_path / "runs" / "a").rename(tmp_path / "runs" / "killed")
    whole, _ = finished(words, tmp_path)
    # Each once, but for half a second of what was in flight.
    assert after < before + after <= simulations(tmp_path) + 60
    if verb in ("falsify", "fuzz"):
        one, other = (vj.load(tmp_path / "runs" / name).table.all for name in ("killed", "a"))
        assert one.equals(other)
        return
    assert plain(result) == plain(whole)
    assert not (tmp_path / "runs" / "unfinished").exists()


@pytest.fixture
def problem():
    def system(features, key):
        return vj.Trace({"x": features["a"] * jnp.ones(3)}, dt=1.0)

    return vj.Problem("ramp", {"a": vj.Normal(0, 1)}, system, "always x <= 1.5")


class Killed(BaseException):
    pass


@pytest.mark.slow
def test_compiled_simulations_are_kept(tmp_path, monkeypatch, problem):
    from verifai_jax.evaluation.engine import Engine

    evaluate, calls = Engine.evaluate, []

    def counting(self, *arguments, **options):
        calls.append(len(arguments[0]))
        if sum(calls) > limit:
            raise Killed
        return evaluate(self, *arguments, **options)

    monkeypatch.setattr(Engine, "evaluate", counting)
    limit = 10**9
    options = {"budget": 4000, "batch": 250, "method": "importance", "progress": False}
    whole = vj.estimate(problem, **options)
    needed, limit = sum(calls), 1500
    calls.clear()
    with pytest.raises(Killed), keeping(tmp_path / "kept", {"of": "it"}):
        vj.estimate(problem, **options)
    calls.clear()
    with keeping(tmp_path / "kept", {"of": "it"}) as kept:
        limit = 10**9
        again = vj.estimate(problem, **options)
        kept.done = True
    assert sum(calls) <= needed - 1250
    assert (again.probability, again.low, again.high) == (whole.probability, whole.low, whole.high)
    assert present() is None
    assert not (tmp_path / "kept").exists()


@pytest.mark.thorough
def test_a_run_within_the_work_has_its_table_again(tmp_path, monkeypatch):
    from verifai_jax.evaluation.engine import Engine

    def system(features, key):
        return vj.Trace({"x": features["part"]["a"] * jnp.ones(3)}, dt=1.0)

    space = {"part": vj.Struct({"a": vj.Normal(0, 1), "b": vj.Categorical("on", "off")})}
    problem = vj.Problem("nested", space, system, "always x <= 1.5")
    options = {"search": "uniform", "budget": 300, "confirm": False, "progress": False}
    whole = vj.falsify(problem, **options).table.all
    with keeping(tmp_path / "kept", {"of": "it"}):
        first = vj.falsify(problem, **options).table.all
    monkeypatch.setattr(Engine, "evaluate", lambda *_, **__: pytest.fail("simulated again"))
    with keeping(tmp_path / "kept", {"of": "it"}) as kept:
        again = vj.falsify(problem, **options).table.all
        kept.done = True
    assert first.equals(whole)
    assert again.equals(whole)


@pytest.mark.thorough
def test_another_model_has_no_finished_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SLOW", "0")
    monkeypatch.setenv("COUNTER", str(tmp_path / "counter"))
    (tmp_path / "spec.py").write_text(MODEL)
    words = ["estimate", "spec.py:old", "--method", "monte_carlo", "--budget", "200"]
    from verifai_jax.addons.estimation.commands import estimate

    real, ends = estimate.show_result, [KeyboardInterrupt]

    def ending(*arguments):
        if ends:
            raise ends.pop()
        return real(*arguments)

    monkeypatch.setattr(estimate, "show_result", ending)
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 130
    assert re.search(r"^  resume +verifai-jax estimate spec.py:old ", result.output, re.MULTILINE)
    (tmp_path / "spec.py").write_text(MODEL.replace("1.0), problem", "1.2), problem"))
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    assert "note: begun anew, since the model has changed since then: spec.py" in result.output


@pytest.mark.thorough
def test_a_full_disk_ends_no_estimate(tmp_path, monkeypatch, problem, capsys):
    from verifai_jax.core.store import log

    def full(*_):
        raise OSError(28, "No space left on device")

    with keeping(tmp_path / "kept", {"of": "it"}):
        monkeypatch.setattr(log.Log, "put", full)
        found = vj.estimate(problem, "monte_carlo", 200, progress=False)
    assert found.simulations == 200
    assert capsys.readouterr().err.count("goes on without keeping what is finished") == 1
