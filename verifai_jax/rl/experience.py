"""Environments side by side, each begun anew as its episode ends.

    episodes = begin(task, key, environments=8)
    episodes, transition = advance(task, episodes, actions, key)
    progress([transitions])                    # what to report of an update

A transition keeps the observation that its step led to *before* the reset: an episode that only
the time limit cut off goes on to have a value, and that is where it has it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.rl.advantage import Ends
from verifai_jax.rl.algorithm import Progress
from verifai_jax.rl.task.task import Task


class Episodes(NamedTuple):
    """Where each environment stands: its state, and steps and rewards of the episode so far."""

    state: Any
    age: Int[Array, " environments"]
    total: Float[Array, " environments"]


class Transition(NamedTuple):
    """One step of each environment. `total` is the episode's return with this step in it."""

    reward: Float[Array, "*time environments"]
    next_observation: Float[Array, "*time environments k"]
    ends: Ends
    total: Float[Array, "*time environments"]

    @property
    def over(self) -> Bool[Array, "*time environments"]:
        """Where an episode ended, for good or cut off."""
        return self.ends.terminated | self.ends.truncated


def begin(task: Task, key: Key[Array, ""], environments: int) -> Episodes:
    """Fresh episodes."""
    state = jax.vmap(task.reset)(jax.random.split(key, environments))
    return Episodes(state, jnp.zeros(environments, jnp.int32), jnp.zeros(environments))


def observation_size(task: Task, episodes: Episodes) -> int:
    """Numbers in an observation."""
    return jax.eval_shape(jax.vmap(task.observe), episodes.state).shape[-1]


def advance(
    task: Task, episodes: Episodes, action: Array, key: Key[Array, ""]
) -> tuple[Episodes, Transition]:
    """One step of each environment with its `action`, as `task.step` takes it."""
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
        fresh = begin(task, reset_key, environments)

        def chosen(new: Array, old: Array) -> Array:
            over = transition.over.reshape(-1, *[1] * (old.ndim - 1))
            return jnp.where(over, new.astype(old.dtype), old)

        return jax.tree.map(chosen, fresh, after)

    # Most steps end no episode, and a reset draws random numbers for every environment.
    return jax.lax.cond(jnp.any(transition.over), reset, lambda: after), transition


def progress(transition: Transition) -> Progress:
    """Number and mean return of the episodes that ended in some steps."""
    count = jnp.sum(transition.over)
    total = jnp.sum(jnp.where(transition.over, transition.total, 0.0))
    return Progress(jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan), count)
