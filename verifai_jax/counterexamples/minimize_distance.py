"""Search in batches along the failure boundary for the failure nearest to nominal.

    points = minimize_distance(candidates, starts, rng, keep_nominal=True)
                                                # failing, none farther than its start

Each round simulates a batch of candidates for each followed point:

- on the segment to nominal (bisection, several points at once);
- at the nearest point of the linearised boundary, and part of the way to it: the iteration of
  Hasofer and Lind (Exact and invariant second-moment code format, Journal of the Engineering
  Mechanics Division 100, 1974) and of Rackwitz and Fiessler (Structural reliability under combined
  random load sequences, Computers and Structures 9, 1978), with a line search in one batch; if
  several pieces of the boundary meet, at the nearest point of the intersection of their half-spaces
  (`statistics.shortest_vector`);
- sideways and nearer, at random (Brendel, Rauber and Bethge, Decision-based adversarial
  attacks, ICLR 2018), which needs no gradient and no continuity;
- with a single coordinate nearer to nominal, by a cell if it is discrete.

The gradient is that of the smooth robustness, or else a least-squares fit to points simulated
nearby.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.counterexamples.candidates import Candidates, Tangent
from verifai_jax.statistics.shortest_vector import shortest_in_box

Point = Float[np.ndarray, " d"]
Points = Float[np.ndarray, "n d"]
Departure = Float[np.ndarray, " k"]
Departures = Float[np.ndarray, "n k"]
TURNS = (1.0, 0.75, 0.5, 0.3, 0.15, 0.05)
"""Shares of the way to the linearised boundary's nearest point,"""
STRETCHES = (1.0, 1.003, 1.015, 1.06)
"""and how far beyond it: the boundary is curved."""
COSTS = (0.0, 3.0, 30.0)
"""Standard deviations that the whole range of a value costs whose prior is even; one of them, at
random, in each round."""
ENOUGH = 5e-4
"""Relative improvement that is not worth a round."""


@dataclass
class Track:
    """A failing point that moves nearer to nominal, round by round.

    `free`: which coordinates may depart; `gap`: the known share of the way to nominal on which the
    last failure lies; `sigma`: size of random steps, relative to the distance; `stalled`: rounds
    without progress; `tangents` of the boundary so far, the latest last; `target`: the nearest
    point of the latest linearised boundary.
    """

    u: Point
    free: Bool[np.ndarray, " d"]
    gap: float = 1.0
    sigma: float = 0.3
    stalled: int = 0
    tangents: list[Tangent] = field(default_factory=list)
    target: Point | None = None


