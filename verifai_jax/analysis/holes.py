"""The largest hole between points of the unit cube.

Its radius is their dispersion: Niederreiter, Random number generation and quasi-Monte Carlo methods
(1992).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from verifai_jax.analysis.data.marginals import Marginal

PROBES = 4096
"""Points at which the distance to the nearest point is computed."""
REFINEMENTS = 4
"""Rounds of closer probes around the best one."""
MAX_TREE = 8
"""Dimensions up to which a tree finds neighbours faster than brute force."""
BLOCK = 4096
"""Points that distances are computed from at once."""


def largest_hole(
    points: Float[np.ndarray, "n k"],
    parts: Sequence[Marginal],
    seed: int,
    among: Float[np.ndarray, "m k"] | None = None,
) -> tuple[float, Float[np.ndarray, " k"]]:
    """Return the greatest distance of a probe to its nearest point, and that probe.

    Probes are 4096 points of a Sobol sequence, then more and more closely around the best; 1024 in
    more than 8 dimensions.

    **Arguments:**

    - `points`: in the unit cube.
    - `parts`: the prior distributions of their columns.
    - `seed`: the seed of the probes.
    - `among`: the only points that may be probes, where not all of the cube is allowed.
    """
    from scipy.spatial import KDTree
    from scipy.stats import qmc

    k = points.shape[1]
    if among is not None and k <= MAX_TREE:
        distance = np.asarray(KDTree(points).query(among)[0])
        return float(distance.max()), among[int(np.argmax(distance))]
    probes = qmc.Sobol(k, rng=seed).random(PROBES if k <= MAX_TREE else PROBES // 4)
    probes = np.stack([part.snap(probes[:, j]) for j, part in enumerate(parts)], axis=1)
    probes = probes if among is None else among[: len(probes)]
    if k <= MAX_TREE:
        tree = KDTree(points)
        distance = np.asarray(tree.query(probes)[0])
        best, radius = int(np.argmax(distance)), float(distance.max())
        for _ in range(REFINEMENTS):
            # Closer and closer around the emptiest place so far, which stays among the probes.
            radius /= 2
            near = np.clip(probes[best] + radius * (2 * probes[: PROBES // 4] - 1), 0, 1)
            near = [part.snap(near[:, j]) for j, part in enumerate(parts)]
            probes = np.concatenate([probes[best : best + 1], np.stack(near, axis=1)])
            distance = np.asarray(tree.query(probes)[0])
            best = int(np.argmax(distance))
    else:
        # Trees do not prune in many dimensions; one matrix product a block does it.
        nearest = np.full(len(probes), np.inf)
        single = probes.astype(np.float32)
        own = np.sum(single**2, axis=1)
        for begin in range(0, len(points), BLOCK):
            block = points[begin : begin + BLOCK].astype(np.float32)
            squares = own[:, None] + np.sum(block**2, axis=1) - 2 * single @ block.T
            nearest = np.minimum(nearest, squares.min(axis=1))
        distance = np.sqrt(np.maximum(nearest, 0))
    index = int(np.argmax(distance))
    return float(distance[index]), probes[index]


def uniform_points(
    parts: Sequence[Marginal], generator: np.random.Generator, n: int
) -> Float[np.ndarray, "n k"]:
    """Draw uniform samples of the same columns."""
    return np.stack([part.snap(generator.random(n)) for part in parts], axis=1)
