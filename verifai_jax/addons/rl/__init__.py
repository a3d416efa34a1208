"""Training of the policies whose closed loops are then tested."""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.addons.rl._evaluate import evaluate as evaluate
    from verifai_jax.addons.rl._train import Checkpoint as Checkpoint
    from verifai_jax.addons.rl._train import Training as Training
    from verifai_jax.addons.rl._train import train as train
    from verifai_jax.addons.rl.algorithm import Algorithm as Algorithm
    from verifai_jax.addons.rl.algorithm import Progress as Progress
    from verifai_jax.addons.rl.algorithms import ALGORITHMS as ALGORITHMS
    from verifai_jax.addons.rl.batched_training import BatchedTraining as BatchedTraining
    from verifai_jax.addons.rl.batched_training import Configuration as Configuration
    from verifai_jax.addons.rl.policy import Policy as Policy
    from verifai_jax.addons.rl.policy import PolicyFileError as PolicyFileError
    from verifai_jax.addons.rl.policy import load_policy as load_policy
    from verifai_jax.addons.rl.policy import policy_notes as policy_notes
    from verifai_jax.addons.rl.policy import policy_sources as policy_sources
    from verifai_jax.addons.rl.policy import save_policy as save_policy
    from verifai_jax.addons.rl.ppo import PPO as PPO
    from verifai_jax.addons.rl.pqn import PQN as PQN
    from verifai_jax.addons.rl.sac import SAC as SAC
    from verifai_jax.addons.rl.task.brax import brax_task as brax_task
    from verifai_jax.addons.rl.task.brax import playground_task as playground_task
    from verifai_jax.addons.rl.task.gymnax import gymnax_task as gymnax_task
    from verifai_jax.addons.rl.task.mjx import mjx_task as mjx_task
    from verifai_jax.addons.rl.task.ode import ode_task as ode_task
    from verifai_jax.addons.rl.task.task import Task as Task
    from verifai_jax.systems.actions import Continuous as Continuous
    from verifai_jax.systems.actions import Discrete as Discrete
# Imported when first used: a folder inside needs few of these names.
__getattr__, __dir__, __all__ = attach(__name__)
