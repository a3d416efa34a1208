"""The training algorithms by name, and which of them fit a task.

algorithm_named("sac")                    # the class SAC
fitting(Discrete(2))                      # ("ppo", "pqn")
"""

from typing import Any

from verifai_jax.core.errors import unknown_name
from verifai_jax.rl.algorithm import Algorithm
from verifai_jax.rl.ppo import PPO
from verifai_jax.rl.pqn import PQN
from verifai_jax.rl.sac import SAC
from verifai_jax.rl.task.task import Action

ALGORITHMS: dict[str, type[Any]] = {"ppo": PPO, "pqn": PQN, "sac": SAC}


def algorithm_named(name: str) -> type[Algorithm]:
    """The class of an algorithm.

    **Raises:** `UnknownNameError`, with the nearest names.
    """
    if name not in ALGORITHMS:
        raise unknown_name("training algorithm", name, ALGORITHMS)
    return ALGORITHMS[name]


def fitting(action: Action) -> tuple[str, ...]:
    """Names of the algorithms that learn this kind of action."""
    return tuple(name for name, cls in ALGORITHMS.items() if isinstance(action, cls.actions))
