"""The simulation of (policy, block of samples) pairs by the workers of an executor.

    simulator = ExecutorSimulator(problem_of, policies, lanes=64, dim=3, executor=executor)
    simulator([0, 0, 1], points, first, key)            # as of `simulators.SharedSimulator`

A worker keeps the program of a structure, and on a host the problem of a policy, between blocks.
The result of a block depends only on its policy and samples, not on the worker.
"""

import time
import uuid
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt32

from verifai_jax.addons.clusters import executors
from verifai_jax.addons.estimation.certification.policy_groups import PolicyGroup
from verifai_jax.addons.estimation.certification.simulators import (
    SeparateSimulators,
    problem_with,
    shared_simulator,
)
from verifai_jax.core.compute.keys import as_key
from verifai_jax.core.compute.precision import truncate_silently
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem

AT_FIRST = 4
"""Blocks that a worker gets at a time, before it is known how long one takes."""
MAX_BLOCKS_PER_SECOND = 64
"""Blocks that a worker gets at a time at most, for a second of work."""
MAX_KEPT = 64
"""Groups of policies by themselves whose problems a worker keeps."""


class ExecutorSimulator:
    """A simulator on workers, for one or more policies of one structure; see the module.

    **Arguments:**
    - `shipment`: the pickled code for the workers, with `problem_of`.
    - `policies`: the policies as workers simulate them; those of one structure are padded.
    - `structure`: the structure of policies that share a program; None for those simulated alone.
    - `lanes`: samples in a block.
    - `dim`: coordinates of a sample.
    - `executor`: an executor with `submit`.

    `messages` holds the errors of policies whose simulation raised.
    """

    def __init__(
        self, shipment: executors.Shipment[Callable[[Any], Problem]], policies: Sequence[Any],
        structure: str | None, lanes: int, dim: int, executor: executors.Executor,
    ) -> None:  # fmt: skip
        self.lanes, self.messages = lanes, dict[int, str]()
        self._shipment, self._policies, self._structure = shipment, policies, structure
        self._dim, self._executor = dim, executor
        self._each = AT_FIRST
        # Of policies by themselves: what a worker keeps of them goes by this name.
        self._name = uuid.uuid4().hex

    def blocks_per_call(self) -> int:
        """Return the number of blocks in a call, enough to keep all workers busy for a while."""
        return 3 * executors.count_workers(self._executor) * self._each

    def __call__(
        self, members: Sequence[int], points: Float[np.ndarray, "blocks lanes d"],
        first: Int[np.ndarray, " blocks"], key: Key[Array, ""],
    ) -> list[Verdicts]:  # fmt: skip
        """Return the verdicts of the blocks, in order; arguments as of `simulators.Simulator`."""
        words = np.asarray(jax.random.key_data(key))
        share = -(-len(members) // executors.count_workers(self._executor))
        step = max(1, min(self._each, share))
        parts, futures = [], []
        for start in range(0, len(members), step):
            part = slice(start, start + step)
            numbers = sorted(set(members[part]))
            parts.append(numbers)
            futures.append(
                self._executor.submit(
                    simulate_blocks, self._shipment, self._structure, self.lanes, self._dim,
                    [(number, self._policies[number]) for number in numbers],
                    list(members[part]), points[part], first[part], words, self._name,
                )
            )  # fmt: skip
        found: dict[int, list[Verdicts]] = {}

        def ended(index: int, result: dict[str, Any]) -> None:
            arrays = zip(result["rho"], result["status"], result["violated"], strict=True)
            found[index] = [Verdicts(*block) for block in arrays]
            for number, message in result["messages"].items():
                self.messages.setdefault(number, message)
            each = result["seconds"] / max(len(found[index]), 1)
            wanted = executors.seconds_per_block(self._executor)
            maximum = MAX_BLOCKS_PER_SECOND * max(1, int(wanted / executors.SECONDS))
            self._each = max(1, min(maximum, int(wanted / max(each, 1e-9))))

        executors.gather(futures, ended)
        return [verdicts for index in range(len(parts)) for verdicts in found[index]]


@truncate_silently()
def simulate_blocks(
    shipment: executors.Shipment[Callable[[Any], Problem]],
    structure: str | None,
    lanes: int,
    dim: int,
    policies: Sequence[tuple[int, Any]],
    members: Sequence[int],
    points: Float[np.ndarray, "blocks lanes d"],
    first: Int[np.ndarray, " blocks"],
    words: UInt32[np.ndarray, "2"],
    name: str,
) -> dict[str, Any]:
    """Simulate blocks of policies; called by a worker.

    **Arguments:** those of `ExecutorSimulator`, but `policies` holds only the policies of these
    blocks, by number; `name` identifies the simulator of separately simulated policies.
    **Returns:** `rho`, `status` and `violated` of each block; `messages` by policy; `seconds`.
    """
    indices = {number: index for index, (number, _) in enumerate(policies)}
    weights = tuple(policy for _, policy in policies)
    if structure is not None:
        group = PolicyGroup(tuple(indices), weights, structure)
        simulator: Any = shared_simulator(shipment.thing, group, lanes, dim)
    else:
        simulator = _separate(shipment, policies, lanes, name)
        indices = {number: number for number in indices}
    started = time.perf_counter()
    verdicts = simulator([indices[member] for member in members], points, first, as_key(words))
    return {
        "rho": [each.rho for each in verdicts],
        "status": [each.status for each in verdicts],
        "violated": [each.violated for each in verdicts],
        "messages": {} if structure is not None else dict(simulator.messages),
        "seconds": time.perf_counter() - started,
    }


def _separate(
    shipment: executors.Shipment[Callable[[Any], Problem]], policies: Sequence[tuple[int, Any]],
    lanes: int, name: str,
) -> SeparateSimulators:  # fmt: skip
    """Return the simulators of policies by themselves, whose problems this worker keeps."""
    if name not in shipment.made:
        problems: dict[int, Problem] = {}
        shipment.made[name] = problems, SeparateSimulators(problems, lanes)
        for other in list(shipment.made)[:-MAX_KEPT]:
            del shipment.made[other]
    problems, simulators = shipment.made[name]
    for number, policy in policies:
        if number not in problems:
            problems[number] = problem_with(shipment.thing, policy)
    return simulators
