"""Environments side by side, each with a new episode as soon as its last one ends.

    keys = step_keys(key, horizon=128, environments=8)
    episodes, transition = advance(task, episodes, actions, keys[0])

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
from verifai_jax.systems.actions import Discrete


class Episodes(NamedTuple):
    """The present episode of each environment: the `state` of the task, with a leading axis
    `[environments]`; the number of its steps so far, `age`; the sum of its rewards so far, `total`.
    """

    state: State
    age: Int[Array, " environments"]
    total: Float[Array, " environments"]


class Transition(NamedTuple):
    """One or several steps of each environment: their `reward`; `next_observation`, that of the
    state that the step led to, before any reset; the `ends` of episodes; their return `total` with
    this step.
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
    return _start(task, jax.random.split(key, environments))


def _start(task: Task, keys: Key[Array, " environments"]) -> Episodes:
    state = jax.vmap(task.reset)(keys)
    return Episodes(state, jnp.zeros(len(keys), jnp.int32), jnp.zeros(len(keys)))


def step_keys(key: Key[Array, ""], horizon: int, environments: int) -> Key[Array, "h e 2"]:
    """Return the random keys for `horizon` calls of `advance`.

    All at once: in a loop, random bits of a few lanes would cost as much as the network.
    """
    return jax.random.split(key, (horizon, environments, 2))


def sizes(task: Task, episodes: Episodes) -> tuple[int, int]:
    """Return the number of entries in an observation, and of outputs that an action needs."""
    outputs = task.action.n if isinstance(task.action, Discrete) else task.action.size
    return jax.eval_shape(jax.vmap(task.observe), episodes.state).shape[-1], outputs


def advance(
    task: Task, episodes: Episodes, action: Shaped[Array, "environments ..."],
    keys: Key[Array, "environments 2"],
) -> tuple[Episodes, Transition]:  # fmt: skip
    """Take one step of each environment.

    **Arguments:**
    - `episodes`: the episodes before the step.
    - `action`: the action of each environment, in the form of `task.step`.
    - `keys`: random keys of `step_keys` for this step and the reset that may follow.
    **Returns:** the episodes after the step, with new ones where it ended one; the transition.
    """
    state, reward, terminated = jax.vmap(task.step)(keys[:, 0], episodes.state, action)
    reward = jnp.asarray(reward, jnp.float32)
    age, total = episodes.age + 1, episodes.total + reward
    ends = Ends(terminated, age >= task.time_limit)
    after = Episodes(state, age, total)
    transition = Transition(reward, jax.vmap(task.observe)(state), ends, total)

    def reset() -> Episodes:
        fresh = _start(task, keys[:, 1])

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
