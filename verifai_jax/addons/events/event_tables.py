"""Tables of an automaton, looked up where its sequences are drawn, read and written.

    tables = EventTables(transitions, graph)
    tables.by_kind[node, kind]                      # the transition that a kind of event is there
    tables.followed(kinds)                          # the transition of each event of many sequences

All follow from the transitions and from the graph of what can follow what.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.events.sequence import ABSENT
from verifai_jax.addons.events.transitions import Graph, Transition
from verifai_jax.features.domain import Domain


@dataclass(frozen=True, eq=False)
class EventTables:
    """Tables of an automaton's events.

    - `transitions`: the possible transitions, in the order written.
    - `graph`: the reachable states and pasts.
    """

    transitions: tuple[Transition, ...]
    graph: Graph

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the kinds of events, in the order written."""
        return tuple(dict.fromkeys(each.name for each in self.transitions))

    @cached_property
    def domains(self) -> dict[str, tuple[Domain, ...]]:
        """The different domains of each parameter, in the order written."""
        found: dict[str, dict[Domain, None]] = {}
        for each in self.transitions:
            for name, domain in each.parameters:
                found.setdefault(name, {})[domain] = None
        return {name: tuple(domains) for name, domains in found.items()}

    @cached_property
    def widths(self) -> tuple[int, ...]:
        """Numbers of coordinates of an event: 1 for its kind, those of its wait and parameters."""
        waits = max(each.wait.size for each in self.transitions)
        others = [max(domain.size for domain in group) for group in self.domains.values()]
        return (1, waits, *others)

    @cached_property
    def kind_of(self) -> Int[np.ndarray, " transitions"]:
        return np.array([self.names.index(each.name) for each in self.transitions], np.int32)

    @cached_property
    def by_kind(self) -> Int[np.ndarray, "nodes kinds"]:
        """The transition for each kind of event at each node; -1 if it is not enabled."""
        table = np.full((len(self.graph.states), len(self.names)), ABSENT, np.int32)
        for node, number in np.argwhere(self.graph.enabled):
            table[node, self.kind_of[number]] = number
        return table

    @cached_property
    def interval_middles(self) -> Float[np.ndarray, "nodes transitions"]:
        edges = self.graph.edges
        before = np.concatenate([np.zeros_like(edges[:, :1]), edges[:, :-1]], axis=1)
        return ((before + edges) / 2).astype(np.float32)

    @cached_property
    def waits(self) -> dict[Domain, tuple[int, ...]]:
        """The different domains of waiting times, each with the transitions that use it."""
        found: dict[Domain, tuple[int, ...]] = {}
        for number, each in enumerate(self.transitions):
            found[each.wait] = (*found.get(each.wait, ()), number)
        return found

    @cached_property
    def users(self) -> dict[str, dict[Domain, tuple[int, ...]]]:
        """For each parameter its domains, each with the transitions that use it."""
        found: dict[str, dict[Domain, tuple[int, ...]]] = {name: {} for name in self.domains}
        for number, each in enumerate(self.transitions):
            for name, domain in each.parameters:
                found[name][domain] = (*found[name].get(domain, ()), number)
        return found

    @cached_property
    def uses(self) -> Bool[np.ndarray, "transitions width"]:
        """The coordinates of an event that are used, for each transition."""
        table = np.zeros((len(self.transitions), sum(self.widths)), bool)
        starts = np.concatenate([[0], np.cumsum(self.widths)])
        for number, each in enumerate(self.transitions):
            table[number, 0] = True
            table[number, 1 : 1 + each.wait.size] = True
            own = dict(each.parameters)
            for name, begin in zip(self.domains, starts[2:], strict=False):
                if name in own:
                    table[number, begin : begin + own[name].size] = True
        return table

    @cached_property
    def pair_ids(self) -> Int[np.ndarray, "transitions transitions"]:
        count = len(self.transitions)
        table = np.full((count, count), ABSENT, np.int32)
        for i, (one, other) in enumerate(self.graph.pairs):
            table[one, other] = count + i
        return table

    def followed(self, kinds: Int[np.ndarray, "n events"]) -> Int[np.ndarray, "n events"]:
        """Return the transition of each event, given the kinds in many sequences."""
        taken, node = np.full(kinds.shape, ABSENT), np.zeros(len(kinds), int)
        for i in range(kinds.shape[1]):
            there = kinds[:, i] >= 0
            taken[:, i] = np.where(there, self.by_kind[node, kinds[:, i]], ABSENT)
            node = np.where(there, self.graph.following[node, taken[:, i]], node)
        return taken
