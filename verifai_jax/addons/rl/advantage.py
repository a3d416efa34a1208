"""Generalised advantage estimation over a stretch of experience.

An episode can end in two ways. *Terminated*: nothing comes after, its value is zero. *Truncated*
by the time limit: the last state still has a value, which the critic supplies.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from verifai_jax.addons.rl.algorithm import Number


class Ends(NamedTuple):
    """The ends of episodes at each time: terminated only, and terminated or truncated."""

    terminated: Bool[Array, "*time"]
    truncated: Bool[Array, "*time"]


def advantages(
    reward: Float[Array, "time *lanes"], value: Float[Array, "time *lanes"],
    next_value: Float[Array, "time *lanes"], ends: Ends, discount: Number, gae_lambda: Number,
) -> Float[Array, "time *lanes"]:  # fmt: skip
    """Estimate the advantage of each action; advantage plus `value` is the critic's target.

    **Arguments:**
    - `value`: the value of the state in which the action was taken.
    - `next_value`: the value of the state that the step led to, *before* any reset.
    - `ends`: the steps that ended an episode.
    - `discount`, `gae_lambda`: as in `PPO`.

    Source: Schulman et al., High-dimensional continuous control using generalized advantage
    estimation (2016), eqs. 10 and 16.
    """
    continues = 1.0 - ends.terminated
    delta = reward + discount * continues * next_value - value
    same_episode = 1.0 - (ends.terminated | ends.truncated)

    def backwards(
        later: Float[Array, "*lanes"], step: tuple[Float[Array, "*lanes"], Float[Array, "*lanes"]]
    ) -> tuple[Float[Array, "*lanes"], Float[Array, "*lanes"]]:
        delta, same_episode = step
        advantage = delta + discount * gae_lambda * same_episode * later
        return advantage, advantage

    steps, last = (delta, same_episode), jnp.zeros_like(delta[0])
    return jax.lax.scan(backwards, last, steps, reverse=True, unroll=16)[1]
