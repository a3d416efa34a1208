"""The falsification competition's table of results, which its validation reads.

    python benchmarks/arch_validation.py results.csv                        # instance 2: an hour
    python benchmarks/arch_validation.py results.csv at1 cc3 --seeds 10 --instance 1

A line for each requirement and seed: the first counterexample that closer replays confirm
(`vj.confirm`), or else the simulation that came nearest. The columns are those that the
competition's validator reads (FalStar, `Validation.scala`): `system`, `property` (by its names,
such as `(NN 0.005 0.03)`), `instance`, `simulations`, `time` in seconds, `robustness`, `falsified`,
`stop time`, `parameters` and `input`. An input is a matrix `[time value ...; ...]`: where signals
are constant in pieces a line where one begins, otherwise a line every 0.1 s.

The validator simulates the original models; what is off by less than a hundredth may fall there on
the other side of zero. Its own names for requirements of this project that the competition does not
have are missing, so these are not written.
"""

import argparse
import csv
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

import verifai_jax as vj
from benchmarks.arch import BUDGETS, requirements
from verifai_jax.core.values.waveform import Waveform, control_times

COLUMNS = (
    "system",
    "property",
    "instance",
    "simulations",
    "time",
    "robustness",
    "falsified",
    "stop time",
    "parameters",
    "input",
)
INPUTS = {
    "AT": ("throttle", "brake"),
    "CC": ("throttle", "brake"),
    "NN": ("Ref",),
    "SC": ("steam",),
    "AFC": ("throttle", "rpm"),
    "PM": ("LRL",),
    "F16": (),
}
PARAMETERS = {"F16": ("phi", "theta", "psi")}
PROPERTIES = {
    "nn": "(NN 0.005 0.03)",
    "nn_wide": "(NN 0.005 0.04)",
    "nnx": "NNx",
    "ccx": "CCx",
    "sc": "SCa",
    "afc27": "(AFC27 0.008)",
    "afc29": "(AFC29 0.007)",
    "afc33": "(AFC33 0.007)",
    "at6a": "AT6a",
    "at6b": "AT6b",
    "at6c": "AT6c",
    "at6abc": "AT6abc",
    "f16a": "F16a",
    **{name: name.upper() for name in ("at1", "at2", "at51", "at52", "at53", "at54", "pm")},
    **{name: name.upper() for name in ("cc1", "cc2", "cc3", "cc4", "cc5")},
}
SAMPLED = 0.1
"""Seconds between two lines of an input that is not constant in pieces."""


def system_of(name: str) -> str:
    """Return the competition's name of the model that a requirement is about."""
    return next(system for system in INPUTS if name.startswith(system.lower()))


def input_matrix(
    features: Mapping[str, Any], inputs: tuple[str, ...], duration: float
) -> Float[np.ndarray, "lines columns"]:
    """Return the input signals of a simulation, a line `[time, value, ...]` each.

    **Arguments:**

    - `features`: of the simulation, by name; numbers are inputs that stay.
    - `inputs`: names of the signals, in the order of the model's ports.
    - `duration`: of the simulation in seconds.
    """
    signals = [features[name] for name in inputs]
    signals = [each.over(duration) if isinstance(each, Waveform) else each for each in signals]
    waves = [each for each in signals if isinstance(each, Waveform)]
    constant = all(wave.hold == "constant" for wave in waves)
    if constant:
        starts = [control_times(len(wave.knots), wave.hold, wave.times, duration) for wave in waves]
        times = np.unique(np.round(np.concatenate([[0.0], *starts]), 9))
    else:
        times = np.linspace(0.0, duration, round(duration / SAMPLED) + 1)
    # A piece is looked up in its middle: its beginning may be a rounding before it.
    ends = np.append(times[1:], duration)
    at = (times + ends) / 2 if constant else times
    columns = [
        np.asarray(each(at)) if isinstance(each, Waveform) else np.full(len(at), float(each))
        for each in signals
    ]
    return np.column_stack([times, *columns])


def as_matrix(rows: Float[np.ndarray, "lines columns"]) -> str:
    """Return a matrix as the validator reads it."""
    return "[" + "; ".join(" ".join(repr(float(value)) for value in row) for row in rows) + "]"


def line(problem: vj.Problem, budget: int, seed: int) -> dict[str, Any]:
    """Falsify a requirement from one seed, and return its line of the table."""
    began = time.perf_counter()
    run = vj.falsify(
        problem, "portfolio", budget, batch=1, seed=seed, stop=vj.Stop(after=1), progress=False
    )
    seconds = time.perf_counter() - began
    name = problem.name.removesuffix("_instance1")
    system = system_of(name)
    claimed = run.table.counterexamples
    row = claimed.iloc[0] if len(claimed) else run.best
    features = problem.space.from_row(row)
    parameters = [float(features[each]) for each in PARAMETERS.get(system, ())]
    return {
        "system": system,
        "property": PROPERTIES[name],
        "instance": 1 if problem.name.endswith("_instance1") else 2,
        "simulations": run.simulations,
        "time": f"{seconds:.3f}",
        "robustness": repr(float(row["rho"])),
        "falsified": "yes" if len(claimed) else "no",
        "stop time": problem.system.duration,
        "parameters": as_matrix(np.array([parameters])),
        "input": as_matrix(input_matrix(features, INPUTS[system], problem.system.duration)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--budget", type=int)
    parser.add_argument("--instance", type=int, choices=[1, 2], default=2)
    chosen = parser.parse_args()
    problems = requirements()
    suffix = "_instance1" if chosen.instance == 1 else ""
    names = [f"{name}{suffix}" for name in chosen.names or PROPERTIES]
    if unknown := [name for name in names if chosen.names and name not in problems]:
        parser.error(f"no requirement {', '.join(unknown)}; there are {', '.join(problems)}")
    with chosen.file.open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        for name in names:
            if name not in problems:
                continue
            budget = chosen.budget or BUDGETS.get(name.removesuffix("_instance1"), 300)
            lines = [line(problems[name], budget, seed) for seed in range(chosen.seeds)]
            table.writerows(lines)
            file.flush()
            falsified = sum(each["falsified"] == "yes" for each in lines)
            print(f"{name}: {falsified} of {len(lines)}", flush=True)


if __name__ == "__main__":
    main()
