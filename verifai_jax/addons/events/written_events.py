"""Sequences of events as a person writes them, and as the columns of a table.

    written = WrittenEvents(tables, min_events=0, max_events=6)
    written.check([{"kind": "brake", "wait": 1.0, "rate": 4.0}], "events")
    value = written.coerce([{"kind": "brake", "wait": 1.0, "rate": 4.0}])
    written.to_columns(values, "events")            # events.length, events[0].kind, ...

Dictionaries describe the events of an automaton:

    read_event(("cruise", "brake"), dict(to="slow", wait=Box(0.2, 2)))      # a Transition
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PyTree

from verifai_jax.addons.events.event_tables import EventTables
from verifai_jax.addons.events.sequence import ABSENT, Events
from verifai_jax.addons.events.transitions import Past, Transition
from verifai_jax.core.messages.checks import check_count, check_positive
from verifai_jax.core.messages.errors import nearest_names, unknown_name
from verifai_jax.features.domain import Domain, Row, as_numbers, as_real, dotted, indexed


@dataclass(frozen=True, eq=False)
class WrittenEvents:
    """The written forms of an automaton's sequences: lists of events and table columns.

    - `tables`: the automaton's tables.
    - `min_events`, `max_events`: minimum and maximum number of events in a sequence.
    """

    tables: EventTables
    min_events: int
    max_events: int

    def coerce(self, value: PyTree) -> Events:
        """Return a checked list of events, or an `Events`, as a value of the domain."""
        tables = self.tables
        if isinstance(value, Events):
            kinds = jnp.asarray(value.kinds, jnp.int32)
            there, absent = kinds >= 0, self._absent(as_real(value.waits).dtype)
            return Events(
                kinds,
                jnp.where(there, as_real(value.waits), 0.0),
                {
                    name: where_there(there, jnp.asarray(value.parameters[name]), middle)
                    for name, middle in absent.items()
                },
                tables.names,
            )
        entries = list(value)
        now, node, written = 0.0, 0, []
        for event in entries:
            number = int(tables.by_kind[node, tables.names.index(event["kind"])])
            each = tables.transitions[number]
            wait = event["wait"] if "wait" in event else event["time"] - now
            now, node = now + wait, int(tables.graph.following[node, number])
            own = dict(each.parameters)
            coerced = {name: domain.coerce(event[name]) for name, domain in own.items()}
            written.append((number, each.wait.coerce(wait), coerced))
        return self._built(written)

    def _built(self, events: list[tuple[int, Any, dict[str, Any]]]) -> Events:
        """Return the value with these transitions, waits and parameters."""
        tables = self.tables
        dtype = jnp.result_type(float)
        missing = self.max_events - len(events)
        kinds = [tables.kind_of[number] for number, _, _ in events] + [ABSENT] * missing
        waits = [as_real(wait) for _, wait, _ in events] + [jnp.zeros(())] * missing
        parameters = {}
        for name, middle in self._absent(dtype).items():
            values = [own.get(name, middle) for _, _, own in events] + [middle] * missing
            parameters[name] = jnp.stack([jnp.asarray(value, middle.dtype) for value in values])
        return Events(
            jnp.asarray(np.array(kinds, np.int32)),
            jnp.stack([wait.astype(dtype) for wait in waits]), parameters, tables.names,
        )  # fmt: skip

    def _absent(self, dtype: Any) -> dict[str, jax.Array]:
        """Return the value of each parameter in an empty slot."""
        return {
            name: domains[0].from_unit(jnp.full(domains[0].size, 0.5, dtype))
            for name, domains in self.tables.domains.items()
        }

    def check(self, value: object, name: str) -> None:
        """Refuse anything that is not a sequence of the automaton.

        **Raises:** `ValueError` that names the event and the alternatives.
        """
        tables = self.tables
        if isinstance(value, Events):
            value = self._written(value)
        if isinstance(value, str | Mapping) or not isinstance(value, Sequence):
            raise ValueError(
                f'{name} must be a list of events such as {{"kind": {tables.names[0]!r}, '
                f'"wait": 1.0}}; got {value!r}'
            )
        if not len(value) <= self.max_events:
            raise ValueError(f"{name} must have at most {self.max_events} events; got {len(value)}")
        node, now = 0, 0.0
        for i, event in enumerate(value):
            node, now = self._check_event(event, f"{name}[{i}]", node, now)
        if len(value) < self.min_events and tables.graph.last[node] >= 0:
            raise ValueError(
                f"{name} must have at least {self.min_events} events; got {len(value)}"
            )

    def _check_event(self, event: object, name: str, node: int, now: float) -> tuple[int, float]:
        tables = self.tables
        if not isinstance(event, Mapping) or "kind" not in event:
            raise ValueError(
                f'{name} must be a dictionary with the event\'s "kind", its "wait" in seconds (or '
                f'its "time") and its parameters; got {event!r}'
            )
        kind = event["kind"]
        if kind not in tables.names:
            raise unknown_name(f"kind of {name}", kind, tables.names)
        number = int(tables.by_kind[node, tables.names.index(kind)])
        if number < 0:
            numbers = np.flatnonzero(tables.graph.enabled[node]).tolist()
            raise ValueError(
                f"{name} cannot be {kind!r} here: in state {tables.graph.states[node]!r}, after "
                f"the events before it, {_listed([tables.transitions[n].name for n in numbers])}"
            )
        each = tables.transitions[number]
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
        return int(tables.graph.following[node, number]), now + float(np.asarray(wait))

    def _written(self, value: Events) -> list[dict[str, Any]]:
        """Return the events as a person writes them, each with its own parameters."""
        tables = self.tables
        kinds, node, found = np.asarray(value.kinds), 0, []
        if np.any(kinds[int(value.length) :] >= 0):
            raise ValueError(f"events must stand one after another; got kinds {kinds.tolist()}")
        for i, kind in enumerate(kinds[: int(value.length)].tolist()):
            wait = np.asarray(value.waits)[i]
            event: dict[str, Any] = {"kind": tables.names[kind], "wait": wait}
            number = int(tables.by_kind[node, kind])
            for name, _ in tables.transitions[number].parameters if number >= 0 else ():
                event[name] = np.asarray(value.parameters[name])[i]
            found.append(event)
            node = int(tables.graph.following[node, number]) if number >= 0 else node
        return found

    def columns(self, name: str) -> tuple[str, ...]:
        """Return the names of the columns of a table."""
        found = (f"{name}.length",)
        for item in indexed(name, self.max_events):
            found += (dotted(item, "kind"), dotted(item, "wait"))
            for parameter, domains in self.tables.domains.items():
                found += domains[0].columns(dotted(item, parameter))
        return found

    def to_columns(self, values: Events, name: str) -> dict[str, np.ndarray]:
        """Return values, one for each row, as columns of a table."""
        tables = self.tables
        kinds, waits = np.asarray(values.kinds), np.asarray(values.waits)
        taken = tables.followed(kinds)
        columns: dict[str, np.ndarray] = {
            f"{name}.length": (kinds >= 0).sum(axis=1).astype(np.int32)
        }
        # Texts throughout, so that a column has one type in every batch, on the disk too.
        shown = np.array([*tables.names, ""], object)
        for i, item in enumerate(indexed(name, self.max_events)):
            columns[dotted(item, "kind")] = shown[kinds[:, i]]
            columns[dotted(item, "wait")] = np.where(kinds[:, i] >= 0, waits[:, i], np.nan)
            for parameter, groups in tables.users.items():
                column = dotted(item, parameter)
                entries = np.asarray(values.parameters[parameter])[:, i]
                columns |= _own_entries(groups, entries, taken[:, i], column)
        return columns

    def from_columns(self, row: Row, name: str) -> Events:
        """Return the value in a row of a table."""
        tables = self.tables
        length = as_numbers(row[f"{name}.length"], f"{name}.length").item()
        if length not in range(self.max_events + 1):
            raise ValueError(
                f"{name}.length must be an integer from 0 to {self.max_events}; got {length!r}"
            )
        node, written = 0, []
        for item in indexed(name, self.max_events)[: int(length)]:
            kind = row[dotted(item, "kind")]
            if kind not in tables.names:
                raise unknown_name(dotted(item, "kind"), kind, tables.names)
            number = int(tables.by_kind[node, tables.names.index(kind)])
            if number < 0:
                raise ValueError(
                    f"{dotted(item, 'kind')} cannot be {kind!r} after the events before it"
                )
            each = tables.transitions[number]
            # One column each, whatever the domain of the waiting time calls its own.
            wait = each.wait.from_columns({"wait": row[dotted(item, "wait")]}, "wait")
            own = {
                parameter: domain.from_columns(row, dotted(item, parameter))
                for parameter, domain in each.parameters
            }
            written.append((number, wait, own))
            node = int(tables.graph.following[node, number])
        return self._built(written)


def where_there(there: Any, one: Any, other: Any) -> Any:
    """Select one value where an event exists, else the other; parameters may have further axes."""
    axes = max(jnp.ndim(one), jnp.ndim(other)) - jnp.ndim(there)
    return jnp.where(jnp.reshape(there, jnp.shape(there) + (1,) * axes), one, other)


def _own_entries(
    groups: Mapping[Domain, tuple[int, ...]], values: np.ndarray, taken: Int[np.ndarray, " n"],
    column: str,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Return columns of a parameter, empty in rows whose event does not have it."""
    parts = [(domain.to_columns(values, column), users) for domain, users in groups.items()]
    found = {}
    for index, name in enumerate(parts[0][0]):
        entries = [(list(part.values())[index], users) for part, users in parts]
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


