"""Memory and time of long runs: uniform sampling of a trivial system, in memory and with a folder.

    python benchmarks/large_runs.py                     # 1e6 and 1e7 rows
    python benchmarks/large_runs.py 50_000_000          # other sizes

Each run has a process of its own, whose peak of resident memory (getrusage) is that of everything:
the interpreter, JAX, the run, its summary. A second process loads the folder and reads its
counterexamples, without the other rows.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SIZES = (1_000_000, 10_000_000)


def measure(rows: int, folder: str) -> None:
    """Run, or load the run in a folder that is there, and print what it took."""
    import jax.numpy as jnp

    import verifai_jax as vj

    def system(features, key):
        return vj.Trace({"x": features["a"] * jnp.ones(3)}, dt=0.1)

    problem = vj.Problem("line", {"a": vj.Box(0, 1)}, system, "always x <= 0.999")
    before, begun = peak(), time.perf_counter()
    loads = bool(folder) and Path(folder).exists()
    if loads:
        run = vj.load(folder)
    else:
        run = vj.falsify(problem, "uniform", rows, folder=folder or None, progress=False)
    ended = time.perf_counter()
    first = run.summary().splitlines()[0]
    summed = time.perf_counter()
    failures = len(run.table.counterexamples)
    read = time.perf_counter()
    assert run.simulations == rows, first
    result = {
        "rows": rows,
        "run": "loaded" if loads else "with a folder" if folder else "in memory",
        "seconds": ended - begun,
        "summary": summed - ended,
        "counterexamples": failures,
        "their seconds": read - summed,
        "GB before": before,
        "GB": peak(),
    }
    print(json.dumps(result))


def peak() -> float:
    """Return the most resident memory that this process has had, in GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", type=int, default=SIZES)
    parser.add_argument("--one", nargs="?", const="", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        measure(options.rows[0], options.one)
        return
    print(
        "| rows | | s | s for `summary()` | counterexamples | s to read them | peak GB | on disk |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for rows in options.rows:
        temporary = tempfile.mkdtemp()
        folder = Path(temporary) / "run"
        try:
            for place in ("", str(folder), str(folder)):
                command = [sys.executable, __file__, str(rows), "--one", place]
                output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
                seen = json.loads(output.splitlines()[-1])
                files = [path for path in folder.rglob("*") if path.is_file()]
                size = f"{sum(path.stat().st_size for path in files) / 1e6:.0f} MB" if place else ""
                print(
                    f"| {rows:.0e} | {seen['run']} | {seen['seconds']:.1f} "
                    f"| {seen['summary']:.2f} | {seen['counterexamples']:,} "
                    f"| {seen['their seconds']:.2f} | {seen['GB']:.2f} | {size} |",
                    flush=True,
                )
        finally:
            shutil.rmtree(temporary)


if __name__ == "__main__":
    main()
