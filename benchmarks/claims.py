"""Measure again those claims of the README that take under a minute each, and compare.

    python -m benchmarks.claims                  # all of these
    python -m benchmarks.claims balance rare     # some

`CLAIMS.md` has a line for each claim of the README and of docs/overview.md: the sentence, the
command, the figure, the tolerance, and the commit. The script holds no figures itself, and ends
with 1 if a figure is off.
"""

import argparse
import re
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import verifai_jax as vj
from benchmarks.seeds import first_failures

CLAIMS = Path(__file__).with_name("CLAIMS.md")
COMMAND = re.compile(r"`python -m benchmarks\.claims (\w+)`")
HEAD = ("sentence", "command", "figure", "tolerance", "commit")


class Claim(NamedTuple):
    """A line of the table: the `tolerance` is `± 5`, `at least` or `at most` (the figure)."""

    sentence: str
    command: str
    figure: str
    tolerance: str
    commit: str

    @property
    def name(self) -> str | None:
        """Name of the measurement that takes under a minute; None for another command."""
        match = COMMAND.fullmatch(self.command)
        return None if match is None else match[1]

    def holds(self, measured: float) -> bool:
        """Return whether a measured figure is within the tolerance."""
        figure = float(self.figure)
        if self.tolerance == "at least":
            return measured >= figure
        if self.tolerance == "at most":
            return measured <= figure
        return abs(measured - figure) <= float(self.tolerance.removeprefix("±"))


def read_claims(text: str) -> list[Claim]:
    """Read the lines of the table.

    **Raises:** `ValueError` for a line without the five cells.
    """
    claims = []
    for line in text.splitlines():
        if not line.startswith("|") or line.startswith("|--"):
            continue
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if len(cells) != len(HEAD):
            raise ValueError(f"a claim has the cells {', '.join(HEAD)}; got {line!r}")
        if tuple(cells) != HEAD:
            claims.append(Claim(*cells))
    return claims


def pendulum(time: object, state: dict, control: object, features: dict) -> dict:
    """The plant of the README's first program."""
    torque = jnp.clip(-60 * state["angle"] - 15 * state["speed"], -4, 4)
    inertia, length = features["mass"] * features["length"] ** 2, features["length"]
    speed = 9.81 / length * jnp.sin(state["angle"]) + torque / inertia
    return {"angle": state["speed"], "speed": speed}


def upright() -> vj.Problem:
    """The problem of the README's first program."""
    return vj.Problem(
        "upright",
        space={
            "angle0": vj.Box(-0.3, 0.3),
            "mass": vj.Box(0.5, 2.0),
            "length": vj.Box(0.5, 1.5),
        },
        system=vj.ode(
            pendulum,
            lambda features, key: {"angle": features["angle0"], "speed": 0.0},
            dt=0.01,
            duration=3.0,
        ),
        spec="always[0, 3] abs(angle) <= 0.8",
        nominal={"angle0": 0.0, "mass": 1.0, "length": 1.0},
    )


def first_page() -> float:
    """Count the violations of the README's first program."""
    return float(len(vj.falsify(upright(), "uniform", 2000, progress=False).table.violating))


def first_page_shrunk() -> float:
    """Count the features away from nominal that are enough for its failure."""
    return float(vj.shrink(vj.falsify(upright(), "uniform", 2000, progress=False)).count)


def balance() -> float:
    """Count the simulations of `make falsify` that violate the property."""
    from specs.cartpole import balance as problem

    return float(len(vj.falsify(problem, "uniform", 20_000, progress=False).table.violating))


def balance_confirmed() -> float:
    """Count those of them that closer replays confirm."""
    from specs.cartpole import balance as problem

    run = vj.falsify(problem, "uniform", 20_000, progress=False)
    return float(run.verdict_counts.get("confirmed", 0))


def rare() -> float:
    """Count the simulations up to the first failure of what one sample in a thousand breaks."""
    from specs.cartpole import rare as problem

    return float(vj.falsify(problem, stop=vj.Stop(after=1), progress=False).simulations)


def rare_median() -> float:
    """Return the median of simulations up to that failure, over 50 seeds."""
    from specs.cartpole import rare as problem

    def first(seed: int) -> int:
        run = vj.falsify(problem, stop=vj.Stop(after=1), seed=seed, confirm=False, progress=False)
        return int(run.table.counterexamples.index[0]) + 1

    return statistics.median(map(first, range(50)))


def shrunk() -> float:
    """Count the features away from nominal that are enough for it."""
    from specs.cartpole import rare as problem

    return float(vj.shrink(vj.falsify(problem, stop=vj.Stop(after=1), progress=False)).count)


def rules_covered() -> float:
    """Return the share, in percent, of the failures that the first rule covers."""
    run = vj.falsify(upright(), "uniform", 20_000, progress=False)
    return 100 * vj.analysis.rules(run).rules[0].coverage


def rules_precision() -> float:
    """Return the precision of the first rule."""
    run = vj.falsify(upright(), "uniform", 20_000, progress=False)
    return vj.analysis.rules(run).rules[0].precision.estimate


def swept() -> float:
    """Count the configurations of the overview's sweep that are certified safe."""
    from envs.cartpole_task import CartPoleTask
    from specs.cartpole import balance_with

    study = vj.Study(
        "safe_training",
        space={"learning_rate": vj.LogUniform(3e-4, 1e-2), "length_range": vj.Box(0.0, 2.0)},
        trainer=vj.Trainer(CartPoleTask(), vj.rl.PPO(anneal=False), steps=32_768),
        problem=balance_with,
    )
    return float(len(vj.sweep(study, configurations=32, progress=False).safe))


def arch(name: str) -> Callable[[], float]:
    """Return the measurement of a requirement: the median simulations to the first failure."""

    def measure() -> float:
        from specs.arch import automatic_transmission

        problem = getattr(automatic_transmission, name)
        # A gradient counts as a second simulation.
        return float(np.median(first_failures(problem, "portfolio", 300, 1, range(5)).cost))

    return measure


MEASURES: dict[str, Callable[[], float]] = {
    "first_page": first_page,
    "first_page_shrunk": first_page_shrunk,
    "balance": balance,
    "balance_confirmed": balance_confirmed,
    "rare": rare,
    "rare_median": rare_median,
    "shrunk": shrunk,
    "rules_covered": rules_covered,
    "rules_precision": rules_precision,
    "swept": swept,
    **{name: arch(name) for name in ("at1", "at6b", "at6c")},
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and compare; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(MEASURES)}")
    chosen = parser.parse_args(arguments)
    if unknown := set(chosen.names) - set(MEASURES):
        parser.error(
            f"unknown claims {', '.join(sorted(unknown))}; there are {', '.join(MEASURES)}"
        )
    claims = [claim for claim in read_claims(CLAIMS.read_text()) if claim.name is not None]
    wrong = 0
    for claim in claims:
        name = claim.name or ""
        if chosen.names and name not in chosen.names:
            continue
        began = time.perf_counter()
        measured = MEASURES[name]()
        good = claim.holds(measured)
        wrong += not good
        print(
            f"{'ok   ' if good else 'WRONG'} {name}: {measured:.4g}, claimed {claim.figure} "
            f"({claim.tolerance}), {time.perf_counter() - began:.0f} s",
            flush=True,
        )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
