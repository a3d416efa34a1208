"""The work that evaluators of this process are part of, while its simulations are kept in a folder.

work = present()                                    # an `Unfinished`; None if nothing is kept
"""

from contextvars import ContextVar
from typing import Any

PRESENT: ContextVar[Any] = ContextVar("unfinished", default=None)
"""The work; set by `evaluation.unfinished.keeping`, which a run imports only where it is used."""


def present() -> Any:
    """Return the `Unfinished` work whose simulations are kept now, or None if there is none."""
    return PRESENT.get()
