"""Runs that are killed with -9 at random moments, and resumed.

What must hold: the resumed run ends with the table of one that was never killed.

    python -m benchmarks.faults.kills KIND FOLDER      # the process that is killed
"""

import functools
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd

import verifai_jax as vj
from benchmarks.faults.cases import Broken, chance

ROOT = Path(__file__).parents[2]
BUDGETS = {"traced": 20_000, "black_box": 6_000}
"""Simulations of a run: several seconds of them."""
SPACE = {"a": vj.Box(0.0, 2.0), "b": vj.Box(-1.0, 1.0)}


def simulate(features):
    """The system as a black box."""
    return vj.Trace({"x": (features["a"] + 0.1 * features["b"]) * np.linspace(0, 1, 5)}, dt=0.25)


def traced(features, key):
    """The system in JAX, which fails for three quarters of the space."""
    return vj.Trace({"x": (features["a"] + 0.1 * features["b"]) * jnp.linspace(0, 1, 5)}, dt=0.25)


def problem(kind: str) -> vj.Problem:
    """Return the problem that is run and killed."""
    system = traced if kind == "traced" else vj.blackbox(simulate)
    return vj.Problem("ramp", SPACE, system, "always x <= 0.5")


def run(kind: str, folder: Path | None) -> vj.Run:
    """Begin the run, or go on with it."""
    if folder is not None and (folder / "run.json").exists():
        begun = vj.load(folder, problem(kind))
        return begun if begun.stopped == "budget" else vj.resume(begun)
    search, batch = ("portfolio", None) if kind == "traced" else ("cross_entropy", 64)
    return vj.falsify(
        problem(kind), search, BUDGETS[kind], batch=batch, folder=folder, progress=False
    )


@functools.cache
def whole(kind: str) -> pd.DataFrame:
    """Return the table of a run that was never killed."""
    return run(kind, None).table.all


def case(number: int) -> str:
    """Kill a run up to three times, and resume it to its end.

    **Returns:** the kind of run, and whether a kill came before its end.
    """
    random_ = chance(number, "kills")
    kind = random_.choice(tuple(BUDGETS))
    with tempfile.TemporaryDirectory() as root:
        folder, cut = Path(root) / "run", False
        for _ in range(random_.randrange(1, 4)):
            cut |= _killed(kind, folder, random_.uniform(0.0, 4.0))
        done = run(kind, folder if (folder / "run.json").exists() else None)
        if done.stopped != "budget":
            raise Broken(f"a {kind} run was stopped by {done.stopped}")
        _compare(done.table.all, whole(kind), kind)
    return f"{kind} {'killed' if cut else 'ended before'}"


def _killed(kind: str, folder: Path, seconds: float) -> bool:
    child = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.faults.kills", kind, str(folder)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert child.stdout is not None
    child.stdout.readline()
    try:
        child.wait(seconds)
    except subprocess.TimeoutExpired:
        child.send_signal(signal.SIGKILL)
    _, error = child.communicate()
    if child.returncode not in (0, -signal.SIGKILL):
        raise Broken(f"exit {child.returncode}: {error.decode()[-500:]}")
    return child.returncode == -signal.SIGKILL


def _compare(table: pd.DataFrame, expected: pd.DataFrame, kind: str) -> None:
    if len(table) != len(expected):
        raise Broken(f"{len(table)} rows of a {kind} run instead of {len(expected)}")
    for name in expected:
        if not table[name].equals(expected[name]):
            raise Broken(f"column {name!r} of a {kind} run differs")


if __name__ == "__main__":
    print("begins", flush=True)
    run(sys.argv[1], Path(sys.argv[2]))
