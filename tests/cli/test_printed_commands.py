"""What ended early goes on by the command that it prints: it is taken from the output and run."""

import re
import shlex

import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.cli.arguments import resuming
from verifai_jax.cli.main import main
from verifai_jax.falsification import loop

PROBLEM = """
import numpy as np
import jax.numpy as jnp
import verifai_jax as vj

space = {"a": vj.Box(0, 2), "b": vj.Box(0, 1)}
nominal = {"a": 1.0, "b": 0.25}

def ramp(features, key):
    return vj.Trace({"x": (features["a"] + features["b"]) * jnp.ones(4)}, dt=0.5)

def host(features):
    return vj.Trace({"x": (features["a"] + features["b"]) * np.ones(4)}, dt=0.5)

traced = vj.Problem("traced", space, ramp, "always x <= 2.5", nominal=nominal)
boxed = vj.Problem("boxed", space, vj.blackbox(host), "always x <= 2.5", nominal=nominal)
"""


def called(*arguments, codes=(0, 1)):
    result = CliRunner().invoke(main, [str(each) for each in arguments])
    assert result.exit_code in codes, result.output
    return result.output


def printed(output, folder):
    """Return the words of the command behind `resume` in an output."""
    (line,) = re.findall(r"^  resume +(verifai-jax .+)$", output, re.MULTILINE)
    words = shlex.split(line)
    assert str(folder) in words
    return words[1:]


@pytest.fixture
def interrupted(monkeypatch):
    """Let Ctrl-C come behind the second round of a run, once."""
    advance, rounds = loop.Rounds.advance, []

    def interrupting(self, *arguments):
        advance(self, *arguments)
        rounds.append(1)
        if len(rounds) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(loop.Rounds, "advance", interrupting)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "target", "options"),
    [
        ("falsify", "traced", ["--only", "a", "--stop-after", 10_000, "--search", "uniform"]),
        ("falsify", "boxed", ["--search", "cross_entropy"]),
        ("fuzz", "traced", ["--cells", "x=0:3:4"]),
        ("fuzz", "boxed", []),
    ],
)
def test_an_interrupted_run(tmp_path, monkeypatch, interrupted, verb, target, options):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.py").write_text(PROBLEM)
    common = ["--budget", 64, "--batch", 16, "--no-pictures", *options]
    if verb == "falsify":
        common += ["--no-confirm"]
    output = called(verb, f"spec.py:{target}", *common, "--folder", "runs/a b", codes=(0, 1, 130))
    assert "stopped by Ctrl-C" in output or "interrupted" in output
    called(*printed(output, "runs/a b"), "--no-pictures")
    whole_run = called(verb, f"spec.py:{target}", *common, "--folder", "runs/whole")
    (replay,) = re.findall(r"^  replay +verifai-jax (.+)$", whole_run, re.MULTILINE)
    assert "robustness" in called(*shlex.split(replay))
    gone_on, whole = (vj.load(f"runs/{name}").table.all for name in ("a b", "whole"))
    assert len(gone_on) == 64
    assert gone_on.equals(whole)


def test_a_command_names_what_the_record_alone_does_not(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "spec.py").write_text("")
    monkeypatch.chdir(tmp_path / "here")
    folder = tmp_path / "here" / "runs" / "x y"
    (tmp_path / "here" / "spec.py").write_text("")
    assert resuming("falsify", folder, "spec.py:p", {}) == (
        f"verifai-jax falsify --resume '{folder}'"
    )
    apart = resuming("falsify", folder, "../spec.py:p", {"--stop-after": 3, "--within": None})
    assert apart == f"verifai-jax falsify ../spec.py:p --resume '{folder}' --stop-after 3"


@pytest.mark.slow
def test_a_run_of_fuzz_goes_on_in_python(tmp_path):
    def system(features):
        if features["a"] > 1.5:
            raise RuntimeError("lost")
        return vj.Trace({"x": features["a"] * vj.Waveform([1.0, 1.0], duration=1.0).knots}, dt=1.0)

    space, boxed = {"a": vj.Box(0, 2)}, vj.blackbox(system)
    options = {"space": space, "system": boxed, "ranges": {"x": (0, 1)}, "batch": 16, "seed": 1}
    vj.fuzz(**options, budget=32, folder=tmp_path / "half", confirm=False, progress=False)
    # The problem that fuzz made has no name in a file: one with the same space and system will do.
    again = vj.Problem("fuzz", space, boxed, "always finite > 0")
    resumed = vj.resume(tmp_path / "half", again, budget=64)
    whole = vj.fuzz(**options, budget=64, confirm=False, progress=False)
    assert resumed.table.all.equals(whole.table.all)
    assert resumed.coverage["cells"].hits == whole.coverage["cells"].hits
