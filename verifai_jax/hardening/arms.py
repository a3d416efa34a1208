"""The policies of hardening, stage by stage: one arm with counterexamples, one with the prior.

arms = Arms(trainer, values, stages, seed, cache, mixture, ("hardened", "randomised"))
arms.mix(1, {"hardened": (shares, centres), "randomised": (shares, none)})
arms.policies(1)                                    # trained up to the second stage, or cached

Arms share the training seed, so that up to the first stage they are one training, and afterwards
take the same number of environment steps, wherever an episode begins.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Float

from verifai_jax.hardening.mixture import MixtureTask
from verifai_jax.rl.batched_training import BatchedTraining, Configuration
from verifai_jax.rl.policy import Policy
from verifai_jax.store.cache import Cache
from verifai_jax.sweeps.trainer import Trainer

Mix = tuple[tuple[float, float, float], Float[np.ndarray, "n d"]]
"""Shares of episodes, as `MixtureTask` has them, and the centres of neighbourhoods."""


class Arms:
    """The arms of a hardening, trained by one compiled program."""

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
