"""The memory of a run that goes on for long."""

import gc
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import verifai_jax as vj
from benchmarks.faults import kills

MAX_GROWTH_GB = 0.3
"""Memory beyond that of its rows by which a run may grow once it is under way."""
EVERY = 1.0
"""Seconds between two looks at the memory."""


@dataclass(frozen=True)
class Report:
    """What one run took, in seconds and GB.

    - `begun`: resident memory after a fifth of the time.
    - `largest`: the most of it in the second half.
    - `grown`: the difference, beyond the memory that the rows would take.
    """

    seconds: float
    rows: int
    begun: float
    largest: float
    grown: float

    def __str__(self) -> str:
        return (
            f"{self.rows:,} rows in {self.seconds:.0f} s; {self.begun:.2f} GB resident after a "
            f"fifth of the time, at most {self.largest:.2f} GB in the second half, "
            f"{self.grown:.2f} GB of the growth beyond that of the rows themselves"
        )


def resident() -> float:
    """Return the resident memory of this process, in GB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e9


def simulate(features):
    """A black box that takes a millisecond, and so leaves the machine to others."""
    time.sleep(0.001)
    return kills.simulate(features)


def soak(seconds: float) -> Report:
    """Falsify a black box for so long by a search that learns, with a folder and confirmation."""
    problem = vj.Problem("ramp", kills.SPACE, vj.blackbox(simulate), "always x <= 1.9")
    seen: list[tuple[float, float]] = []
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(EVERY):
            seen.append((time.monotonic(), resident()))

    watcher = threading.Thread(target=watch, daemon=True)
    begun = time.monotonic()
    watcher.start()
    with tempfile.TemporaryDirectory() as root:
        run = vj.falsify(
            problem,
            "cross_entropy",
            1_000_000_000,
            batch=256,
            stop=vj.Stop(seconds=seconds),
            folder=Path(root) / "run",
            progress=False,
        )
        ended.set()
        watcher.join()
        gc.collect()
        table = run.table.all
        rows, size = len(table), table.memory_usage(deep=True).sum() / 1e9
    early = next((m for t, m in seen if t - begun > seconds / 5), seen[0][1])
    last = max(m for t, m in seen if t - begun > seconds / 2)
    return Report(time.monotonic() - begun, rows, early, last, last - early - 0.8 * size)
