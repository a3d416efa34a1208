"""Sequences of timed events that an environment may produce, and adversaries that react.

    traffic = events.Automaton("cruise", {
        ("cruise", "cut_in"): dict(to="crowded", wait=Box(0.5, 4), gap=Box(5, 20)),
        ("crowded", "brake"): dict(to="cruise", wait=Box(0.2, 2), rate=Box(2, 8), weight=2.0),
    }, max_events=6)

An `Automaton` is a domain like any other; a system gets an `Events`.
"""

from typing import TYPE_CHECKING

from verifai_jax.core.display.lazy import attach

if TYPE_CHECKING:
    from verifai_jax.addons.events.automaton import Automaton as Automaton
    from verifai_jax.addons.events.sequence import Events as Events
    from verifai_jax.addons.events.transitions import Past as Past
__getattr__, __dir__, __all__ = attach(__name__)
