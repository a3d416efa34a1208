"""A box of parameters for which provably no values of the other features cause a failure.

    found = prove_around(problem, point, chosen, low, high, seconds=60)
    found.ends                          # {"gain": (0.8, 1.3)}

Boxes of parameters and other features are decided together, first over the whole space of
parameters, then over a quarter of it around the point, and so on. Only boxes inside the widest
parameter box without a known failure are examined. The result is the widest parameter box in which
all boxes are proved.
"""

import time
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.verification.boxes import NARROWEST, OUTSIDE, PROVED, Boxes
from verifai_jax.addons.verification.branch_and_bound import BranchAndBound
from verifai_jax.addons.verification.enclosure import Enclosure
from verifai_jax.problem.problem import Problem

CLOSER = 4
"""Factor by which the parameters come closer to the point, if too little of them is proved."""
SLICES = 8
"""Looks at what is proved before the parameters come closer."""
ENOUGH = 0.9
"""Share of the box without known failures at which a proved one is wide enough."""
Corner: TypeAlias = Float[np.ndarray, " dim"]


@dataclass(frozen=True)
class ProvedParameters:
    """A box of parameters for which no environment fails.

    - `ends`: the minimum and maximum of each parameter, by its column in a table.
    - `mass`: the share of the parameters' prior in the box.
    - `looked_at`: number of boxes examined for it; `seconds`.
    """

    ends: dict[str, tuple[Any, Any]]
    mass: float
    looked_at: int
    seconds: float

    def __str__(self) -> str:
        ends = (
            f"{name} in {low:z.6g} to {high:z.6g}" if isinstance(low, float) else f"{name} = {low}"
            for name, (low, high) in self.ends.items()
        )
        return f"proved: no simulation fails with {', '.join(ends)} ({self.looked_at:,} boxes)"


def prove_around(
    problem: Problem, point: Corner, chosen: Bool[np.ndarray, " dim"], low: Corner, high: Corner,
    seconds: float, precision: str = "float32", seed: int = 0,
) -> ProvedParameters | None:  # fmt: skip
    """Prove a box of parameters around a point; None if no box was proved in time.

    **Arguments:**
    - `problem`: a problem returned by `enclosable`.
    - `point`: a point of the unit cube; its `chosen` coordinates are the parameters.
    - `low`, `high`: corners of the part of the cube that contains the other features.
    - `seconds`: approximate time in seconds.
    - `precision`, `seed`: as in `verify`.
    **Raises:** `MissingRule` for an operation of the system that has no rule for sets.
    """
    started, end = time.perf_counter(), time.perf_counter() + seconds
    enclosure = Enclosure(problem, precision)
    whole = Boxes.whole(enclosure)
    work = BranchAndBound(problem, enclosure, whole, seed)
    first, last = _cells(enclosure, point)
    found, best, size = None, 0.0, 1.0
    while (now := time.perf_counter()) < end and size > NARROWEST:
        near = np.floor((point - size / 2) / NARROWEST) * NARROWEST
        far = np.ceil((point + size / 2) / NARROWEST) * NARROWEST
        begin = np.where(chosen, np.maximum(np.maximum(near, first), 0), low)
        stop = np.where(chosen, np.minimum(np.minimum(far, last), 1), high)
        # The intersections of the boxes with the box between the two corners, as open boxes.
        lower, upper = np.maximum(whole.low, begin), np.minimum(whole.high, stop)
        some = (lower < upper).all(axis=1)
        work.boxes = Boxes.between(lower[some], upper[some], whole.inside[some])
        hope = _Hope(begin, stop, point, chosen)
        work.wanted, pause = hope.touches, (end - now) / (2 * SLICES)
        for i in range(SLICES):
            work.go_on(now + (i + 1) * pause, None)
            box = hope.proved(work.boxes)
            if (volume := np.prod(box[1] - box[0])) > best:
                found, best = box, float(volume)
            if best >= ENOUGH * hope.volume:
                break
        if best >= min(ENOUGH * hope.volume, (size / CLOSER) ** chosen.sum()):
            break
        size /= CLOSER
    if found is None:
        return None
    corners = np.tile(point, (2, 1))
    corners[:, chosen] = found
    corners = np.concatenate(enclosure.ranges.ends(corners[:1], corners[1:]))
    columns = problem.space.rows(problem.space.features_at(corners.astype(np.float32)))
    own = np.cumsum([0, *(domain.size for domain in problem.space.domains.values())])
    names = [
        column for (name, domain), start in zip(problem.space.domains.items(), own, strict=False)
        if chosen[start : start + domain.size].any() for column in domain.columns(name)
    ]  # fmt: skip
    ends = {name: tuple(np.asarray(columns[name]).tolist()) for name in names}
    return ProvedParameters(ends, best, work.looked_at, time.perf_counter() - started)


def _cells(enclosure: Enclosure, point: Corner) -> tuple[Corner, Corner]:
    """Return the ends of the cell of a point in each coordinate: all of it where it has none."""
    first, last = np.zeros(len(point)), np.ones(len(point))
    for j, edges in enumerate(enclosure.ranges.edges):
        if edges is not None:
            cell = np.clip(np.searchsorted(edges, point[j], side="right") - 1, 0, len(edges) - 2)
            first[j], last[j] = edges[cell], edges[cell + 1]
    return first, last


class _Hope:
    """The box of parameters around a point that holds none which is known to fail.

    **Arguments:**
    - `low`, `high`: corners of the part of the cube that is looked at.
    - `point`, `chosen`: as in `prove_around`.
    """

    def __init__(self, low: Corner, high: Corner, point: Corner, chosen: np.ndarray) -> None:
        self.low, self.high, self.point = low[chosen], high[chosen], point[chosen]
        self.chosen = chosen

    @property
    def volume(self) -> float:
        """The share of the parameters' prior in the box."""
        return float(np.prod(self.high - self.low))

    def touches(self, boxes: Boxes) -> Bool[np.ndarray, " n"]:
        """Return which boxes have parameters in this box, made smaller by failures found since."""
        witness = boxes.witness[:, self.chosen]
        inside = np.all((self.low < witness) & (witness < self.high), axis=1)
        self.low, self.high = self.without(witness[inside], witness[inside])
        low, high = boxes.low[:, self.chosen], boxes.high[:, self.chosen]
        return np.all((low < self.high) & (high > self.low), axis=1)

    def proved(self, boxes: Boxes) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of an inner box that is proved completely; they may be equal."""
        left = boxes[self.touches(boxes) & ~np.isin(boxes.state, (PROVED, OUTSIDE))]
        return self.without(left.low[:, self.chosen], left.high[:, self.chosen])

    def without(
        self, low: Float[np.ndarray, "n p"], high: Float[np.ndarray, "n p"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return this box, cut so that no others reach into it, the nearest to the point first."""
        begin, end = self.low.copy(), self.high.copy()
        gaps = np.maximum(low - self.point, self.point - high).max(axis=1, initial=-np.inf)
        for i in np.argsort(gaps, kind="stable"):
            if not np.all((low[i] < end) & (high[i] > begin)):
                continue
            above, below = low[i] >= self.point, high[i] <= self.point
            kept = np.where(above, low[i] - begin, np.where(below, end - high[i], -1.0))
            j = int(np.argmax(kept / np.maximum(end - begin, NARROWEST)))
            if kept[j] <= 0:
                return begin, begin
            if above[j]:
                end[j] = low[i, j]
            else:
                begin[j] = high[i, j]
        return begin, end
