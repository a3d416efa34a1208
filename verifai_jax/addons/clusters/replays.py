"""Rows of a black box simulated again by the workers of an executor.

A simulator that exists only on the workers cannot be started here, and a run shared by many workers
would wait for one process.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int, Key, PyTree, UInt32

from verifai_jax.addons.clusters.executor_engine import TOGETHER, shipped
from verifai_jax.addons.clusters.executors import Shipment, gather
from verifai_jax.addons.clusters.worker import computing
from verifai_jax.core.compute.executors import Executor
from verifai_jax.core.compute.keys import as_key
from verifai_jax.core.compute.precision import reproducible_settings
from verifai_jax.core.display.progress import count_done
from verifai_jax.evaluation.resimulate import HostReplays
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem


class ExecutorReplays(HostReplays):
    """Replays of a problem on the host by an executor's workers.

    **Arguments:**
    - `problem`, `precision`, `key`: as in `HostReplays`.
    - `executor`: an executor with `submit`.
    """

    def __init__(
        self, problem: Problem, precision: str, key: Key[Any, ""], executor: Executor,
    ) -> None:  # fmt: skip
        super().__init__(problem, precision, key)
        self._executor, self._shipment = executor, shipped(problem, executor)

    def __call__(
        self, factor: int, each: Sequence[PyTree], numbers: Int[np.ndarray, " n"]
    ) -> list[Verdicts]:
        return [self._sent(features, numbers, factor, False) for features in each]

    def anew(self, features: PyTree, numbers: Int[np.ndarray, " n"]) -> list[Verdicts]:
        return [self._sent(features, numbers, 1, True)]

    def _sent(
        self, features: PyTree, numbers: Int[np.ndarray, " n"], factor: int, anew: bool
    ) -> Verdicts:
        system = self.problem.system
        backend = system.backend if system.backends else None
        how = (backend, self.precision, factor, anew)
        words = np.asarray(jax.random.key_data(self.key))
        step = TOGETHER if system.can_simulate_batch else 1
        futures = []
        for start in range(0, len(numbers), step):
            block = slice(start, start + step)
            leaves = [np.asarray(leaf)[block] for leaf in jax.tree.leaves(features)]
            given = (self._shipment, how, words, leaves, numbers[block])
            futures.append(self._executor.submit(replay_block, *given))
        found: dict[int, Verdicts] = {}

        def ended(index: int, result: dict[str, Any]) -> None:
            found[index] = Verdicts(**result)
            count_done(len(found[index].status))

        gather(futures, ended)
        return Verdicts.concatenate([found[index] for index in range(len(futures))])


@reproducible_settings()
def replay_block(
    shipment: Shipment[Problem], how: tuple[str | None, str, int, bool],
    words: UInt32[np.ndarray, "2"], leaves: Sequence[np.ndarray], numbers: Int[np.ndarray, " n"],
) -> dict[str, Any]:  # fmt: skip
    """Simulate rows again; called by a worker.

    **Arguments:**
    - `shipment`: the pickled problem.
    - `how`: backend, precision, divisor of the step, and whether to use a new copy of the system.
    - `words`: the two words of the key of the run's simulations.
    - `leaves`: the leaves of the features, `[n, ...]` each.
    **Returns:** `rho`, `status`, `violated` and `messages` of the rows.
    """
    backend, precision, factor, anew = how
    problem = shipment.thing
    if backend is not None:
        problem = problem.on_backend(backend)
    features = jax.tree.unflatten(jax.tree.structure(problem.space.feature_form), leaves)
    replays = HostReplays(problem, precision, as_key(words))
    with computing:
        [found] = replays.anew(features, numbers) if anew else replays(factor, [features], numbers)
    return {name: getattr(found, name) for name in ("rho", "status", "violated", "messages")}
