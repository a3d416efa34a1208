"""Train a policy inside one compiled program, and measure it.

    trained = train(CartPoleTask(), PPO(hidden=(32, 32)), seed=0, steps=200_000)
    trained.policy, trained.mean_return
    returns = evaluate(CartPoleTask(), trained.policy, seed=1, episodes=100)

Hyper-parameters that change no shape re-use the program.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.rl.algorithm import Algorithm
from verifai_jax.rl.policy import Policy
from verifai_jax.rl.ppo import PPO
from verifai_jax.rl.task.task import Task
from verifai_jax.rl.trainings import Configuration, Known, Trainings, leaves_of


class Snapshot(NamedTuple):
    """The policy after so many environment steps."""

    steps: int
    policy: Policy


@dataclass(frozen=True, eq=False)
class Trained:
    """What a training gave.

    - `steps`: environment steps taken by the end of each update.
    - `mean_return`: of the episodes that ended in each update, exploration included; NaN where
      none did.
    - `snapshots`: policies on the way, where they were asked for.
    """

    policy: Policy
    steps: np.ndarray
    mean_return: np.ndarray
    snapshots: tuple[Snapshot, ...] = ()


def train(
    task: Task,
    algorithm: Algorithm | None = None,
    *,
    seed: int = 0,
    steps: int = 200_000,
    snapshots: Sequence[int] = (),
) -> Trained:
    """Train on `task` for `steps` environment steps, rounded up to whole updates.

    The same seed gives the same policy on the same machine. Compiled once for each task and shape;
    other hyper-parameters re-use the program.

    **Arguments:**

    - `algorithm`: `PPO()` when left out.
    - `snapshots`: environment steps at which to keep the policy too.

    **Raises:** `ValueError` for hyper-parameters that cannot train, an algorithm that does not fit
    the task's actions, no steps, or snapshots outside of the training.
    """
    algorithm = PPO() if algorithm is None else algorithm
    trainings = Trainings([Configuration(task, algorithm, steps, seed)])
    kept = []
    ordered = sorted(set(snapshots))
    for at in ordered:
        if not 1 <= at <= steps:
            raise ValueError(f"snapshots must lie between 1 and steps = {steps}; got {at}")
    for at in ordered:
        for number in trainings.advance({0: at}):
            kept.append(Snapshot(int(trainings.curve(number)[0][-1]), trainings.policy(number)))
    for _ in trainings.advance({0: steps}):
        pass
    return Trained(trainings.policy(0), *trainings.curve(0), tuple(kept))


def evaluate(task: Task, policy: Policy, *, seed: int = 0, episodes: int = 100) -> np.ndarray:
    """Returns `[episodes]` of the policy's likeliest actions, up to the task's time limit."""
    key, (leaves, _) = jax.random.key(seed), leaves_of(task)
    return np.asarray(_evaluate(Known(task), episodes, leaves, policy, key))


@partial(jax.jit, static_argnums=(0, 1))
def _evaluate(
    known: Known, episodes: int, leaves: Any, policy: Policy, key: Key[Array, ""]
) -> Float[Array, " episodes"]:
    task = known.with_leaves(leaves)

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
