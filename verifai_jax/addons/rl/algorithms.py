"""The training algorithms by name, and those that fit a task.

algorithm_named("sac")                    # the class SAC
algorithms_for(Discrete(2))               # ("ppo", "pqn")
"""

from typing import TypeAlias

from verifai_jax.addons.rl.ppo import PPO
from verifai_jax.addons.rl.pqn import PQN
from verifai_jax.addons.rl.sac import SAC
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.systems.actions import Action

AlgorithmClass: TypeAlias = type[PPO] | type[PQN] | type[SAC]
"""The class of a training algorithm of this package."""
ALGORITHMS: dict[str, AlgorithmClass] = {"ppo": PPO, "pqn": PQN, "sac": SAC}
"""The classes of the training algorithms, by name."""


def algorithm_named(name: str) -> AlgorithmClass:
    """Return the class of an algorithm.

    **Raises:** `UnknownNameError`, with the nearest names.
    """
    if name not in ALGORITHMS:
        raise unknown_name("training algorithm", name, ALGORITHMS)
    return ALGORITHMS[name]


def algorithms_for(action: Action) -> tuple[str, ...]:
    """Return the names of the algorithms that learn this kind of action."""
    return tuple(name for name, cls in ALGORITHMS.items() if isinstance(action, cls.actions))
