"""The result of `last_chance`: the bracket, and the escapes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.replay import Replay

AT_AN_END = 0.02
"""Distance from a bound, as a share of the range, within which an action is at it."""


@dataclass(frozen=True, eq=False)
class Escape:
    """A way in which the failure is avoided, simulated again alone; `str()` says what it had to do.

    - `start`, `stop`: the seconds between which it differs; `stop` is None if to the end.
    - `robustness`: the least robustness over the formulas; `trace`: its trace.
    - `actions`: a row for each decision from `start` to `stop`; `own`: those of the policy then;
      `bounds`: the lowest and the highest. None for other means.
    - `features`: the new and the old value of each changed column; empty for other means.
    """

    start: float
    stop: float | None
    robustness: float
    trace: Trace = field(repr=False)
    actions: Float[np.ndarray, "decisions entries"] | None = field(default=None, repr=False)
    own: Float[np.ndarray, "decisions entries"] | None = field(default=None, repr=False)
    bounds: tuple[np.ndarray, np.ndarray] | None = field(default=None, repr=False)
    features: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)

    def __str__(self) -> str:
        until = "to the end" if self.stop is None else f"to {format_seconds(self.stop, 4)}"
        parts = [f"{name} {new} instead of {old}" for name, (new, old) in self.features.items()]
        if self.actions is not None and self.own is not None and self.bounds is not None:
            for i, (low, high) in enumerate(zip(*self.bounds, strict=True)):
                name = "action" if len(self.bounds[0]) == 1 else f"action[{i}]"
                did = _course(self.actions[:, i], low, high)
                parts.append(f"{name} {did} instead of {self.own[:, i].mean():z.3g} on average")
        then = "" if self.stop is None else "; then the policy goes on"
        said = ", ".join(parts) or "the other policy"
        return f"{said}, from {format_seconds(self.start, 4)} {until}{then}"


def _course(values: Float[np.ndarray, " n"], low: float, high: float) -> str:
    """Describe the values of one entry of the actions."""
    said = []
    for end, word in ((low, "lowest"), (high, "highest")):
        share = float(np.mean(np.abs(values - end) <= AT_AN_END * (high - low)))
        if share > 0.99:
            return f"at its {word}, {end:z.4g},"
        said += [f"at its {word}, {end:z.4g}, for {share:.0%} of the time"] * (share >= 0.1)
    return ", ".join([*said, f"{values.mean():z.3g} on average"])


@dataclass(frozen=True, eq=False)
class LastChance(Drawn, InNotebook):
    """The last instant at which a failure could have been avoided, as a bracket in seconds.

    - `row`: the number of the failing simulation, None for given features; `by`: who could have
      avoided it; `failed`: the first instant at which a predicate breaks the formula.
    - `avoidable_until`: the last instant with an escape, None if none was found; `no_escape_from`:
      the next instant that was tried; from it on no escape was found; `bracket`: both.
    - `proved_from`: the instant from which the failure is proved unavoidable; None without a proof.
    - `escape`: the escape from `avoidable_until`; `escapes`: this and earlier ones.
    - `tried`: all instants from which escapes were searched for; `simulations`: forks that went on.
    - `replay`: the failing simulation; `notes`: sentences for the user.
    """

    _picture = "verifai_jax.addons.avoidability.picture", "plot_last_chance"
    row: int | None
    by: str
    failed: float
    avoidable_until: float | None
    no_escape_from: float
    proved_from: float | None
    escapes: tuple[Escape, ...] = field(repr=False)
    tried: tuple[float, ...] = field(repr=False)
    simulations: int
    replay: Replay = field(repr=False)
    notes: tuple[str, ...] = ()

    @property
    def escape(self) -> Escape | None:
        return self.escapes[0] if self.escapes else None

    @property
    def bracket(self) -> tuple[float, float]:
        return self.avoidable_until or 0.0, self.no_escape_from

    def __str__(self) -> str:
        which = "a failure" if self.row is None else f"the failure of row {self.row}"
        about = f"{which} of {self.replay.problem.name}: "
        said = f"{about}no escape by {self.by} was found from any instant"
        if self.avoidable_until is not None:
            before = format_seconds(max(self.failed - self.avoidable_until, 0.0), 4)
            until = format_seconds(self.avoidable_until, 4)
            said = f"{about}{self.by} could avoid it until {until}, {before} before it"
        lines = [*self.replay.warnings, said, f"  failure      at {format_seconds(self.failed, 4)}"]
        if self.escape is not None:
            lines.append(f"  escape       {self.escape}")
            lines.append(
                f"               robustness {self.escape.robustness:z.3g}, simulated alone"
            )
        lines.append(
            f"  no escape    found from {format_seconds(self.no_escape_from, 4)} on, in "
            f"{self.simulations:,} simulations from {len(self.tried)} instants"
        )
        if self.proved_from is not None:
            when = format_seconds(self.proved_from, 4)
            lines.append(f"  proved       unavoidable from {when} on, whatever the actions")
        return "\n".join([*lines, *(f"  note         {note}" for note in self.notes)])

    __repr__ = __str__
