"""Sequences of timed events that an automaton allows (`Automaton`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from verifai_jax.addons.events.event_tables import EventTables
from verifai_jax.addons.events.sequence import ABSENT, Events
from verifai_jax.addons.events.transitions import Graph, Transition, check_states, unfold
from verifai_jax.addons.events.written_events import (
    WrittenEvents,
    describe_event,
    read_event,
    where_there,
)
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.features.domain import Domain, Row, as_real, cell, centre, dotted, indexed
from verifai_jax.features.facts import Facts, integer_facts


@dataclass(frozen=True, init=False, repr=False)
class Automaton(Domain):
    """Sequences of timed events that an automaton allows; every point of the cube is one.

        Automaton(start="cruise", max_events=6, events={
            ("cruise", "cut_in"): dict(to="crowded", wait=Box(0.5, 4), gap=Box(5, 20)),
            ("crowded", "brake"): dict(to="cruise", wait=Box(0.2, 2), rate=Box(2, 8), weight=2.0),
        })

    A value is an `Events`. Under the prior the number of events is uniform from `min_events` to
    `max_events`, and a sequence ends early in a state that no event can leave. Each event is drawn
    from those enabled by its predecessors, in proportion to their weights; waiting times and
    parameters come from their domains. Each of these is one unit coordinate, mapped by its inverse
    cumulative distribution.

    **Arguments:**
    - `start`: the state before the first event.
    - `events`: `(state, name)` -> a description of the event: a dictionary with

      - `to`: the state afterwards; the same one when left out,
      - `wait`: domain of the seconds since the previous event, or since the start,
      - `weight`: relative probability among the enabled events, 1 when left out,
      - `after`: names of events that must have happened before,
      - `at_most`: maximum number of events of this name,
      - `guard`: a function of the `Past` that must return True; called when the automaton is built,
      - and parameters by name, each a domain.
    - `max_events`: maximum number of events.
    - `min_events`: minimum number of events, unless no event is possible any more.

    **Raises:** `ValueError` for invalid events, options that are unknown or out of range, states
    that no event leads to, a `to` that nearly matches the name of another state, a `min_events`
    that no sequence reaches, and guards that distinguish too many pasts; `TypeError` for a
    parameter that is not a domain.
    """

    start: str
    transitions: tuple[Transition, ...]
    min_events: int
    max_events: int

    def __init__(
        self, start: str, events: Mapping[tuple[str, str], Mapping[str, Any]], max_events: int = 6,
        min_events: int = 0,
    ) -> None:  # fmt: skip
        check_count("max_events", max_events)
        if (
            isinstance(min_events, bool)
            or not isinstance(min_events, int)
            or not 0 <= min_events <= max_events
        ):
            raise ValueError(
                f"min_events must be an integer from 0 to max_events, {max_events}; got "
                f"{min_events!r}"
            )
        if not isinstance(events, Mapping) or not events:
            raise ValueError(
                'events must be a dictionary {("state", "name"): dict(to=..., wait=...), ...}; '
                f"got {events!r}"
            )
        transitions = tuple(read_event(entry, event) for entry, event in events.items())
        sources = {each.source for each in transitions}
        if start not in sources:
            raise unknown_name("state to start in", start, sources)
        names = {each.name for each in transitions}
        for each in transitions:
            for name in each.after:
                if name not in names:
                    raise unknown_name(f"event in after= of {each.label}", name, names)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "transitions", transitions)
        object.__setattr__(self, "min_events", int(min_events))
        object.__setattr__(self, "max_events", int(max_events))
        self._check_parameters()
        check_states(start, transitions)
        longest = self.graph.longest(max_events)
        if longest < min_events:
            raise ValueError(
                f"min_events={min_events} events are impossible: no sequence from {start!r} has "
                f"more than {longest}, after which no event is enabled; require fewer, or add "
                "events that can follow"
            )

    def _check_parameters(self) -> None:
        """Refuse parameters of one name whose values have different forms."""
        for name, domains in self._tables.domains.items():
            forms = {}
            for each in domains:
                form = jax.eval_shape(each.from_unit, jax.ShapeDtypeStruct((each.size,), "float32"))
                if not isinstance(form, jax.ShapeDtypeStruct) or each.lengths or each.signals:
                    raise ValueError(
                        f"parameter {name!r} must be a number, a choice or a vector of numbers; "
                        f"got {each!r}"
                    )
                forms[form.shape, str(form.dtype)] = each
            if len(forms) > 1:
                one, two = list(forms.values())[:2]
                raise ValueError(
                    f"parameter {name!r} must be of one kind in all events; got {one!r} and {two!r}"
                )
        for each in self.transitions:
            form = jax.eval_shape(
                each.wait.from_unit, jax.ShapeDtypeStruct((each.wait.size,), "float32")
            )
            if getattr(form, "shape", None) != () or not jnp.issubdtype(form.dtype, jnp.number):
                raise ValueError(f"wait of {each.label} must be of one number; got {each.wait!r}")
        waits = [each.wait for each in self.transitions]
        # One program for all, and not one for each operation.
        shortest = jax.jit(lambda: [wait.from_unit(jnp.zeros(wait.size)) for wait in waits])()
        for each, earliest in zip(self.transitions, shortest, strict=True):
            if float(earliest) < 0:
                raise ValueError(
                    f"wait of {each.label} is in seconds and must not be negative; got "
                    f"{each.wait!r}"
                )

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""
        found = [self.start]
        for each in self.transitions:
            found += [each.source, each.to]
        return tuple(dict.fromkeys(found))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the kinds of events, in the order written."""
        return self._tables.names

    @cached_property
    def graph(self) -> Graph:
        """The reachable states and pasts, and their possible successors."""
        return unfold(self.start, self.transitions, self.max_events)

    @cached_property
    def _tables(self) -> EventTables:
        return EventTables(self.transitions, self.graph)

    @cached_property
    def _written(self) -> WrittenEvents:
        return WrittenEvents(self._tables, self.min_events, self.max_events)

    @property
    def _varies(self) -> bool:
        return self.max_events > self.min_events

    @cached_property
    def levels(self) -> tuple[int, ...]:
        length = (self.max_events - self.min_events + 1,) if self._varies else ()
        # Which cells a coordinate of an event has depends on the events before it.
        return length + (0,) * (sum(self._tables.widths) * self.max_events)

    @property
    def lengths(self) -> tuple[int, ...]:
        return (0,) * self._varies

    @property
    def sequences(self) -> tuple[tuple[int, int, int, int], ...]:
        return ((0, 1, sum(self._tables.widths), self.max_events),) if self._varies else ()

    @property
    def nominal(self) -> PyTree:
        return () if self.min_events == 0 else None

    def coordinates(self, name: str) -> tuple[str, ...]:
        parts = ("kind", "wait", *self._tables.domains)
        found = (f"{name}.length",) * self._varies
        for item in indexed(name, self.max_events):
            for part, width in zip(parts, self._tables.widths, strict=True):
                label = dotted(item, part)
                found += indexed(label, width) if width > 1 else (label,) * width
        return found

    def from_unit(self, u: Float[jax.Array, " size"]) -> Events:
        taken, _, slots = self._walk(u)
        units = jnp.split(slots, np.cumsum(self._tables.widths)[:-1].tolist(), axis=1)
        kinds = jnp.where(taken >= 0, jnp.asarray(self._tables.kind_of)[taken], ABSENT)
        waits = jnp.zeros(self.max_events, u.dtype)
        for domain, users in self._tables.waits.items():
            values = jax.vmap(domain.from_unit, axis_size=self.max_events)(
                units[1][:, : domain.size]
            )
            waits = jnp.where(_among(taken, users), values.astype(u.dtype), waits)
        parameters = {}
        for (name, groups), unit in zip(self._tables.users.items(), units[2:], strict=True):
            chosen = None
            for domain, users in groups.items():
                mine = _among(taken, users)[:, None]
                own = jnp.where(mine, unit[:, : domain.size], 0.5)
                values = jax.vmap(domain.from_unit, axis_size=self.max_events)(own)
                # The first domain's middle stands where there is no such parameter.
                chosen = values if chosen is None else where_there(mine[:, 0], values, chosen)
            parameters[name] = chosen
        return Events(kinds, waits, parameters, self.names)

    def to_unit(self, value: Events) -> Float[jax.Array, " size"]:
        kinds, waits = jnp.asarray(value.kinds), as_real(value.waits)
        taken, nodes = self._follow(kinds)
        edges = jnp.asarray(self._tables.interval_middles)
        unit = jnp.where(taken >= 0, edges[nodes, taken], 0.5).astype(waits.dtype)
        columns = [unit[:, None]]
        for groups, values, width in zip(
            (self._tables.waits, *self._tables.users.values()),
            (waits, *(value.parameters[name] for name in self._tables.users)),
            self._tables.widths[1:],
            strict=True,
        ):
            units = jnp.full((self.max_events, width), 0.5, waits.dtype)
            for domain, users in groups.items():
                own = jax.vmap(domain.to_unit, axis_size=self.max_events)(jnp.asarray(values))
                own = jnp.clip(own, 0.0, 1.0).astype(waits.dtype)
                mine = _among(taken, users)[:, None]
                units = units.at[:, : domain.size].set(
                    jnp.where(mine, own, units[:, : domain.size])
                )
            columns.append(units)
        whole = jnp.ravel(jnp.concatenate(columns, axis=1))
        if not self._varies:
            return whole
        length = self._wanted(taken, nodes)
        return jnp.concatenate(
            [centre(length - self.min_events, self.levels[0]).astype(whole.dtype), whole]
        )

    def settled(self, u: Float[jax.Array, " size"]) -> Float[jax.Array, " size"]:
        taken, nodes, slots = self._walk(u)
        unit = jnp.asarray(self._tables.interval_middles)[nodes, taken].astype(u.dtype)
        used = jnp.asarray(self._tables.uses)[taken] & (taken >= 0)[:, None]
        slots = jnp.where(used, slots, 0.5)
        slots = slots.at[:, 0].set(jnp.where(taken >= 0, unit, 0.5))
        length = self._wanted(taken, nodes)
        return self._joined(u, length, slots)

    def used(self, u: Float[jax.Array, " size"]) -> Bool[jax.Array, " size"]:
        taken, _, _ = self._walk(u)
        there = taken >= 0
        used = jnp.asarray(self._tables.uses)[taken].astype(bool) & there[:, None]
        used = used.at[:, 0].set(there)
        return jnp.concatenate([jnp.ones(int(self._varies), bool), jnp.ravel(used)])

    @property
    def items(self) -> int:
        return self.max_events

    def without(
        self, u: Float[jax.Array, " size"], drop: Bool[jax.Array, " items"]
    ) -> Float[jax.Array, " size"]:
        taken, _, slots = self._walk(u)
        kinds = jnp.where(taken >= 0, jnp.asarray(self._tables.kind_of)[taken], ABSENT)
        lookup = jnp.asarray(self._tables.by_kind)
        following = jnp.asarray(self.graph.following)
        middles = jnp.asarray(self._tables.interval_middles)

        def step(node: Any, event: Any) -> Any:
            kind, dropped = event
            number = lookup[node, kind]
            # What the events that are left no longer allow goes too.
            stays = (kind >= 0) & ~dropped & (number >= 0)
            after = jnp.where(stays, following[node, number], node)
            return after, (stays, middles[node, number])

        _, (stays, unit) = jax.lax.scan(step, jnp.int32(0), (kinds, drop))
        slots = slots.at[:, 0].set(jnp.where(stays, unit.astype(u.dtype), 0.5))
        slots = jnp.where(stays[:, None], slots, 0.5)
        order = jnp.argsort(~stays, stable=True)
        length = jnp.maximum(jnp.sum(stays), self.min_events)
        return self._joined(u, length, slots[order])

    def _joined(self, u: Any, length: Any, slots: Any) -> Any:
        whole = jnp.ravel(slots)
        if not self._varies:
            return whole
        unit = centre(length - self.min_events, self.levels[0]).astype(u.dtype)
        return jnp.concatenate([unit, whole])

    def _walk(self, u: Float[jax.Array, " size"]) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the transition of each event, -1 after the end, its node, and coordinates."""
        length = jnp.int32(self.max_events)
        if self._varies:
            length = self.min_events + cell(u[0], self.levels[0])
        slots = u[int(self._varies) :].reshape(self.max_events, sum(self._tables.widths))
        edges, last = jnp.asarray(self.graph.edges), jnp.asarray(self.graph.last)
        following = jnp.asarray(self.graph.following)

        def step(node: Any, event: Any) -> Any:
            pick, index = event
            number = jnp.sum(edges[node] <= pick.astype(jnp.float32)).astype(jnp.int32)
            number = jnp.minimum(number, last[node])
            number = jnp.where(index < length, number, ABSENT)
            return jnp.where(number >= 0, following[node, number], node), (number, node)

        indices = jnp.arange(self.max_events, dtype=jnp.int32)
        _, (taken, nodes) = jax.lax.scan(step, jnp.int32(0), (slots[:, 0], indices))
        return taken, nodes, slots

    def _follow(self, kinds: Int[jax.Array, " events"]) -> tuple[jax.Array, jax.Array]:
        """Return the transition of each event and the node before it, from the kinds of events."""
        lookup = jnp.asarray(self._tables.by_kind)
        following = jnp.asarray(self.graph.following)

        def step(node: Any, kind: Any) -> Any:
            number = jnp.where(kind >= 0, lookup[node, kind], ABSENT)
            return jnp.where(number >= 0, following[node, number], node), (number, node)

        _, (taken, nodes) = jax.lax.scan(step, jnp.int32(0), kinds)
        return taken, nodes

    def _wanted(self, taken: jax.Array, nodes: jax.Array) -> jax.Array:
        """Return the coordinate's length of this sequence; the greatest if it had to end."""
        count = jnp.sum(taken >= 0).astype(jnp.int32)
        ended = jnp.asarray(self.graph.last)[nodes[jnp.minimum(count, self.max_events - 1)]] < 0
        forced = (count < self.max_events) & ended
        return jnp.where(forced, self.max_events, count)

    @property
    def coverage_id_count(self) -> int:
        return len(self.transitions) + len(self.graph.pairs)

    def coverage_ids(self, value: Events) -> Int[jax.Array, " ids"]:
        taken, _ = self._follow(jnp.asarray(value.kinds))
        pairs = jnp.asarray(self._tables.pair_ids)[taken[:-1], taken[1:]]
        both = (taken[:-1] >= 0) & (taken[1:] >= 0)
        return jnp.concatenate([taken, jnp.where(both, pairs, ABSENT)])

    def check(self, value: object, name: str) -> None:
        self._written.check(value, name)

    def coerce(self, value: PyTree) -> Events:
        return self._written.coerce(value)

    def columns(self, name: str) -> tuple[str, ...]:
        return self._written.columns(name)

    def to_columns(self, values: Events, name: str) -> dict[str, np.ndarray]:
        return self._written.to_columns(values, name)

    def from_columns(self, row: Row, name: str) -> Events:
        return self._written.from_columns(row, name)

    def facts(self, name: str) -> Facts:
        found = {f"{name}.length": {**integer_facts(0, self.max_events), "length": True}}
        for item in indexed(name, self.max_events):
            # An absent event is a choice of its own.
            found[f"{item}.kind"] = {"ordered": False, "choices": (*self.names, "")}
            for each in self.transitions:
                for part, own in (("wait", each.wait), *each.parameters):
                    for column, known in own.facts(f"{item}.{part}").items():
                        found[column] = joined_facts(found.get(column), known)
        return found

    def words_for(self, value: Events) -> str:
        listed = value.listed()
        each = ", ".join(f"{one['kind']} at {format_seconds(one['time'], 4)}" for one in listed)
        return f"{len(listed)} event{'s' * (len(listed) != 1)}{': ' * bool(each)}{each}"

    def plain(self, nested: Callable[[Domain], dict[str, Any]]) -> dict[str, Any]:
        events = []
        for each in self.transitions:
            if each.guard is not None:
                raise ValueError(f"the guard of {each.label} is code, which JSON cannot contain")
            options = {"to": each.to, "weight": each.weight, "after": list(each.after)}
            domains = [[name, nested(part)] for name, part in each.parameters]
            event = {**options, "at_most": each.at_most, "wait": nested(each.wait)}
            events.append([each.source, each.name, {**event, "parameters": domains}])
        ends = {"min_events": self.min_events, "max_events": self.max_events}
        return {"start": self.start, "events": events, **ends}

    @classmethod
    def from_plain(
        cls, data: Mapping[str, Any], nested: Callable[[Mapping[str, Any]], Domain]
    ) -> "Automaton":
        events: dict[tuple[str, str], dict[str, Any]] = {}
        for source, name, event in data["events"]:
            options = {key: event[key] for key in ("to", "weight", "after", "at_most")}
            options["wait"] = nested(event["wait"])
            parameters = {key: nested(part) for key, part in event["parameters"]}
            events[source, name] = {**options, **parameters}
        return cls(data["start"], events, data["max_events"], data["min_events"])

    def __repr__(self) -> str:
        events = ", ".join(describe_event(each) for each in self.transitions)
        minimum = f", min_events={self.min_events}" if self.min_events else ""
        return f"Automaton({self.start!r}, {{{events}}}, max_events={self.max_events}{minimum})"


def _among(taken: jax.Array, numbers: tuple[int, ...]) -> jax.Array:
    found = taken == numbers[0]
    for number in numbers[1:]:
        found |= taken == number
    return found


def joined_facts(one: dict[str, Any] | None, other: dict[str, Any]) -> dict[str, Any]:
    """Return the facts about a column that has one of two domains, or may be empty."""
    if not (other["ordered"] and (one is None or one["ordered"])):
        return {"ordered": False}
    if one is None or one == other:
        return other
    joined: dict[str, Any] = {"ordered": True, "integer": one["integer"] and other["integer"]}
    for ends in ("bounds", "range"):
        (a, b), (c, d) = one[ends], other[ends]
        joined[ends] = (min(a, c), max(b, d))
    return joined
