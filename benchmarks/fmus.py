"""Simulations of FMUs per second of CPU time, next to FMPy's own, and how far the results differ.

pip install fmpy
cmake -S Reference-FMUs -B build -DFMI_VERSION=2 -DCMAKE_BUILD_TYPE=Release && make -C build
python benchmarks/fmus.py build/fmus/*.fmu

The FMUs are those of github.com/modelica/Reference-FMUs, for FMI 2 and 3. Both sides use one
instance again, which is reset before each simulation, record the outputs at the same times of one
default experiment, and integrate to the same tolerance (FMPy by CVODE). They take turns in one
process, so that what else the machine does falls on both alike.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy import extract, instantiate_fmu, read_model_description, simulate_fmu

import verifai_jax as vj
from verifai_jax.addons.simulators.fmu.exchange import TOLERANCE

SECONDS = 0.1
"""CPU time of one turn, so that the clock's resolution does not matter."""


def prepare(
    file: Path, exchange: bool
) -> tuple[list[str], Callable[[], Any], Callable[[], Any]] | None:
    """Return outputs, and functions that simulate once, here and by FMPy; None without any."""
    description: Any = read_model_description(str(file))
    offered = description.modelExchange if exchange else description.coSimulation
    if offered is None:
        return None
    experiment = description.defaultExperiment
    duration = float(experiment.stopTime)
    dt = float(experiment.stepSize or duration / 500)
    there = vj.fmu_variables(file)
    outputs = [
        v.name for v in description.modelVariables
        if v.causality == "output" and v.type != "String" and not v.dimensions
        and v.name in there.index
    ]  # fmt: skip
    if not outputs:
        return None
    system = vj.fmu(
        file, duration=duration, dt=dt, outputs=outputs, exchange=exchange, workers=None
    )
    kind = "ModelExchange" if exchange else "CoSimulation"
    folder = extract(str(file), tempfile.mkdtemp())
    instance = instantiate_fmu(folder, description, kind)
    new = instance.getFMUState() if description.fmiVersion[0] == "3" else instance.getFMUstate()
    restore = instance.setFMUState if description.fmiVersion[0] == "3" else instance.setFMUstate

    def theirs() -> Any:
        restore(new)
        return simulate_fmu(
            folder, validate=False, stop_time=duration, output_interval=dt, output=outputs,
            relative_tolerance=TOLERANCE, record_events=False, fmi_type=kind,
            model_description=description, fmu_instance=instance,
        )  # fmt: skip

    return outputs, lambda: system({}), theirs


def difference(outputs: list[str], trace: Any, table: Any) -> float:
    """Return the greatest difference before an early end, as a share of a signal's range."""
    found = 0.0
    for signal, name in zip(trace.signals.values(), outputs, strict=True):
        ours, theirs = np.asarray(signal, float), np.asarray(table[name], float)
        length = min(len(ours) if trace.valid is None else int(trace.valid), len(theirs))
        gap = np.abs(ours[:length] - theirs[:length]).max()
        found = max(found, gap / max(np.ptp(theirs), 1e-9))
    return found


def rate(simulate: Callable[[], Any], count: int) -> float:
    """Return simulations per second of CPU time."""
    began = time.process_time()
    for _ in range(count):
        simulate()
    return count / (time.process_time() - began)


def main() -> None:
    """Print a row for each FMU and kind."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    print(f"FMPy {fmpy.__version__}\n")
    print("| FMU | FMI | kind | here, 1/s | FMPy, 1/s | ratio (quartiles) | difference |")
    print("|---|---|---|---|---|---|---|")
    for file in options.files:
        for exchange in (False, True):
            prepared = prepare(file, exchange)
            if prepared is None:
                continue
            outputs, *both = prepared
            gap = difference(outputs, *(side() for side in both))
            counts = [max(1, round(SECONDS * rate(side, 3))) for side in both]
            rows = np.array(
                [[rate(s, n) for s, n in zip(both, counts, strict=True)]
                 for _ in range(options.rounds)]
            )  # fmt: skip
            low, middle, high = np.quantile(rows[:, 0] / rows[:, 1], [0.25, 0.5, 0.75])
            version = read_model_description(str(file)).fmiVersion[0]
            kind = "model exchange" if exchange else "co-simulation"
            ends = np.median(rows, axis=0)
            print(
                f"| {file.stem} | {version} | {kind} | {ends[0]:z.0f} | {ends[1]:z.0f} | "
                f"{middle:z.2f} ({low:z.2f} to {high:z.2f}) | {gap:z.1e} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
