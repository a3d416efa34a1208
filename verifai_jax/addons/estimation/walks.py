"""Walks of chains among failures, each by moves that leave the prior invariant.

    states, nearest = walk_among_failures(limit_state, rng, z, deciding, groups, steps=24)

A move is `z' = sqrt(1 - s^2) z + s xi`, reversible for the standard normal, and accepted if the new
point fails. The deciding coordinates and all others move in turn, since a joint move could only be
as long as the deciding ones allow. The chains of a group learn the step size together.

Source: Papaioannou, Betz, Zwirglmaier and Straub, MCMC algorithms for subset simulation,
Probabilistic Engineering Mechanics 41 (2015), for the moves and their adaptation.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation.normal_space import LimitState, fails_at
from verifai_jax.addons.estimation.splitting import ACCEPTED

FIRST, WIDEST = 0.5, 0.98
"""First scale of the moves of coordinates that decide, and the widest one, the first of others."""
FALL = 1.0
"""Fall of the logarithm of a scale after moves that were all refused, until one is taken."""
GAIN = 1.5
"""Change of the logarithm of a scale, in parts of how far the share of accepted moves is off."""


def walk_among_failures(
    limit_state: LimitState, rng: np.random.Generator, z: Float[np.ndarray, "n d"],
    deciding: Bool[np.ndarray, "n d"], groups: Int[np.ndarray, " n"], steps: int,
) -> tuple[list[Float[np.ndarray, "n d"]], Float[np.ndarray, "n d"]]:  # fmt: skip
    """Walk from failures to other failures nearby.

    **Arguments:**
    - `z`: the failure where each chain begins.
    - `deciding`: for each failure, the coordinates that must stay close to their values.
    - `groups`: the group of each chain, from 0.
    - `steps`: number of simulations of a chain.
    **Returns:** the states of the second half, and the state of each chain nearest to the origin.
    """
    whole = deciding.all(axis=1)
    scales = np.tile(np.array([WIDEST, FIRST]), (int(groups.max()) + 1, 1))
    moving, turns = np.zeros(scales.shape, bool), np.zeros(scales.shape)
    states, nearest = [], z.copy()
    for step in range(1, steps + 1):
        # Where all coordinates decide they move together every time.
        kind = np.where(whole, 1, step % 2)
        part = deciding == (kind == 1)[:, None]
        scale = scales[groups, kind][:, None] * part
        moved = np.sqrt(1 - scale**2) * z + scale * rng.standard_normal(z.shape)
        take = fails_at(limit_state, moved)
        z = np.where(take[:, None], moved, z)
        tried, taken = np.zeros(scales.shape), np.zeros(scales.shape)
        np.add.at(tried, (groups, kind), 1)
        np.add.at(taken, (groups, kind), take)
        moving |= taken > 0
        turns += tried > 0
        # Gains fall with the steps, so that the scales settle. In a small region no move is taken
        # until it is small as well.
        gain = GAIN * (taken / np.maximum(tried, 1) - ACCEPTED) / np.sqrt(np.maximum(turns, 1))
        gain = np.where(tried > 0, np.where(moving, gain, -FALL), 0.0)
        scales = np.clip(scales * np.exp(gain), 1e-4, WIDEST)
        closer = np.sum(z * z, axis=1) < np.sum(nearest * nearest, axis=1)
        nearest = np.where(closer[:, None], z, nearest)
        if step > steps // 2:
            states.append(z)
    return states, nearest
