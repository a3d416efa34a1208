"""The first failure of a search from many seeds, each a run of its own.

    found = first_failures(problem, "portfolio", budget=300, batch=1, seeds=range(50))
    found.number                                 # [seeds], counted from 1; inf without one
    found.cost                                   # the same, a differentiated simulation as two

The problem compiles once, for the first seed.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

import verifai_jax as vj


class FirstFailures(NamedTuple):
    """How soon each seed found a failure.

    - `number`: the number of the first failing simulation, from 1; infinite without one.
    - `cost`: the same, with each simulation that was differentiated counted as two.
    - `points`: its point in the unit cube; NaN without one.
    """

    number: Float[np.ndarray, " seeds"]
    cost: Float[np.ndarray, " seeds"]
    points: Float[np.ndarray, "seeds d"]

    @property
    def falsified(self) -> int:
        """The number of seeds that found a failure."""
        return int(np.isfinite(self.number).sum())


def first_failures(
    problem: vj.Problem,
    search: str | vj.search.Search,
    budget: int,
    batch: int | None,
    seeds: Iterable[int],
) -> FirstFailures:
    """Falsify from each seed until the first violation, which is not replayed.

    **Arguments:**
    - `budget`: the most simulations of a seed.
    - `batch`: simulations of a round; None for the search's own number.
    """
    gradient = (vj.search.named(search) if isinstance(search, str) else search).wants.gradient
    number, cost, points = [], [], []
    for seed in seeds:
        run = vj.falsify(
            problem, search, budget, batch=batch, seed=seed, stop=vj.Stop(after=1), confirm=False,
            progress=False,
        )  # fmt: skip
        rows = run.table.all
        failing = np.flatnonzero(rows["violated"])
        if not len(failing):
            number.append(np.inf)
            cost.append(np.inf)
            points.append(np.full(problem.space.dim, np.nan))
            continue
        first = int(failing[0]) + 1
        derived = first if gradient else 0
        if "differentiated" in rows:
            derived = int(rows["differentiated"][:first].sum())
        number.append(first)
        cost.append(first + derived)
        points.append(problem.space.points(rows.iloc[[first - 1]])[0])
    return FirstFailures(np.array(number, float), np.array(cost, float), np.array(points))
