"""A proof about a part of a feature space, as `Start(proved=)` uses it."""

from typing import TYPE_CHECKING, Protocol, runtime_checkable

from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd


@runtime_checkable
class Proof(Protocol):
    """A result that proves the property on a part of a feature space."""

    @property
    def note(self) -> str:
        """A sentence on simulations of the remaining part."""
        ...

    def rest(self, problem: Problem, precision: str = "float32") -> Problem:
        """Return the problem without its proved part."""
        ...

    def loosest(self, problem: Problem, budget: int) -> "pd.DataFrame | None":
        """Return rows of the remaining part for a search to begin with."""
        ...
