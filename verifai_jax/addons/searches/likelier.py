"""Search for likelier failures, by samples around the known ones and by other choices.

    draw_around_elite(candidates, rng)                  # cross-entropy, with elites by likelihood
    shift_in_time(candidates, u)
    exchange_cells(candidates, rng)                     # discrete features, two at a time

Samples are drawn around the likeliest failures, with their spread and the choices of one of them.
For discrete features, all single changes of a failure are simulated. Pairs of changes that make it
likelier are tried in the order of the predicted robustness, which adds up the effects of the single
changes.
"""

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.counterexamples.candidates import Candidates

Point = Float[np.ndarray, " d"]
Points = Float[np.ndarray, "n d"]
PARENTS = 6
"""Failures from which changes are tried, the likeliest ones."""
TRIED = 256
"""Pairs of changes at a time: a failure that is found among them ends the round."""
SINGLES = 400
"""Single changes at most that are combined into pairs."""
ELITE, MANY, SAMPLES = 24, 200, 96
"""Likeliest failures whose spread is that of samples, few and many; samples of a round."""
SIZES = (1.3, 0.5, 0.2, 0.07)
"""Factors on that spread, in which a narrow valley of failures is followed too."""
SHIFTS = (-8, -4, -2, -1, 1, 2, 4, 8)
"""Items by which a failure is moved in time."""
FRUITLESS = 4
"""Rounds without a likelier failure after which no more are drawn."""
CLOSER = 1e-9
"""Fall of the distance that counts."""


def draw_around_elite(candidates: Candidates, rng: np.random.Generator) -> None:
    """Sample repeatedly around the likeliest failures, refitting to the likeliest found so far.

    **Arguments:**
    - `candidates`: simulates points within its limit, and remembers which failed.
    """
    nominal, fruitless = candidates.nominal, 0
    free = nominal.cube.continuous
    while candidates.left > 0 and fruitless < FRUITLESS:
        pool = _likeliest(candidates, MANY)
        best = float(nominal.distance(pool[:1])[0])
        away = nominal.departure(pool)[:, free]
        parents = np.minimum(rng.geometric(0.15, SAMPLES) - 1, len(pool) - 1)
        # A random combination of departures has their covariance: of the likeliest failures, or of
        # many, which know the directions in which failures go on.
        moved = np.zeros((SAMPLES, nominal.space.dim))
        for row, parent in enumerate(parents):
            some = away[: rng.choice([ELITE, MANY])]
            step = rng.standard_normal(len(some)) @ (some - some.mean(axis=0)) / len(some) ** 0.5
            own = 0.2 * rng.standard_normal(len(free)) * some.std(axis=0)
            middle = some.mean(axis=0) if rng.random() < 0.25 else away[parent]
            moved[row, free] = middle + rng.choice(SIZES) * (step + own)
        points = pool[parents].astype(np.float64)
        points[:, free] = nominal.point_at(moved)[:, free]
        points = nominal.settle(points)
        # What is less likely than all of the elite can be no better, whether it fails or not.
        nearer = nominal.distance(points) < nominal.distance(pool[-1:])
        candidates(points[nearer] if nearer.any() else points)
        after = float(nominal.distance(_likeliest(candidates, 1))[0])
        fruitless = 0 if after < (1 - 1e-3) * best else fruitless + 1


def shift_in_time(candidates: Candidates, u: Point) -> None:
    """Try a failure earlier and later: shift signals and arrays by some of their items.

    A failure at another time lies on another part of the boundary, to which no gradient leads.
    """
    nominal = candidates.nominal
    series = []
    for name, own in nominal.groups:
        items = [part.size for _, part in nominal.space.domains[name].parts(name)]
        # Of items that are alike, as those of signals and arrays are.
        if len(items) > 1 and len(set(items)) == 1 and sum(items) == own.size:
            series.append(own.reshape(len(items), -1))
    points = []
    for some in [series, *([one] for one in series)] if series else []:
        for shift in SHIFTS:
            point = u.copy()
            for own in some:
                later, count = np.arange(len(own)) - shift, len(own)
                inside = (later >= 0) & (later < count)
                point[own] = np.where(inside[:, None], u[own[later % count]], nominal.u[own])
            points.append(point)
    if points:
        candidates(np.array(points))


def exchange_cells(candidates: Candidates, rng: np.random.Generator) -> None:
    """Change cells of the likeliest failures until no change of two cells makes one likelier.

    **Arguments:**
    - `candidates`: simulates points within its limit, and remembers which failed.
    - `rng`: orders changes with equal predictions.
    """
    done: set[bytes] = set()
    while candidates.left > 0:
        parents = [u for u in _likeliest(candidates, PARENTS) if u.tobytes() not in done]
        if not parents:
            return
        done.add(parents[0].tobytes())
        _improve(candidates, parents[0], rng)


def _likeliest(candidates: Candidates, count: int) -> Points:
    failures = candidates.points[candidates.failing]
    order = np.argsort(candidates.nominal.distance(failures), kind="stable")
    return failures[order[:count]]


def _improve(candidates: Candidates, u: Point, rng: np.random.Generator) -> None:
    """Try the changes of one failure, until one fails and is likelier."""
    nominal = candidates.nominal
    singles, of = _single_changes(candidates, u, rng)
    rho, failing = candidates(singles)
    before = float(nominal.distance(u[None])[0])
    distance = nominal.distance(singles)
    if np.any(failing & (distance < before - CLOSER)):
        return
    gain = distance**2 - before**2
    one, two = np.triu_indices(len(singles), 1)
    likelier = (of[one] != of[two]) & (gain[one] + gain[two] < -CLOSER)
    one, two = one[likelier], two[likelier]
    # What has no verdict is no way to a failure; of equal predictions any may come first.
    order = np.lexsort((rng.random(len(one)), rho[one] + rho[two]))
    for first in range(0, len(order), TRIED):
        if candidates.left <= 0:
            return
        chosen = order[first : first + TRIED]
        pairs = singles[one[chosen]].copy()
        pairs[np.arange(len(chosen)), of[two[chosen]]] = singles[two[chosen], of[two[chosen]]]
        if candidates(pairs)[1].any():
            return


def _single_changes(
    candidates: Candidates, u: Point, rng: np.random.Generator
) -> tuple[Points, Int[np.ndarray, " n"]]:
    """Return all points with one discrete coordinate in another cell, and which it is."""
    nominal, cube = candidates.nominal, candidates.nominal.cube
    here = nominal.cells(u)
    changes = [
        (k, cell)
        for k, i in enumerate(cube.discrete)
        for cell in range(cube.levels[i])
        if cell != here[k]
    ]
    if len(changes) > SINGLES:
        changes = [changes[i] for i in rng.choice(len(changes), SINGLES, replace=False)]
    cells = np.repeat(here[None], len(changes), axis=0)
    moved = np.array([k for k, _ in changes], int)
    cells[np.arange(len(changes)), moved] = [cell for _, cell in changes]
    points = np.repeat(u[None], len(changes), axis=0)
    points[:, cube.discrete] = nominal.centres(cells)
    return nominal.settle(points), cube.discrete[moved]
