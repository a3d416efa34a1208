"""Policies of hardening at each stage, in two arms: with counterexamples, and with the prior.

    arms.mix(1, [mixture, prior])                   # what the episodes up to stage 1 are drawn from
    arms.policies(1)                                    # trained up to the second stage, or cached

Arms share the training seed, so they are one training up to the first stage. Afterwards all take
the same number of environment steps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import jax
import numpy as np

from verifai_jax.addons.rl.batched_training import BatchedTraining, Configuration
from verifai_jax.addons.training.hardening.mixture import HardeningError, Mixture, MixtureTask
from verifai_jax.addons.training.sweeps.clock import Clock
from verifai_jax.addons.training.sweeps.function_runs import FunctionRuns
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.training_runs import RunCheckpoint
from verifai_jax.core.store.cache import Cache

STARTS = 4096
"""Initial features that a function receives; enough for each of 256 neighbourhoods."""
AVERAGED = 4
"""Weights that are averaged over the second half of a round's training: those of the last update
alone fail, and return, more or less by chance. Source: Izmailov et al., Averaging weights leads to
wider optima and better generalization, UAI 2018."""


@dataclass(eq=False)
class Arms:
    """Trainings that continue from stage to stage.

    - `stages`: environment steps at the end of each stage; `names`: names of the arms.
    """

    study: Study
    values: Mapping[str, object]
    stages: Sequence[int]
    seed: int
    cache: Cache
    names: Sequence[str]


@dataclass(eq=False)
class TaskArms(Arms):
    """Trainings of a task, by one compiled program."""

    configured: Configuration
    mixture: MixtureTask

    def __post_init__(self) -> None:
        self.configured.check()
        trainer = self.study.trainer
        untrained = trainer.untrained_policy(trainer.algorithm_name(self.values))
        self._form = jax.tree.structure([untrained] * len(self.names))
        one = replace(self.configured, task=self.mixture, steps=self.stages[-1])
        self._batch = BatchedTraining([one] * len(self.names))
        self._mixes: dict[int, Sequence[Mixture]] = {}
        self._reached = -1

    def mix(self, stage: int, mixtures: Sequence[Mixture]) -> None:
        """Set the mixtures from which each arm draws the episodes of a stage."""
        self._mixes[stage] = mixtures

    def policies(self, stage: int) -> list[Any]:
        """Return the policy of each arm at a stage, trained if it is not cached."""

        def trained() -> dict[str, np.ndarray]:
            # A training that was cut off is repeated from its beginning, with the same numbers.
            policies = [self._train(at) for at in range(self._reached + 1, stage + 1)][-1]
            return {f"{i:04d}": leaf for i, leaf in enumerate(jax.tree.leaves(policies))}

        arrays = self.cache.remember(f"training/{stage}", trained)
        return jax.tree.unflatten(self._form, [arrays[name] for name in sorted(arrays)])

    def _train(self, stage: int) -> list[Any]:
        """Train up to a stage; return the policies, averaged from the first round on."""
        for number, mixture in enumerate(self._mixes.get(stage, ())):
            self._batch.change_task(number, replace(self.mixture, mixture=mixture))
        numbers, end = range(len(self.names)), self.stages[stage]
        middle = (self.stages[stage - 1] + end) / 2
        reached = []
        for steps in np.linspace(end, middle, AVERAGED, endpoint=False)[::-1] if stage else [end]:
            for _ in self._batch.advance(dict.fromkeys(numbers, int(steps))):
                pass
            reached.append([self._batch.policy(number) for number in numbers])
        self._reached = stage
        return jax.tree.map(lambda *leaves: np.mean(leaves, axis=0), *reached)


@dataclass(eq=False)
class FunctionArms(Arms):
    """Trainings by a function that receives the initial features of its episodes."""

    def __post_init__(self) -> None:
        study, trainer = self.study, replace(self.study.trainer, steps=self.stages[-1])
        staged = Study(study.name, study.space, trainer, study.problem, self.stages[:-1])
        self._runs = FunctionRuns(staged, self.cache, Clock(study.name, None, False))
        for number, arm in enumerate(self.names):
            self._runs.add(self.values, self.seed)
            run = self._runs.runs[number]
            self._runs.runs[number] = replace(run, key=f"{run.key}-{arm}")

    def mix(self, stage: int, mixtures: Sequence[Mixture]) -> None:
        """Draw the initial features of a stage's episodes for each arm."""
        for number, mixture in enumerate(mixtures):
            key = jax.random.fold_in(jax.random.key(self.seed), stage)
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
