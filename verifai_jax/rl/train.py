"""Train a policy inside one compiled program, and measure it.

    trained = train(CartPoleTask(), PPO(hidden=(32, 32)), seed=0, steps=200_000)
    trained.policy, trained.mean_return
    returns = evaluate(CartPoleTask(), trained.policy, seed=1, episodes=100)

Hyper-parameters that change no shape re-use the program.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.rl.policy import Policy
from verifai_jax.rl.ppo import PPO, init, policy_of, update
from verifai_jax.rl.task import Task


@dataclass(frozen=True, eq=False)
class Trained:
    """What a training gave.

    - `steps`: environment steps taken by the end of each update.
    - `mean_return`: of the episodes that ended in each update, exploration included; NaN where
      none did.
    """

    policy: Policy
    steps: np.ndarray
    mean_return: np.ndarray


def train(task: Task, ppo: PPO | None = None, *, seed: int = 0, steps: int = 200_000) -> Trained:
    """Train on `task` for `steps` environment steps, rounded up to whole updates.

    The same seed gives the same policy on the same machine. Compiled once for each task and shape;
    other hyper-parameters re-use the program.

    **Raises:** `ValueError` for hyper-parameters that cannot train, or no steps.
    """
    ppo = PPO() if ppo is None else ppo
    ppo.check()
    if steps < 1:
        raise ValueError(f"steps must be at least 1; got {steps}")
    updates = -(-steps // ppo.steps_per_update)
    policy, mean_return = _train(task, updates, ppo, jax.random.key(seed))
    taken = np.arange(1, updates + 1) * ppo.steps_per_update
    return Trained(policy, taken, np.asarray(mean_return))


def evaluate(task: Task, policy: Policy, *, seed: int = 0, episodes: int = 100) -> np.ndarray:
    """Returns `[episodes]` of the policy's likeliest actions, up to the task's time limit."""
    return np.asarray(_evaluate(task, episodes, policy, jax.random.key(seed)))


@partial(jax.jit, static_argnums=(0, 1))
def _train(task: Task, updates: int, ppo: PPO, key: Key[Array, ""]) -> Any:
    def one(training: Any, _: None) -> Any:
        return update(ppo, task, training)

    training, progress = jax.lax.scan(one, init(ppo, task, key, updates), None, length=updates)
    return policy_of(ppo, task, training), progress.mean_return


@partial(jax.jit, static_argnums=(0, 1))
def _evaluate(
    task: Task, episodes: int, policy: Policy, key: Key[Array, ""]
) -> Float[Array, " episodes"]:
    def episode(key: Key[Array, ""]) -> Float[Array, ""]:
        reset_key, step_key = jax.random.split(key)

        def step(carry: Any, key: Key[Array, ""]) -> Any:
            state, total, over = carry
            after, reward, terminated = task.step(key, state, policy.act(task.observe(state)))
            total = total + jnp.where(over, 0.0, reward)
            return (after, total, over | terminated), None

        start = (task.reset(reset_key), jnp.zeros(()), jnp.array(False))
        keys = jax.random.split(step_key, task.time_limit)
        return jax.lax.scan(step, start, keys)[0][1]

    return jax.vmap(episode)(jax.random.split(key, episodes))
