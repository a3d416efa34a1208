"""Environments side by side, each with a new episode as soon as its last one ends.

    episodes = start_episodes(task, key, environments=8)
    episodes, transition = advance(task, episodes, actions, key)
    progress(transitions)                      # the episodes that ended in an update

A transition keeps the observation after its step and *before* the reset. The value of an episode
that the time limit truncated is estimated from this observation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, Shaped

from verifai_jax.addons.rl.advantage import Ends
from verifai_jax.addons.rl.algorithm import Progress
from verifai_jax.addons.rl.task.task import State, Task


class Episodes(NamedTuple):
    """The present episode of each environment.

    - `state`: states of the task with a leading axis `[environments]`.
    - `age`: number of steps in the episode so far.
    - `total`: sum of rewards in the episode so far.
    """

    state: State
    age: Int[Array, " environments"]
    total: Float[Array, " environments"]


class Transition(NamedTuple):
    """One or several steps of each environment.

    - `reward`: the reward of the step.
    - `next_observation`: the observation of the state that the step led to, before any reset.
    - `ends`: the episodes that the step ended.
    - `total`: the episode's return including this step.
    """

    reward: Float[Array, "*steps"]
    next_observation: Float[Array, "*steps k"]
    ends: Ends
    total: Float[Array, "*steps"]

    @property
    def over(self) -> Bool[Array, "*steps"]:
        """The ends of episodes, terminated or truncated."""
        return self.ends.terminated | self.ends.truncated


def start_episodes(task: Task, key: Key[Array, ""], environments: int) -> Episodes:
    """Start an episode in each of this many environments."""
    state = jax.vmap(task.reset)(jax.random.split(key, environments))
    return Episodes(state, jnp.zeros(environments, jnp.int32), jnp.zeros(environments))


def observation_size(task: Task, episodes: Episodes) -> int:
    """Return the number of entries in an observation."""
    return jax.eval_shape(jax.vmap(task.observe), episodes.state).shape[-1]


def advance(
    task: Task, episodes: Episodes, action: Shaped[Array, "environments ..."], key: Key[Array, ""]
) -> tuple[Episodes, Transition]:
    """Take one step of each environment.

    **Arguments:**
    - `episodes`: the episodes before the step.
    - `action`: the action of each environment, in the form of `task.step`.
    - `key`: a random key for this step of all environments.
    **Returns:** the episodes after the step, with new ones where it ended one; the transition.
    """
    step_key, reset_key = jax.random.split(key)
    environments = len(episodes.age)
    step_keys = jax.random.split(step_key, environments)
    state, reward, terminated = jax.vmap(task.step)(step_keys, episodes.state, action)
    reward = jnp.asarray(reward, jnp.float32)
    age, total = episodes.age + 1, episodes.total + reward
    ends = Ends(terminated, age >= task.time_limit)
    after = Episodes(state, age, total)
    transition = Transition(reward, jax.vmap(task.observe)(state), ends, total)

    def reset() -> Episodes:
        fresh = start_episodes(task, reset_key, environments)

        def select(new: Shaped[Array, "..."], old: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
            over = transition.over.reshape(-1, *[1] * (old.ndim - 1))
            return jnp.where(over, new.astype(old.dtype), old)

        return jax.tree.map(select, fresh, after)

    # Most steps end no episode, and a reset draws random numbers for every environment.
    return jax.lax.cond(jnp.any(transition.over), reset, lambda: after), transition


def progress(transition: Transition) -> Progress:
    """Summarise the episodes that ended in some steps by their mean return and number."""
    count = jnp.sum(transition.over)
    total = jnp.sum(jnp.where(transition.over, transition.total, 0.0))
    return Progress(jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan), count)
