"""The dictionaries that describe the events of an automaton, read and written.

read_event(("cruise", "brake"), dict(to="slow", wait=Box(0.2, 2)))      # a Transition
"""

from collections.abc import Callable, Mapping
from typing import Any, cast

from verifai_jax.core.checks import check_count, check_positive
from verifai_jax.core.errors import nearest_names
from verifai_jax.features.domain import Domain
from verifai_jax.features.transitions import Past, Transition

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

    **Raises:** `ValueError` or `TypeError`, which name the event and what is wrong with it.
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
    """Return the entry of `events` that describes a transition, as Python writes it."""
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
