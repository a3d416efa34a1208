"""Coverage of a run, and totals: states, transitions and pairs of automata, cells, clauses."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from jaxtyping import Bool, Int

from verifai_jax.core.display.figure import Figure
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.values.trace import Status
from verifai_jax.features import Domain
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    from verifai_jax.addons.events.automaton import Automaton
MAX_NAMED = 4
"""Uncovered names that are listed at most."""


@dataclass(frozen=True)
class Covered:
    """One kind of item to cover.

    - `where`: the name of the feature, or `traces`.
    - `what`: `states`, `transitions`, `pairs`, `cells` or `clauses`.
    - `names`: the names of all items.
    - `hits`: number of simulations that covered each item.
    """

    where: str
    what: str
    names: tuple[str, ...]
    hits: tuple[int, ...]

    @property
    def covered(self) -> int:
        """Number of items that at least one simulation covered."""
        return sum(count > 0 for count in self.hits)

    @property
    def total(self) -> int:
        """Number of items."""
        return len(self.names)

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the items that no simulation covered."""
        return tuple(name for name, count in zip(self.names, self.hits, strict=True) if not count)

    def __str__(self) -> str:
        noun = _NOUNS[self.what]
        share = f"{self.covered} of {self.total} {noun}"
        if not self.total or self.covered == self.total:
            return share
        if self.what == "cells":
            return share
        shown = ", ".join(self.missing[:MAX_NAMED])
        more = len(self.missing) - MAX_NAMED
        return f"{share}; not covered: {shown}{f' and {more} more' if more > 0 else ''}"


_NOUNS = {
    "states": "states",
    "transitions": "transitions",
    "pairs": "pairs of transitions that can follow each other",
    "cells": "cells of behaviour",
    "clauses": "clauses nearest to breaking",
}


@dataclass(frozen=True, eq=False)
class FuzzCoverage(InNotebook):
    """Coverage of a run; `parts` holds a `Covered` for each feature and kind."""

    parts: tuple[Covered, ...]
    automata: "tuple[tuple[str, Automaton], ...]" = ()

    @classmethod
    def of(cls, problem: Problem, counts: Int[np.ndarray, " ids"]) -> "FuzzCoverage":
        """Compute the coverage from a run's counts of coverage ids."""
        parts: list[Covered] = []
        first = len(Status)
        automata = tuple(_automata(problem.space.root, ""))
        for name, automaton in automata:
            own = counts[first : first + automaton.coverage_id_count]
            parts += _of_automaton(name, automaton, own)
            first += automaton.coverage_id_count
        behaviour = problem.behaviour
        if behaviour is not None and behaviour.cells:
            own = counts[first : first + behaviour.cells]
            names = tuple(behaviour.cell_name(i) for i in range(behaviour.cells))
            parts.append(Covered("traces", "cells", names, tuple(own.tolist())))
        if behaviour is not None and behaviour.goals is not None:
            own = counts[first + behaviour.cells : first + behaviour.total]
            names = tuple(f"clause {i + 1}" for i in range(len(own)))
            parts.append(Covered("traces", "clauses", names, tuple(own.tolist())))
        return cls(tuple(parts), automata)

    def __getitem__(self, what: str) -> Covered:
        """Return the part of this kind; if several features have it, that of the first."""
        for part in self.parts:
            if part.what == what:
                return part
        raise KeyError(f"nothing to cover of kind {what!r}: {[part.what for part in self.parts]}")

    def pairs(self, name: str) -> tuple[Bool[np.ndarray, "t t"], Int[np.ndarray, "t t"]]:
        """Return the possible pairs of transitions of an automaton, and the hits of each."""
        automaton = dict(self.automata)[name]
        count = len(automaton.transitions)
        possible, hits = np.zeros((count, count), bool), np.zeros((count, count), int)
        found = next(part for part in self.parts if (part.where, part.what) == (name, "pairs"))
        for (one, other), number in zip(automaton.graph.pairs, found.hits, strict=True):
            possible[one, other], hits[one, other] = True, number
        return possible, hits

    def plot(self, path: str | Path | None = None) -> Figure:
        """Draw the pairs of consecutive transitions of the first automaton.

        **Raises:** `ValueError` for a run without an automaton.
        """
        return lazy_import("verifai_jax.addons.fuzzing.picture", "plot_pairs")(self, path)

    def __str__(self) -> str:
        width = max((len(part.where) for part in self.parts), default=0)
        return "\n".join(f"{part.where:<{width}}  {part}" for part in self.parts)

    __repr__ = __str__


def _automata(domain: Domain, name: str) -> "Iterator[tuple[str, Automaton]]":
    """Yield the automata of a space in the order of their coverage ids."""
    if domain.graph is not None:
        yield name, cast("Automaton", domain)
    for field, part in domain.named:
        yield from _automata(part, f"{name}.{field}" if name else field)


def _of_automaton(
    name: str, automaton: "Automaton", counts: Int[np.ndarray, " ids"]
) -> list[Covered]:
    graph, labels = automaton.graph, [each.label for each in automaton.transitions]
    taken, pairs = counts[: len(labels)], counts[len(labels) :]
    states = dict.fromkeys(graph.reachable_states, 0)
    # Every simulation begins in the start.
    states[automaton.start] = 1
    for number in graph.transitions:
        states[automaton.transitions[number].to] += int(taken[number])
    possible = [(labels[number], int(taken[number])) for number in graph.transitions]
    following = tuple(f"{labels[one]} then {labels[other]}" for one, other in graph.pairs)
    return [
        Covered(name, "states", tuple(states), tuple(states.values())),
        Covered(
            name,
            "transitions",
            tuple(label for label, _ in possible),
            tuple(count for _, count in possible),
        ),
        Covered(name, "pairs", following, tuple(pairs.tolist())),
    ]
