"""The command line, as a person uses it from the root of the checkout."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from verifai_jax.cli import arguments
from verifai_jax.cli.main import main
from verifai_jax.cli.next_folder import next_folder
from verifai_jax.core.store.files import sealed
from verifai_jax.falsification.run_folder import load

ROOT = Path(__file__).parents[2]
PROBLEM = """
import jax.numpy as jnp
import verifai_jax as vj

ramp = vj.Problem(
    "ramp",
    space={"a": vj.Box(0.0, 1.0), "b": vj.Box(-1.0, 1.0)},
    system=lambda f, key: vj.Trace({"x": f["a"] + f["b"] * jnp.linspace(0, 1, 9)}, dt=1 / 8),
    spec="always[0, 1] x <= 1",
    description="a ramp that should stay below one",
    nominal={"a": 0.5, "b": 0.25},
)
flat = vj.Problem("flat", ramp.space, ramp.system, "eventually x > 0.5")
never = vj.Problem("calm", ramp.space, ramp.system, "always x < 9")
"""


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "specs").mkdir()
    (tmp_path / "specs" / "ramp.py").write_text(PROBLEM)

    def run(*arguments, code=0):
        result = CliRunner().invoke(main, [str(a) for a in arguments])
        assert result.exit_code == code, result.output
        return result.output

    return run


@pytest.mark.thorough
def test_falsify_and_replay(call, tmp_path):
    output = call(
        "falsify", "specs/ramp.py:ramp", "--search", "uniform", "--budget", 300, "--seed", 2
    )
    assert "simulations violate the property" in output
    assert "always[0,1] (x <= 1)" in output
    assert "95 % interval" in output
    folder = tmp_path / "runs" / "ramp-1"
    for picture in ("features.png", "robustness.png", "worst.png"):
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")
        assert str(Path("runs/ramp-1") / picture) in output
    record = json.loads((folder / "run.json").read_text())
    assert record["target"] == "specs/ramp.py:ramp"
    command = next(line for line in output.splitlines() if "verifai-jax replay" in line)
    again = call(*command.split("verifai-jax ")[1].split())
    assert "violated" in again
    call("falsify", "specs/ramp.py:ramp", "--search", "halton", "--budget", 20, "--no-pictures")
    assert (tmp_path / "runs" / "ramp-2" / "table.parquet").exists()


@pytest.mark.slow
def test_options_of_a_search(call, tmp_path):
    output = call(
        "falsify",
        "specs/ramp.py:ramp",
        "--search",
        "cross_entropy",
        "--set",
        "elite=0.3",
        "--budget",
        64,
        "--batch",
        32,
        "--folder",
        "here",
        "--no-pictures",
    )
    assert "0.3" in json.loads((tmp_path / "here" / "run.json").read_text())["search"]
    assert "here" in output


@pytest.mark.slow
def test_resume_goes_on_in_the_same_folder(call, tmp_path):
    start = ["falsify", "specs/ramp.py:ramp", "--search", "uniform", "--batch", 16]
    call(*start, "--budget", 48, "--only", "b", "--folder", "one", "--no-pictures")
    call("falsify", "--resume", "one", "--only", "b", "--budget", 80, "--no-pictures")
    call(*start, "--budget", 80, "--only", "b", "--folder", "two", "--no-pictures")
    one, two = (load(tmp_path / name).table.all for name in ("one", "two"))
    assert one.equals(two)
    assert set(one["a"]) == {0.5}
    # What was held stands in the record.
    call("falsify", "--resume", "one", "--budget", 99, "--no-pictures")
    assert set(load(tmp_path / "one").table.all["a"]) == {0.5}
    output = call("falsify", "--resume", "one", "--seed", 3, code=2)
    assert "--seed is fixed in the run that --resume goes on with" in output


@pytest.mark.slow
def test_ends_and_warm_start(call):
    ramp = ["falsify", "specs/ramp.py:ramp", "--batch", 64, "--no-pictures"]
    output = call(*ramp, "--search", "uniform", "--within", 0.1, "--folder", "prior")
    assert "stopped by stop_when" in output
    assert "whenever stopped" in output
    output = call(*ramp, "--search", "uniform", "--decide", 0.6, "--folder", "decided")
    assert "stopped by stop_when" in output
    learning = ("--search", "cross_entropy", "--warm-start", "prior")
    output = call(*ramp, *learning, "--budget", 64, "--folder", "warm")
    assert "64 simulations" in output
    assert "give one" in call(*ramp, "--within", 0.1, "--decide", 0.1, code=2)
    assert "needs independent samples" in call(*ramp, "--within", 0.1, code=2)


@pytest.mark.slow
def test_analyze_writes_its_findings(call, tmp_path):
    call("falsify", "specs/ramp.py:ramp", "--search", "uniform", "--budget", 400, "--no-pictures")
    output = call("analyze", "runs/ramp-1")
    assert "Where it fails" in output
    report = (tmp_path / "runs" / "ramp-1" / "analysis" / "report.md").read_text()
    assert "Coverage" in report
    assert (tmp_path / "runs/ramp-1/analysis/overview.png").read_bytes().startswith(b"\x89PNG")


def test_list_shows_the_targets(call):
    output = call("list")
    assert "specs/ramp.py:ramp  a ramp that should stay below one" in output
    assert "specs/ramp.py:flat" in output
    assert "searches: " in output
    assert "cross_entropy" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["falsify", "specs/ramp.py:rampe"],
            "unknown problem in specs/ramp.py 'rampe'; did you mean",
        ),
        (["falsify", "specs/ramp.py"], "has 3 problems; name one: specs/ramp.py:ramp"),
        (["falsify", "specs/rampp.py:ramp"], "no file specs/rampp.py; specs/ has ramp.py"),
        (["falsify", "nowhere.at:all"], "no file and no module 'nowhere.at'"),
        (["falsify", "specs/ramp.py:ramp", "--search", "halten"], "did you mean 'halton'"),
        (["falsify", "specs/ramp.py:ramp", "--set", "gradient=1"], "did you mean 'gradients"),
        (["falsify", "specs/ramp.py:ramp", "--set", "elite"], "--set needs NAME=VALUE"),
        (
            ["falsify", "specs/ramp.py:ramp", "--budget", "0"],
            "budget must be an integer of at least",
        ),
        (["falsify", "specs/ramp.py:ramp", "--budgets", "3"], "--budget"),
        (["falsfy", "specs/ramp.py:ramp"], "did you mean 'falsify'"),
        (["replay", "runs/none"], "no run in runs/none"),
    ],
)
def test_mistakes_get_one_line(call, arguments, message):
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code != 0
    assert message in result.output
    assert "Traceback" not in result.output


def test_a_run_folder_does_not_choose_what_code_runs(call, tmp_path):
    start = ["falsify", "specs/ramp.py:ramp", "--search", "uniform", "--no-pictures"]
    call(*start, "--budget", 20, "--folder", "r")
    record = json.loads((tmp_path / "r" / "run.json").read_text())
    evil = tmp_path / "r" / "evil.py"
    evil.write_text("raise SystemExit('ran')")
    # Beside it, in folders of other results, and named as modules.
    for name in ("r/evil.pyx/evil.py", "runs/two/evil.py", "lib/sweeps/evil.py", "old/in/evil.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("raise SystemExit('ran')")
    (tmp_path / "old" / "run.json").write_text("{}")
    (tmp_path / "link.py").symlink_to(evil)
    for target in (
        "r/evil.py:ramp", "r/evil.py", "./r/../r/evil.py:ramp", "link.py:ramp", "/etc/evil.py:ramp",
        "../evil.py:x", "os:path", "os", "r.evil", "r.evil.pyx:ramp", "r.evil.py:x", "r/evil:x",
        "runs/two/evil.py:ramp", "lib/sweeps/evil.py:ramp", "old/in/evil.py:ramp", "",
        "specs/none.py:x", "specs/ramp.py\0:x", "specs:ramp", "runs.two.evil:x", ":", 3,
        ["specs/ramp.py"], None,
    ):  # fmt: skip
        (tmp_path / "r" / "run.json").write_text(json.dumps(sealed(record | {"target": target})))
        result = CliRunner().invoke(main, ["replay", "r", "0"])
        assert "does not record to which problem of this project" in result.output, target
        assert result.exit_code == 2
        assert "ran" not in result.output.split()
    # A pack of folders from elsewhere: the code of one is not for the other.
    (tmp_path / "pack" / "two").mkdir(parents=True)
    (tmp_path / "pack" / "two" / "evil.py").write_text("raise SystemExit('ran')")
    shutil.copytree(tmp_path / "r", tmp_path / "pack" / "one")
    evil_target = json.dumps(sealed(record | {"target": "pack/two/evil.py:ramp"}))
    (tmp_path / "pack" / "one" / "run.json").write_text(evil_target)
    assert "does not record to which" in call("replay", "pack/one", 0, code=2)
    output = call("replay", "r", 0, "--problem", "specs/ramp.py:ramp", "--no-pictures")
    assert "robustness" in output


def test_the_name_of_a_problem_stays_in_the_folder(call, tmp_path):
    file = tmp_path / "specs" / "ramp.py"
    evil = (
        '\nevil = vj.Problem("../../evil\\n\\x1b[2J name", ramp.space, ramp.system, "always x < 9")'
    )
    file.write_text(file.read_text() + evil)
    start = ["falsify", "specs/ramp.py:evil", "--search", "uniform", "--no-pictures"]
    output = call(*start, "--budget", 8)
    assert "\x1b" not in output
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["evil___2J name-1"]
    assert {path.name for path in tmp_path.iterdir()} == {"specs", "runs"}
    # A command that ends before it has a row leaves no folder.
    call(*start, "--budget", 0, code=2)
    assert len(list((tmp_path / "runs").iterdir())) == 1


def test_commands_that_start_together_take_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    taken, ready = [], threading.Barrier(8)

    def take():
        ready.wait()
        with next_folder("runs", "tiny") as folder:
            (folder / "mine").write_text("")
            taken.append(folder.name)

    threads = [threading.Thread(target=take) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == [f"tiny-{number}" for number in range(1, 9)]


def test_messages_do_not_steer_the_terminal(call, tmp_path):
    (tmp_path / "specs" / "rude.py").write_text(
        "import verifai_jax as vj\n"
        "def simulate(features):\n"
        "    raise RuntimeError('\\x1b[2J' + 'x' * 100_000)\n"
        "system = vj.blackbox(simulate)\n"
        "rude = vj.Problem('rude', {'a': vj.Box(0, 1)}, system, 'always x > 0')\n"
    )
    start = ("falsify", "specs/rude.py:rude", "--search", "uniform", "--no-pictures", "--budget", 2)
    output = call(*start, code=3)
    assert "RuntimeError" in output
    assert "x1b[2J" in output
    assert "\x1b" not in output
    assert len(output) < 5000


def test_precision_of_a_run(call, tmp_path):
    where = ("--search", "uniform", "--folder", tmp_path / "run", "--no-pictures")
    call("falsify", "specs/ramp.py:ramp", "--budget", 32, "--precision", "float64", *where)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (record["precision"], record["backend"]) == ("float64", None)
    output = call("falsify", "specs/ramp.py:ramp", "--backend", "native", code=2)
    assert "has no backends to choose from; got backend 'native'" in output


@pytest.mark.thorough
def test_replay_compares_each_formula_with_its_own_column(call, tmp_path):
    (tmp_path / "specs" / "two.py").write_text(
        "import jax.numpy as jnp\nimport verifai_jax as vj\n"
        "def system(features, key):\n"
        "    return vj.Trace({'x': features['a'] + jnp.zeros(3)}, dt=1.0)\n"
        "spec = {'low': 'always x < 2', 'high': 'always x < 10'}\n"
        "p = vj.Problem('two', {'a': vj.Box(3, 4)}, system, spec)\n"
    )
    call("falsify", "specs/two.py:p", "--search", "uniform", "--budget", 8, "--no-pictures")
    output = call("replay", "runs/two-1", 0, "--no-pictures")
    found = re.findall(r"robustness (\S+) in float64, (\S+) in the table", output)
    assert len(found) == 2
    for again, stored in found:
        assert float(again) == pytest.approx(float(stored), abs=1e-5)


@pytest.mark.slow
def test_a_system_that_draws_is_replayed_in_the_precision_of_its_run(call, tmp_path):
    (tmp_path / "specs" / "noisy.py").write_text(
        PROBLEM.replace('f["a"] +', 'jax.random.normal(key) + f["a"] +').replace(
            "import jax.numpy", "import jax\nimport jax.numpy"
        )
    )
    call("falsify", "specs/noisy.py:ramp", "--search", "uniform", "--budget", 64, "--no-pictures")
    output = call("replay", "runs/ramp-1", 7, "--no-pictures")
    stored = load(tmp_path / "runs" / "ramp-1").table.all["rho"][7]
    assert "row 7, float32" in output
    assert f"robustness {stored:.6g} in float32, {stored:.6g} in the table" in output
    call("falsify", "specs/ramp.py:ramp", "--search", "uniform", "--budget", 8, "--no-pictures")
    assert "float64" in call("replay", "runs/ramp-2", 0, "--no-pictures")


BROKEN = """
import jax.numpy as jnp
import verifai_jax as vj

