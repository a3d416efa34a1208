"""The work that evaluators of this process are part of, while its simulations are kept in a folder.

work = present()                                    # an `Unfinished`; None if nothing is kept
"""

from contextvars import ContextVar
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from verifai_jax.evaluation.unfinished import Unfinished

PRESENT: "ContextVar[Unfinished | None]" = ContextVar("unfinished", default=None)
"""The work; set by `evaluation.unfinished.keeping`."""


def present() -> "Unfinished | None":
    """Return the work whose simulations are kept now, or None if there is none."""
    return PRESENT.get()
