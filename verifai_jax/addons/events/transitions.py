"""The graph of an automaton with unfolded guards: possible successors and their probabilities.

    graph = unfold("cruise", transitions, 6)
    graph.edges[node]                                   # cumulative probabilities of transitions
    graph.pairs                                         # all that can follow each other

Guards depend on past events. They are evaluated here, once for each reachable state and past, so
that a simulation only looks up tables, and all coverable items are counted exactly.
"""

import difflib
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.features.domain import Domain

MAX_NODES = 50_000
"""Greatest number of states of an automaton, each with the pasts that guards tell apart: its tables
have a row for each and a column for each transition."""
NEARLY = 0.82
"""Similarity of two names from which one is taken for the other, misspelt: one letter in six."""
MIN_SHARE = 2.0**-20
"""Least probability of a transition: a narrower interval is no distinct one in float32."""


@dataclass(frozen=True)
class Past:
    """The events before the one that a guard decides on.

    - `counts`: how often each event has happened, by name; events that have not are missing.
    - `last`: name of the latest event; None at the start.
    """

    counts: tuple[tuple[str, int], ...] = ()
    last: str | None = None

    def count(self, name: str) -> int:
        """Return how often this event has happened."""
        return dict(self.counts).get(name, 0)

    def __len__(self) -> int:
        return sum(count for _, count in self.counts)

    def then(self, name: str) -> "Past":
        """Return the past after one more event."""
        counts = dict(self.counts)
        counts[name] = counts.get(name, 0) + 1
        return Past(tuple(sorted(counts.items())), name)


@dataclass(frozen=True)
class Transition:
    """An event that may happen in a state.

    - `source` and `to`: the states before and after it.
    - `name`: the name of the event.
    - `wait`: domain of the seconds since the previous event.
    - `parameters`: domains by name.
    - `weight`: relative probability among the enabled transitions.
    - `after`: names of events that must have happened before.
    - `at_most`: maximum number of events of this name; any number if None.
    - `guard`: a function of the `Past` that must return True; None for no guard.
    """

    source: str
    name: str
    to: str
    wait: Domain
    parameters: tuple[tuple[str, Domain], ...] = ()
    weight: float = 1.0
    after: tuple[str, ...] = ()
    at_most: int | None = None
    guard: Callable[[Past], bool] | None = None

    @property
    def guarded(self) -> bool:
        """True if the past decides whether it is enabled."""
        return bool(self.after) or self.at_most is not None or self.guard is not None

    def enabled(self, past: Past) -> bool:
        """Return whether the transition is enabled after this past, in its state."""
        if any(not past.count(name) for name in self.after):
            return False
        if self.at_most is not None and past.count(self.name) >= self.at_most:
            return False
        return self.guard is None or bool(self.guard(past))

    @property
    def label(self) -> str:
        """The transition as text, such as `cruise -cut_in-> crowded`."""
        return f"{self.source} -{self.name}-> {self.to}"


@dataclass(frozen=True, eq=False)
class Graph:
    """The reachable nodes, node 0 first, and the transitions from each.

    - `states`: the state of each node.
    - `edges`: cumulative probabilities of the transitions from each node; those that are not
      enabled have an interval of width zero.
    - `following`: the node after each transition; 0 if it is not enabled.
    - `enabled`: whether each transition is enabled.
    - `last`: the last enabled transition at each node; -1 if there is none.
    - `reachable_states`, `transitions`: names and numbers of those that occur in some sequence.
    - `pairs`: pairs of transitions that can follow each other directly.
    """

    states: tuple[str, ...]
    edges: Float[np.ndarray, "nodes transitions"]
    following: Int[np.ndarray, "nodes transitions"]
    enabled: Bool[np.ndarray, "nodes transitions"]
    last: Int[np.ndarray, " nodes"]
    reachable_states: tuple[str, ...]
    transitions: tuple[int, ...]
    pairs: tuple[tuple[int, int], ...]

    def longest(self, limit: int) -> int:
        """Return the number of events in the longest sequence, at most `limit`."""
        nodes = {0}
        for length in range(limit):
            nodes = {
                int(self.following[node, number])
                for node in nodes
                for number in np.flatnonzero(self.enabled[node])
            }
            if not nodes:
                return length
        return limit


