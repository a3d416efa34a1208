"""Sequences of timed events that an environment may produce.

    traffic = events.Automaton("cruise", {
        ("cruise", "cut_in"): dict(to="crowded", wait=Box(0.5, 4), gap=Box(5, 20)),
        ("crowded", "brake"): dict(to="cruise", wait=Box(0.2, 2), rate=Box(2, 8), weight=2.0),
    }, max_events=6)

An `Automaton` is a domain like any other; a system gets an `Events`.
"""

from verifai_jax.core.values.events import Events as Events
from verifai_jax.features.automaton import Automaton as Automaton
from verifai_jax.features.transitions import Past as Past

__all__ = ["Automaton", "Events", "Past"]


def __dir__() -> list[str]:
    return list(__all__)
