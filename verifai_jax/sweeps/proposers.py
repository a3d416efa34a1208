"""Which configurations to train: a search over the cube of the hyper-parameters, asked and told.

    asker = asker_for("bayes", space, configurations=64, seed=0)
    values = asker.ask(8)                            # dictionaries of plain values, 8 at most
    asker.tell([0.02, None, ...])                    # how bad each was; None: not to be learnt from

A search looks for the least number. What it is told comes from `badness`: how often the policy
fails, then how nearly, then what it earns.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from verifai_jax import search as searches
from verifai_jax.core.cores import available_cores
from verifai_jax.core.keys import run_keys
from verifai_jax.falsification.validation import needs_slopes
from verifai_jax.features import FeatureSpace
from verifai_jax.search import Portfolio, Search
from verifai_jax.search.proposals import Proposals
from verifai_jax.sweeps.trainer import labelled

Values = dict[str, Any]
WORST = 1.2
"""The badness of a training that gave no finite policy: more than any other."""
ROUNDS = 8
"""In which a search that learns is asked for all configurations, if nobody says how many a round.
More learn more; fewer keep the cores busy."""


class Asker(Protocol):
    """What proposes configurations."""

    learns: bool
    batch: int

    def ask(self, most: int) -> list[Values]:
        """The next configurations, at most `most` and `batch`; none if there are no more."""
        ...

    def tell(self, badness: Sequence[float | None]) -> None:
        """How bad those of the last `ask` were, one by one; None where nothing is known."""
        ...

    def described(self) -> Any:
        """The search as plain data."""
        ...


def asker_for(
    search: Any, space: FeatureSpace, *, configurations: int, seed: int, batch: int | None = None
) -> Asker:
    """The asker of a search: a name, `"optuna:NAME"`, a `Search`, or an `OptunaSampler`.

    **Raises:** `UnknownNameError` for another name; `ValueError` for a search that needs
    gradients, or cannot work on this space; `MissingExtra` without Optuna.
    """
    rounds = max(available_cores(), -(-configurations // ROUNDS))
    if hasattr(search, "asker"):
        return search.asker(space, seed, rounds if batch is None else batch)
    if isinstance(search, str) and search.startswith("optuna:"):
        from verifai_jax.sweeps.optuna import OptunaSampler

        sampler = OptunaSampler(search.removeprefix("optuna:"))
        return sampler.asker(space, seed, rounds if batch is None else batch)
    if isinstance(search, str):
        search = searches.named(search)
    if not isinstance(search, Search):
        raise TypeError(
            f"search must be a name, a Search or an OptunaSampler; got {search!r}. "
            f"Names: {', '.join(searches.names())}, optuna:tpe"
        )
    if isinstance(search, Portfolio):
        search = replace(search, gradients=False)
    if needs_slopes(search):
        raise ValueError(
            f"search {search!r} needs gradients, which trainings do not have; "
            "use one that does not, such as 'halton' or 'bayes'"
        )
    search.check(space.cube)
    whole = configurations if not search.learns else rounds
    return CubeAsker(search, space, whole if batch is None else batch, seed)


class CubeAsker:
    """One of our own searches, on the unit cube of the space."""

    def __init__(self, search: Search, space: FeatureSpace, batch: int, seed: int) -> None:
        self.search, self.space, self.batch = search, space, batch
        self.learns = search.learns
        self._proposals = Proposals(search, space.cube, batch, run_keys(seed)[0], space.constraint)
        self._asked = 0

    def ask(self, most: int) -> list[Values]:
        if self._proposals.exhausted:
            self._asked = 0
            return []
        points = np.asarray(self._proposals.next(min(most, self.batch)))
        # A search that learns gives whole rounds, of which the last may be one too many.
        self._asked = len(points)
        return labelled(self.space, points)[:most]

    def tell(self, badness: Sequence[float | None]) -> None:
        known = [*badness, *[None] * (self._asked - len(badness))]
        rho = np.array([np.nan if b is None else b for b in known], np.float32)
        self._proposals.tell(rho, np.isfinite(rho), None)

    def described(self) -> Any:
        return searches.to_json(self.search) or repr(self.search)


def badness(
    failure_rate: float, worst: float, merit: float, earned: tuple[float, float]
) -> float | None:
    """How bad a policy is, between 0 and 1.11, for a search that looks for the least.

    The failure rate counts most; among equal rates the worst robustness, squeezed into a tenth;
    among equal ones of these the return, squeezed into a hundredth.

    - `merit`, `earned`: its nominal return, and the range of those of the first round.
    """
    if not math.isfinite(failure_rate):
        return None
    worst = 0.0 if math.isnan(worst) else float(np.clip(worst, -1e30, 1e30))
    low, high = earned
    share = (merit - low) / (high - low) if high > low and math.isfinite(merit) else 0.0
    near = 0.5 - 0.5 * worst / (1 + abs(worst))
    return failure_rate + 0.1 * near + 0.01 * (1 - float(np.clip(share, 0.0, 1.0)))