def check_states(start: str, transitions: tuple[Transition, ...]) -> None:
    """Refuse states that are misspelt, or that no sequence of events reaches.

    **Raises:** `UnknownNameError`, `ValueError`.
    """
    sources = dict.fromkeys(each.source for each in transitions)
    for each in transitions:
        if each.to not in sources:
            near = difflib.get_close_matches(each.to, sources, n=1, cutoff=NEARLY)
            near += [name for name in sources if sorted(name) == sorted(each.to)]
            if near and not _is_numbered(each.to, near[0]):
                raise ValueError(
                    f"no event leaves the state {each.to!r} that {each.label} leads to; did you "
                    f"mean {near[0]!r}? A state in which a sequence ends needs a more different "
                    "name"
                )
    reached, added = {start}, True
    while added:
        leads = {each.to for each in transitions if each.source in reached}
        reached, added = reached | leads, not leads <= reached
    for each in transitions:
        if each.source not in reached:
            raise ValueError(
                f"no sequence of events leads from {start!r} to the state {each.source!r} of "
                f"{each.label}, only to {', '.join(sorted(reached))}: correct its name, or add an "
                f"event with to={each.source!r}"
            )


def _is_numbered(one: str, other: str) -> bool:
    """Return whether two names differ by their digits alone, as `lane1` and `lane2` do."""
    return re.sub(r"\d+", "", one) == re.sub(r"\d+", "", other)


def unfold(start: str, transitions: tuple[Transition, ...], limit: int) -> Graph:
    """Return the graph of all sequences of at most `limit` events.

    **Raises:** `ValueError` for guards that distinguish too many pasts, too unequal weights, or a
    start that no event can leave.
    """
    guarded = any(each.guarded for each in transitions)
    nodes: dict[tuple[str, Past], int] = {(start, Past()): 0}
    following: list[dict[int, int]] = []
    frontier = [(start, Past())]
    taken: set[int] = set()
    pairs: set[tuple[int, int]] = set()
    # Breadth first, so that a node is met at the least number of events that lead to it.
    for depth in range(limit + 1):
        found: list[tuple[str, Past]] = []
        for state, past in frontier:
            node = nodes[state, past]
            leads: dict[int, int] = {}
            for number, each in enumerate(transitions):
                if each.source != state or not each.enabled(past):
                    continue
                target = (each.to, past.then(each.name) if guarded else Past())
                if target not in nodes:
                    if depth == limit:
                        leads[number] = 0
                        continue
                    nodes[target] = len(nodes)
                    found.append(target)
                    if len(nodes) > MAX_NODES:
                        raise ValueError(
                            f"the guards distinguish more than {MAX_NODES} pasts of at most "
                            f"{limit} events; allow fewer events, or guard fewer of them"
                        )
                leads[number] = nodes[target]
            following.append(leads)
        frontier = found
    depths = _min_depths(following)
    for node, leads in enumerate(following):
        for number, target in leads.items():
            if depths[node] < limit:
                taken.add(number)
                if depths[node] < limit - 1:
                    pairs |= {(number, second) for second in following[target]}
    names = list(nodes)
    if not following[0]:
        raise ValueError(f"no event is possible in the start, {start!r}")
    return _tables(names, transitions, following, taken, pairs)


def _min_depths(following: list[dict[int, int]]) -> list[int]:
    depths = [0] + [len(following) + 1] * (len(following) - 1)
    frontier = [0]
    while frontier:
        found = []
        for node in frontier:
            for target in following[node].values():
                if target and depths[target] > depths[node] + 1:
                    depths[target] = depths[node] + 1
                    found.append(target)
        frontier = found
    return depths


def _tables(
    nodes: list[tuple[str, Past]], transitions: tuple[Transition, ...],
    following: list[dict[int, int]], taken: set[int], pairs: set[tuple[int, int]],
) -> Graph:  # fmt: skip
    shape = (len(nodes), len(transitions))
    enabled, target = np.zeros(shape, bool), np.zeros(shape, np.int32)
    for node, leads in enumerate(following):
        for number, to in leads.items():
            enabled[node, number], target[node, number] = True, to
    weights = np.where(enabled, [each.weight for each in transitions], 0.0)
    total = weights.sum(axis=1, keepdims=True)
    shares = weights / np.where(total > 0, total, 1.0)
    if enabled.any() and shares[enabled].min() < MIN_SHARE:
        node, number = (int(i) for i in np.argwhere(enabled & (shares < MIN_SHARE))[0])
        raise ValueError(
            f"the weight of {transitions[number].label}, {transitions[number].weight:zg}, is too "
            "small next to the others of its state: its probability must be at least "
            f"{MIN_SHARE:z.1g}; leave out events that never happen"
        )
    last = np.where(
        enabled.any(axis=1), shape[1] - 1 - np.argmax(enabled[:, ::-1], axis=1), -1
    ).astype(np.int32)
    states = {nodes[0][0]} | {transitions[number].to for number in taken}
    return Graph(
        states=tuple(state for state, _ in nodes),
        edges=np.cumsum(shares, axis=1).astype(np.float32),
        following=target,
        enabled=enabled,
        last=last,
        reachable_states=tuple(sorted(states)),
        transitions=tuple(sorted(taken)),
        pairs=tuple(sorted(pairs)),
    )