def minimize_distance(
    candidates: Candidates, starts: Points, rng: np.random.Generator, *, keep_nominal: bool,
    rounds: int = 60,
) -> Points:  # fmt: skip
    """Follow failing points along the boundary until none gets nearer to nominal.

    **Arguments:**
    - `candidates`: simulates points, and remembers which failed.
    - `starts` `[n, d]`: failing points.
    - `rng`: draws random candidates.
    - `keep_nominal`: whether nominal coordinates stay nominal.
    - `rounds`: maximum number of batches.
    **Returns:** the final points `[n, d]`, one for each start.
    """
    nominal = candidates.nominal
    d = nominal.space.dim
    tracks = [
        Track(u, nominal.departs(u[None])[0] if keep_nominal else np.ones(d, bool)) for u in starts
    ]
    active = list(tracks)
    for _ in range(rounds):
        if not active or candidates.left <= 0:
            break
        each = max(12, min(40, 64 // len(active)))
        batches = [propose(candidates, track, each, rng) for track in active]
        _, failing = candidates(np.concatenate(batches))
        first = 0
        for track, batch in zip(active, batches, strict=True):
            advance(candidates, track, nominal.settle(batch), failing[first : first + len(batch)])
            first += len(batch)
        update_tangents(candidates, active)
        active = [track for track in active if track.stalled < 3]
        if len(active) > 1:
            # What is far behind the best gets no more of the budget.
            reach = min(float(nominal.distance(track.u[None])[0]) for track in tracks)
            active = [
                track
                for track in active
                if track.stalled == 0 or nominal.distance(track.u[None])[0] < 1.3 * reach
            ]
    return np.array([track.u for track in tracks])


def propose(candidates: Candidates, track: Track, count: int, rng: np.random.Generator) -> Points:
    """Propose about `count` points nearer to nominal than that of the track."""
    nominal = candidates.nominal
    levels = np.array(nominal.cube.levels)
    coordinates = np.flatnonzero(track.free & (levels == 0))
    whole = nominal.departure(track.u[None])
    v = whole[0, coordinates]
    length = float(np.linalg.norm(v))
    parts = [discrete_steps(candidates, track)]
    if length > 0:
        lines = segment_shares(track)
        costs = rng.choice(COSTS)
        aims = boundary_steps(candidates, track, coordinates, v, costs)
        left = max(count - len(lines) - len(aims) - len(parts[0]), 6)
        ones = single_coordinates(track, v, left // 3, rng)
        scale = nominal.scale[coordinates]
        near = random_directions(track, v, left - len(ones), rng, scale)
        moved = np.concatenate([np.outer(lines, v), aims, ones, near])
        moved = moved[np.linalg.norm(moved, axis=1) < length]
        points = np.repeat(track.u[None].astype(np.float64), len(moved), axis=0)
        departures = np.repeat(whole, len(moved), axis=0)
        departures[:, coordinates] = moved
        points[:, coordinates] = nominal.point_at(departures)[:, coordinates]
        parts.append(points)
    return np.concatenate(parts)


def segment_shares(track: Track) -> Float[np.ndarray, " n"]:
    """Return shares of the way from nominal to the point at which the boundary may lie."""
    if track.gap >= 1:
        return np.linspace(0, 1, 14)[1:-1]
    return 1 - track.gap * np.linspace(0.2, 1, 5) if track.gap > 2e-4 else np.zeros(0)


def boundary_steps(
    candidates: Candidates, track: Track, coordinates: Int[np.ndarray, " k"], v: Departure,
    costs: float = 0.0,
) -> Departures:  # fmt: skip
    """Return departures at the nearest points of the linearised boundary, and on the way there.

    - `costs`: a small cost of a departure of each coordinate over its whole range, or 0. Without it
      a linear model would lead to an end of the range.
    """
    nominal = candidates.nominal
    ends = np.zeros((2, len(track.u)))
    ends[0] += nominal.low
    ends[1] += nominal.high
    low, high = nominal.departure(ends)[:, coordinates]
    tangents = track.tangents[-1:] or fit_tangent(candidates, track, coordinates)
    targets = []
    slight = (nominal.scale[coordinates] < 1) & (costs > 0)
    centre = np.where(slight, v, 0.0)
    width = np.where(slight, (high - low) / max(costs, 1.0), 1.0)
    for some in (tangents, track.tangents[-6:]) if len(track.tangents) > 1 else (tangents,):
        if not some:
            continue
        points = np.array([piece.point for piece in some])
        rows = np.array([piece.gradient for piece in some]) / nominal.slope(points)
        rows = rows[:, coordinates]
        if not rows.any():
            continue
        values = np.array([piece.value for piece in some])
        levels = np.sum(rows * nominal.departure(points)[:, coordinates], axis=1) - values
        nearest = shortest_in_box(
            rows * width, levels - rows @ centre, (low - centre) / width, (high - centre) / width
        )
        if nearest is not None:
            targets.append(centre + width * nearest)
    track.target = None
    if not targets:
        return np.zeros((0, len(v)))
    track.target = track.u.astype(np.float64)
    departures = nominal.departure(track.u[None])
    departures[:, coordinates] = targets[0]
    track.target[coordinates] = nominal.point_at(departures)[0, coordinates]
    steps = [
        stretch * ((1 - turn) * v + turn * target)
        for target in targets
        for turn in TURNS
        for stretch in (STRETCHES if turn == 1 else (1.0, 0.99))
    ]
    return np.array(steps)


def fit_tangent(
    candidates: Candidates, track: Track, coordinates: Int[np.ndarray, " k"]
) -> list[Tangent]:
    """Fit a tangent to points simulated nearby; empty if there are too few."""
    others = np.ones(len(track.u), bool)
    others[coordinates] = False
    alike = np.isfinite(candidates.rho) & np.all(
        candidates.points[:, others] == track.u[others], axis=1
    )
    points, rho = candidates.points[alike].astype(np.float64)[:, coordinates], candidates.rho[alike]
    k = len(coordinates)
    if len(points) < k + 2:
        return []
    offsets = points - track.u[coordinates]
    far = np.linalg.norm(offsets, axis=1)
    order = np.argsort(far)[: 3 * k + 4]
    offsets, rho, far = offsets[order], rho[order], far[order]
    weight = 1 / (far + 0.1 * far[-1] + 1e-9)
    design = np.concatenate([np.ones((len(offsets), 1)), offsets], axis=1)
    ridge = 1e-6 * float(weight @ (far**2 + 1e-12)) * np.eye(k + 1)
    weighted = design * weight[:, None]
    solution = np.linalg.solve(weighted.T @ design + ridge, weighted.T @ rho)
    gradient = np.zeros(len(track.u))
    gradient[coordinates] = solution[1:]
    if not np.all(np.isfinite(gradient)) or not gradient.any():
        return []
    return [Tangent(track.u.astype(np.float64), float(solution[0]), gradient)]


def single_coordinates(
    track: Track, v: Departure, count: int, rng: np.random.Generator
) -> Departures:
    """Draw departures that have one coordinate nearer to nominal, and the others unchanged."""
    chosen = np.flatnonzero(v)
    if not len(chosen) or count < 1:
        return np.zeros((0, len(v)))
    chosen = rng.permutation(chosen)[:count]
    moved = np.repeat(v[None], len(chosen), axis=0)
    share = np.where(rng.random(len(chosen)) < 0.3, 0.0, 1 - rng.random(len(chosen)) * track.sigma)
    moved[np.arange(len(chosen)), chosen] *= share
    return moved


def random_directions(
    track: Track, v: Departure, count: int, rng: np.random.Generator, scale: Departure
) -> Departures:
    """Draw departures in random directions close to that of `v`, slightly shorter."""
    length = np.linalg.norm(v)
    k = len(v)
    noise = rng.standard_normal((count, k)) * scale
    # Half of them in keep_nominal coordinates: boundaries are often aligned with some.
    kept = rng.random((count, k)) < min(1.0, 2 / k)
    kept |= (rng.random(count) < 0.5).reshape(-1, 1) | ~kept.any(axis=1, keepdims=True)
    noise *= kept
    size = track.sigma * rng.uniform(0.2, 1.5, (count, 1))
    norm = np.maximum(np.linalg.norm(noise, axis=1, keepdims=True), 1e-12)
    moved = v / length + size * noise / norm
    moved /= np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-12)
    shorter = 1 - np.minimum(0.5, size * rng.random((count, 1)) ** 2)
    return moved * length * shorter


def discrete_steps(candidates: Candidates, track: Track) -> Points:
    """Return points with one discrete coordinate at nominal, or nearer to it if ordered."""
    nominal = candidates.nominal
    cube = nominal.cube
    tried = []
    for index, i in enumerate(cube.discrete):
        if not track.free[i] or track.u[i] == nominal.u[i]:
            continue
        here = int(nominal.cells(track.u)[index])
        home = int(nominal.cells(nominal.u)[index])
        nearer = {home}
        if cube.ordered[i]:
            nearer |= {here + int(np.sign(home - here)), (here + home) // 2}
        for cell in nearer - {here}:
            point = track.u.astype(np.float64)
            cells = np.zeros((1, len(cube.discrete)), np.int32)
            cells[0, index] = cell
            point[i] = nominal.u[i] if cell == home else nominal.centres(cells)[0, index]
            tried.append(point)
    return np.array(tried).reshape(-1, nominal.space.dim)


def advance(candidates: Candidates, track: Track, points: Points, failing: np.ndarray) -> None:
    """Move to the nearest failing candidate, and record where on the segment none failed."""
    nominal = candidates.nominal
    before = float(nominal.distance(track.u[None])[0])
    lengths = np.where(failing, nominal.distance(points), np.inf)
    after = float(lengths.min(initial=np.inf))
    gain = 1 - after / before if after < before else 0.0
    if gain:
        u = points[int(np.argmin(lengths))]
        straight = share_of_segment(candidates, track.u, u) is not None
        wider = min(1.0, 4 * track.gap) if straight else 0.1
        track.u = u
    else:
        wider = track.gap
    shares = [share_of_segment(candidates, track.u, point) for point in points[~failing]]
    safe = max((share for share in shares if share is not None and share < 1), default=None)
    track.gap = wider if safe is None else 1 - safe
    track.sigma = float(np.clip(track.sigma * (1.3 if gain > 0.02 else 0.6), 1e-3, 0.5))
    settled = gain <= ENOUGH and track.gap <= 1e-3
    track.stalled = track.stalled + 1 if settled else 0


def share_of_segment(candidates: Candidates, u: Point, other: Point) -> float | None:
    """Return the position of `other` between nominal (0) and `u` (1); None if it lies elsewhere."""
    v, w = candidates.nominal.departure(np.stack([u, other]))
    share = float(w @ v / max(v @ v, 1e-30))
    return share if np.linalg.norm(w - share * v) < 1e-5 * np.linalg.norm(v) + 1e-7 else None


def update_tangents(candidates: Candidates, tracks: list[Track]) -> None:
    """Compute tangents at the tracks' points, and at the targets of those without progress."""
    if not candidates.differentiable:
        return
    wanted = [(track, track.u) for track in tracks]
    wanted = [
        (track, track.target) for track in tracks if track.stalled and track.target is not None
    ] + wanted
    for (track, _), linear in zip(
        wanted, candidates.tangents(np.array([u for _, u in wanted])), strict=True
    ):
        if linear is not None and (not track.tangents or track.tangents[-1] is not linear):
            track.tangents.append(linear)
