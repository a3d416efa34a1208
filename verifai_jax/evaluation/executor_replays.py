"""Replays of a host system's rows by the workers of an executor; as `replays.HostReplays`.

    replays = ExecutorReplays(problem, "float32", key, executor=executor)
    [verdicts] = replays(1, [features], numbers)        # [n] rows, simulated once more

A simulator that is only where the workers are cannot be started here, and a run that many workers
share would wait for one process.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int, Key, PyTree, UInt32

from verifai_jax.core.executors import Executor, Shipment, check_executor, gather, ship
from verifai_jax.core.keys import as_key
from verifai_jax.core.precision import reproducible_settings
from verifai_jax.core.progress import count_done
from verifai_jax.evaluation.executor_engine import SHIPMENTS, TOGETHER, identity
from verifai_jax.evaluation.replays import HostReplays
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.evaluation.worker import computing
from verifai_jax.problem.problem import Problem


class ExecutorReplays(HostReplays):
    """Replays of a problem that runs on the host, on workers.

    **Arguments:**

    - `problem`, `precision`, `key`: as of `HostReplays`.
    - `executor`: with `submit`.
    - `target`: name of the problem, for an executor that cannot send it.
    """

    def __init__(
        self,
        problem: Problem,
        precision: str,
        key: Key[Any, ""],
        executor: Executor,
        target: str | None = None,
    ) -> None:
        super().__init__(problem, precision, key)
        check_executor(executor)
        self._executor = executor
        self._shipment = problem.programs.get(
            SHIPMENTS,
            (type(executor).__module__ + type(executor).__name__, target),
            lambda: ship(problem, executor, target, identity),
        )

    def __call__(
        self, factor: int, each: Sequence[PyTree], numbers: Int[np.ndarray, " n"]
    ) -> list[Verdicts]:
        """Simulate the rows of these numbers again, with a `factor` times smaller step."""
        return [self._sent(features, numbers, factor, False) for features in each]

    def anew(self, features: PyTree, numbers: Int[np.ndarray, " n"]) -> list[Verdicts]:
        """Simulate rows again, by a system without memory of earlier ones where it can be made."""
        return [self._sent(features, numbers, 1, True)]

    def _sent(
        self, features: PyTree, numbers: Int[np.ndarray, " n"], factor: int, anew: bool
    ) -> Verdicts:
        system = self.problem.system
        backend = system.backend if system.backends else None
        words = np.asarray(jax.random.key_data(self.key))
        step = TOGETHER if system.can_simulate_batch else 1
        futures = []
        for start in range(0, len(numbers), step):
            block = slice(start, start + step)
            leaves = [np.asarray(leaf)[block] for leaf in jax.tree.leaves(features)]
            how = (backend, self.precision, factor, anew)
            futures.append(
                self._executor.submit(
                    replay_block, self._shipment, how, words, leaves, numbers[block]
                )
            )
        found: dict[int, Verdicts] = {}

        def ended(place: int, result: dict[str, Any]) -> None:
            found[place] = Verdicts(**result)
            count_done(len(found[place].status))

        gather(futures, ended)
        return Verdicts.concatenate([found[place] for place in range(len(futures))])


@reproducible_settings()
def replay_block(
    shipment: Shipment[Problem],
    how: tuple[str | None, str, int, bool],
    words: UInt32[np.ndarray, "2"],
    leaves: Sequence[np.ndarray],
    numbers: Int[np.ndarray, " n"],
) -> dict[str, Any]:
    """Simulate rows again; called by a worker.

    **Arguments:**

    - `shipment`: with the problem.
    - `how`: backend, precision, by how much the step is smaller, and whether the system is to be
      made anew.
    - `words`: of the key of the run's simulations.
    - `leaves`: of the features, `[n, ...]` each.
    - `numbers`: of the rows.

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
    parts = ("rho", "status", "violated", "messages")
    return {name: getattr(found, name) for name in parts}
