"""Rounds that are simulated ahead, for a search that does not learn.

    ahead = Prefetch(proposals, evaluate, batch=1024, limit=1_000_000, first=0)
    points, verdicts = ahead.next()                     # of one round, in their order

Such a search can propose many rounds before the verdicts of the first are known. So no worker of an
executor waits, and in this process the next round is simulated while the last one is confirmed and
stored. The checkpoint is that of the last round taken; rounds still running when the run ends are
discarded.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from verifai_jax.core.compute.precision import reproducible_settings
from verifai_jax.evaluation.evaluator import Evaluator, Pending
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.search.proposals import Proposals

AHEAD = 3
"""Rounds of this process that are simulated or wait to be, so that one is ready while an earlier
one is confirmed for longer than another takes."""


class _Round(NamedTuple):
    """One round: its points, its offset among the rows sent together, and the state after it."""

    points: Float[Any, "n d"]
    pending: Pending | Future[Verdicts]
    begin: int
    checkpoint: dict[str, Any]


class Prefetch:
    """The rounds that workers simulate ahead of time; see the module's docstring.

    **Arguments:**
    - `proposals`: the proposals of a search that does not learn.
    - `evaluate`: the evaluator, with an executor or of a system that this process compiles.
    - `batch`: rows in a round.
    - `limit`: rows of the whole run.
    - `first`: number of the next row.
    - `searching`: a context around each proposal.
    """

    def __init__(
        self, proposals: Proposals, evaluate: Evaluator, batch: int, limit: int, first: int,
        searching: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> None:  # fmt: skip
        self._proposals, self._evaluate, self._searching = proposals, evaluate, searching
        self._workers = evaluate.sender
        self._thread = None if self._workers else ThreadPoolExecutor(1, "simulations")
        self._batch, self._limit, self._next = batch, limit, first
        self._rounds: deque[_Round] = deque()
        self._failure: Exception | None = None
        self.checkpoint = proposals.checkpoint()

    @property
    def empty(self) -> bool:
        """True if no round has been sent ahead."""
        return not self._rounds

    def next(self) -> tuple[Float[Any, "n d"], Verdicts | None]:
        """Return the points of the next round and their verdicts; no points if there is no round.

        **Raises:** the error that proposing or evaluating this round raised.
        """
        self._fill()
        if not self._rounds:
            if self._failure is not None:
                raise self._failure
            return np.zeros((0, self._proposals.cube.dim), np.float32), None
        each = self._rounds[0]
        whole = each.pending.result()
        self._rounds.popleft()
        self.checkpoint = each.checkpoint
        part = slice(each.begin, each.begin + len(each.points))
        return each.points, whole.rows(part)

    def close(self) -> None:
        """Cancel queued rounds, and reset the proposals to the end of the last round taken."""
        if self._rounds or self._failure is not None:
            for each in self._rounds:
                each.pending.cancel()
            self._rounds.clear()
            self._proposals.restore(self.checkpoint)
        if self._thread is not None:
            self._thread.shutdown(wait=False)

    @property
    def _block(self) -> int:
        """Rows that are sent together."""
        return self._batch if self._workers is None else self._workers.block

    @property
    def _ahead(self) -> int:
        """Number of rows that are simulated ahead at a time."""
        return AHEAD * self._batch if self._workers is None else self._workers.ahead

    def _submit(self, points: Float[Any, "n d"], first: int) -> "Pending | Future[Verdicts]":
        if self._thread is None:
            return self._evaluate.submit(points, first)
        return self._thread.submit(self._simulated, points, first)

    def _simulated(self, points: Float[Any, "n d"], first: int) -> Verdicts:
        with reproducible_settings():  # A thread begins with a person's own.
            return self._evaluate(points, first=first)

    def _fill(self) -> None:
        """Propose and send rounds until enough rows are being simulated."""
        waiting = sum(len(each.points) for each in self._rounds)
        while waiting < max(self._ahead, 1) and self._failure is None:
            group: list[tuple[Any, dict[str, Any]]] = []
            count = 0
            # Small rounds go together, in one block.
            while count < self._block and self._next + count < self._limit:
                try:
                    maximum = min(self._batch, self._limit - self._next - count)
                    with self._searching():
                        points = self._proposals.next(maximum)
                except Exception as error:
                    self._failure = error  # Raised when the rounds before it are stored.
                    break
                if not len(points):
                    break
                group.append((points, self._proposals.checkpoint()))
                count += len(points)
            if not group:
                return
            together = group[0][0] if len(group) == 1 else np.concatenate([p for p, _ in group])
            pending = self._submit(together, self._next)
            begin = 0
            for points, checkpoint in group:
                self._rounds.append(_Round(points, pending, begin, checkpoint))
                begin += len(points)
            self._next += count
            waiting += count
