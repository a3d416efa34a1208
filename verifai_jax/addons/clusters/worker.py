"""One block of rows of a problem, from points to verdicts: the work of an executor's worker.

    executor.submit(evaluate_block, shipment, mode, key, first, u, temperature)

A worker keeps the problem and its compiled programs between blocks, and stores programs on its disk
(`VERIFAI_JAX_CACHE`). Blocks use the same number of lanes per device as on one machine, so their
bits do not depend on the division into blocks.
"""

import threading
import time
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, UInt32

from verifai_jax.addons.clusters.executors import Shipment
from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.devices import describe_processor
from verifai_jax.core.compute.keys import as_key
from verifai_jax.core.compute.precision import reproducible_settings
from verifai_jax.evaluation.engine import Engine
from verifai_jax.evaluation.guidance import Guidance
from verifai_jax.evaluation.host_engine import HostEngine
from verifai_jax.evaluation.remarks import Remarks
from verifai_jax.evaluation.row import CubePoints
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem

ARRAYS = (
    "rho", "status", "violated", "gradient", "clauses", "clause_gradients", "coverage_ids",
    "guidance",
)  # fmt: skip
"""Parts of verdicts that come back as arrays under their names."""


class BlockMode(NamedTuple):
    """The options for evaluating blocks, equal for all blocks of a run.

    - `lanes`: number of rows that a device processes together.
    - `gradient`, `clauses`, `precision`: as in `Engine`.
    - `padded_to`: minimum number of rows whose features are computed together, for a host system.
    - `backend`: the backend of a system that has several.
    - `guidance`: additional results for a search.
    - `given`: whether points are rows of given features, as in `CubePoints`.
    """

    lanes: int
    gradient: bool
    clauses: bool
    precision: str
    padded_to: int
    backend: str | None
    guidance: Guidance
    given: bool = False


ENGINES: Slot[tuple[BlockMode, int], Engine] = Slot("engines of blocks")
"""Engines by mode and number of devices."""
HOST_ENGINES: Slot[BlockMode, HostEngine] = Slot("host engines of blocks")
# An executor may work in threads of one process. A compiled block keeps all cores busy by itself,
# and a simulator is not made for two simulations at a time.
computing = threading.Lock()


@reproducible_settings()
def evaluate_block(
    shipment: Shipment[Problem], mode: BlockMode, key: UInt32[np.ndarray, "2"], first: int,
    u: Float[np.ndarray, "n d"], temperature: Float[np.ndarray, " n"] | float,
) -> dict[str, Any]:  # fmt: skip
    """Simulate and evaluate the rows `first` to `first + n - 1`; called by a worker.

    **Arguments:**
    - `shipment`: the pickled problem.
    - `mode`: the options of the evaluation.
    - `key`: words of the run's random key.
    - `first`: number of the first row.
    - `u`: points of the unit cube.
    - `temperature`: the temperature of the smooth robustness, one for all rows or one for each.
    **Returns:** arrays by the names of `ARRAYS`; the `leaves` of the features; `messages`; the
    `seconds` without compilation; the `processor`; the engine's `notes`; the `remarks` of the
    simulations; the `question` that this answers.
    """
    problem = shipment.thing
    if mode.backend is not None:
        problem = problem.on_backend(mode.backend)
    with computing:
        if problem.black_box:
            notes: tuple[str, ...] = ()
            verdicts, seconds, remarks = _on_host(problem, mode, key, first, u)
        else:
            remarks = Remarks()
            verdicts, seconds, notes = _compiled(problem, mode, key, first, u, temperature)
    result: dict[str, Any] = {
        name: value for name in ARRAYS if (value := getattr(verdicts, name)) is not None
    }
    result["leaves"] = [np.asarray(leaf) for leaf in jax.tree.leaves(verdicts.features)]
    result |= {"messages": verdicts.messages, "seconds": seconds, "notes": notes}
    result["remarks"] = remarks.to_data()
    result["question"] = question_of(shipment, key, first, u)
    return result | {"processor": describe_processor()}


def question_of(
    shipment: Shipment[Problem], key: UInt32[np.ndarray, "2"], first: int,
    u: Float[np.ndarray, "n d"],
) -> tuple[str, tuple[int, ...], int, int]:  # fmt: skip
    """Return a value that identifies a call of `evaluate_block` among all calls of a run."""
    return shipment.token, tuple(int(word) for word in key), int(first), len(u)


def _on_host(
    problem: Problem, mode: BlockMode, key: UInt32[np.ndarray, "2"], first: int,
    u: Float[np.ndarray, "n d"],
) -> tuple[Verdicts, float, Remarks]:  # fmt: skip
    engine = problem.programs.get(
        HOST_ENGINES,
        mode,
        lambda: HostEngine(problem, mode.precision, guidance=mode.guidance, given=mode.given),
    )
    started, engine.remarks = time.perf_counter(), Remarks()
    verdicts = engine.evaluate(u, as_key(key), first, padded_to=mode.padded_to)
    return verdicts, time.perf_counter() - started, engine.remarks


def _compiled(
    problem: Problem, mode: BlockMode, key: UInt32[np.ndarray, "2"], first: int,
    u: Float[np.ndarray, "n d"], temperature: Float[np.ndarray, " n"] | float,
) -> tuple[Verdicts, float, tuple[str, ...]]:  # fmt: skip
    devices = jax.local_devices()
    devices = devices[: max(1, min(len(devices), -(-len(u) // mode.lanes)))]
    step = mode.lanes * len(devices)
    engine = problem.programs.get(
        ENGINES,
        (mode, len(devices)),
        lambda: Engine(
            problem, step, mode.gradient, devices, mode.precision, mode.clauses,
            inputs=CubePoints(problem, mode.given, mode.precision), lanes=mode.lanes,
            guidance=mode.guidance,
        ),
    )  # fmt: skip
    engine.compile()
    started, compiled, parts = time.perf_counter(), engine.compile_seconds, []
    for begin in range(0, len(u), step):
        some = temperature
        if isinstance(temperature, np.ndarray) and temperature.ndim:
            some = temperature[begin : begin + step]
        points = u[begin : begin + step]
        parts.append(engine.evaluate(points, as_key(key), first + begin, some))
    seconds = time.perf_counter() - started - (engine.compile_seconds - compiled)
    return Verdicts.concatenate(parts), seconds, engine.notes
