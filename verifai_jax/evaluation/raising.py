"""Detection of problems whose simulations all raise: the error is reported once and ends the work.

    raising = Raising()
    raising.add(verdicts.status, verdicts.messages)     # of each batch, until one does not raise
    raising.reason                                      # None, or what all of them say

A formula on a signal that no trace has, a vector where a number is needed, a function with a
misspelt name: every simulation then raises the same error, so more of them are pointless.
"""

import re
import time
from collections.abc import Sequence

import numpy as np
from jaxtyping import Integer

from verifai_jax.core.messages.text import one_line
from verifai_jax.core.values.trace import Status

ALWAYS = 64
"""Simulations that have to raise, with none that does not: where nine of ten raise by chance, that
happens in one of 850 runs."""
SLOW = 10.0
"""Seconds after which `ALIKE` simulations that raise the same are enough."""
ALIKE = 16
"""Of these, where half raise by chance, all do in one of 65 000 runs."""
LONG = 30.0
"""Seconds after which `FEW` simulations that raise the same are enough."""
FEW = 3
_VARIES = re.compile(r"[-+]?\d[\d.]*(?:e[-+]?\d+)?")
"""What tells messages of one kind apart: the numbers in them."""


class AlwaysRaises(RuntimeError):
    """An error that ends work early because all of its simulations raise."""


class Raising:
    """The simulations of some work, recorded as long as all of them raise."""

    def __init__(self) -> None:
        self._since: float | None = None  # The first of them, so without what compiles before.
        self._kinds: set[str] = set()
        self._count = 0
        self._first = ""
        self.always = True

    def add(self, status: Integer[np.ndarray, " n"], messages: Sequence[str] | None) -> None:
        """Record the statuses and messages of simulations."""
        if not self.always or not len(status):
            return
        self._since = time.monotonic() if self._since is None else self._since
        self.always = bool(np.all(np.asarray(status) == Status.ERROR))
        self._count += len(status)
        for message in messages or ("",):
            self._first = self._first or message
            self._kinds.add(_VARIES.sub("0", message))

    def check(self, name: str) -> None:
        """End the work on the problem of this name if all of its simulations raise.

        **Raises:** `AlwaysRaises`.
        """
        if (said := self.reason) is not None:
            raise AlwaysRaises(
                f"each of the first {self._count} simulations of problem {name!r} "
                f"raised{f' {one_line(said)}' if said else ' an error'}, so no more are made; "
                "falsify(problem, 'uniform', 20, keep_going=True).table.all shows them"
            )

    @property
    def reason(self) -> str | None:
        """The common message, empty if there is none; None if further simulations may succeed."""
        seconds = 0.0 if self._since is None else time.monotonic() - self._since
        alike = ALWAYS if seconds < SLOW else ALIKE if seconds < LONG else FEW
        enough = self._count >= (alike if len(self._kinds) == 1 else ALWAYS)
        return self._first if self.always and enough else None
