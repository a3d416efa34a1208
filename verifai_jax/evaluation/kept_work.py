"""The present work of this process, whose simulations are stored in a folder.

kept = present_part(kept, problem, "float32", 0)    # a `Part`; None if nothing is kept
"""

from contextvars import ContextVar
from typing import Any, Protocol

from verifai_jax.problem.problem import Problem


class KeptWork(Protocol):
    """The interface of `evaluation.unfinished.Unfinished` that evaluators need."""

    def part(self, problem: Problem, *mode: object) -> Any:
        """Return the `Part` of the next evaluator."""


PRESENT: ContextVar[KeptWork | None] = ContextVar("unfinished", default=None)
"""The work; set by `evaluation.unfinished.keeping`."""


def present() -> KeptWork | None:
    """Return the work whose simulations are being stored; None if there is none."""
    return PRESENT.get()


def present_part(kept: Any, problem: Problem, *mode: object) -> Any:
    """Return an evaluator's `Part` of the present work; None if nothing is stored.

    **Arguments:**
    - `kept`: its part of earlier work, or None. A part of the present work is returned unchanged.
    - `problem`, `mode`: the arguments of a new `Part`.
    """
    work = present()
    if work is None or (kept is not None and kept.of is work):
        return None if work is None else kept
    return work.part(problem, *mode)
