import contextlib
import gc
import os
import queue
import re
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import host_systems
import numpy as np
import pytest

from verifai_jax.core.user_code import targets
from verifai_jax.core.values.trace import Status
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.systems.base import Outcome
from verifai_jax.systems.blackbox import blackbox, workers
from verifai_jax.systems.blackbox._blackbox import single_trace
from verifai_jax.systems.blackbox.worker_process import MARK, end_marked

ROOT = Path(__file__).parents[3]
HERE = r" \([^()]*host_systems.py, line \d+, in \w+\)"


@pytest.fixture(scope="module")
def troublesome():
    # A machine that stalls must not end a worker.
    with pool_of_two(timeout=60.0) as system:
        yield system


def pool_of_two(timeout):
    options = {"workers": 2, "timeout": timeout, "signals": ("x",)}
    return contextlib.closing(blackbox(host_systems.seeded, seeded=True, **options))


def outcomes(system, features, seeds=None):
    seeds = [0] * len(features) if seeds is None else seeds
    found = list(system.simulate_each(features, seeds))
    assert sorted(index for index, _ in found) == list(range(len(features)))
    return [outcome for _, outcome in sorted(found, key=lambda pair: pair[0])]


@pytest.mark.slow
def test_each_trouble_is_a_row_and_stops_no_other():
    with pool_of_two(timeout=3.0) as troublesome:
        found = outcomes(troublesome, [{"a": a} for a in (0, 1, 3, 4, 5, 6, 7, 8, 9.5)])
    messages = [(o.status.name, re.sub(HERE, "", o.message)) for o in found]
    assert "host_systems.py, line 29, in troublesome)" in found[1].message
    assert messages == [
        ("OK", ""),
        ("ERROR", "KeyError: 'no such road'"),
        ("ERROR", "the worker process was killed by SIGSEGV (attempt 2 of 2)"),
        ("TIMEOUT", "the simulation took longer than 3 s"),
        ("ERROR", "SystemExit: enough"),
        ("ERROR", "TypeError: the system must return a Trace; it returned str"),
        (
            "ERROR",
            "ValueError: the trace must have the signals x; got y (x missing; y not expected)",
        ),
        ("OK", ""),
        ("OK", ""),
    ]
    assert all((o.trace is not None) == (o.status == Status.OK) for o in found)
    np.testing.assert_array_equal(found[8].trace["x"], host_systems.decay({"a": 9.5})["x"])


@pytest.mark.slow
def test_at_the_end_of_all_time_what_runs_is_ended_and_nothing_begins(troublesome):
    outcomes(troublesome, [{"a": 0}] * 2)
    features, began = [{"a": a} for a in (0, 4, 4, 4, 0)], time.monotonic()
    found = dict(troublesome.pool.outcomes(features, [0] * 5, began + 2.0))
    assert time.monotonic() - began < 10
    assert found[0].status == Status.OK
    assert {found[i].status for i in (1, 2, 3, 4)} == {Status.TIMEOUT}
    ended = "the simulation was ended, as all time was over"
    assert [found[i].message for i in (1, 2, 3, 4)] == [ended, ended, "", ""]


def test_one_simulation_raises_what_went_wrong(troublesome):
    assert troublesome({"a": np.float32(0.5)}).length == 5
    with pytest.raises(RuntimeError, match="KeyError: 'no such road'"):
        troublesome({"a": 1})
    late = Outcome(None, Status.TIMEOUT, "the simulation took longer than 1 s")
    with pytest.raises(TimeoutError, match="longer than 1 s"):
        single_trace(iter([(0, late)]))


@pytest.mark.slow
def test_workers_are_used_again_and_end_with_the_pool(troublesome):
    found = outcomes(troublesome, [{"a": 9}] * 20) + outcomes(troublesome, [{"a": 9}] * 20)
    pids = {int(outcome.trace["x"][0]) for outcome in found}
    assert 1 <= len(pids) <= 2
    assert os.getpid() not in pids
    # Each in a session of its own, so that Ctrl-C in the terminal is not for them.
    assert {int(outcome.trace["x"][1]) for outcome in found} == pids
    troublesome.close()
    assert not any(alive(pid) for pid in pids)
    assert outcomes(troublesome, [{"a": 0}])[0].status == Status.OK


@pytest.mark.thorough
def test_a_pool_that_is_forgotten_ends_its_workers():
    system = blackbox(host_systems.troublesome, workers=1)
    (outcome,) = outcomes(system, [{"a": 9}])
    pid = int(outcome.trace["x"][0])
    assert alive(pid)
    del system
    gc.collect()
    assert not alive(pid)


