"""Policies of hardening at each stage, in two arms: with counterexamples, and with the prior.

    arms.mix(1, [mixture, prior])                   # what the episodes up to stage 1 are drawn from
    arms.policies(1)                                    # trained up to the second stage, or cached

They are training runs as those of a sweep. Arms share the training seed, so they are one training
up to the first stage. Afterwards all take the same number of environment steps.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from verifai_jax.addons.training.hardening.mixture import HardeningError, Mixture, MixtureTask
from verifai_jax.addons.training.sweeps.clock import Clock
from verifai_jax.addons.training.sweeps.running import runs_of
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.trainer import STEPS
from verifai_jax.core.store.cache import Cache

STARTS = 4096
"""Initial features that a function receives; enough for each of 256 neighbourhoods."""
AVERAGED = 4
"""Weights that are averaged over the second half of a round's training: those of the last update
alone fail, and return, more or less by chance. Source: Izmailov et al., Averaging weights leads to
wider optima and better generalization, UAI 2018."""


class Arms:
    """Trainings that continue from stage to stage.

    - `stages`: environment steps at the end of each stage; `names`: names of the arms.
    - `mixture`: the task with episodes of a mixture; None for a function that trains, which gets
      the initial features of its episodes.
    """

    def __init__(
        self, study: Study, values: Mapping[str, object], stages: Sequence[int], seed: int,
        cache: Cache, names: Sequence[str], mixture: MixtureTask | None,
    ) -> None:  # fmt: skip
        count = 1 if mixture is None else AVERAGED
        ends = [(stages[0],)] + [
            tuple(np.linspace(end, (end + before) / 2, count, endpoint=False)[::-1].astype(int))
            for before, end in itertools.pairwise(stages)
        ]
        points = sorted({int(at) for each in ends for at in each})
        trainer = replace(study.trainer, steps=points[-1])
        staged = Study(study.name, study.space, trainer, study.problem, points[:-1])
        self.seed = seed
        self._rungs = [[points.index(at) for at in each] for each in ends]
        self._runs = runs_of(staged, cache, Clock(study.name, None, False))
        swept = {name: value for name, value in values.items() if name != STEPS}
        for number, arm in enumerate(names):
            run = self._runs.runs[self._runs.add(swept, seed)]
            own = run.configuration and replace(run.configuration, task=mixture)
            key = f"{run.key}-{arm}"
            self._runs.runs[number] = replace(run, key=key, configuration=own)

    def mix(self, stage: int, mixtures: Sequence[Mixture]) -> None:
        """Set the mixtures from which each arm draws the episodes of a stage."""
        for number, mixture in enumerate(mixtures):
            own: Any = self._runs.runs[number].configuration
            change: Any = own and replace(own, task=replace(own.task, mixture=mixture))
            if change is None:
                key = jax.random.fold_in(jax.random.key(self.seed), stage)
                own, points = jax.vmap(mixture.episode)(*jax.random.split(key, (2, STARTS)))
                features = jax.tree.map(np.asarray, mixture.space.features_at(np.asarray(points)))
                change = [
                    None if is_own else jax.tree.map(lambda leaf, i=i: leaf[i], features)
                    for i, is_own in enumerate(np.asarray(own))
                ]
            self._runs.changes[number, self._rungs[stage - 1][-1] + 1] = change

    def policies(self, stage: int) -> list[Any]:
        """Return the policy of each arm at a stage, averaged from the first round on."""
        runs, rungs = self._runs, self._rungs[stage]
        runs.train(range(len(runs.runs)), rungs[-1], further=True)
        for error in runs.errors.values():
            raise HardeningError(f"{runs.study.trainer.name} does not train: {error}")
        reached = [
            [one.policy for rung in rungs if (one := runs.checkpoint(number, rung)) is not None]
            for number in range(len(runs.runs))
        ]
        if len(rungs) == 1:
            return [policies[0] for policies in reached]
        return [jax.tree.map(lambda *ls: np.mean(ls, axis=0), *policies) for policies in reached]

    def training_return(self, number: int, stage: int) -> float:
        """Return the mean return of an arm at the end of a stage that it has reached."""
        reached = self._runs.checkpoint(number, self._rungs[stage][-1])
        assert reached is not None
        return reached.training_return
