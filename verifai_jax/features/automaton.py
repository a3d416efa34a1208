"""Sequences of timed events that an automaton allows (`Automaton`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from verifai_jax.core.checks import check_count
from verifai_jax.core.errors import unknown_name
from verifai_jax.core.events import ABSENT, Events
from verifai_jax.features.domain import (
    Domain,
    Row,
    as_numbers,
    as_real,
    cell,
    centre,
    dotted,
    indexed,
)
from verifai_jax.features.event_descriptions import describe_event, read_event
from verifai_jax.features.transitions import Graph, Transition, unfold


@dataclass(frozen=True, init=False, repr=False)
class Automaton(Domain):
    """Sequences of timed events that an automaton allows, as a domain without a refused point.

        Automaton(start="cruise", most=6, events={
            ("cruise", "cut_in"): dict(to="crowded", wait=Box(0.5, 4), gap=Box(5, 20)),
            ("crowded", "brake"): dict(to="cruise", wait=Box(0.2, 2), rate=Box(2, 8), weight=2.0),
        })

    A value is an `Events`. The prior: the number of events is uniform over `least` to `most`, and a
    sequence ends early in a state that no event can leave; each event is drawn among those that
    are enabled after the ones before it, in proportion to their weights; waiting times and
    parameters come from their domains. Each of these is one unit coordinate by its inverse
    cumulative distribution, so every point of the cube is a legal sequence.

    **Arguments:**

    - `start`: the state before the first event.
    - `events`: `(state, name)` -> what happens: a dictionary with

      - `to`: the state afterwards; the same one when left out,
      - `wait`: domain of the seconds since the event before, or since the start,
      - `weight`: relative probability among the events that are enabled, 1 when left out,
      - `after`: names of events that must have happened before,
      - `at_most`: how often events of this name may happen,
      - `guard`: a function of the `Past` that must be true, asked when the automaton is made,
      - and parameters by name, each a domain.
    - `most`: events at most.
    - `least`: events at least, unless no event is possible any longer.

    **Raises:** `ValueError` for events that are none, options that are unknown or out of range,
    guards that tell too many pasts apart; `TypeError` for a parameter that is no domain.
    """

    start: str
    transitions: tuple[Transition, ...]
    least: int
    most: int

    def __init__(
        self,
        start: str,
        events: Mapping[tuple[str, str], Mapping[str, Any]],
        most: int = 6,
        least: int = 0,
    ) -> None:
        check_count("most", most)
        if isinstance(least, bool) or not isinstance(least, int) or not 0 <= least <= most:
            raise ValueError(f"least must be an integer from 0 to most, {most}; got {least!r}")
        if not isinstance(events, Mapping) or not events:
            raise ValueError(
                'events must be a dictionary {("state", "name"): dict(to=..., wait=...), ...}; '
                f"got {events!r}"
            )
        transitions = tuple(read_event(place, event) for place, event in events.items())
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
        object.__setattr__(self, "least", int(least))
        object.__setattr__(self, "most", int(most))
        self._check_parameters()
        self.graph  # noqa: B018 - unfolded now, so that what is wrong with guards is said now

    def _check_parameters(self) -> None:
        """Refuse parameters of one name whose values have different forms."""
        for name, domains in self._domains.items():
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
        for each, least in zip(self.transitions, shortest, strict=True):
            if float(least) < 0:
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

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the kinds of events, in the order written."""
        return tuple(dict.fromkeys(each.name for each in self.transitions))

    @cached_property
    def graph(self) -> Graph:
        """The states and pasts that can be reached, and what can follow what."""
        return unfold(self.start, self.transitions, self.most)

    @cached_property
    def _domains(self) -> dict[str, tuple[Domain, ...]]:
        """The different domains of each parameter, in the order written."""
        found: dict[str, dict[Domain, None]] = {}
        for each in self.transitions:
            for name, domain in each.parameters:
                found.setdefault(name, {})[domain] = None
        return {name: tuple(domains) for name, domains in found.items()}

    @cached_property
    def _widths(self) -> tuple[int, ...]:
        """Coordinates of an event: one for its kind, those of its wait and of each parameter."""
        waits = max(each.wait.size for each in self.transitions)
        others = [max(domain.size for domain in group) for group in self._domains.values()]
        return (1, waits, *others)

    @property
    def _varies(self) -> bool:
        return self.most > self.least

    @cached_property
    def levels(self) -> tuple[int, ...]:
        length = (self.most - self.least + 1,) if self._varies else ()
        # Which cells a coordinate of an event has depends on the events before it.
        return length + (0,) * (sum(self._widths) * self.most)

    @property
    def lengths(self) -> tuple[int, ...]:
        return (0,) * self._varies

    @property
    def sequences(self) -> tuple[tuple[int, int, int, int], ...]:
        return ((0, 1, sum(self._widths), self.most),) if self._varies else ()

    @property
    def nominal(self) -> PyTree:
        return () if self.least == 0 else None

    def coordinates(self, name: str) -> tuple[str, ...]:
        parts = ("kind", "wait", *self._domains)
        found = (f"{name}.length",) * self._varies
        for item in indexed(name, self.most):
            for part, width in zip(parts, self._widths, strict=True):
                label = dotted(item, part)
                found += indexed(label, width) if width > 1 else (label,) * width
        return found

    def from_unit(self, u: Float[jax.Array, " size"]) -> Events:
        taken, _, slots = self._walk(u)
        units = self._split(slots)
        kinds = jnp.where(taken >= 0, jnp.asarray(self._kind_of)[taken], ABSENT)
        waits = jnp.zeros(self.most, u.dtype)
        for domain, users in self._waits.items():
            values = jax.vmap(domain.from_unit, axis_size=self.most)(units[1][:, : domain.size])
            waits = jnp.where(_among(taken, users), values.astype(u.dtype), waits)
        parameters = {}
        for (name, groups), unit in zip(self._users.items(), units[2:], strict=True):
            chosen = None
            for domain, users in groups.items():
                mine = _among(taken, users)[:, None]
                own = jnp.where(mine, unit[:, : domain.size], 0.5)
                values = jax.vmap(domain.from_unit, axis_size=self.most)(own)
                # The first domain's middle stands where there is no such parameter.
                chosen = values if chosen is None else _where(mine[:, 0], values, chosen)
            parameters[name] = chosen
        return Events(kinds, waits, parameters, self.names)

    def to_unit(self, value: Events) -> Float[jax.Array, " size"]:
        kinds, waits = jnp.asarray(value.kinds), as_real(value.waits)
        taken, nodes = self._follow(kinds)
        edges = jnp.asarray(self._interval_middles)
        place = jnp.where(taken >= 0, edges[nodes, taken], 0.5).astype(waits.dtype)
        columns = [place[:, None]]
        for groups, values, width in zip(
            (self._waits, *self._users.values()),
            (waits, *(value.parameters[name] for name in self._users)),
            self._widths[1:],
            strict=True,
        ):
            units = jnp.full((self.most, width), 0.5, waits.dtype)
            for domain, users in groups.items():
                own = jax.vmap(domain.to_unit, axis_size=self.most)(jnp.asarray(values))
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
            [centre(length - self.least, self.levels[0]).astype(whole.dtype), whole]
        )

    def settled(self, u: Float[jax.Array, " size"]) -> Float[jax.Array, " size"]:
        taken, nodes, slots = self._walk(u)
        place = jnp.asarray(self._interval_middles)[nodes, taken].astype(u.dtype)
        used = jnp.asarray(self._uses)[taken] & (taken >= 0)[:, None]
        slots = jnp.where(used, slots, 0.5)
        slots = slots.at[:, 0].set(jnp.where(taken >= 0, place, 0.5))
        length = self._wanted(taken, nodes)
        return self._joined(u, length, slots)

    @property
    def items(self) -> int:
        return self.most

    def without(
        self, u: Float[jax.Array, " size"], drop: Bool[jax.Array, " items"]
    ) -> Float[jax.Array, " size"]:
        taken, _, slots = self._walk(u)
        kinds = jnp.where(taken >= 0, jnp.asarray(self._kind_of)[taken], ABSENT)
        lookup = jnp.asarray(self._by_kind)
        following, middles = jnp.asarray(self.graph.following), jnp.asarray(self._interval_middles)

        def step(node: Any, event: Any) -> Any:
            kind, dropped = event
            number = lookup[node, kind]
            # What the events that are left no longer allow goes too.
            stays = (kind >= 0) & ~dropped & (number >= 0)
            after = jnp.where(stays, following[node, number], node)
            return after, (stays, middles[node, number])

        _, (stays, place) = jax.lax.scan(step, jnp.int32(0), (kinds, drop))
        slots = slots.at[:, 0].set(jnp.where(stays, place.astype(u.dtype), 0.5))
        slots = jnp.where(stays[:, None], slots, 0.5)
        order = jnp.argsort(~stays, stable=True)
        length = jnp.maximum(jnp.sum(stays), self.least)
        return self._joined(u, length, slots[order])

    def _joined(self, u: Any, length: Any, slots: Any) -> Any:
        whole = jnp.ravel(slots)
        if not self._varies:
            return whole
        place = centre(length - self.least, self.levels[0]).astype(u.dtype)
        return jnp.concatenate([place, whole])

    def _walk(self, u: Float[jax.Array, " size"]) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the transition at each place, -1 behind the end, its node, and coordinates."""
        length = jnp.int32(self.most)
        if self._varies:
            length = self.least + cell(u[0], self.levels[0])
        slots = u[int(self._varies) :].reshape(self.most, sum(self._widths))
        edges, last = jnp.asarray(self.graph.edges), jnp.asarray(self.graph.last)
        following = jnp.asarray(self.graph.following)

        def step(node: Any, event: Any) -> Any:
            pick, place = event
            number = jnp.sum(edges[node] <= pick.astype(jnp.float32)).astype(jnp.int32)
            number = jnp.minimum(number, last[node])
            number = jnp.where(place < length, number, ABSENT)
            return jnp.where(number >= 0, following[node, number], node), (number, node)

        places = jnp.arange(self.most, dtype=jnp.int32)
        _, (taken, nodes) = jax.lax.scan(step, jnp.int32(0), (slots[:, 0], places))
        return taken, nodes, slots

    def _follow(self, kinds: Int[jax.Array, " places"]) -> tuple[jax.Array, jax.Array]:
        """Return the transition at each place and the node before it, from the kinds of events."""
        lookup, following = jnp.asarray(self._by_kind), jnp.asarray(self.graph.following)

        def step(node: Any, kind: Any) -> Any:
            number = jnp.where(kind >= 0, lookup[node, kind], ABSENT)
            return jnp.where(number >= 0, following[node, number], node), (number, node)

        _, (taken, nodes) = jax.lax.scan(step, jnp.int32(0), kinds)
        return taken, nodes

    def _wanted(self, taken: jax.Array, nodes: jax.Array) -> jax.Array:
        """Return the length that stands for this sequence; the greatest where it had to end."""
        count = jnp.sum(taken >= 0).astype(jnp.int32)
        ended = jnp.asarray(self.graph.last)[nodes[jnp.minimum(count, self.most - 1)]] < 0
        forced = (count < self.most) & ended
        return jnp.where(forced, self.most, count)

    def _split(self, slots: jax.Array) -> list[jax.Array]:
        return jnp.split(slots, np.cumsum(self._widths)[:-1].tolist(), axis=1)

    @cached_property
    def _kind_of(self) -> Int[np.ndarray, " transitions"]:
        return np.array([self.names.index(each.name) for each in self.transitions], np.int32)

    @cached_property
    def _by_kind(self) -> Int[np.ndarray, "nodes kinds"]:
        """The transition that each kind of event is at each node; -1 where it is not enabled."""
        table = np.full((len(self.graph.states), len(self.names)), ABSENT, np.int32)
        for node, number in np.argwhere(self.graph.enabled):
            table[node, self._kind_of[number]] = number
        return table

    @cached_property
    def _interval_middles(self) -> Float[np.ndarray, "nodes transitions"]:
        edges = self.graph.edges
        before = np.concatenate([np.zeros_like(edges[:, :1]), edges[:, :-1]], axis=1)
        return ((before + edges) / 2).astype(np.float32)

    @cached_property
    def _waits(self) -> dict[Domain, tuple[int, ...]]:
        """The different domains of waiting times, each with the transitions that have it."""
        found: dict[Domain, tuple[int, ...]] = {}
        for number, each in enumerate(self.transitions):
            found[each.wait] = (*found.get(each.wait, ()), number)
        return found

    @cached_property
    def _users(self) -> dict[str, dict[Domain, tuple[int, ...]]]:
        """For each parameter its domains, each with the transitions that have it."""
        found: dict[str, dict[Domain, tuple[int, ...]]] = {name: {} for name in self._domains}
        for number, each in enumerate(self.transitions):
            for name, domain in each.parameters:
                found[name][domain] = (*found[name].get(domain, ()), number)
        return found

    @cached_property
    def _uses(self) -> Bool[np.ndarray, "transitions width"]:
        """The coordinates of an event that matter, for each transition."""
        table = np.zeros((len(self.transitions), sum(self._widths)), bool)
        starts = np.concatenate([[0], np.cumsum(self._widths)])
        for number, each in enumerate(self.transitions):
            table[number, 0] = True
            table[number, 1 : 1 + each.wait.size] = True
            own = dict(each.parameters)
            for name, begin in zip(self._domains, starts[2:], strict=False):
                if name in own:
                    table[number, begin : begin + own[name].size] = True
        return table

    @property
    def mark_count(self) -> int:
        return len(self.transitions) + len(self.graph.pairs)

    def marks(self, value: Events) -> Int[jax.Array, " marks"]:
        taken, _ = self._follow(jnp.asarray(value.kinds))
        pairs = jnp.asarray(self._pair_marks)[taken[:-1], taken[1:]]
        both = (taken[:-1] >= 0) & (taken[1:] >= 0)
        return jnp.concatenate([taken, jnp.where(both, pairs, ABSENT)])

    @cached_property
    def _pair_marks(self) -> Int[np.ndarray, "transitions transitions"]:
        count = len(self.transitions)
        table = np.full((count, count), ABSENT, np.int32)
        for i, (one, other) in enumerate(self.graph.pairs):
            table[one, other] = count + i
        return table

    def coerce(self, value: PyTree) -> Events:
        if isinstance(value, Events):
            kinds = jnp.asarray(value.kinds, jnp.int32)
            there, absent = kinds >= 0, self._absent(as_real(value.waits).dtype)
            return Events(
                kinds,
                jnp.where(there, as_real(value.waits), 0.0),
                {
                    name: _where(there, jnp.asarray(value.parameters[name]), middle)
                    for name, middle in absent.items()
                },
                self.names,
            )
        entries = list(value)
        now, node, written = 0.0, 0, []
        for event in entries:
            number = int(self._by_kind[node, self.names.index(event["kind"])])
            each = self.transitions[number]
            wait = event["wait"] if "wait" in event else event["time"] - now
            now, node = now + wait, int(self.graph.following[node, number])
            own = dict(each.parameters)
            coerced = {name: domain.coerce(event[name]) for name, domain in own.items()}
            written.append((number, each.wait.coerce(wait), coerced))
        return self._built(written)

    def _built(self, events: list[tuple[int, Any, dict[str, Any]]]) -> Events:
        """Return the value with these transitions, waits and parameters."""
        dtype = jnp.result_type(float)
        missing = self.most - len(events)
        kinds = [self._kind_of[number] for number, _, _ in events] + [ABSENT] * missing
        waits = [as_real(wait) for _, wait, _ in events] + [jnp.zeros(())] * missing
        parameters = {}
        for name, middle in self._absent(dtype).items():
            values = [own.get(name, middle) for _, _, own in events] + [middle] * missing
            parameters[name] = jnp.stack([jnp.asarray(value, middle.dtype) for value in values])
        return Events(
            jnp.asarray(np.array(kinds, np.int32)),
            jnp.stack([wait.astype(dtype) for wait in waits]),
            parameters,
            self.names,
        )

    def _absent(self, dtype: Any) -> dict[str, jax.Array]:
        """Return what each parameter is where there is none."""
        return {
            name: domains[0].from_unit(jnp.full(domains[0].size, 0.5, dtype))
            for name, domains in self._domains.items()
        }

    def check(self, value: object, name: str) -> None:
        if isinstance(value, Events):
            value = self._written(value)
        if isinstance(value, str | Mapping) or not isinstance(value, Sequence):
            raise ValueError(
                f'{name} must be a list of events such as {{"kind": {self.names[0]!r}, "wait": 1.0'
                f"}}; got {value!r}"
            )
        if not len(value) <= self.most:
            raise ValueError(f"{name} must have at most {self.most} events; got {len(value)}")
        node, now = 0, 0.0
        for i, event in enumerate(value):
            node, now = self._check_event(event, f"{name}[{i}]", node, now)
        if len(value) < self.least and self.graph.last[node] >= 0:
            raise ValueError(f"{name} must have at least {self.least} events; got {len(value)}")

    def _check_event(self, event: object, name: str, node: int, now: float) -> tuple[int, float]:
        if not isinstance(event, Mapping) or "kind" not in event:
            raise ValueError(
                f'{name} must be a dictionary with the event\'s "kind", its "wait" in seconds (or '
                f'its "time") and its parameters; got {event!r}'
            )
        kind = event["kind"]
        if kind not in self.names:
            raise unknown_name(f"kind of {name}", kind, self.names)
        number = int(self._by_kind[node, self.names.index(kind)])
        if number < 0:
            enabled = [
                self.transitions[n].name for n in np.flatnonzero(self.graph.enabled[node]).tolist()
            ]
            raise ValueError(
                f"{name} cannot be {kind!r} here: in state {self.graph.states[node]!r}, after the "
                f"events before it, {_listed(enabled)}"
            )
        each = self.transitions[number]
        own = dict(each.parameters)
        if "wait" not in event and "time" not in event:
            raise ValueError(f"{name}.wait is missing; got {', '.join(map(str, event))}")
        wait = event["wait"] if "wait" in event else event["time"] - now
        each.wait.check(wait, dotted(name, "wait"))
        for key in event:
            if key not in (*own, "kind", "wait", "time"):
                raise unknown_name(f"parameter of {name}, an event {kind!r},", key, own)
        for key, domain in own.items():
            if key not in event:
                raise ValueError(
                    f"{dotted(name, key)} is missing; got {', '.join(map(str, event))}"
                )
            domain.check(event[key], dotted(name, key))
        return int(self.graph.following[node, number]), now + float(np.asarray(wait))

    def _written(self, value: Events) -> list[dict[str, Any]]:
        """Return the events as a person writes them, each with its own parameters."""
        kinds, node, found = np.asarray(value.kinds), 0, []
        if np.any(kinds[int(value.length) :] >= 0):
            raise ValueError(f"events must stand one after another; got kinds {kinds.tolist()}")
        for i, kind in enumerate(kinds[: int(value.length)].tolist()):
            event: dict[str, Any] = {"kind": self.names[kind], "wait": np.asarray(value.waits)[i]}
            number = int(self._by_kind[node, kind])
            for name, _ in self.transitions[number].parameters if number >= 0 else ():
                event[name] = np.asarray(value.parameters[name])[i]
            found.append(event)
            node = int(self.graph.following[node, number]) if number >= 0 else node
        return found

    def columns(self, name: str) -> tuple[str, ...]:
        found = (f"{name}.length",)
        for item in indexed(name, self.most):
            found += (dotted(item, "kind"), dotted(item, "wait"))
            for parameter, domains in self._domains.items():
                found += domains[0].columns(dotted(item, parameter))
        return found

    def to_columns(self, values: Events, name: str) -> dict[str, np.ndarray]:
        kinds, waits = np.asarray(values.kinds), np.asarray(values.waits)
        taken = self._followed(kinds)
        columns: dict[str, np.ndarray] = {
            f"{name}.length": (kinds >= 0).sum(axis=1).astype(np.int32)
        }
        # Texts throughout, so that a column has one type in every batch, on the disk too.
        shown = np.array([*self.names, ""], object)
        for i, item in enumerate(indexed(name, self.most)):
            columns[dotted(item, "kind")] = shown[kinds[:, i]]
            columns[dotted(item, "wait")] = np.where(kinds[:, i] >= 0, waits[:, i], np.nan)
            for parameter, groups in self._users.items():
                column = dotted(item, parameter)
                place = np.asarray(values.parameters[parameter])[:, i]
                columns |= _own_entries(groups, place, taken[:, i], column)
        return columns

    def from_columns(self, row: Row, name: str) -> Events:
        length = as_numbers(row[f"{name}.length"], f"{name}.length").item()
        if length not in range(self.most + 1):
            raise ValueError(
                f"{name}.length must be an integer from 0 to {self.most}; got {length!r}"
            )
        node, written = 0, []
        for item in indexed(name, self.most)[: int(length)]:
            kind = row[dotted(item, "kind")]
            if kind not in self.names:
                raise unknown_name(dotted(item, "kind"), kind, self.names)
            number = int(self._by_kind[node, self.names.index(kind)])
            if number < 0:
                raise ValueError(
                    f"{dotted(item, 'kind')} cannot be {kind!r} after the events before it"
                )
            each = self.transitions[number]
            # One column each, whatever the domain of the waiting time calls its own.
            wait = each.wait.from_columns({"wait": row[dotted(item, "wait")]}, "wait")
            own = {
                parameter: domain.from_columns(row, dotted(item, parameter))
                for parameter, domain in each.parameters
            }
            written.append((number, wait, own))
            node = int(self.graph.following[node, number])
        return self._built(written)

    def _followed(self, kinds: Int[np.ndarray, "n places"]) -> Int[np.ndarray, "n places"]:
        """Return the transition at each place, from the kinds of many sequences."""
        taken, node = np.full(kinds.shape, ABSENT), np.zeros(len(kinds), int)
        for i in range(kinds.shape[1]):
            there = kinds[:, i] >= 0
            taken[:, i] = np.where(there, self._by_kind[node, kinds[:, i]], ABSENT)
            node = np.where(there, self.graph.following[node, taken[:, i]], node)
        return taken

    def __repr__(self) -> str:
        events = ", ".join(describe_event(each) for each in self.transitions)
        least = f", least={self.least}" if self.least else ""
        return f"Automaton({self.start!r}, {{{events}}}, most={self.most}{least})"


def _among(taken: jax.Array, numbers: tuple[int, ...]) -> jax.Array:
    found = taken == numbers[0]
    for number in numbers[1:]:
        found |= taken == number
    return found


def _where(mask: Any, one: Any, other: Any) -> Any:
    axes = max(jnp.ndim(one), jnp.ndim(other)) - jnp.ndim(mask)
    return jnp.where(jnp.reshape(mask, jnp.shape(mask) + (1,) * axes), one, other)


def _own_entries(
    groups: Mapping[Domain, tuple[int, ...]],
    values: np.ndarray,
    taken: Int[np.ndarray, " n"],
    column: str,
) -> dict[str, np.ndarray]:
    """Return columns of a parameter, empty in rows whose event does not have it."""
    parts = [(domain.to_columns(values, column), users) for domain, users in groups.items()]
    found = {}
    for place, name in enumerate(parts[0][0]):
        entries = [(list(part.values())[place], users) for part, users in parts]
        numeric = all(part.dtype.kind in "iufb" for part, _ in entries)
        real = entries[0][0].dtype if entries[0][0].dtype.kind == "f" else np.float64
        whole = np.full(len(taken), np.nan if numeric else "", real if numeric else object)
        for part, users in entries:
            mine = np.isin(taken, users)
            whole[mine] = part[mine]
        found[name] = whole
    return found


def _listed(enabled: Sequence[str]) -> str:
    return f"it can be {', '.join(enabled)}" if enabled else "no event is possible"
