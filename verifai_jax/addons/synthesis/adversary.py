"""Search for environments in which given parameters fail, between two choices of parameters.

A search explores the environment's cube with fixed parameters. Then descents start from the worst
environments, with gradients or with differences of few coordinates. Their steps may reach a corner
of the cube, where the worst case of a smooth system often lies. All points stay in the region where
the prior has its probability (`region.py`).
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.synthesis.budget import Budget
from verifai_jax.addons.synthesis.parametric import Pairs, Parametric
from verifai_jax.addons.synthesis.region import Region
from verifai_jax.search import Search
from verifai_jax.search.proposals import Proposals

MAX_FOLLOWED = 4
"""Environments that are followed downhill."""
DESCENT = 4
"""Steps of a descent at most."""
MAX_DIFFERENCES = 12
"""Coordinates up to which differences take the place of gradients."""
GAP = 0.01
"""Length of a difference, in unit coordinates."""
STEPS = (1.0, 0.3, 0.1, 0.03)
"""Lengths of a step of descent, in each coordinate of the environment."""


class Attack(NamedTuple):
    """Environments that were tried against one choice of parameters, and their verdicts.

    **Fields:** `environments` `[m, d]`; `rho` `[m]`, NaN without a verdict; `violating` `[m]`:
    whether the formula fails, or holds by less than the margin.
    """

    environments: Float[np.ndarray, "m d"]
    rho: Float[np.ndarray, " m"]
    violating: Bool[np.ndarray, " m"]

    @property
    def worst(self) -> float:
        """The least robustness of all verdicts; infinite if there is none."""
        return float(np.nanmin(self.rho, initial=np.inf))

    def select(self, maximum: int) -> Float[np.ndarray, "k d"]:
        """Select the worst violating environment, and distant ones from the worse half."""
        indices = np.flatnonzero(self.violating)
        indices = indices[np.argsort(self.rho[indices], kind="stable")]
        indices = indices[: max(maximum, (len(indices) + 1) // 2)]
        points = self.environments[indices]
        if len(points) <= maximum:
            return points
        taken, far = [0], np.linalg.norm(points - points[0], axis=1)
        while len(taken) < maximum and far.max() > 0:
            taken.append(int(np.argmax(far)))
            far = np.minimum(far, np.linalg.norm(points - points[taken[-1]], axis=1))
        return points[taken]


def attack(
    loop: Parametric, theta: Float[np.ndarray, " p"], level: float, limits: Budget, *,
    search: Search, batch: int, seed: int, region: Region, enough: int = 64, scale: float = 1.0,
) -> Attack:  # fmt: skip
    """Search for environments whose robustness is below `level`.

    **Arguments:**
    - `loop`: the system with its parameters.
    - `theta` `[p]`: the parameters to attack.
    - `level`: robustness below which an environment counts.
    - `limits`: the budget of simulations.
    - `search`: the search over the environment.
    - `batch`: number of environments that the search proposes at once.
    - `seed`: the seed of the search.
    - `region`: the region in which the environment is attacked.
    - `enough`: number of environments after which the search stops.
    - `scale`: typical size of the robustness, to which temperatures are relative.
    """
    assert loop.environment is not None
    free = np.sum(np.array(loop.environment.levels) == 0)
    follows = free > 0 and (loop.differentiable or free <= MAX_DIFFERENCES)
    each = 1 if loop.differentiable else 1 + int(free)
    reserved = DESCENT * MAX_FOLLOWED * (each + len(STEPS)) if follows else 0
    searching = limits.slice(limits.left - min(reserved, limits.left // 3))
    proposals = Proposals(
        search, loop.environment.cube, batch, jax.random.key(seed), loop.environment.constraint
    )
    parts: list[tuple[np.ndarray, Pairs]] = []
    violations = 0
    while not searching.exhausted and not proposals.exhausted:
        points = np.asarray(proposals.next(min(batch, searching.left)))
        if not len(points):
            break
        points = region.project(points)
        warm = float(proposals.temperature) if search.wants.gradient else None
        pairs = loop.evaluate(theta[None], points, warm)
        parts.append((points, pairs))
        # A pair that cannot happen tells the search nothing.
        counted = pairs.proper[0] & np.isfinite(pairs.rho[0])
        gradient = None if pairs.by_environment is None else pairs.by_environment[0]
        shifted = np.where(counted, pairs.rho[0] - level, np.nan).astype(np.float32)
        gradient = None if gradient is None else gradient.astype(np.float32)
        proposals.tell(shifted, counted, gradient)
        violations += int(np.sum(pairs.violates(level)))
        if violations >= enough:
            break
    result = _collect(parts, level, loop)
    if len(result.rho) and follows:
        result = _descend(loop, theta, level, limits, result, scale, region)
    return result


def _descend(
    loop: Parametric, theta: Float[np.ndarray, " p"], level: float, limits: Budget, first: Attack,
    scale: float, region: Region,
) -> Attack:  # fmt: skip
    assert loop.environment is not None
    free = np.array(loop.environment.levels) == 0
    order = np.argsort(np.where(np.isnan(first.rho), np.inf, first.rho), kind="stable")
    points = first.environments[order[:MAX_FOLLOWED]]
    best = first.rho[order[:MAX_FOLLOWED]]
    tried: list[tuple[np.ndarray, Pairs]] = []
    for _ in range(DESCENT):
        each = 1 if loop.differentiable else 1 + int(free.sum())
        if limits.left < len(points) * (each + len(STEPS)) or not free.any():
            break
        gradients, shifted = _gradients(loop, theta, points, 0.02 * scale, free)
        tried.append(shifted)
        down = -np.sign(gradients) * free
        moved = np.stack([np.clip(points + step * down, 0.0, 1.0) for step in STEPS], axis=1)
        rows = region.project(moved.reshape(-1, points.shape[1]))
        moved = rows.reshape(moved.shape)
        pairs = loop.evaluate(theta[None], rows)
        tried.append((rows, pairs))
        rho = np.where(pairs.proper[0], pairs.rho[0], np.inf).reshape(len(points), len(STEPS))
        lowest, which = rho.min(axis=1), rho.argmin(axis=1)
        better = lowest < best
        if not better.any():
            break
        points = np.where(better[:, None], moved[np.arange(len(points)), which], points)
        best = np.where(better, lowest, best)
    return Attack(
        *(np.concatenate(both) for both in zip(first, _collect(tried, level, loop), strict=True))
    )


def _gradients(
    loop: Parametric, theta: Float[np.ndarray, " p"], points: np.ndarray, warmth: float,
    free: np.ndarray,
) -> tuple[Float[np.ndarray, "n d"], tuple[np.ndarray, Pairs]]:  # fmt: skip
    """Return gradients by the environment, or differences, and what was simulated for them."""
    if loop.differentiable:
        pairs = loop.evaluate(theta[None], points, warmth)
        assert pairs.by_environment is not None
        return pairs.by_environment[0], (points, pairs)
    indices = np.flatnonzero(free)
    shifted = np.repeat(points[:, None], 1 + len(indices), axis=1)
    gaps = np.where(points[:, indices] > 0.5, -GAP, GAP)
    shifted[:, 1 + np.arange(len(indices)), indices] += gaps
    rows = shifted.reshape(-1, points.shape[1])
    pairs = loop.evaluate(theta[None], rows)
    rho = np.where(pairs.proper & np.isfinite(pairs.rho), pairs.rho, np.nan)[0]
    rho = rho.reshape(len(points), -1)
    gradients = np.zeros(points.shape)
    gradients[:, indices] = np.nan_to_num((rho[:, 1:] - rho[:, :1]) / gaps)
    return gradients, (rows, pairs)


def _collect(parts: list[tuple[np.ndarray, Pairs]], level: float, loop: Parametric) -> Attack:
    if not parts:
        assert loop.environment is not None
        none = np.zeros(0)
        return Attack(np.zeros((0, loop.environment.dim)), none, np.zeros(0, bool))
    return Attack(
        np.concatenate([points for points, _ in parts]),
        np.concatenate([pairs.rho[0] for _, pairs in parts]),
        np.concatenate([pairs.violates(level)[0] for _, pairs in parts]),
    )
