"""The policies of hardening, stage by stage: one arm with counterexamples, one with the prior.

arms = TaskArms(trainer, values, stages, seed, cache, mixture, ("hardened", "randomised"))
arms.mix(1, [mixture, prior])
arms.policies(1)                                    # trained up to the second stage, or cached

Arms share the training seed, so that up to the first stage they are one training, and afterwards
take the same number of environment steps, wherever an episode begins.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import jax
import numpy as np

from verifai_jax.core.store.cache import Cache
from verifai_jax.rl.batched_training import BatchedTraining, Configuration
from verifai_jax.training.hardening.mixture import HardeningError, Mixture, MixtureTask
from verifai_jax.training.sweeps.clock import Clock
from verifai_jax.training.sweeps.function_runs import FunctionRuns
from verifai_jax.training.sweeps.study import Study
from verifai_jax.training.sweeps.trainer import Trainer
from verifai_jax.training.sweeps.training_runs import RunCheckpoint

STARTS = 4096
"""Episodes that a function gets to train on: enough that each of 256 neighbourhoods has some."""


class TaskArms:
    """Trainings of a task, by one compiled program."""

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
        self._mixes: dict[int, Sequence[Mixture]] = {}
        self._reached = -1

    def mix(self, stage: int, mixtures: Sequence[Mixture]) -> None:
        """Say, for each arm, what the episodes are drawn from on the way to a stage."""
        self._mixes[stage] = mixtures

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
        known = cast("list[dict[str, np.ndarray]]", stored)
        return [jax.tree.unflatten(self._form, [a[n] for n in sorted(a)]) for a in known]

    def _train(self, stage: int) -> None:
        for number, mixture in enumerate(self._mixes.get(stage, ())):
            self._batch.change_task(number, replace(self._mixture, mixture=mixture))
        for _ in self._batch.advance(dict.fromkeys(range(len(self.names)), self.stages[stage])):
            pass
        self._reached = stage


class FunctionArms:
    """Trainings by a function, which gets the features that its episodes begin with."""

    def __init__(
        self,
        study: Study,
        values: Mapping[str, object],
        stages: Sequence[int],
        seed: int,
        cache: Cache,
        arms: Sequence[str],
    ) -> None:
        trainer = replace(study.trainer, steps=stages[-1])
        staged = Study(study.name, study.space, trainer, study.problem, stages[:-1])
        self._runs, self._seed = FunctionRuns(staged, cache, Clock(study.name, None, False)), seed
        for number, arm in enumerate(arms):
            self._runs.add(values, seed)
            run = self._runs.runs[number]
            self._runs.runs[number] = replace(run, key=f"{run.key}-{arm}")

    def mix(self, stage: int, mixtures: Sequence[Mixture]) -> None:
        """Draw, for each arm, the episodes on the way to a stage."""
        for number, mixture in enumerate(mixtures):
            key = jax.random.fold_in(jax.random.key(self._seed), stage)
            own, points = jax.vmap(mixture.episode)(*jax.random.split(key, (2, STARTS)))
            features = jax.tree.map(np.asarray, mixture.space.features_at(np.asarray(points)))
            self._runs.starts[number] = [
                None if is_own else jax.tree.map(lambda leaf, i=i: leaf[i], features)
                for i, is_own in enumerate(np.asarray(own))
            ]

    def policies(self, stage: int) -> list[Any]:
        """Return the policy of each arm at a stage, trained if it is not cached."""
        numbers = range(len(self._runs.runs))
        self._runs.train(numbers, stage, further=True)
        for error in self._runs.errors.values():
            raise HardeningError(f"{self._runs.study.trainer.name} does not train: {error}")
        return [self.checkpoint(number, stage).policy for number in numbers]

    def checkpoint(self, number: int, stage: int) -> RunCheckpoint:
        """Return an arm at a stage that it has reached."""
        return cast(RunCheckpoint, self._runs.checkpoint(number, stage))
