"""Likelier failures over discrete features, by changes of one and of two of them at a time.

    exchange_cells(candidates, rng)                     # goes on from the failures found so far

All single changes of a failure are simulated. Of pairs, those that make it likelier are tried in
the order of the robustness that the single changes predict for both together, as if they added up.
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
"""Single changes at most, of which pairs are made."""
CLOSER = 1e-9
"""Fall of the distance that counts."""


def exchange_cells(candidates: Candidates, rng: np.random.Generator) -> None:
    """Change cells of the likeliest failures until no change of two makes any likelier.

    **Arguments:**

    - `candidates`: simulates, and remembers what failed, within its limit.
    - `rng`: of the order of changes that are predicted alike.
    """
    done: set[bytes] = set()
    while candidates.left > 0:
        parents = [u for u in _likeliest(candidates) if u.tobytes() not in done]
        if not parents:
            return
        done.add(parents[0].tobytes())
        _improve(candidates, parents[0], rng)


def _likeliest(candidates: Candidates) -> Points:
    failures = candidates.points[candidates.failing]
    order = np.argsort(candidates.nominal.distance(failures), kind="stable")
    return failures[order[:PARENTS]]


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
