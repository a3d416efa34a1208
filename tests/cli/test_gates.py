"""Gates and JSON: exit codes by what is shown, and results that programs read."""

import json

import click
import pytest
from click.testing import CliRunner

from verifai_jax.cli.gates import Gate, GateType, exceeds
from verifai_jax.cli.json_output import ReportingCommand, as_plain
from verifai_jax.cli.main import main
from verifai_jax.statistics.binomial import Rate

SPEC = """
import jax.numpy as jnp
import verifai_jax as vj


def ramp(limit):
    def system(f, key):
        return vj.Trace({"x": f["a"] * jnp.ones(3)}, dt=1.0)

    space = {"a": vj.Box(0.0, 1.0), "b": vj.Box(0.0, 1.0)}
    return vj.Problem("ramp", space, system, f"always x < {limit}", nominal={"a": 0.1, "b": 0.5})


often, never = ramp(0.9), ramp(2.0)
"""


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.py").write_text(SPEC)

    def run(*arguments, code=0):
        result = CliRunner().invoke(main, [str(a) for a in arguments])
        assert result.exit_code == code, result.output
        return result

    return run


def test_gates_are_read():
    kinds = GateType(("counterexample", "rate"))
    assert kinds.convert("rate > 0.01", None, None) == Gate("rate", 0.01)
    assert str(Gate("rate", 0.01)) == "rate>0.01"
    for text, message in (
        ("rate", "must be rate>P with P between 0 and 1"),
        ("rate>2", "must be rate>P with P between 0 and 1"),
        ("counterexmple", "did you mean 'counterexample'"),
        ("p0", "Known: counterexample, rate>P"),
        ("counterexample>1", "there is no gate"),
    ):
        with pytest.raises(click.BadParameter, match=message):
            kinds.convert(text, None, None)
    assert not exceeds(None, 1.0)
    assert not exceeds(Gate("rate", 0.1), 0.1)
    assert exceeds(Gate("rate", 0.1), 0.11)
    # What is not known is not shown.
    assert exceeds(Gate("rate", 0.1), None)
    assert exceeds(Gate("rate", 0.1), float("nan"))


@pytest.mark.addons
def test_every_command_has_json():
    context = click.Context(main)
    commands = [main.get_command(context, name) for name in main.list_commands(context)]
    groups = [command.commands for command in commands if isinstance(command, click.Group)]
    single = [command for command in commands if not isinstance(command, click.Group)]
    inner = [command for group in groups for command in group.values()]
    # What `mcp` writes is JSON anyway, message by message.
    plain = {
        command.name for command in single + inner if not isinstance(command, ReportingCommand)
    }
    assert plain == {"mcp"}


def test_values_as_plain_data():
    import numpy as np
    import pandas as pd

    value = {
        "rate": Rate(1, 10, 0.0, float("nan"), 0.95),
        "array": np.array([1.5, np.inf]),
        "table": pd.DataFrame({"a": [1, 2]}, index=pd.Index([7, 9], name="row")),
        "number": np.float32(0.5),
        "flag": np.bool_(True),
    }
    plain = as_plain(value)
    json.dumps(plain, allow_nan=False)
    assert plain["rate"]["high"] is None
    assert plain["rate"]["failures"] == 1
    assert plain["array"] == [1.5, None]
    assert plain["table"] == [{"row": 7, "a": 1}, {"row": 9, "a": 2}]
    assert (plain["number"], plain["flag"]) == (0.5, True)


@pytest.mark.addons
@pytest.mark.slow
def test_falsify_with_a_rate_and_what_follows_a_run(call):
    few = ("--search", "uniform", "--budget", 500, "--no-pictures")
    often = ("falsify", "spec.py:often", *few)
    result = call(*often, "--fail-on", "rate>0.2", "--json", "--folder", "one")
    told = json.loads(result.stdout)
    assert told["command"] == "falsify"
    assert told["counterexamples"] == told["violating"] > 20
    assert told["failure_rate"]["high"] < 0.2
    assert told["gate"] == {"asked": "rate>0.2", "passed": True}
    assert told["worst"]["features"]["a"] > 0.9
    assert "simulations violate the property" in result.stderr
    failed = call(*often, "--fail-on", "rate>0.1", "--json", code=1)
    assert json.loads(failed.stdout)["gate"]["passed"] is False
    refused = call("falsify", "spec.py:often", "--fail-on", "rate>0.1", code=2)
    assert "needs independent samples of the space; give --search uniform" in refused.output
    for command, more in (
        ("confirm", ("--fail-on", "counterexample")),
        ("replay", ("--fail-on", "counterexample", "--no-pictures")),
    ):
        told = json.loads(call(command, "one", *more, "--json", code=1).stdout)
        assert told["gate"] == {"asked": "counterexample", "passed": False}
    told = json.loads(call("shrink", "one", "--no-pictures", "--json").stdout)
    assert list(told["changed"]) == ["a"]
    told = json.loads(call("save-counterexamples", "one", "--max-count", 1, "--json").stdout)
    assert len(told["files"]) == 1
    told = json.loads(call("replay-counterexamples", "spec.py:often", "--json").stdout)
    assert told["passed"] is False
    assert told["counterexamples"][0]["state"] == "failing"


@pytest.mark.thorough
def test_gates_of_an_estimate_a_comparison_and_a_list(call):
    options = ("--method", "monte_carlo", "--budget", 400, "--json")
    told = json.loads(call("estimate", "spec.py:never", *options, "--fail-on", "rate>0.05").stdout)
    assert told["upper_bound"] < 0.05
    call("estimate", "spec.py:often", *options, "--fail-on", "rate>0.05", code=1)
    call("estimate", "spec.py:often", *options, "--fail-on", "counterexample", code=1)
    result = call("compare", "spec.py:never", "spec.py:often", "--fail-on", "regression",
                  "--json", code=1)  # fmt: skip
    told = json.loads(result.stdout)
    assert told["verdict"] == told["candidates"][0]["verdict"] == "worse"
    assert told["candidates"][0]["low"] > 0
    told = json.loads(call("list", "spec.py", "--json").stdout)
    assert [one["target"] for one in told["targets"]] == ["spec.py:often", "spec.py:never"]
