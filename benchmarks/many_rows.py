"""A run of many rows, its analyses and its report: seconds and memory, beside another checkout.

    python benchmarks/many_rows.py [--before ../checkout-of-before] [--rows 1_000_000] [--pairs 3]

Each measurement is a process of its own, in turn with both checkouts; processor seconds (user and
system, all threads) are what a busy machine disturbs least. The memory is what a step adds to the
peak of resident memory before it.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

SWING = """
import jax.numpy as jnp
import verifai_jax as vj

def swing(time, state, control, features):
    push = jnp.clip(-60 * state["angle"] - 15 * state["speed"], -4, 4) / features["mass"]
    return {"angle": state["speed"], "speed": 9.81 * jnp.sin(state["angle"]) + push}

def begin(features, key):
    return {"angle": features["angle0"], "speed": 0.0}

problem = vj.Problem(
    "swing", {"angle0": vj.Box(-0.3, 0.3), "mass": vj.Box(0.5, 2.0)},
    vj.ode(swing, begin, dt=0.01, duration=1.0), "always abs(angle) <= 0.5",
)
"""
"""A program that makes a problem of two features, `problem`; for new processes."""
MEASURE = """
import json, resource, sys, tempfile, time
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
found, run = {}, None
for name, step in (
    ("run", lambda: vj.falsify(problem, "uniform", int(sys.argv[1]), progress=False)),
    ("analyze", lambda: run.analyze(progress=False)),
    ("report", lambda: run.report(tempfile.mkdtemp() + "/it.html")),
):
    cpu, clock, memory = time.process_time(), time.perf_counter(), peak()
    result = step()
    run = result if run is None else run
    found[name] = time.process_time() - cpu, time.perf_counter() - clock, peak() - memory
print(json.dumps(found))
"""


def measured(checkout: Path, rows: int) -> dict[str, list[float]]:
    """Return processor seconds, seconds and MB of each step in a new process."""
    done = subprocess.run(
        [sys.executable, "-c", SWING + MEASURE, str(rows)], cwd=checkout, check=True,
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(checkout)},
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Print a row for each step and checkout, with the ratio of processor seconds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--before", type=Path)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--pairs", type=int, default=3)
    options = parser.parse_args()
    here = Path(__file__).resolve().parents[1]
    checkouts = [here] if options.before is None else [options.before.resolve(), here]
    taken = [[measured(each, options.rows) for each in checkouts] for _ in range(options.pairs)]
    print("| step | processor s | s | MB | ratio to before |\n|---|---|---|---|---|")
    for name in ("run", "analyze", "report"):
        cpu, clock, memory = (
            " / ".join(
                f"{statistics.median(pair[k][name][i] for pair in taken):.3g}"
                for k in range(len(checkouts))
            )
            for i in range(3)
        )
        ratio = statistics.median(pair[-1][name][0] / pair[0][name][0] for pair in taken)
        print(f"| {name} | {cpu} | {clock} | {memory} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
