"""Simulations that all have the random key of one row, so that only features make a difference.

problem = with_key_of(run, row)                     # the same problem where no key is used
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from verifai_jax.core.keys import run_keys, simulation_key
from verifai_jax.core.trace import Trace
from verifai_jax.falsification.run import Run
from verifai_jax.problem.problem import Problem

AS_IT_IS = ("check", "reverse_hint", "forward_up_to", "lanes", "abstract", "dt", "duration")


class Keyed:
    """A system that ignores the key that it is given and uses its own.

    It offers what the system offers: `fold`, `simulate_batch`, `simulate_each`, ...
    """

    def __init__(self, system: Any, key: Key[Array, ""]) -> None:
        self.system, self.key = system, key
        self.black_box = bool(getattr(system, "black_box", False))
        for name in AS_IT_IS:
            if hasattr(system, name):
                setattr(self, name, getattr(system, name))
        # As attributes of the instance, since what is offered is asked by their presence.
        for name, method in (
            ("fold", self._fold),
            ("simulate_batch", self._batch),
            ("simulate_each", self._each),
        ):
            if getattr(system, name, None) is not None:
                setattr(self, name, method)

    def __call__(self, features: Any, key: Any = None) -> Trace:
        return self.system(features, self.key)

    def _fold(self, features: Any, key: Any, carry: Any, update: Any) -> Any:
        return self.system.fold(features, self.key, carry, update)

    def _batch(self, features: Any, keys: Any) -> Trace:
        return self.system.simulate_batch(features, self.key[None].repeat(len(keys)))

    def _each(self, features: Any, seeds: Any) -> Iterator[Any]:
        seed = int(np.asarray(jax.random.bits(self.key)))
        return self.system.simulate_each(features, [seed] * len(seeds))


def key_of(run: Run, row: int | None) -> Key[Array, ""]:
    """The random key with which a row of this run was simulated."""
    return simulation_key(run_keys(run.seed)[1], 0 if row is None else row)


def with_key_of(problem: Problem, run: Run, row: int | None) -> Problem:
    """The problem with every simulation on the random key of that row.

    Itself where the system does not draw, so that it keeps what is compiled.
    """
    if not problem.black_box and not problem.draws():
        return problem
    return replace(problem, system=Keyed(problem.system, key_of(run, row)))