OPTIONS = ("to", "wait", "weight", "after", "at_most", "guard")
"""Entries of an event that are no parameters."""
TAKEN = ("kind", "kinds", "wait", "waits", "time", "times", "length")
"""Names that a parameter cannot have, because a table or a value uses them."""
Guard = Callable[[Past], bool]
"""A function that says whether an event may happen after a past."""


def read_event(entry: object, event: object) -> Transition:
    """Return the transition that one entry of an automaton's `events` describes.

    **Arguments:**
    - `entry`: its key, `(state, name)`.
    - `event`: its dictionary; see `Automaton`.
    **Raises:** `ValueError` or `TypeError` that names the event and the problem.
    """
    if not (
        isinstance(entry, tuple) and len(entry) == 2 and all(isinstance(x, str) for x in entry)
    ):
        raise ValueError(
            f'events are named by (state, name), as ("cruise", "brake"); got {entry!r}'
        )
    if not isinstance(event, Mapping):
        raise ValueError(
            f"event {entry!r} must be a dictionary, dict(to=..., wait=...); got {event!r}"
        )
    source, name = entry
    wait = event.get("wait")
    if not isinstance(wait, Domain) or wait.lengths or wait.signals:
        raise ValueError(
            f"event {entry!r} needs wait=, the domain of the seconds since the event before, such "
            f"as Box(0.5, 4); got {wait!r}"
        )
    parameters = {key: value for key, value in event.items() if key not in OPTIONS}
    for key, value in parameters.items():
        if not isinstance(value, Domain):
            raise TypeError(
                f"{key!r} of event {entry!r} must be a domain, such as Box(0, 1); got {value!r}"
                f"{nearest_names(key, OPTIONS)}"
            )
        if key in TAKEN or not key.strip():
            raise ValueError(f"a parameter of event {entry!r} cannot be called {key!r}")
    guard: Any = event.get("guard")
    if guard is not None and not callable(guard):
        raise ValueError(f"guard of event {entry!r} must be a function of the past; got {guard!r}")
    if not isinstance(event.get("to", source), str):
        raise ValueError(f"to of event {entry!r} must be the name of a state; got {event['to']!r}")
    after = event.get("after", ())
    at_most = event.get("at_most")
    return Transition(
        source=source,
        name=name,
        to=event.get("to", source),
        wait=wait,
        parameters=tuple(parameters.items()),
        weight=float(
            check_positive(f"weight of event {entry!r}", event.get("weight", 1.0), finite=True)
        ),
        after=(after,) if isinstance(after, str) else tuple(after),
        at_most=None if at_most is None else check_count(f"at_most of event {entry!r}", at_most),
        guard=cast(Guard | None, guard),
    )


def describe_event(each: Transition) -> str:
    """Return the entry of `events` that describes a transition, as Python source."""
    parts = [f"'to': {each.to!r}", f"'wait': {each.wait!r}"]
    if each.weight != 1:
        parts.append(f"'weight': {each.weight:zg}")
    if each.after:
        parts.append(f"'after': {list(each.after)!r}")
    if each.at_most is not None:
        parts.append(f"'at_most': {each.at_most}")
    if each.guard is not None:
        parts.append(f"'guard': {getattr(each.guard, '__qualname__', repr(each.guard))}")
    parts += [f"{name!r}: {domain!r}" for name, domain in each.parameters]
    return f"({each.source!r}, {each.name!r}): {{{', '.join(parts)}}}"
