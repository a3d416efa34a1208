"""Training of the policies whose closed loops are then tested."""

from verifai_jax.rl._evaluate import evaluate
from verifai_jax.rl._train import Checkpoint, Training, train
from verifai_jax.rl.algorithm import Algorithm, Progress
from verifai_jax.rl.algorithms import ALGORITHMS
from verifai_jax.rl.batched_training import BatchedTraining, Configuration
from verifai_jax.rl.policy import (
    Policy,
    PolicyFileError,
    load_policy,
    policy_notes,
    policy_sources,
    save_policy,
)
from verifai_jax.rl.ppo import PPO
from verifai_jax.rl.pqn import PQN
from verifai_jax.rl.sac import SAC
from verifai_jax.rl.task.brax import brax_task, playground_task
from verifai_jax.rl.task.gymnax import gymnax_task
from verifai_jax.rl.task.mjx import mjx_task
from verifai_jax.rl.task.ode import ode_task
from verifai_jax.rl.task.task import Continuous, Discrete, Task

__all__ = [
    "ALGORITHMS", "PPO", "PQN", "SAC", "Algorithm", "BatchedTraining", "Checkpoint",
    "Configuration", "Continuous", "Discrete", "Policy", "PolicyFileError", "Progress", "Task",
    "Training", "brax_task", "evaluate", "gymnax_task", "load_policy", "mjx_task", "ode_task",
    "playground_task", "policy_notes", "policy_sources", "save_policy", "train",
]  # fmt: skip


def __dir__() -> list[str]:
    return list(__all__)