@pytest.mark.thorough
def test_a_death_is_survived_by_a_retry(troublesome, tmp_path):
    file = tmp_path / "file"
    assert outcomes(troublesome, [{"a": 10, "file": str(file)}])[0].status == Status.OK
    assert file.exists()


def test_seeds_and_waveforms_arrive(troublesome):
    features = [{"a": float(i)} for i in range(5)]
    found = outcomes(troublesome, features, [7, 2**32 - 1, 3, 4, 5])
    got = [list(outcome.trace["x"]) for outcome in found]
    assert got == [[0, 7], [1, 2**32 - 1], [2, 3], [3, 4], [4, 5]]
    wind = Waveform(np.array([1.0, 3.0], np.float32), "linear", 2.0)
    (outcome,) = outcomes(troublesome, [{"a": 11, "wind": wind}])
    np.testing.assert_array_equal(outcome.trace["x"], [1.0, 3.0])


@pytest.mark.thorough
def test_a_caller_that_stops_ends_what_runs(troublesome):
    running = troublesome.simulate_each([{"a": 0}] + [{"a": 4}] * 5, [0] * 6)
    assert next(running)[0] == 0
    begun = time.monotonic()
    running.close()
    assert time.monotonic() - begun < 30
    assert outcomes(troublesome, [{"a": 0}])[0].status == Status.OK


@pytest.mark.slow
def test_what_a_simulator_has_started_ends_with_the_pool():
    with_children = blackbox(host_systems.troublesome, workers=1)
    (outcome,) = outcomes(with_children, [{"a": 12}])
    child = int(outcome.trace["x"][0])
    assert alive(child)
    with_children.close()
    until(lambda: not alive(child), 5)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="Linux lists processes there")
def test_what_a_worker_has_started_ends_in_whatever_session():
    marks, started = ("8/1-2/", "8/1-2/3-0/", "8/1-20/", "7/8/1-2/"), []
    for mark in marks:
        command = ["sh", "-c", "echo; sleep 1000 & wait"]
        how = {"env": {**os.environ, MARK: mark}, "start_new_session": True}
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, **how))
        started[-1].stdout.readline()  # Its environment is its own by now.
    try:
        end_marked("8/1-2/")
        assert [process.wait(5) for process in started[:2]] == [-signal.SIGKILL] * 2
        assert [process.poll() for process in started[2:]] == [None, None]
    finally:
        for process in started:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.stdout.close()
            process.wait()


@pytest.mark.slow
def test_what_has_ended_when_interrupted_is_handed_over(monkeypatch, tmp_path):
    """Outcomes of several workers lie in the queue when Ctrl-C comes."""
    system = blackbox(host_systems.troublesome, workers=2)
    outcomes(system, [{"a": 0}, {"a": 0}])  # Both are ready.
    real, calls = workers._Batch, []

    class Interrupted(queue.SimpleQueue):
        def get(self, *args, **options):
            if not calls:
                calls.append(1)
                until(lambda: self.qsize() == 2)
                raise KeyboardInterrupt
            return super().get(*args, **options)

    def batch(*args):
        made = real(*args)
        made.results = Interrupted()
        return made

    monkeypatch.setattr(workers, "_Batch", batch)
    rest = system.simulate_each([{"a": 0}, {"a": 0}, {"a": 4}, {"a": 4}], [1, 2, 3, 4])
    assert sorted(next(rest)[0] for _ in range(2)) == [0, 1]
    with pytest.raises(KeyboardInterrupt):
        next(rest)
    system.close()


def test_refuses_what_a_new_process_cannot_import():
    match = r"must be able to import what they run: .*<lambda> cannot be .* at the top level"
    with pytest.raises(ValueError, match=match):
        blackbox(lambda features: host_systems.decay(features), workers=2)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"workers": 0}, "workers must be an integer of at least 1; got 0"),
        ({"workers": 2, "timeout": 0}, "timeout must be a positive number of seconds; got 0"),
        ({"workers": 2, "retries": -1}, "retries must be an integer of at least 0; got -1"),
        ({"timeout": 2.0}, "give workers=1, or more, with timeout=2.0"),
        ({"workers": 2, "vectorised": True}, "either vectorised or in workers"),
        ({"wokers": 2}, "unknown option of blackbox 'wokers'; did you mean 'workers'"),
        ({"signals": "x"}, r"signals must be names, such as \('x', 'theta'\); got 'x'"),
        ({"signals": {"x": 0}}, "how many components 'x' has, at least 1; got 0"),
        ({"dt": -1}, "dt must be a positive number of seconds; got -1"),
        ({"length": 0}, "length must be an integer of at least 1; got 0"),
    ],
)
def test_refuses_bad_options(options, match):
    with pytest.raises(ValueError, match=match):
        blackbox(host_systems.decay, **options)


