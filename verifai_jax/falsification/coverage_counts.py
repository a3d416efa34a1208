"""Coverage ids: numbers of the items that simulations covered, and the first row for each.

    coverage = CoverageCounts(problem)
    rows = coverage.of(points, verdicts)                   # [n, ids], -1 for nothing
    fresh = coverage.add(rows)                             # [n], ids that no earlier row had

The ids number statuses first, then items covered by features (transitions of an automaton and pairs
of them), then items covered by traces (`problem.behaviour`): cells, and the clause nearest to
breaking.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem
from verifai_jax.search.base import KIND

SEEN = "coverage.seen"
"""Entry of a checkpoint: how many rows had each coverage id."""


class CoverageCounts:
    """The coverage ids of a run, counted; see the module's docstring."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.features = problem.space.root.coverage_id_count
        self.behaviour = 0 if problem.behaviour is None else problem.behaviour.total
        self.counts = np.zeros(len(Status) + self.features + self.behaviour, np.int64)

    @property
    def width(self) -> int:
        """Maximum number of coverage ids of a row."""
        return 1 + self._feature_width + self._shown

    @property
    def _feature_width(self) -> int:
        space = self.problem.space
        point = jax.ShapeDtypeStruct((space.dim,), jnp.float32)
        return jax.eval_shape(lambda u: space.root.coverage_ids(space.unflatten(u)), point).shape[0]

    @property
    def _shown(self) -> int:
        return 0 if self.problem.behaviour is None else self.problem.behaviour.size

    def of(self, points: Float[Any, "n d"], verdicts: Verdicts) -> Int[np.ndarray, "n ids"]:
        """Return the coverage ids of rows."""
        parts = [verdicts.status[:, None].astype(np.int32)]
        if self.features:
            own = np.asarray(self.problem.space.coverage_ids_at(points))
            parts.append(np.where(own >= 0, own + len(Status), -1))
        if self._shown:
            assert verdicts.coverage_ids is not None
            first = len(Status) + self.features
            parts.append(np.where(verdicts.coverage_ids >= 0, verdicts.coverage_ids + first, -1))
        return np.concatenate(parts, axis=1).astype(np.int32)

    def of_kinds(self, rows: Int[np.ndarray, "n ids"]) -> Int[np.ndarray, "n ids"]:
        """Return the ids that a search gets: features, cells and verdicts are separate kinds."""
        cells = len(Status) + self.features
        behaviour = self.problem.behaviour
        clauses = cells + (0 if behaviour is None else behaviour.cells)
        numbers = np.where(rows >= clauses, 2 * KIND + len(Status) + rows - clauses, rows)
        numbers = np.where((rows >= cells) & (rows < clauses), KIND + rows - cells, numbers)
        numbers = np.where((rows >= len(Status)) & (rows < cells), rows - len(Status), numbers)
        numbers = np.where((rows >= 0) & (rows < len(Status)), 2 * KIND + rows, numbers)
        return numbers.astype(np.int32)

    def add(self, rows: Int[np.ndarray, "n ids"]) -> Int[np.ndarray, " n"]:
        """Count the coverage ids of rows; return how many ids of each row are new."""
        fresh = np.zeros(len(rows), np.int32)
        for i, row in enumerate(rows):
            own = np.unique(row[row >= 0])
            fresh[i] = np.count_nonzero(self.counts[own] == 0)
            self.counts[own] += 1
        return fresh

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return the counts as an entry of a checkpoint."""
        return {SEEN: self.counts.copy()}

    def restore(self, checkpoint: Mapping[str, Any]) -> None:
        """Continue with the counts of a checkpoint."""
        if SEEN in checkpoint:
            self.counts = np.array(checkpoint[SEEN], np.int64)
