"""The order of several rules, for comparisons in which a sum would mislead.

    rulebook = Rulebook(("safe", "legal", "comfort"), [("safe", "comfort"), ("legal", "comfort")])
    rulebook.graver([1, 0, 0], [0, 0, 1])                    # True: breaking safety is worse
    rulebook.front(violations)                               # rows that no other row outdoes

An edge `(higher, lower)` says that breaking `higher` is graver than breaking `lower` by any amount;
without a path between them two rules cannot be traded for each other (Censi et al., Liability,
ethics, and culture-aware behavior specification using rulebooks, ICRA 2019). A row of robustness
becomes one number for a search through a linear extension of that order, so that a graver
counterexample always scores lower.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Shaped

from verifai_jax.core.messages.errors import check_names

Violation: TypeAlias = Sequence[float] | Shaped[np.ndarray, " k"]
"""By how much a row breaks each rule: numbers, 0 where a rule is kept, or truth values."""
MAX_RULES = 30
"""Rules at most: beyond, a lexicographic number would not be exact."""


@dataclass(frozen=True)
class Rulebook:
    """Rules by name, with pairs `(higher, lower)`: the first rule of a pair matters more.

    `order` lists each rule after all those that matter more: a topological order, which follows
    `names` where the edges leave it open.

    **Raises:** `ValueError` for a name that is not a rule, edges with a cycle, or more than
    `MAX_RULES` rules.
    """

    names: tuple[str, ...]
    edges: tuple[tuple[str, str], ...] = ()
    order: tuple[str, ...] = field(init=False, repr=False, compare=False)

    def __init__(self, names: Iterable[str], edges: Iterable[Sequence[str]] = ()) -> None:
        object.__setattr__(self, "names", tuple(names))
        pairs = []
        for edge in edges:
            if isinstance(edge, str) or len(edge) != 2:
                raise ValueError(f"an edge of a rulebook is a pair (higher, lower); got {edge!r}")
            check_names("rule", edge, self.names)
            pairs.append((edge[0], edge[1]))
        object.__setattr__(self, "edges", tuple(pairs))
        if len(self.names) > MAX_RULES:
            raise ValueError(f"a rulebook has at most {MAX_RULES} rules; got {len(self.names)}")
        object.__setattr__(self, "order", self._sorted())

    def graver(self, one: Violation, other: Violation) -> bool:
        """Return whether `one` is a graver counterexample than `other`.

        Both arguments list how far each rule is broken, in the order of `names`: a number that is 0
        where the rule is kept, or a truth value. `one` is graver if they differ and, for each rule
        that `other` breaks more, `one` breaks a higher rule more.
        """
        first, second = np.asarray(one, np.float64), np.asarray(other, np.float64)
        return bool(self._outdone(second[None], first[None])[0, 0])

    def front(
        self, violations: Shaped[np.ndarray, "n k"] | Sequence[Sequence[float]]
    ) -> Bool[np.ndarray, " n"]:
        """Mark the rows that no other row dominates: the Pareto set of counterexamples.

        Equal rows are marked together. Rows that break nothing are marked only if no row breaks a
        rule.
        """
        broken = np.asarray(violations, np.float64).reshape(-1, len(self.names))
        unique, index = np.unique(broken, axis=0, return_inverse=True)
        kept = np.ones(len(unique), bool)
        # In blocks, so that memory stays small with thousands of different rows.
        for start in range(0, len(unique), 256):
            block = slice(start, start + 256)
            kept[block] = ~np.any(self._outdone(unique[block], unique), axis=1)
        return kept[index.ravel()]

    def grade(
        self, violated: Bool[np.ndarray, "n k"] | Float[np.ndarray, "n k"]
    ) -> Float[np.ndarray, " n"]:
        """Return a number for each row: larger for graver rows, equal for equal rows.

        This extends the partial order to a linear one, so rows that cannot be compared are ordered
        too.
        """
        indices = [self.names.index(name) for name in self.order]
        weights = 2.0 ** np.arange(len(indices) - 1, -1, -1)
        return np.asarray(violated, np.float64)[..., indices] @ weights

    def _outdone(
        self, rows: Float[np.ndarray, "n k"], others: Float[np.ndarray, "m k"]
    ) -> Bool[np.ndarray, "n m"]:
        """Return whether row i is less grave than other row j."""
        more = others[None] > rows[:, None]  # Rules that the other breaks by more.
        less = others[None] < rows[:, None]
        excused = more.astype(np.float32) @ self._above.astype(np.float32).T > 0
        return np.any(more, axis=-1) & np.all(~less | excused, axis=-1)

    @property
    def _above(self) -> Bool[np.ndarray, "k k"]:
        """`[lower, higher]`: whether a path leads from the higher to the lower rule."""
        k = len(self.names)
        above = np.zeros((k, k), bool)
        for higher, lower in self.edges:
            above[self.names.index(lower), self.names.index(higher)] = True
        for via in range(k):
            above |= above[:, via : via + 1] & above[via : via + 1, :]
        return above

    def _sorted(self) -> tuple[str, ...]:
        sorter = TopologicalSorter({name: set() for name in self.names})
        for higher, lower in self.edges:
            sorter.add(lower, higher)
        try:
            sorter.prepare()
        except CycleError as error:
            circle = " > ".join(reversed(error.args[1]))
            raise ValueError(f"the edges of a rulebook go round in a circle: {circle}") from None
        found: list[str] = []
        ready = list(sorter.get_ready())
        while ready:
            ready.sort(key=self.names.index)
            name = ready.pop(0)
            found.append(name)
            sorter.done(name)
            ready += sorter.get_ready()
        return tuple(found)


class Objective:
    """The objective of a search over several rules, in one number.

    Positive for rows that are less grave than the gravest counterexample so far, negative for rows
    that are as grave: once an important rule is broken, breaking a lesser one alone is no success.
    Within one grade the weighted margins of the rules decide. `state` holds its whole memory; keep
    it to resume later.
    """

    def __init__(self, rulebook: Rulebook) -> None:
        self.rulebook = rulebook
        k = len(rulebook.names)
        self.state: dict[str, np.ndarray] = {
            "gravest": np.zeros(()),
            "scale": np.zeros(k),  # Typical size of each rule's robustness; 0 until a batch shows.
        }

    def __call__(
        self, rho: Float[np.ndarray, "n k"], violated: Bool[np.ndarray, "n k"]
    ) -> Float[np.ndarray, " n"]:
        """Score rows `[n, k]` of robustness and verdicts; NaN stays NaN."""
        rho = np.asarray(rho, np.float64)
        proper = np.all(np.isfinite(rho), axis=1)
        score = np.full(len(rho), np.nan)
        if not proper.any():
            return score
        rho, violated = rho[proper], np.asarray(violated)[proper]
        if not self.state["scale"].all():
            size = np.mean(np.abs(rho), axis=0)
            self.state["scale"] = np.where(size > 0, size, 1.0)
        grade = self.rulebook.grade(violated)
        self.state["gravest"] = np.maximum(self.state["gravest"], grade.max())
        margin = self.rulebook.grade(np.tanh(rho / self.state["scale"]))
        margin /= 2.0 ** len(self.rulebook.names) - 1  # From -1 to 1.
        if self.state["gravest"] == 0:
            score[proper] = 0.5 * (1 + margin)
        else:
            score[proper] = np.log2(1 + self.state["gravest"] - grade) + 0.5 * (margin - 1)
        return score
