"""Memory and time of long runs: uniform sampling of a trivial system, in memory and with a folder.

    python benchmarks/large_runs.py                     # 1e6, 1e7 and 1e8 rows
    python benchmarks/large_runs.py 50_000_000          # other sizes

Each run has a process of its own, whose peak of resident memory (getrusage) is that of everything:
the interpreter, JAX, the run, its summary. A second process loads the folder and reads its
counterexamples, without the other rows. A third run is killed with SIGKILL at a random moment;
another process goes on with it, and says how long it took until it had added a batch, and all. The
names of the files of a table have their checksums: those of the killed run are compared with those
of the run that nobody killed.
"""

import argparse
import json
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SIZES = (1_000_000, 10_000_000, 100_000_000)
MAX_IN_MEMORY = 50_000_000
"""Rows beyond which a run without a folder is left out."""


def measure(rows: int, folder: str, resumes: bool) -> None:
    """Run, load or resume a run, and print what it took."""
    import jax.numpy as jnp

    import verifai_jax as vj

    def system(features, key):
        return vj.Trace({"x": features["a"] * jnp.ones(3)}, dt=0.1)

    problem = vj.Problem("line", {"a": vj.Box(0, 1)}, system, "always x <= 0.999")
    before, begun = peak(), time.perf_counter()
    loads = bool(folder) and Path(folder).exists()
    kind = "loaded" if loads else "with a folder" if folder else "in memory"
    if resumes:
        there = vj.load(folder, problem)
        first = vj.resume(folder, problem, budget=len(there.table) + there.batch, progress=False)
        kind = (
            f"killed at {len(there.table):,}; another batch after "
            f"{time.perf_counter() - begun:.1f} s"
        )
        run = first
        if first.simulations < rows:
            run = vj.resume(folder, problem, budget=rows, progress=False)
    elif loads:
        run = vj.load(folder)
    else:
        run = vj.falsify(problem, "uniform", rows, folder=folder or None, progress=False)
    ended = time.perf_counter()
    first_line = run.summary().splitlines()[0]
    summed = time.perf_counter()
    failures = len(run.table.counterexamples)
    read = time.perf_counter()
    assert run.simulations == rows, first_line
    result = {
        "rows": rows,
        "run": kind,
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


def command(rows: int, target: str, *more: str) -> list[str]:
    """Return the command of one measurement."""
    return [sys.executable, __file__, str(rows), "--one", target, *more]


def kill_in_the_middle(rows: int, folder: Path, seconds: float) -> None:
    """Begin a run and kill it, at a random moment of the seconds that it would take."""
    process = subprocess.Popen(command(rows, str(folder)), stdout=subprocess.DEVNULL)
    while not (folder / "search.state").exists() and process.poll() is None:
        time.sleep(0.01)
    time.sleep(random.uniform(0.1, 0.8) * seconds)
    process.kill()
    process.wait()


def table_files(folder: Path) -> list[str]:
    """Return the names of the files of a table, which have their checksums."""
    return sorted(path.name for path in (folder / "table").glob("*.parquet"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", type=int, default=SIZES)
    parser.add_argument("--one", nargs="?", const="", help=argparse.SUPPRESS)
    parser.add_argument("--resume", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        measure(options.rows[0], options.one, options.resume)
        return
    print(
        "| rows | | s | s for `summary()` | counterexamples | s to read them | GB before | peak GB "
        "| on disk |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for rows in options.rows:
        temporary = Path(tempfile.mkdtemp())
        folder, killed = temporary / "run", temporary / "killed"
        seconds = 0.0
        try:
            for target, resumes in (("", False), (folder, False), (folder, False), (killed, True)):
                if not target and rows > MAX_IN_MEMORY:
                    continue
                if resumes:
                    kill_in_the_middle(rows, killed, seconds)
                more = ("--resume",) if resumes else ()
                output = subprocess.run(
                    command(rows, str(target), *more), check=True, capture_output=True, text=True
                ).stdout
                seen = json.loads(output.splitlines()[-1])
                if target == folder and not seconds:
                    seconds = seen["seconds"]
                files = [path for path in Path(target or temporary).rglob("*") if path.is_file()]
                size = (
                    f"{sum(path.stat().st_size for path in files) / 1e6:.0f} MB" if target else ""
                )
                print(
                    f"| {rows:.0e} | {seen['run']} | {seen['seconds']:.1f} "
                    f"| {seen['summary']:.2f} | {seen['counterexamples']:,} "
                    f"| {seen['their seconds']:.2f} | {seen['GB before']:.2f} | {seen['GB']:.2f} "
                    f"| {size} |",
                    flush=True,
                )
            same = table_files(folder) == table_files(killed)
            print(f"\nThe files of the two tables are {'the same' if same else 'different'}.\n")
        finally:
            shutil.rmtree(temporary)


if __name__ == "__main__":
    main()
