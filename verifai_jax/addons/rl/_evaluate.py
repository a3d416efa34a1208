"""Returns of policies on a task, with their most likely actions and without exploration.

The same seed gives all policies the same episodes, which end when the task terminates them, or at
its time limit. Policies of one structure share a program of fixed width, so a mean return does not
depend on which other policies are measured.
"""

from collections.abc import Hashable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from verifai_jax.addons.rl.batched_training import StaticTask, numbers_of
from verifai_jax.addons.rl.policy import Policy
from verifai_jax.addons.rl.task.task import State, Task
from verifai_jax.core.compute.compilation import jit_each
from verifai_jax.core.compute.devices import Device, enable_compile_cache, spread_over_devices
from verifai_jax.core.compute.keys import IMPLEMENTATION
from verifai_jax.core.display.progress import shows_progress

POLICIES_PER_DEVICE = 8
"""Policies that a device simulates at a time."""
EPISODES = 32
"""Default number of episodes of a mean return."""
Totals = tuple[State, Float[Array, "..."], Bool[Array, "..."]]
"""States, rewards so far, and flags of the episodes that are over."""


@shows_progress("simulating episodes of", "episodes")
def evaluate(
    task: Task, policy: Policy, *, seed: int = 0, episodes: int = 100, progress: bool | None = None
) -> Float[np.ndarray, " episodes"]:
    """Simulate episodes with the policy's most likely actions and return their returns.

    **Arguments:**
    - `task`: the task. An episode ends when the task terminates it, or at its time limit.
    - `policy`: the policy to measure.
    - `seed`: the seed of the episodes' starts and of random steps.
    - `episodes`: number of episodes.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Returns:** `[episodes]`, the sum of rewards of each episode.
    """
    numbers, _ = numbers_of(task)
    key = jax.random.key(seed, impl=IMPLEMENTATION)
    return np.asarray(_episode_returns(StaticTask(task), episodes, numbers, policy, key))


def batched_mean_returns(
    task: Task, policies: Sequence[PyTree], *, seed: int = 0, episodes: int = EPISODES
) -> Iterator[tuple[list[int], Float[np.ndarray, " batch"]]]:
    """Measure the mean returns of policies batch by batch.

    **Yields:** indices of policies, and their mean returns.
    """
    enable_compile_cache()
    devices = tuple(jax.local_devices())
    lanes = POLICIES_PER_DEVICE * len(devices)
    structures: dict[Hashable, list[int]] = {}
    for number, policy in enumerate(policies):
        leaves, form = jax.tree.flatten(policy)
        structures.setdefault((form, tuple(np.shape(leaf) for leaf in leaves)), []).append(number)
    numbers_of_task, static_task = numbers_of(task)[0], StaticTask(task)
    for group in structures.values():
        for start in range(0, len(group), lanes):
            batch = group[start : start + lanes]
            filled = batch + [batch[-1]] * (lanes - len(batch))
            stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(policies[n] for n in filled))
            key = jax.random.key(seed, impl=IMPLEMENTATION)
            means = _mean_returns(static_task, episodes, devices, numbers_of_task, stacked, key)
            yield batch, np.asarray(means, np.float64)[: len(batch)]


@jit_each(2)
def _episode_returns(
    static_task: StaticTask, episodes: int, numbers: list[Array], policy: Policy,
    key: Key[Array, ""],
) -> Float[Array, " episodes"]:  # fmt: skip
    return _returns(static_task.with_numbers(numbers), episodes, policy, key, None)


@jit_each(3)
def _mean_returns(
    static_task: StaticTask, episodes: int, devices: tuple[Device, ...], numbers: list[Array],
    policies: PyTree, key: Key[Array, ""],
) -> Float[Array, " policies"]:  # fmt: skip
    def on_device(
        numbers: list[Array], policies: PyTree, key: Key[Array, ""]
    ) -> Float[Array, " some"]:
        task, count = static_task.with_numbers(numbers), jax.tree.leaves(policies)[0].shape[0]
        return jnp.mean(_returns(task, episodes, policies, key, count), axis=1)

    return spread_over_devices(on_device, (False, True, False), devices)(numbers, policies, key)


def _returns(
    task: Task, episodes: int, policies: PyTree, key: Key[Array, ""], count: int | None
) -> Float[Array, "*policies episodes"]:
    """Step all episodes of one policy, or of `count` stacked ones, until the last one is over."""
    keys = jax.vmap(jax.random.split)(jax.random.split(key, episodes))
    reset_keys, step_keys = jnp.moveaxis(keys, 1, 0)
    starts = (jax.vmap(task.reset)(reset_keys), jnp.zeros(episodes), jnp.zeros(episodes, bool))

    def one(policy: PyTree, episode: Totals, key: Key[Array, ""]) -> Totals:
        state, total, over = episode
        after, reward, terminated = task.step(key, state, policy.act(task.observe(state)))
        return after, total + jnp.where(over, 0.0, reward), over | terminated

    step = jax.vmap(one, in_axes=(None, 0, 0))
    if count is not None:
        starts = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), starts)
        step = jax.vmap(step, in_axes=(0, 0, None))

    def goes_on(loop: tuple[Int[Array, ""], Totals]) -> Bool[Array, ""]:
        time, (_, _, over) = loop
        return (time < task.time_limit) & ~jnp.all(over)

    def forward(loop: tuple[Int[Array, ""], Totals]) -> tuple[Int[Array, ""], Totals]:
        time, episodes = loop
        keys = jax.vmap(lambda key: jax.random.fold_in(key, time))(step_keys)
        return time + 1, step(policies, episodes, keys)

    return jax.lax.while_loop(goes_on, forward, (jnp.int32(0), starts))[1][1]
