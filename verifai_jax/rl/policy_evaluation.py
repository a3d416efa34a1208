"""What policies earn on their task: the mean return of the likeliest actions, many at a time.

    nominal_returns(task, policies, seed=0)              # one number a policy

Policies of one form go through one program, whose width is fixed: a return does not depend on
which others are measured along with it.
"""

from collections.abc import Hashable, Iterator, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.core.devices import enable_compile_cache, spread_over_devices
from verifai_jax.rl.policy import Policy
from verifai_jax.rl.task.task import Task
from verifai_jax.rl.trainings import Known, leaves_of

TOGETHER = 8
"""Policies on a device at a time."""
EPISODES = 32


def nominal_returns(
    task: Task, policies: Sequence[Policy], *, seed: int = 0, episodes: int = EPISODES
) -> Float[np.ndarray, " policies"]:
    """Mean return of each policy's likeliest actions over the same episodes.

    An episode ends where the task says so, or at its time limit.
    """
    found = np.full(len(policies), np.nan)
    for numbers, values in each_return(task, policies, seed=seed, episodes=episodes):
        found[numbers] = values
    return found


def each_return(
    task: Task, policies: Sequence[Policy], *, seed: int = 0, episodes: int = EPISODES
) -> Iterator[tuple[list[int], Float[np.ndarray, " some"]]]:
    """The same as it is finished: numbers of policies and their mean returns."""
    enable_compile_cache()
    devices = tuple(jax.local_devices())
    lanes = TOGETHER * len(devices)
    forms: dict[Hashable, list[int]] = {}
    for number, policy in enumerate(policies):
        leaves, form = jax.tree.flatten(policy)
        forms.setdefault((form, tuple(np.shape(leaf) for leaf in leaves)), []).append(number)
    numbers_of_task, known = leaves_of(task)[0], Known(task)
    for group in forms.values():
        for start in range(0, len(group), lanes):
            some = group[start : start + lanes]
            filled = some + [some[-1]] * (lanes - len(some))
            stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(policies[n] for n in filled))
            key = jax.random.key(seed, impl="threefry2x32")
            returns = _returns(known, episodes, devices, numbers_of_task, stacked, key)
            yield some, np.asarray(returns, np.float64)[: len(some)]


@partial(jax.jit, static_argnums=(0, 1, 2))
def _returns(
    known: Known,
    episodes: int,
    devices: tuple[Any, ...],
    leaves: Any,
    policies: Policy,
    key: Key[Array, ""],
) -> Float[Array, " lanes"]:
    def on_device(leaves: Any, policies: Policy, key: Key[Array, ""]) -> Float[Array, " some"]:
        task = known.with_leaves(leaves)

        reset_keys, step_keys = jnp.moveaxis(
            jax.vmap(jax.random.split)(jax.random.split(key, episodes)), 1, 0
        )
        starts = (jax.vmap(task.reset)(reset_keys), jnp.zeros(episodes), jnp.zeros(episodes, bool))
        count = jax.tree.leaves(policies)[0].shape[0]
        starts = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), starts)

        def step(policy: Policy, carry: Any, key: Any) -> Any:
            state, total, over = carry
            after, reward, terminated = task.step(key, state, policy.act(task.observe(state)))
            total = total + jnp.where(over, 0.0, reward)
            return after, total, over | terminated

        each = jax.vmap(jax.vmap(step, in_axes=(None, 0, 0)), in_axes=(0, 0, None))

        def goes_on(loop: Any) -> Any:
            time, (_, _, over) = loop
            return (time < task.time_limit) & ~jnp.all(over)

        def forward(loop: Any) -> Any:
            time, carry = loop
            keys = jax.vmap(lambda key: jax.random.fold_in(key, time))(step_keys)
            return time + 1, each(policies, carry, keys)

        return jnp.mean(jax.lax.while_loop(goes_on, forward, (0, starts))[1][1], axis=1)

    spread = spread_over_devices(on_device, (False, True, False), devices)
    return spread(leaves, policies, key)
