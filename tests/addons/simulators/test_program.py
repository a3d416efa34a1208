"""Programs on the command line as systems."""

import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.values.trace import Status

SIMULATOR = """
import json, os, subprocess, sys, time
mass, out = float(sys.argv[1]), sys.argv[2]
print("starting", file=sys.stderr)
if mass > 8:
    sys.exit("the solver diverged")
if mass > 7:
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    open(os.environ["CHILD"], "w").write(str(child.pid))
    time.sleep(60)
if mass > 6:
    os.kill(os.getpid(), 11)
rows = [(0.1 * k, mass - 0.1 * k, "ON" if k else "OFF", "A" if k < 3 else "B") for k in range(20)]
text = "time,x,on,mode\\n" + "".join(f"{a},{b},{c},{d}\\n" for a, b, c, d in rows)
if out.endswith("json"):
    text = json.dumps({"time": [row[0] for row in rows], "x": [[row[1], mass] for row in rows]})
print(text) if out == "-" else open(out, "w").write(text)
"""


@pytest.fixture
def simulator(tmp_path):
    path = tmp_path / "a simulator.py"
    path.write_text(SIMULATOR)
    return path


def made(simulator, rest, **options):
    return vj.program([sys.executable, str(simulator), *rest.split()], **options)


@pytest.mark.parametrize(("rest", "output"), [("{mass} {out}", "out.csv"), ("{mass} -", "x.csv")])
def test_csv(simulator, rest, output):
    trace = made(simulator, rest, output=output)({"mass": 5.0})
    assert set(trace.signals) == {"x", "on"}
    np.testing.assert_allclose(trace["x"], 5 - 0.1 * np.arange(20))
    np.testing.assert_allclose(trace.times, 0.1 * np.arange(20))


def test_json_and_features(simulator, tmp_path):
    trace = made(simulator, "{mass} {out}", output="out.json", dt=0.1)({"mass": 5.0})
    assert trace["x"].shape == (20, 2)
    script = "import sys, json; print(json.dumps([{'t': k, 'x': k} for k in range(3)]));"
    script += "open(sys.argv[1], 'w').write(open(sys.argv[2]).read() + sys.argv[3])"
    seen = tmp_path / "seen"
    system = vj.program([sys.executable, "-c", script, str(seen), "{features}", "{p[1]}-{seed}"],
                        time="t", dt=0.5)  # fmt: skip
    assert system.may_draw({})
    assert system({"p": np.array([1.0, 2.5]), "car": {"kind": "; rm -rf /"}}, 7).length == 3
    text = seen.read_text()
    assert text.endswith("2.5-7")
    assert json.loads(text[:-5]) == {
        "p": [1.0, 2.5], "p[0]": 1.0, "p[1]": 2.5, "car.kind": "; rm -rf /",
    }  # fmt: skip


def test_rows_that_fail(simulator, tmp_path):
    child = tmp_path / "child"
    system = made(
        simulator, "{mass} {out}", timeout=2, workers=3, environment={"CHILD": str(child)}
    )
    begin = time.monotonic()
    features = [{"mass": mass} for mass in (9.0, 7.5, 6.5, 1.0)]
    found = dict(system.simulate_each(features, [0] * 4))
    assert time.monotonic() - begin < 20
    assert [found[k].status for k in range(4)] == [
        Status.ERROR, Status.TIMEOUT, Status.ERROR, Status.OK,
    ]  # fmt: skip
    assert found[0].message == (
        "the program ended with exit status 1; it wrote: starting the solver diverged"
    )
    assert found[1].message == "the program was ended after 2 s; it wrote: starting"
    assert found[2].message.startswith("the program died by signal 11")
    state = Path(f"/proc/{child.read_text()}/stat")  # The child of the program died with it.
    for _ in range(100):
        if not state.exists() or state.read_text().split()[2] == "Z":
            break
        time.sleep(0.05)
    else:
        raise AssertionError("the child lives")


def test_a_result_that_is_missing_or_no_table(simulator):
    silent = vj.program([sys.executable, "-c", "", "{mass}", "{out}"])
    with pytest.raises(RuntimeError, match="the program has not written its result"):
        silent({"mass": 1.0})
    with pytest.raises(RuntimeError, match=r"^ValueError: stdout\.csv"):
        vj.program([sys.executable, "-c", "print('hello')", "{mass}"])({"mass": 1.0})


def test_a_run_of_a_program(simulator):
    system = made(simulator, "{mass} {out}", timeout=30, workers=2)
    problem = vj.Problem("sink", {"mass": vj.Box(1, 10)}, system, "always x > 0")
    for rest, why in (("{mas} {out}", "has no feature 'mas'.*did you mean 'mass'"),
                      ("1 {out}", "does not say where the features mass go")):  # fmt: skip
        wrong = vj.Problem("sink", {"mass": vj.Box(1, 10)}, made(simulator, rest), "always x > 0")
        with pytest.raises(ValueError, match=why):
            vj.falsify(wrong, "uniform", budget=4, progress=False)
    run = vj.simulate(problem, [{"mass": mass} for mass in (1.5, 3.0, 9.0)], progress=False)
    assert list(run.table.all["status"]) == ["ok", "ok", "error"]
    assert list(run.table.all["violated"]) == [True, False, False]
    assert "solver diverged" in run.table.all["message"].iloc[2]


def test_commands_that_cannot_be(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no program"):
        vj.program("./nothing {mass}")
    with pytest.raises(ValueError, match="the command is empty"):
        vj.program("")
    with pytest.raises(ValueError, match="without a folder"):
        vj.program([sys.executable], output="../x.csv")
