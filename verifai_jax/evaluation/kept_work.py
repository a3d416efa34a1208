"""The work that evaluators of this process are part of, while its simulations are kept in a folder.

work = present()                                    # an `Unfinished`; None if nothing is kept
"""

from contextvars import ContextVar
from typing import Any, Protocol

from verifai_jax.problem.problem import Problem


class KeptWork(Protocol):
    """The part of an `evaluation.unfinished.Unfinished` that evaluators need."""

    def part(self, problem: Problem, *mode: object) -> Any:
        """Return the `Part` of the next evaluator."""


PRESENT: ContextVar[KeptWork | None] = ContextVar("unfinished", default=None)
"""The work; set by `evaluation.unfinished.keeping`."""


def present() -> KeptWork | None:
    """Return the work whose simulations are kept now, or None if there is none."""
    return PRESENT.get()
