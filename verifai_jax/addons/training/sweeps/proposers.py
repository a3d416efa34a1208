"""Proposals of configurations: a search over the unit cube of the hyper-parameters, or Optuna.

proposer = make_proposer("bayes", space, configurations=64, seed=0)
values = proposer.propose(8)                        # dictionaries of plain values, 8 at most
proposer.observe([0.02, None, ...])                 # their objective; None if it is unknown
"""

import math
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from verifai_jax import search as searches
from verifai_jax.addons.training.sweeps.hyperparameters import Hyperparameters, values_at
from verifai_jax.addons.training.sweeps.optuna import OptunaSampler
from verifai_jax.core.compute.cores import available_cores
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.features import FeatureSpace
from verifai_jax.search import Search
from verifai_jax.search.proposals import Proposals

WORST = 1.2
"""Objective of a training without a finite policy: greater than any other."""
ROUNDS = 8
"""Rounds of a search that learns, unless its batch is given.

More rounds learn more; fewer keep the cores busy."""


@runtime_checkable
class Proposer(Protocol):
    """A source of configurations.

    - `learns`: True if proposals depend on observed objectives.
    - `batch`: configurations in a round.
    """

    learns: bool
    batch: int

    def propose(self, maximum: int) -> list[Hyperparameters]:
        """Return the next configurations, at most `maximum` and `batch`; none at the end."""
        ...

    def observe(self, objectives: Sequence[float | None]) -> None:
        """Record the objectives of the last proposals, in order; None for an unknown one."""
        ...

    def to_json(self) -> object:
        """Return the search as plain data."""
        ...


def make_proposer(
    search: object, space: FeatureSpace, *, configurations: int, seed: int, batch: int | None = None
) -> Proposer:
    """Make the proposer of a search.

    **Arguments:**
    - `search`: a name, `"optuna:NAME"`, a `Search`, or an `OptunaSampler`.
    - `configurations`: number of proposals in all.
    - `batch`: configurations in a round.
    **Raises:** `UnknownNameError` for an unknown name; `ValueError` for a search that needs
    gradients or does not fit this space; `TypeError` for anything that is not a search;
    `MissingExtra` without Optuna.
    """
    rounds = max(available_cores(), -(-configurations // ROUNDS))
    if isinstance(search, str) and search.startswith("optuna:"):
        search = OptunaSampler(search.removeprefix("optuna:"))
    if isinstance(search, OptunaSampler):
        return search.proposer(space, seed, rounds if batch is None else batch)
    if isinstance(search, str):
        search = searches.named(search)
    if not isinstance(search, Search):
        raise TypeError(
            f"search must be a name, a Search or an OptunaSampler; got {search!r}. "
            f"Names: {', '.join(searches.names())}, optuna:tpe"
        )
    if search.wants.derivatives and search.fallback is not None:
        search = search.fallback
    if search.needs_derivatives:
        raise ValueError(
            f"search {search!r} needs gradients, which trainings do not have; "
            "use one that does not, such as 'halton' or 'bayes'"
        )
    search.check(space.cube)
    whole = configurations if not search.learns else rounds
    return SearchProposer(search, space, whole if batch is None else batch, seed)


class SearchProposer:
    """A search of this package on the unit cube of the space; see `Proposer`."""

    def __init__(self, search: Search, space: FeatureSpace, batch: int, seed: int) -> None:
        self.search, self.space, self.batch = search, space, batch
        self.learns = search.learns
        self._proposals = Proposals(search, space.cube, batch, run_keys(seed)[0], space.constraint)
        self._count = 0

    def propose(self, maximum: int) -> list[Hyperparameters]:
        if self._proposals.exhausted:
            self._count = 0
            return []
        points = np.asarray(self._proposals.next(min(maximum, self.batch)))
        # A search that learns gives whole rounds, also where fewer are wanted at the end.
        self._count = len(points)
        return values_at(self.space, points)[:maximum]

    def observe(self, objectives: Sequence[float | None]) -> None:
        known = [*objectives, *[None] * (self._count - len(objectives))]
        rho = np.array([np.nan if value is None else value for value in known], np.float32)
        self._proposals.tell(rho, np.isfinite(rho), None)

    def to_json(self) -> object:
        return searches.to_json(self.search) or repr(self.search)


def objective(
    failure_rate: float, worst_robustness: float, nominal_return: float,
    return_range: tuple[float, float],
) -> float | None:  # fmt: skip
    """Return the objective of a policy, between 0 and 1.11, which searches minimise; None if
    unknown.

    The failure rate counts most; the worst robustness, scaled to a tenth, decides between equal
    rates; the return, scaled to a hundredth, decides between policies that are still equal.

    - `return_range`: minimum and maximum nominal return of the first round.
    """
    if not math.isfinite(failure_rate):
        return None
    worst = 0.0 if math.isnan(worst_robustness) else float(np.clip(worst_robustness, -1e30, 1e30))
    low, high = return_range
    known = high > low and math.isfinite(nominal_return)
    share = (nominal_return - low) / (high - low) if known else 0.0
    near = 0.5 - 0.5 * worst / (1 + abs(worst))
    return failure_rate + 0.1 * near + 0.01 * (1 - float(np.clip(share, 0.0, 1.0)))
