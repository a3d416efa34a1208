"""Environments in which given parameters do badly: the falsification between two choices of them.

A search drives the environment's own cube with the parameters held. The worst environments are then
followed downhill, by gradients or by differences of few coordinates, with steps as far as a corner
of the cube, where the worst of a smooth system often lies.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from verifai_jax.core.budget import Limits
from verifai_jax.search import Search
from verifai_jax.search.proposals import Proposals
from verifai_jax.synthesis.parametric import Pairs, Parametric

MOST_FOLLOWED = 4
DESCENT = 4
"""Steps of a descent at most."""
MOST_DIFFERENCES = 12
"""Coordinates up to which slopes are taken from differences where there are no gradients,"""
GAP = 0.01
"""of this length."""
STEPS = (1.0, 0.3, 0.1, 0.03)
"""Lengths of a step of descent, in each coordinate of the environment."""


class Attack(NamedTuple):
    """Environments that were tried against one choice of parameters, and what came of them."""

    environments: Float[np.ndarray, "m d"]
    rho: Float[np.ndarray, " m"]
    violating: Float[np.ndarray, " m"]

    @property
    def worst(self) -> float:
        """Least robustness with a verdict; infinite if there is none."""
        return float(np.nanmin(self.rho, initial=np.inf))

    def chosen(self, most: int) -> Float[np.ndarray, "k d"]:
        """The worst violating environment, and those farthest from each other, worst half first."""
        places = np.flatnonzero(self.violating)
        places = places[np.argsort(self.rho[places], kind="stable")]
        places = places[: max(most, (len(places) + 1) // 2)]
        points = self.environments[places]
        if len(points) <= most:
            return points
        taken, far = [0], np.linalg.norm(points - points[0], axis=1)
        while len(taken) < most and far.max() > 0:
            taken.append(int(np.argmax(far)))
            far = np.minimum(far, np.linalg.norm(points - points[taken[-1]], axis=1))
        return points[taken]


def attack(
    loop: Parametric,
    theta: Float[np.ndarray, " p"],
    level: float,
    limits: Limits,
    *,
    search: Search,
    batch: int,
    seed: Any,
    enough: int = 64,
    scale: float = 1.0,
) -> Attack:
    """Look for environments whose robustness lies below `level` until `limits` or `enough` of them.

    - `scale`: size of ordinary robustnesses, which the temperature of gradients goes by.
    """
    assert loop.environment is not None
    free = np.sum(np.array(loop.environment.levels) == 0)
    follows = free > 0 and (loop.differentiable or free <= MOST_DIFFERENCES)
    each = 1 if loop.differentiable else 1 + int(free)
    kept = DESCENT * MOST_FOLLOWED * (each + len(STEPS)) if follows else 0
    searching = limits.slice(limits.left - min(kept, limits.left // 3))
    proposals = Proposals(
        search,
        loop.environment.cube,
        batch,
        jax.random.key(seed),
        loop.environment.constraint,
    )
    seen: list[tuple[np.ndarray, Pairs]] = []
    found = 0
    while not searching.over and not proposals.exhausted:
        points = np.asarray(proposals.next(min(batch, searching.left)))
        if not len(points):
            break
        warm = float(proposals.temperature) if search.wants_gradient else None
        pairs = loop.judge(theta[None], points, warm)
        seen.append((points, pairs))
        # A pair that cannot happen tells the search nothing.
        counted = pairs.proper[0] & np.isfinite(pairs.rho[0])
        gradient = None if pairs.by_environment is None else pairs.by_environment[0]
        told = np.where(counted, pairs.rho[0] - level, np.nan).astype(np.float32)
        gradient = None if gradient is None else gradient.astype(np.float32)
        proposals.tell(told, counted, gradient)
        found += int(np.sum(pairs.violates(level)))
        if found >= enough:
            break
    result = _collected(seen, level, loop)
    if len(result.rho) and follows:
        result = _followed(loop, theta, level, limits, result, scale)
    return result


def _followed(
    loop: Parametric, theta: Any, level: float, limits: Limits, seen: Attack, scale: float
) -> Attack:
    assert loop.environment is not None
    free = np.array(loop.environment.levels) == 0
    order = np.argsort(np.where(np.isnan(seen.rho), np.inf, seen.rho), kind="stable")
    points = seen.environments[order[:MOST_FOLLOWED]]
    best = seen.rho[order[:MOST_FOLLOWED]]
    tried: list[tuple[np.ndarray, Pairs]] = []
    for _ in range(DESCENT):
        each = 1 if loop.differentiable else 1 + int(free.sum())
        if limits.left < len(points) * (each + len(STEPS)) or not free.any():
            break
        slopes, beside = _slopes(loop, theta, points, 0.02 * scale, free)
        tried.append(beside)
        down = -np.sign(slopes) * free
        moved = np.stack([np.clip(points + step * down, 0.0, 1.0) for step in STEPS], axis=1)
        pairs = loop.judge(theta[None], moved.reshape(-1, points.shape[1]))
        tried.append((moved.reshape(-1, points.shape[1]), pairs))
        rho = np.where(pairs.proper[0], pairs.rho[0], np.inf).reshape(len(points), len(STEPS))
        least, which = rho.min(axis=1), rho.argmin(axis=1)
        better = least < best
        if not better.any():
            break
        points = np.where(better[:, None], moved[np.arange(len(points)), which], points)
        best = np.where(better, least, best)
    return _joined(seen, _collected(tried, level, loop))


def _slopes(
    loop: Parametric, theta: Any, points: np.ndarray, warmth: float, free: np.ndarray
) -> tuple[Float[np.ndarray, "n d"], tuple[np.ndarray, Pairs]]:
    """Slopes by the environment, from gradients or differences, and what was simulated for them."""
    if loop.differentiable:
        pairs = loop.judge(theta[None], points, warmth)
        assert pairs.by_environment is not None
        return pairs.by_environment[0], (points, pairs)
    places = np.flatnonzero(free)
    beside = np.repeat(points[:, None], 1 + len(places), axis=1)
    gaps = np.where(points[:, places] > 0.5, -GAP, GAP)
    beside[:, 1 + np.arange(len(places)), places] += gaps
    rows = beside.reshape(-1, points.shape[1])
    pairs = loop.judge(theta[None], rows)
    rho = np.where(pairs.proper & np.isfinite(pairs.rho), pairs.rho, np.nan)[0]
    rho = rho.reshape(len(points), -1)
    slopes = np.zeros(points.shape)
    slopes[:, places] = np.nan_to_num((rho[:, 1:] - rho[:, :1]) / gaps)
    return slopes, (rows, pairs)


def _collected(seen: list[tuple[np.ndarray, Pairs]], level: float, loop: Parametric) -> Attack:
    if not seen:
        assert loop.environment is not None
        none = np.zeros(0)
        return Attack(np.zeros((0, loop.environment.dim)), none, np.zeros(0, bool))
    return Attack(
        np.concatenate([points for points, _ in seen]),
        np.concatenate([pairs.rho[0] for _, pairs in seen]),
        np.concatenate([pairs.violates(level)[0] for _, pairs in seen]),
    )


def _joined(one: Attack, other: Attack) -> Attack:
    return Attack(*(np.concatenate(both) for both in zip(one, other, strict=True)))
