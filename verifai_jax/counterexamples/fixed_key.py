"""Simulations with one random key, so that only features make a difference.

problem = fix_key(problem, run, row)                # the problem itself where no key is used
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key

from verifai_jax.core.compute.keys import run_keys, simulation_key
from verifai_jax.core.values.trace import Trace
from verifai_jax.falsification.run import Run
from verifai_jax.problem.dependence import depends_on_key
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import Carry, Features, Outcome, Seed, System


class FixedKey(System):
    """A system that always uses one random key, whatever key it receives.

    It has the same methods as the system: `fold`, `simulate_batch`, `simulate_each`, ...
    """

    def __init__(self, system: System, key: Key[Array, ""]) -> None:
        self.system, self.key = system, key
        self.black_box, self.lanes, self.dt = system.black_box, system.lanes, system.dt
        self.forward_up_to, self.reverse_hint = system.forward_up_to, system.reverse_hint

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        return self.system(features, self.key)

    def may_draw(self, features: Features) -> bool:
        return False

    def check(self, features: Features) -> None:
        self.system.check(features)

    def abstract(self, features: Features) -> Trace | None:
        return self.system.abstract(features)

    @property
    def can_fold(self) -> bool:
        return self.system.can_fold

    def fold(
        self, features: Features, key: Seed, carry: Carry,
        update: Callable[[Carry, dict[str, Array]], Carry],
    ) -> tuple[Carry, Int[Array, ""]]:  # fmt: skip
        return self.system.fold(features, self.key, carry, update)

    @property
    def can_simulate_batch(self) -> bool:
        return self.system.can_simulate_batch

    def simulate_batch(self, features: Features, keys: Key[Array, " n"]) -> Trace:
        return self.system.simulate_batch(features, jnp.broadcast_to(self.key, len(keys)))

    @property
    def can_simulate_each(self) -> bool:
        return self.system.can_simulate_each

    def simulate_each(
        self, features: Sequence[Features], seeds: Sequence[int]
    ) -> Iterator[tuple[int, Outcome]]:
        seed = int(np.asarray(jax.random.bits(self.key)))
        return self.system.simulate_each(features, [seed] * len(seeds))


def key_of(run: Run, row: int | None) -> Key[Array, ""]:
    """Return the random key with which a row of a run was simulated."""
    return simulation_key(run_keys(run.seed)[1], 0 if row is None else row)


def hold_key(problem: Problem, key: Key[Array, ""]) -> Problem:
    """Return the problem in which every simulation uses this random key."""
    return replace(problem, system=FixedKey(problem.system, key))


def note_on_key(problem: Problem, row: int) -> list[str]:
    """Return a note on the fixed random key with which a row was studied."""
    if not depends_on_key(problem):
        return []
    return [
        f"the system draws random numbers: all simulations had the random key of row {row}, and "
        "with another one the same features may keep the property"
    ]


def fix_key(problem: Problem, run: Run, row: int | None) -> Problem:
    """Return the problem in which every simulation uses the random key of one row.

    It is the same problem if the system draws no random numbers, and compiled programs are reused.
    """
    if not problem.black_box and not problem.draws():
        return problem
    return hold_key(problem, key_of(run, row))
