"""Scenes as inputs of simulators on the host, in this process or in others.

Each process compiles the program once. A simulation gets Scenic's own `Scene`, or runs it in the
simulator that the program names, or in Scenic's Newtonian one.
"""

import math
import os
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from verifai_jax.addons.scenic.recipe import Recipe
from verifai_jax.addons.scenic.sampling import LOCK, SEED, digest
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import require, unknown_name
from verifai_jax.core.values.trace import Trace


@dataclass(frozen=True)
class OnScenes:
    """A function of Scenic's scenes, turned into a function of features.

    - `recipe`: the recipe of the program.
    - `function`: `(scene) -> Trace`, or `(scene, seed) -> Trace` with `seeded`.
    """

    recipe: Recipe
    function: Callable[..., Trace]
    seeded: bool

    @property
    def __module__(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.function.__module__

    def __call__(self, features: Mapping[str, Any], seed: int) -> Trace:
        _, sampling = self.recipe.compiled()
        scene = sampling.scene(sampling.values(features), features)
        return self.function(scene, seed) if self.seeded else self.function(scene)


class SimulationRejected(RuntimeError):
    """An error for a simulation that violates a requirement of its program over time."""


@dataclass(frozen=True)
class ScenicSimulation:
    """A dynamic scenario in its simulator, with its records as a trace.

    - `recipe`: the recipe of the program.
    - `steps`: the number of steps of the simulation.
    - `records`: names of `record` statements; all when empty.
    - `dt`: duration of a step in seconds; the simulator's own when None.
    """

    recipe: Recipe
    steps: int
    records: tuple[str, ...]
    dt: float | None

    def __call__(self, features: Mapping[str, Any], seed: int) -> Trace:
        """Simulate a scene; behaviours draw from the seed of the row, and from a feature `seed`.

        **Raises:** `SimulationRejected` where a requirement over time is broken.
        """
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        _, sampling = self.recipe.compiled()
        scene = sampling.scene(sampling.values(features), features)
        if SEED in features:
            seed = digest(str(seed), f"{float(features[SEED]):z.9g}")
        with LOCK:
            random.seed(seed)
            np.random.seed(seed % 2**32)  # noqa: NPY002 - what Scenic draws from
            simulator = _simulator(sampling.scenario)
            options: dict[str, Any] = {} if self.dt is None else {"timestep": self.dt}
            simulation = simulator.simulate(
                scene, maxSteps=self.steps, maxIterations=1, verbosity=0, **options
            )
        if simulation is None:
            raise SimulationRejected(
                "the simulation breaks a requirement of the program over time, so Scenic drops it"
            )
        return self._trace(simulation)

    def _trace(self, simulation: Any) -> Trace:
        recorded = simulation.result.records
        names = self.records or tuple(n for n, r in recorded.items() if _is_series(r))
        if not names:
            raise ValueError(NOTHING_RECORDED)
        for name in names:
            if name not in recorded:
                raise unknown_name("record", name, recorded)
        series = {name: recorded[name] for name in names}
        signals = {name: _column(name, rows) for name, rows in series.items()}
        length = min(map(len, signals.values()))
        signals = {name: column[:length] for name, column in signals.items()}
        step = float(getattr(simulation, "timestep", 0) or self.dt or math.nan)
        return Trace(signals, dt=step)


def _is_series(record: Any) -> bool:
    return isinstance(record, Sequence) and bool(record) and np.ndim(record[0]) == 1


def _column(name: str, rows: Sequence[tuple[int, Any]]) -> np.ndarray:
    """Return the values of a record, numbers or vectors."""
    try:
        values = [tuple(value) if hasattr(value, "coordinates") else value for _, value in rows]
        column = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"record {name!r} holds no numbers: {error}") from error
    return column.astype(np.float32)


def _simulator(scenario: Any) -> Any:
    """Return the simulator of the program, once for each; the Newtonian one where it has none."""
    made = getattr(scenario, "_verifai_jax_simulator", None)
    if made is None:
        if scenario.simulator is not None:
            made = scenario.getSimulator()
        else:
            newtonian = require("scenic.simulators.newtonian.simulator", "scenic")
            made = newtonian.NewtonianSimulator()
        if hasattr(made, "render"):
            made.render = False  # A window of its own in each worker helps nobody.
        scenario._verifai_jax_simulator = made
    return made


NOTHING_RECORDED = (
    "the program records nothing over time: add `record EXPRESSION as NAME` to it, such as "
    "`record (distance from ego to other) as gap`"
)


def check_simulation(
    steps: int, records: Sequence[str], dt: float | None, scenario: Any
) -> tuple[str, ...]:
    """Check the options of a simulation, and return its records.

    **Raises:** `ValueError` for steps that are not a positive integer, records that are not names
    or that the program does not record over time, and a step duration that is not positive.
    """
    check_count("steps", steps)
    if isinstance(records, str) or not all(isinstance(name, str) for name in records):
        raise ValueError(f"records must be names, such as ('gap',); got {records!r}")
    if dt is not None and not (isinstance(dt, int | float) and 0 < dt < math.inf):
        raise ValueError(f"dt must be a positive number of seconds; got {dt!r}")
    if getattr(scenario.dynamicScenario, "_compose", None) is not None:
        return tuple(records)  # What is composed may record too, which shows when it runs.
    series = [each.name for each in scenario.recordedExprs]
    single = [*scenario.recordedInitialExprs, *scenario.recordedFinalExprs]
    if not series:
        raise ValueError(NOTHING_RECORDED)
    for name in records:
        if name in (each.name for each in single):
            raise ValueError(
                f"record {name!r} is one value, at the first or last step, and no signal: write "
                f"`record EXPRESSION as {name}` for one of each step"
            )
        if name not in series:
            raise unknown_name("record", name, series)
    return tuple(records)
