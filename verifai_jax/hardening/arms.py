"""The policies of hardening, stage by stage: one arm with counterexamples, one with the prior.

arms = TaskArms(trainer, values, stages, seed, cache, mixture, ("hardened", "randomised"))
arms.mix(1, {"hardened": (shares, centres), "randomised": (shares, none)})
arms.policies(1)                                    # trained up to the second stage, or cached

Arms share the training seed, so that up to the first stage they are one training, and afterwards
take the same number of environment steps, wherever an episode begins.
"""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
import pandas as pd
from jaxtyping import Float

from verifai_jax.core.atomic_files import replacing
from verifai_jax.features import FeatureSpace
from verifai_jax.features.choice import Constant
from verifai_jax.hardening.mixture import HardeningError, MixtureTask
from verifai_jax.rl.batched_training import BatchedTraining, Configuration
from verifai_jax.rl.policy import Policy
from verifai_jax.store.cache import Cache
from verifai_jax.sweeps.clock import Clock
from verifai_jax.sweeps.function_runs import FunctionRuns
from verifai_jax.sweeps.study import Study
from verifai_jax.sweeps.trainer import FunctionTrainer, Trainer

Mix = tuple[tuple[float, float, float], Float[np.ndarray, "n d"]]
"""Shares of episodes, as `MixtureTask` has them, and the centres of neighbourhoods."""
EPISODES = "episodes"
"""Hyper-parameter by which a function that trains gets the file of the features to train on."""
DRAWN = 4096
"""Features in that file."""


class TaskArms:
    """The arms of a task, trained side by side by one compiled program."""

    def __init__(
        self,
        trainer: Trainer,
        values: Mapping[str, object],
        stages: Sequence[int],
        seed: int,
        cache: Cache,
        mixture: MixtureTask,
        arms: Sequence[str],
    ) -> None:
        configuration = trainer.configuration(values, seed)
        configuration.check()
        self.names, self.stages, self._cache, self._mixture = tuple(arms), stages, cache, mixture
        self._form = jax.tree.structure(trainer.untrained_policy(trainer.algorithm_name(values)))
        one = Configuration(mixture, configuration.algorithm, stages[-1], seed)
        self._batch = BatchedTraining([one] * len(self.names))
        self._mixes: dict[int, Mapping[str, Mix]] = {}
        self._reached = -1

    def mix(self, stage: int, mixes: Mapping[str, Mix]) -> None:
        """Say what the episodes are drawn from on the way to a stage."""
        self._mixes[stage] = mixes

    def policies(self, stage: int) -> list[Any]:
        """Return the policy of each arm at a stage, trained if it is not cached."""
        names = [f"training/{stage}/{arm}" for arm in self.names]
        stored = [self._cache.get(name) for name in names]
        if any(arrays is None for arrays in stored):
            # A training that was cut off is repeated from its beginning, with the same numbers.
            for at in range(self._reached + 1, stage + 1):
                self._train(at)
            trained = [self._batch.policy(number) for number in range(len(self.names))]
            leaves = [jax.tree.leaves(policy) for policy in trained]
            self._cache.put(
                {
                    name: {f"{i:03d}": np.asarray(leaf) for i, leaf in enumerate(each)}
                    for name, each in zip(names, leaves, strict=True)
                }
            )
            stored = [self._cache.get(name) for name in names]
        return [self._policy(cast("dict[str, np.ndarray]", arrays)) for arrays in stored]

    def _train(self, stage: int) -> None:
        for number, arm in enumerate(self.names):
            if stage in self._mixes:
                shares, centres = self._mixes[stage][arm]
                self._batch.change_task(number, self._mixture.mixed(shares, centres))
        for _ in self._batch.advance(dict.fromkeys(range(len(self.names)), self.stages[stage])):
            pass
        self._reached = stage

    def _policy(self, arrays: Mapping[str, np.ndarray]) -> Policy:
        return jax.tree.unflatten(self._form, [arrays[name] for name in sorted(arrays)])


class FunctionArms:
    """The arms of a function that trains; it gets their episodes' features as a file.

    The function's hyper-parameter `episodes` is the path of a Parquet file with a column for each
    column of the problem's features, from whose rows it starts its episodes, evenly. There is no
    such file on the way to the first stage, where it starts episodes of its own.
    """

    def __init__(
        self,
        study: Study,
        values: Mapping[str, object],
        stages: Sequence[int],
        seed: int,
        cache: Cache,
        space: FeatureSpace,
        arms: Sequence[str],
    ) -> None:
        self.names, self.stages, self._space = tuple(arms), stages, space
        trainer = cast(FunctionTrainer, study.trainer)
        fields = {"steps": Constant(stages[-1])}
        whole = Study(study.name, fields, trainer, study.problem, checkpoints=stages[:-1])
        self._runs = FunctionRuns(whole, cache, Clock(study.name, None, False))
        folder = tempfile.mkdtemp() if cache.path is None else cache.path.parent
        self._files = [Path(folder) / f"{EPISODES}_{arm}.parquet" for arm in self.names]
        self._numbers = [
            self._runs.add({**values, "steps": stages[-1], EPISODES: str(file)}, seed)
            for file in self._files
        ]
        for file in self._files:
            file.unlink(missing_ok=True)

    def mix(self, stage: int, mixes: Mapping[str, Mix]) -> None:
        """Write the features that the episodes on the way to a stage begin with."""
        empty = np.zeros((1, self._space.dim), np.float32)
        mixture = MixtureTask(
            cast(Any, None), self._space, None, None, [], np.zeros(3), empty, empty, 0
        )
        for arm, file in zip(self.names, self._files, strict=True):
            shares, centres = mixes[arm]
            task = mixture.mixed((0.0, 1 - shares[2], shares[2]), centres)
            keys = jax.random.split(jax.random.key(stage), DRAWN)
            columns = self._space.rows(self._space.features_at(jax.jit(jax.vmap(task.draw))(keys)))
            with replacing(file) as partial:
                pd.DataFrame(columns).to_parquet(partial)

    def policies(self, stage: int) -> list[Any]:
        """Return the policy of each arm at a stage, trained if it is not cached.

        **Raises:** `HardeningError` with the error of the function.
        """
        self._runs.train(self._numbers, stage, further=True)
        found = [self._runs.checkpoint(number, stage) for number in self._numbers]
        for number, reached in zip(self._numbers, found, strict=True):
            if reached is None:
                raise HardeningError(f"the training failed: {self._runs.errors[number]}")
        return [reached.policy for reached in found if reached is not None]