@pytest.mark.thorough
def test_a_simulator_that_workers_cannot_import(tmp_path, monkeypatch):
    (tmp_path / "licensed.py").write_text(
        "from verifai_jax.systems.blackbox import worker_process\n"
        "if worker_process.preparing:\n    raise ImportError('no licence left')\n"
        "def simulate(features): ...\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    import licensed  # pyright: ignore[reportMissingImports]

    system = blackbox(licensed.simulate, workers=1)
    match = "a worker process could not import what it runs: ImportError: no licence left"
    with pytest.raises(workers.StartError, match=match):
        list(system.simulate_each([{}], [0]))


@pytest.mark.thorough
def test_ways_in_which_a_worker_dies_are_named():
    assert workers._manner(3) == "ended with exit code 3"
    assert workers._manner(-11) == "was killed by SIGSEGV"
    assert workers._manner(-9) == "was killed by SIGKILL (out of memory?)"
    assert workers._manner(-63) == "was killed by signal 63"


SCRIPT = """
    import numpy as np
    from verifai_jax.systems.blackbox import blackbox
    from verifai_jax.core.values.trace import Trace

    def simulate(features):
        return Trace({"x": np.array([features["a"]])}, dt=1.0)

    system = blackbox(simulate, workers=2)

    def main():
        found = system.simulate_each([{"a": 1.0}] * 2, [0, 0])
        print([float(outcome.trace["x"][0]) for _, outcome in found])
"""


def script(tmp_path, text):
    file = tmp_path / "script.py"
    file.write_text(textwrap.dedent(text))
    return file


def run(*arguments, stdin=None):
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        input=stdin,
    )


@pytest.mark.slow  # Ctrl-C is tested with such a function, too.
def test_a_function_of_the_script_itself(tmp_path):
    done = run(script(tmp_path, SCRIPT + "\n    if __name__ == '__main__':\n        main()\n"))
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[1.0, 1.0]\n"
    # A busy machine may take long to start a worker, which is said.
    assert not [line for line in done.stderr.splitlines() if "is still importing" not in line]


@pytest.mark.slow
def test_a_script_without_a_guard_is_told_so(tmp_path):
    done = run(script(tmp_path, SCRIPT + "\n    main()\n"))
    assert done.returncode == 1
    (last,) = done.stderr.strip().splitlines()[-1:]
    assert last.startswith(
        "verifai_jax.systems.blackbox.workers.StartError: a worker process imports the"
    )
    assert "under `if __name__ == '__main__':`" in last


@pytest.mark.slow
def test_a_session_without_a_file_is_told_so():
    done = run("-", stdin=textwrap.dedent(SCRIPT) + "\nmain()\n")
    assert done.returncode == 1
    assert "cannot import simulate from a notebook or an interactive session" in done.stderr
    assert "%%writefile simulator.py" in done.stderr


@pytest.mark.slow
def test_a_module_that_only_its_file_finds(tmp_path, monkeypatch):
    # As `verifai-jax falsify folder/script.py` loads its target.
    monkeypatch.setattr(sys, "path", list(sys.path))
    module = targets._import(str(script(tmp_path, SCRIPT)))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    assert outcomes(module.system, [{"a": 1.0}])[0].message == ""
    module.system.close()


@pytest.fixture
def sleeping(tmp_path):
    """A process whose worker simulates for a minute, and the worker's number."""
    text = """
        import os, signal, time
        from pathlib import Path
        from verifai_jax.systems.blackbox import blackbox

        # A shell that runs the tests in its background lets them ignore Ctrl-C.
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.default_int_handler)

        def simulate(features):
            Path(features["file"]).write_text(str(os.getpid()))
            time.sleep(60)

        if __name__ == "__main__":
            list(blackbox(simulate, workers=1).simulate_each([{"file": FILE}], [0]))
    """
    mark = tmp_path / "pid"
    process = subprocess.Popen(
        [sys.executable, script(tmp_path, text.replace("FILE", repr(str(mark))))],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    until(lambda: mark.exists() and mark.read_text())
    with process:
        yield process, int(mark.read_text())
        process.kill()


@pytest.mark.thorough
def test_ctrl_c_ends_the_workers(sleeping):
    process, worker = sleeping
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert error.strip().splitlines()[-1] == "KeyboardInterrupt"
    assert error.count("Traceback") == 1
    assert not alive(worker)


@pytest.mark.slow
def test_a_worker_does_not_outlive_a_killed_parent(sleeping):
    process, worker = sleeping
    process.kill()
    _, error = process.communicate()
    assert error == ""
    until(lambda: not alive(worker))


def until(condition, seconds=30):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"