def crash(features):
    raise RuntimeError("no road")

space = {"a": vj.Box(0.0, 1.0)}
nan = vj.Problem(
    "nan", space, lambda f, key: vj.Trace({"x": jnp.log(-1 - f["a"])[None]}, dt=1.0), "x < 1"
)
raising = vj.Problem("raising", space, vj.blackbox(crash, signals=("x",)), "x < 1")
"""


@pytest.mark.thorough
def test_exit_codes(call, tmp_path, monkeypatch):
    (tmp_path / "specs" / "broken.py").write_text(BROKEN)
    few = ("--search", "uniform", "--budget", 32, "--no-pictures")
    ramp = ("falsify", "specs/ramp.py:ramp", *few)
    call(*ramp)
    call(*ramp, "--fail-on", "counterexample", code=1)
    call("falsify", "specs/ramp.py:calm", *few, "--fail-on", "counterexample")
    call(*ramp, "--fail-on", "something", code=2)
    call("falsify", "specs/ramp.py:rampe", *few, code=2)
    output = call("falsify", "specs/broken.py:nan", *few, code=3)
    last = "Error: no simulation had a verdict, so nothing is known of the property: 32 nonfinite"
    assert output.splitlines()[-1] == last
    broken = ("falsify", "specs/broken.py:raising", "--search", "uniform", "--no-pictures")
    broken = (*broken, "--budget", 96)
    output = call(*broken, "--fail-on", "counterexample", code=3)
    ended = (
        "ended after 64 of 96 simulations, since none succeeds: each raised RuntimeError: no road"
    )
    assert f"{ended} (specs/broken.py, line 6" in output
    assert output.rstrip().endswith("Stop(keep_going=True), or --keep-going, simulates all")
    output = call(*broken, "--keep-going", code=3)
    assert "96 error. The first says: RuntimeError: no road (specs/broken.py, line 6" in output
    for command in ("analyze", "confirm", "shrink", "explain", "replay"):
        output = call(command, "runs/nan-1", code=3)
        assert "no simulation of the run in runs/nan-1 had a verdict, of 32" in output
    assert "status nonfinite" in call("replay", "runs/nan-1", 0, "--no-pictures")
    output = call("estimate", "specs/broken.py:nan", "--budget", 64, code=3)
    assert "no simulation had a verdict" in output
    assert "goes with --p0" in call("estimate", "specs/ramp.py:calm", "--fail-on", "p0", code=2)
    shown = ("--budget", 200, "--method", "monte_carlo", "--fail-on", "p0", "--p0")
    call("estimate", "specs/ramp.py:calm", *shown, 0.1)
    call("estimate", "specs/ramp.py:ramp", *shown, 0.001, code=1)
    for command in ([], ["falsify"], ["monitor"]):
        assert "3  the tool or the simulator broke" in call(*command, "--help")

    # Raised in a file of the package, and not in one of a user.
    code = "def bug(*_, **__):\n    raise AttributeError('no such part')"
    scope = {}
    exec(compile(code, arguments.__file__, "exec"), scope)
    monkeypatch.setattr("verifai_jax.falsification.falsify", scope["bug"])
    output = call(*ramp, code=3)
    assert "Traceback" in output
    assert "AttributeError: no such part\nThis is a bug of verifai_jax; please report it" in output
    monkeypatch.setattr("verifai_jax.falsification.falsify", _interrupted)
    assert call(*ramp, code=130) == "Error: interrupted\n"


def _interrupted(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_ends_a_command_as_ctrl_c_does(call, monkeypatch, name, code):
    number = getattr(signal, name)
    monkeypatch.setattr("verifai_jax.falsification.falsify", lambda *_, **__: _signalled(number))
    # Tests that are started by nohup ignore it, and so would the command.
    before = signal.signal(number, signal.SIG_DFL)
    try:
        assert call("falsify", "specs/ramp.py:ramp", code=code) == "Error: interrupted\n"
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)


def _signalled(number):
    os.kill(os.getpid(), number)
    time.sleep(5)


def test_a_reader_that_closes_the_pipe_is_no_error(call, monkeypatch):
    def closed(*_, **__):
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr("verifai_jax.cli.list.click.echo", closed)
    assert call("list", code=141) == ""


def test_the_help_may_be_cut_off_too():
    # As before `| true`: nobody has the other end of the pipe.
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-c", "from verifai_jax.cli.main import main; main()", "--help"]
    try:
        done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, timeout=60)
    finally:
        os.close(writing)
    assert done.returncode == 141
    assert done.stderr == b""


@pytest.mark.addons
def test_the_help_of_all_commands_imports_nothing_heavy():
    code = (
        "import atexit, sys\nfrom verifai_jax.cli.main import main\n"
        "atexit.register(lambda: print(*{'jax', 'pandas'} & {*sys.modules}, file=sys.stderr))"
        "\nmain()"
    )
    command = [sys.executable, "-c", code, "--help"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, timeout=60, env=environment, check=True)
    assert b"last-chance" in done.stdout
    assert done.stderr.strip() == b""


@pytest.mark.addons
@pytest.mark.parametrize("words", [["--help"], ["monitor", "always x > 0", "log.csv"]])
def test_an_output_that_cannot_be_written_is_one_line(tmp_path, words):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    (tmp_path / "log.csv").write_text("time,x\n0,1\n1,2\n")
    command = [sys.executable, "-c", "from verifai_jax.cli.main import main; main()", *words]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, timeout=60, cwd=tmp_path, env=environment
        )
    assert done.returncode == 3
    assert done.stderr.decode() == (
        "Error: the output cannot be written (No space left on device); send it to a file on "
        "another disk\n"
    )


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("def f(:", "is not Python: invalid syntax (bad.py, line 1)"),
        ("d = {}\nd['x']", "bad.py, line 2"),
        ("raise RuntimeError('no road')", "line 1 (`raise RuntimeError('no road')`): RuntimeError"),
        ("from json import nothing", "ImportError: cannot import name 'nothing'"),
        ("import sys\nsys.exit(3)", "SystemExit: 3"),
        ("class Odd(BaseException): pass\nraise Odd('x')", "bad.py, line 2"),
    ],
)
def test_a_file_that_raises_is_told_with_its_line(call, tmp_path, text, match):
    (tmp_path / "specs" / "bad.py").write_text(text)
    output = call("list", "specs/bad.py", code=2)
    assert match in output
    assert "Traceback" not in output
    output = call("list", code=2)
    assert match in output
    assert "specs/ramp.py:ramp" in output


def test_a_target_by_its_variable(call, tmp_path):
    few = ("--search", "uniform", "--budget", 16, "--no-pictures")
    assert call("falsify", "specs/ramp.py:never", *few).startswith("calm: ")
    call("falsify", "--resume", "runs/calm-1", "--budget", 20, "--no-pictures")
    output = call("falsify", "specs/ramp.py:nevr", code=2)
    assert "did you mean 'never'? Known: ramp, flat, calm, never." in output
    twice = PROBLEM + '\nagain = vj.Problem("ramp", ramp.space, ramp.system, "always x < 7")\n'
    (tmp_path / "specs" / "twice.py").write_text(twice)
    assert call("falsify", "specs/twice.py:again", *few).startswith("ramp: ")
    assert "specs/twice.py:again" in call("list", "specs/twice.py")


@pytest.mark.addons
def test_folders_of_something_else(call, tmp_path):
    call("falsify", "specs/ramp.py:calm", "--search", "uniform", "--budget", 8, "--no-pictures")
    for name, file, text in (
        ("sweeps", "sweep.cache", ""),
        ("other", "run.json", '{"lap": 1}'),
        ("cut", "run.json", "{"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / file).write_text(text)
    for place, told in (
        ("specs", "no run in specs: run.json is missing; give a folder that"),
        ("runs/calm-2", "no run in runs/calm-2: there is no such folder; in runs there are calm-1"),
        ("runs", "run.json is missing; but its folders calm-1 are runs"),
        ("specs/ramp.py", "no run in specs/ramp.py: it is a file"),
        ("sweeps", "it is the folder of a sweep; verifai-jax sweep --resume sweeps goes on"),
        ("other", "no run in other: other/run.json is damaged, or of another program"),
        ("cut", "no run in cut: cut/run.json is damaged, or of another program"),
    ):
        assert told in call("falsify", "--resume", place, code=2)
        assert told in call("falsify", "specs/ramp.py:ramp", "--warm-start", place, code=2)
        assert told in call("replay", place, code=2)
    (tmp_path / "runs" / "calm-1" / "table.parquet").write_text("PAR1")
    output = call("replay", "runs/calm-1", code=2)
    assert "Error: runs/calm-1/table.parquet is damaged: ArrowInvalid: " in output
    told = "it is the folder of a run; verifai-jax falsify --resume runs/calm-1 goes on with it"
    assert told in call("sweep", "--resume", "runs/calm-1", code=2)


def test_list_where_problems_are_elsewhere(call, tmp_path, monkeypatch):
    (tmp_path / "specs" / "helpers.py").write_text("two = 2\n")
    (tmp_path / "specs" / "bad.py").write_text("import verifai_jax\none = {}['x']\n")
    output = call("list", code=2)
    assert "specs/bad.py, line 2 (`one = {}['x']`): KeyError: 'x'" in output
    assert "specs/ramp.py:calm" in output
    assert "helpers" not in output
    (tmp_path / "specs" / "bad.py").write_text("one = (\n")
    assert "specs/bad.py is not Python: '(' was never closed" in call("list", code=2)
    monkeypatch.chdir(tmp_path / "specs")
    output = call("list", code=2)
    assert output.startswith("Error: there is no folder specs/ here; verifai-jax list FILE.py")
    assert "Python files here: bad.py, helpers.py, ramp.py" in output
    assert "ramp.py:calm" in call("list", ".", code=2)


def test_list_runs_no_file_outside_of_its_folder_and_no_name_steers_the_terminal(call, tmp_path):
    (tmp_path / "outside.py").write_text("raise SystemExit('it ran')")
    (tmp_path / "specs" / "link.py").symlink_to(tmp_path / "outside.py")
    turned = PROBLEM.replace('"calm"', '"ca\u202elm\x1b[2J"').replace("a ramp", "a \u2066ramp")
    (tmp_path / "specs" / "ramp.py").write_text(turned)
    (tmp_path / "specs" / "wi\u202ede.py").write_text(PROBLEM)
    output = call("list")
    assert "specs/link.py leads out of specs/, and is not run" in output
    assert r"specs/ramp.py:ca\u202elm_[2J" in output
    assert r"a \u2066ramp" in output
    assert r"specs/wi\u202ede.py:ramp" in output
    assert not {"\u202e", "\u2066", "\x1b"} & {*output}
    assert "it ran" in call("list", "specs/link.py", code=2)


def test_a_missing_extra_is_one_line(call, tmp_path):
    (tmp_path / "specs" / "robot.py").write_text(
        "from verifai_jax.core.messages.errors import require\n"
        "require('no_such_engine', extra='engine')\n"
    )
    told = "no_such_engine is not installed: pip install 'verifai_jax[engine]'"
    assert call("falsify", "specs/robot.py:walk", code=2) == f"Error: {told}\n"
    output = call("list")
    assert f"specs/robot.py: {told}\n" in output
    assert "specs/ramp.py:ramp" in output


@pytest.mark.addons
class TestMonitor:
    @pytest.fixture(autouse=True)
    def recording(self, call, tmp_path):
        (tmp_path / "drive.csv").write_text(
            "time,dist,speed,mode\n0.0,5.0,1.0,a\n0.5,3.0,2.0,a\n1.0,1.5,4.0,b\n1.5,2.5,2.5,b\n"
        )
        (tmp_path / "uneven.csv").write_text("time,dist\n0,1\n0.5,2\n1.5,2\n")

    @pytest.mark.thorough
    def test_robustness_of_a_recording(self, call):
        assert call("monitor", "always dist > 1", "drive.csv") == "holds with robustness 0.5\n"
        gate = ("--fail-on", "violation")
        output = call("monitor", "always[0, 1] dist >= 2", "drive.csv", *gate, code=1)
        assert output == "fails with robustness -0.5\n"
        call("monitor", "always dist > 1", "drive.csv", *gate)
        assert "robustness 0.5" in call(
            "monitor", "G (dist < 2 -> F[0, 500ms] slow)", "drive.csv",
            "--define", "slow=speed < limit", "--const", "limit=3",
        )  # fmt: skip

    @pytest.mark.thorough
    def test_many_requirements_on_many_recordings(self, call, tmp_path):
        (tmp_path / "all.csv").write_text("id,formula\ngap,always X dist > 1\nnear,G X dist >= 2\n")
        (tmp_path / "logs").mkdir()
        (tmp_path / "drive.csv").rename(tmp_path / "logs" / "drive.csv")
        (tmp_path / "uneven.csv").rename(tmp_path / "logs" / "uneven.csv")
        files = ("--report", "out/r.html", "--junit", "out/j.xml")
        output = call("monitor", "all.csv", "logs", *files, "--fail-on", "violation", code=1)
        assert "2 requirements on 2 recordings: 1 of 2 verdicts fail, and 2 could" in output
        assert "dist >= 2 has margin -0.5 at 1 s" in output
        assert (tmp_path / "out" / "j.xml").exists()
        assert (tmp_path / "out" / "r.html").exists()
        one = ("monitor", "always X dist > 0", "logs")
        assert "is not evenly sampled" in call(*one, "--fail-on", "incomplete", code=1)
        call(*one, "--resample", "0.5", "--method", "hold", "--fail-on", "incomplete")
        assert "no requirement had a verdict" in call("monitor", "other > 0", "logs", code=3)
        assert "--plot and --compat go with one" in call(*one, "--plot", "a.png", code=2)

    def test_monitor_explains_what_decided(self, call, tmp_path):
        output = call(
            "monitor", "always[0, 1] dist >= 2", "drive.csv", "--explain", "--plot", "why.png"
        )
        assert "decided by  dist >= 2  at 1 s" in output
        assert (tmp_path / "why.png").read_bytes().startswith(b"\x89PNG")

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (
                ["always dst > 1", "drive.csv"],
                "drive.csv has no signal 'dst'; did you mean 'dist'? It has: dist",
            ),
            (
                ["always mode > 1", "drive.csv"],
                "drive.csv has no signal 'mode'; did you mean 'mode=b' or 'mode=a'?",
            ),
            (["always next dist > 1", "uneven.csv"], "Resample it: --resample 0.75 --method hold"),
            (
                ["always dist > 1", "drive.csv", "--resample", "1"],
                "--resample PERIOD goes with --me",
            ),
            (["always (dist > 1", "drive.csv"], "Error: "),
            (["always (dist > 1", "drive.csv"], "^"),
            (["always[0, 0.3] dist > 1", "drive.csv"], "0.3"),
            (["always dist > 1", "none.csv"], "no recording none.csv"),
            (
                ["always dist > 1", "drive.csv", "--time", "tme"],
                "no column 'tme' of sample times; did you mean 'time' or 'mode'? Give the sampling "
                "period, --dt SECONDS, or the name of the column, --time NAME",
            ),
            (["always dist > 1", "drive.csv", "--const", "a=b"], "--const a must be a number"),
            (
                ["always[0, 9] dist > 1", "drive.csv", "--end", "strict"],
                "Use --end hold or --end truncate, or a longer recording",
            ),
        ],
    )
    def test_mistakes_are_reported_in_a_line_without_a_traceback(self, arguments, message):
        result = CliRunner().invoke(main, ["monitor", *arguments])
        assert result.exit_code == 2
        assert message in result.output
        assert "Traceback" not in result.output

    def test_a_gap_is_no_verdict(self, call, tmp_path):
        (tmp_path / "gap.csv").write_text("time,dist\n0,1\n1,\n2,3\n")
        output = call("monitor", "always dist > 0", "gap.csv", code=3)
        assert output == "Error: no verdict: signal 'dist' is NaN at 1 s\n"

    def test_semicolons_and_decimal_commas(self, call, tmp_path):
        (tmp_path / "semi.csv").write_text("time;dist\n0,0;5,0\n0,5;3,5\n")
        assert call("monitor", "G dist > 1", "semi.csv") == "holds with robustness 2.5\n"


def test_new_writes_a_project(call, tmp_path):
    output = call("new", "my_project")
    assert "cd my_project && verifai-jax falsify spec.py:upright" in output
    for name in ("pendulum.py", "spec.py", "test_spec.py"):
        compile((tmp_path / "my_project" / name).read_text(), name, "exec")
    readme = (tmp_path / "my_project" / "README.md").read_text()
    assert "# my_project" in readme
    assert "@vj.test" in (tmp_path / "my_project" / "test_spec.py").read_text()
    # No index has the package: it is installed from where this one was.
    assert re.search(r"^pip install pytest '(verifai_jax @ file:)?/", readme, re.MULTILINE)
    assert "has .gitignore, README.md" in call("new", "my_project", code=2)


@pytest.mark.addons
@pytest.mark.slow
def test_a_new_project_passes_its_tests(call, tmp_path):
    call("new", "my_project")
    place = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    # By itself, where there is no pytest, and by pytest, which knows `@vj.test`.
    for command in (["test_spec.py"], ["-m", "pytest", "-p", "no:cacheprovider"]):
        command = [sys.executable, *command]
        done = subprocess.run(command, cwd=tmp_path / "my_project", env=place, capture_output=True)
        assert done.returncode == 0, (done.stdout + done.stderr).decode()
    assert "2 passed" in done.stdout.decode()


@pytest.mark.parametrize(
    "option", [["--seed", 0], ["--no-confirm"], ["--diverse"], ["--set", "a=1"]]
)
def test_an_option_that_the_run_has_fixed_is_refused_and_not_ignored(call, option):
    output = call("falsify", "--resume", "run", *option, "--no-pictures", code=2)
    assert f"{option[0].replace('--no-', '--')} is fixed in the run" in output


@pytest.mark.addons
def test_an_unknown_kind_of_cluster_is_refused(call):
    output = call("falsify", "specs/ramp.py:ramp", "--cluster", "dusk://a:1", code=2)
    assert "unknown kind of cluster 'dusk'; did you mean 'dask'?" in output
