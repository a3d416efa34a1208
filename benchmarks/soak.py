"""Fuzzers for as long as one likes: hostile texts and messages, damaged folders, kills, memory.

    python benchmarks/soak.py --seconds 120                    # each of them for two minutes
    python benchmarks/soak.py formulas --cases 50000 --seed 7
    python benchmarks/soak.py folders --case 1234              # one case again, with its traceback

Cases are made from their numbers, which begin at a million times the seed: the same seed gives the
same cases. What is broken is printed with the number of its case, and the exit status is then 1.
`memory` is one run of so many seconds, whose memory beyond its own rows must not grow.
"""

import argparse
import contextlib
import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.faults import folders, formulas, kills, memory, messages, stores
from benchmarks.faults.cases import Tally, tally

PER_SEED = 1_000_000
"""Numbers of cases that a seed has for itself."""


@contextlib.contextmanager
def _fuzzer(name: str) -> Iterator[Callable[[int], str]]:
    match name:
        case "formulas":
            yield formulas.case
        case "folders":
            yield folders.case
        case "stores":
            yield stores.case
        case "kills":
            yield kills.case
        case "messages":
            with messages.fire() as fire:
                yield fire.case


FUZZERS = ("formulas", "folders", "stores", "messages", "kills")


def main() -> int:
    """Run the fuzzers that are named, one after the other, and print what came of their cases."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", choices=[*FUZZERS, "memory", []], default=[])
    parser.add_argument("--seconds", type=float, default=120.0, help="for each of them")
    parser.add_argument("--cases", type=int, help="at most, of each of them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="this one alone")
    given = parser.parse_args()
    for name in ("verifai_jax.remote", "verifai_jax.remote_client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    broken = False
    for name in given.names or (*FUZZERS, "memory"):
        if name == "memory":
            report = memory.soak(given.seconds)
            broken |= report.grown > memory.MAX_GROWTH_GB
            print(f"memory: {report}", flush=True)
            continue
        with _fuzzer(name) as case:
            if given.case is not None:
                print(f"{name} {given.case}: {case(given.case)}")
                continue
            found: Tally = tally(case, given.seed * PER_SEED, given.cases, given.seconds)
        broken |= bool(found.broken)
        print(f"{name}: {found}", flush=True)
    return int(broken)


if __name__ == "__main__":
    sys.exit(main())
