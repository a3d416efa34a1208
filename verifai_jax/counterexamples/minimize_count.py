"""Search in batches for a failure in which the fewest features depart from nominal.

    points = minimize_count(candidates, starts, rng)    # failing, the least count first

Three moves, in turns:

- reversals: reset as many features as possible to nominal, and keep the others (delta debugging:
  Zeller and Hildebrandt, Simplifying and isolating failure-inducing input, IEEE Transactions on
  Software Engineering 28(2), 2002);
- exchanges: reset one feature, and move the others farther until the simulation fails again;
- growth: start from nominal, and always add the features that lower the robustness most (a beam
  search).
"""

import numpy as np
from jaxtyping import Float

from verifai_jax.counterexamples.candidates import Candidates, Tangent

Point = Float[np.ndarray, " d"]
Points = Float[np.ndarray, "n d"]
Results = Float[np.ndarray, "m d"]
LEVELS = 5
"""Values of one feature alone that growth begins with."""
BEAM = 6
"""Number of sets of features with which growth continues."""


def revert_features(candidates: Candidates, u: Point) -> Point:
    """Reset features of a failing point to nominal until every further reset ends the failure.

    `u` must fail. Each round tries all single resets and all features' resets at once; then it
    combines those single resets that keep the failure, one after the other.
    """
    nominal = candidates.nominal
    while candidates.left > 0:
        changed = np.flatnonzero(nominal.moved(u[None])[0])
        if not len(changed):
            return u
        groups = [np.intersect1d(coordinates, changed) for _, coordinates in nominal.groups]
        sets = [coordinates for coordinates in groups if 1 < len(coordinates) < len(changed)]
        if len(changed) > 24:
            sets += [part for n in (2, 4, 8) for part in np.array_split(changed, n)]
        sets += [changed[i : i + 1] for i in range(len(changed))]
        tried = revert(candidates, u, sets)
        rho, failing = candidates(tried)
        if not failing.any():
            return u
        order = [int(sets[i][0]) for i in np.argsort(rho) if failing[i] and len(sets[i]) == 1]
        sizes = np.unique(np.geomspace(2, max(len(order), 2), 32).astype(int))
        more = [np.array(order[:n]) for n in sizes if n <= len(order)]
        more += [
            np.union1d(s, order[:n])
            for s, bad in zip(sets, failing, strict=True)
            if bad and len(s) > 1
            for n in (1, len(order) // 2, len(order))
            if n
        ]
        if more:
            others = revert(candidates, u, more)
            tried = np.concatenate([tried, others])
            failing = np.concatenate([failing, candidates(others)[1]])
        u = smallest_departure(candidates, tried[failing])
    return u


def revert(candidates: Candidates, u: Point, sets: list[np.ndarray]) -> Points:
    """Return one copy of the point for each set of coordinates, with this set reset to nominal."""
    points = np.repeat(u[None], len(sets), axis=0)
    for point, coordinates in zip(points, sets, strict=True):
        point[coordinates] = candidates.nominal.u[coordinates]
    return points


def smallest_departure(candidates: Candidates, points: Points) -> Point:
    """Return the point with the fewest departures; of several, the nearest."""
    order = np.lexsort((candidates.nominal.distance(points), candidates.nominal.count(points)))
    return points[order[0]]


def trial_values(candidates: Candidates, i: int) -> list[float]:
    """Return values to try for one coordinate: over its range, or its cells, without nominal."""
    cube = candidates.nominal.cube
    if cube.levels[i] == 0:
        values = np.linspace(0, 1, LEVELS)
    else:
        cells = np.unique(np.linspace(0, cube.levels[i] - 1, min(cube.levels[i], 8)).astype(int))
        every = np.zeros((len(cells), len(cube.discrete)), int)
        index = int(np.flatnonzero(cube.discrete == i)[0])
        every[:, index] = cells
        values = candidates.nominal.centres(every)[:, index]
    return [float(v) for v in values if np.float32(v) != candidates.nominal.u[i]]


def grow(candidates: Candidates, starts: Points, maximum: int) -> Results:
    """Search from nominal for failing points with at most `maximum` departures; may find none."""
    nominal = candidates.nominal
    d = nominal.space.dim
    pairs = [(i, value) for i in range(d) for value in trial_values(candidates, i)]
    pairs += [
        (i, float(u[i])) for u in starts[:3] for i in np.flatnonzero(nominal.departs(u[None])[0])
    ]
    pairs = list(dict.fromkeys(pairs))[: max(candidates.left, 0)]
    points = np.repeat(nominal.u[None], len(pairs), axis=0)
    for point, (i, value) in zip(points, pairs, strict=True):
        point[i] = value
    rho, failing = candidates(points)
    if failing.any() or maximum < 2:
        return points[failing]
    # Of each coordinate the two best values, the best coordinates first.
    ranked = np.argsort(rho)
    offered: dict[int, list[float]] = {}
    for n in ranked:
        i, value = pairs[n]
        if len(offered.setdefault(i, [])) < 2:
            offered[i].append(value)
    beam = distinct_sets(candidates, points[ranked])[:BEAM]
    for _ in range(2, maximum + 1):
        if candidates.left <= 0:
            break
        longer = []
        for u in beam:
            here = nominal.departs(u[None])[0]
            for i, values in offered.items():
                for value in [] if here[i] else values:
                    point = u.copy()
                    point[i] = value
                    longer.append(point)
        if not longer:
            break
        each = max(200 // len(beam), 8) * len(beam)
        longer = (
            np.array(longer)[:each]
            if len(longer) <= each
            else np.array(spread_evenly(longer, each))
        )
        rho, failing = candidates(longer)
        if failing.any():
            return longer[failing]
        beam = distinct_sets(candidates, longer[np.argsort(rho)])[:BEAM]
    return np.zeros((0, d), np.float32)


def spread_evenly(points: list[Point], count: int) -> list[Point]:
    """Return `count` of the points, evenly spaced in their order."""
    return [points[i] for i in np.linspace(0, len(points) - 1, count).astype(int)]


def distinct_sets(candidates: Candidates, points: Points) -> Results:
    """Return the first point of each set of departing coordinates."""
    first: dict[bytes, int] = {}
    for i, mask in enumerate(candidates.nominal.departs(points)):
        first.setdefault(mask.tobytes(), i)
    return points[list(first.values())]


def exchange(candidates: Candidates, u: Point, rng: np.random.Generator) -> Point | None:
    """Search for a failing point with one departure fewer than `u`; None if none is found.

    In three rounds the other coordinates are pushed away from nominal, along the gradient of the
    robustness and at random; sets that came nearest to a failure get more points.
    """
    nominal = candidates.nominal
    support = np.flatnonzero(nominal.moved(u[None])[0])
    if len(support) < 2:
        return None
    smaller = [np.setdiff1d(support, [i]) for i in support]
    centres = revert(candidates, u, [support[i : i + 1] for i in range(len(support))])
    width = 1.0
    for turn in range(3):
        each = int(np.clip((96, 96, 96)[turn] // len(smaller), 4, 32))
        tried = []
        for tangent, centre, coordinates in zip(
            candidates.tangents(centres), centres, smaller, strict=True
        ):
            tried.append(push(candidates, centre, coordinates, tangent, each, width, rng))
        owner = np.repeat(np.arange(len(smaller)), [len(part) for part in tried])
        points = nominal.settle(np.concatenate(tried))
        rho, failing = candidates(points)
        if failing.any():
            return smallest_departure(candidates, points[failing])
        if candidates.left <= 0:
            return None
        # The half that came nearest, each from its best point on.
        lowest = np.array([rho[owner == k].min() for k in range(len(smaller))])
        kept = np.argsort(lowest)[: max(1, min(8, (len(smaller) + 1) // 2))]
        centres = np.array([points[owner == k][np.argmin(rho[owner == k])] for k in kept])
        smaller = [smaller[k] for k in kept]
        width *= 0.4
    return None


def push(
    candidates: Candidates, centre: Point, coordinates: np.ndarray, tangent: Tangent | None,
    count: int, width: float, rng: np.random.Generator,
) -> Results:  # fmt: skip
    """Draw points that differ from `centre` only in these coordinates."""
    cube, u0 = candidates.nominal.cube, candidates.nominal.u
    free = np.array([i for i in coordinates if cube.levels[i] == 0], int)
    points = np.repeat(centre[None].astype(np.float64), count, axis=0)
    if len(free):
        away = np.sign(centre[free] - u0[free])
        gradient = None if tangent is None else tangent.gradient
        downhill = (
            away if gradient is None or not np.any(gradient[free]) else -np.sign(gradient[free])
        )
        end = lambda sign: np.where(sign > 0, 1.0, np.where(sign < 0, 0.0, centre[free]))  # noqa: E731
        fixed = [end(away), end(downhill), (centre[free] + end(away)) / 2]
        for point, values in zip(points, fixed, strict=False):
            point[free] = values
        rest = points[len(fixed) :]
        noise = centre[free] + 0.35 * width * rng.standard_normal((len(rest), len(free)))
        # Some coordinates to an end, so that corners are met.
        corner = rng.random(noise.shape) < 0.3 * width
        noise = np.where(corner, (rng.random(noise.shape) < 0.5).astype(float), noise)
        rest[:, free] = noise
    for i in coordinates:
        if cube.levels[i]:
            rows = rng.random(count) < 0.3
            points[rows, i] = rng.random(int(rows.sum()))
    return points


def minimize_count(candidates: Candidates, starts: Points, rng: np.random.Generator) -> Results:
    """Minimise, among failing points, the number of coordinates that depart from nominal.

    **Arguments:**
    - `candidates`: simulates points, and remembers which failed.
    - `starts` `[m, d]`: failing points to start from.
    - `rng`: draws random candidates.
    **Returns:** failing points `[n, d]`, ordered by their number of departures, then by distance.
    """
    nominal = candidates.nominal
    enough = candidates.left // 3
    pool = []
    for u in starts:
        # The first at any rate; the others as long as enough is left to go on with.
        if not pool or candidates.left > enough:
            pool.append(revert_features(candidates, u))
    while candidates.left > 0:
        u = smallest_departure(candidates, np.array(pool))
        count = int(nominal.count(u[None])[0])
        if count <= 1:
            break
        smaller = grow(candidates, starts, count - 1)
        # A new item counts with all of its coordinates, however it came.
        smaller = smaller[nominal.count(smaller) < count]
        if not len(smaller):
            one = exchange(candidates, u, rng)
            if one is None or nominal.count(one[None])[0] >= count:
                break
            smaller = one[None]
        pool += [
            revert_features(candidates, point) for point in distinct_sets(candidates, smaller)[:4]
        ]
    points = np.concatenate([np.array(pool), candidates.points[candidates.failing]])
    order = np.lexsort((nominal.distance(points), nominal.count(points)))
    return points[order]
