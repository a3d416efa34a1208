"""Trees of operators: what the table says of a node, and how far a formula looks.

Everything here is of nodes in general: `formula` has the nodes themselves.
"""

import abc
import math
from dataclasses import dataclass
from typing import ClassVar

from verifai_jax.mtl.node import Node, missing_case, postorder
from verifai_jax.mtl.words import OPERATORS, Operator, number_text


class Term(Node, abc.ABC):
    """A number at every instant, which predicates compare; made as an `Expression`."""

    @abc.abstractmethod
    def text(self, outer: int = 0) -> str:
        """Return the text, in parentheses if its operator binds weaker than `outer`."""

    @property
    def is_signal(self) -> bool:
        """True for a signal or one component of it."""
        return False

    @property
    def number(self) -> float | None:
        """The value of a number; None for any other expression."""
        return None

    def signals(self) -> tuple[str, ...]:
        """Return the names of the signals in it, in order of appearance."""
        return ()

    def __str__(self) -> str:
        return self.text()


@dataclass(frozen=True)
class Interval:
    """A closed interval of time in seconds; `end` may be infinite."""

    start: float = 0.0
    end: float = math.inf

    def __post_init__(self) -> None:
        start, end = float(self.start), float(self.end)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "end", end)
        if not (start >= 0 and math.isfinite(start)):
            raise ValueError(f"an interval starts at a finite time, at least 0; got {self}")
        if not end >= start:
            raise ValueError(f"an interval ends no earlier than it starts; got {self}")

    @property
    def everything(self) -> bool:
        """True for `[0, inf]`, which the text leaves out."""
        return self.start == 0 and self.end == math.inf

    def __str__(self) -> str:
        return f"[{number_text(self.start)},{number_text(self.end)}]"


EVERYTHING = Interval()
"""The interval of an operator that is written without one."""


class Tree(Node):
    """A node that has an operator over other nodes, or that is a leaf."""

    word: ClassVar[str] = ""
    """Its operator, a key of `OPERATORS`; none for a leaf."""

    timeless: ClassVar[bool] = False
    """True for a kind of node that itself looks at the instant alone."""

    interval: Interval
    """The interval of an operator that takes one."""

    @property
    def operator(self) -> Operator:
        """The entry of its operator in the table. **Raises:** `MissingCaseError` without one."""
        if self.word not in OPERATORS:
            raise missing_case("the operator", self)
        return OPERATORS[self.word]

    def valued(self) -> tuple["Tree", ...]:
        """Return the formulas whose values decide its own."""
        raise NotImplementedError

    def horizon(self, dt: float = 0.0) -> float:
        """Return the seconds of trace beyond an instant on which its truth there depends.

        Infinite for an unbounded future operator. Past operators look back, so they never add (and
        are not subtracted, which keeps the bound simple).

        **Arguments:**

        - `dt`: sampling period in seconds, by which `next` looks ahead.
        """
        return self._total_reach(dt, "ahead")

    def history(self, dt: float = 0.0) -> float:
        """Return the seconds of trace before an instant on which its truth there depends.

        **Arguments:**

        - `dt`: sampling period in seconds, by which `prev` looks back.
        """
        return self._total_reach(dt, "back")

    def _total_reach(self, dt: float, side: str) -> float:
        reach: dict[int, float] = {}
        for part in postorder(self):
            if isinstance(part, Tree):
                below = max((reach[id(p)] for p in part.valued()), default=0.0)
                reach[id(part)] = below + (part.span(dt)[1] if part.side == side else 0.0)
        return reach[id(self)]

    def first_look_ahead(self, dt: float, start: float = 0.0) -> float:
        """Return the end of the latest window if every operator begins at its earliest.

        Unbounded windows end with the trace and do not count.

        **Arguments:**

        - `dt`: sampling period in seconds, by which `next` looks ahead.
        - `start`: instant at which the formula is asked, in seconds.
        """
        first, last = self.span(dt) if self.side == "ahead" else (0.0, 0.0)
        latest = start + (last if math.isfinite(last) else first)
        below = [part.first_look_ahead(dt, start + first) for part in self.valued()]
        return max([latest, *below])

    @property
    def depth(self) -> int:
        """Operators that stand within each other; 0 for a leaf."""
        for part in postorder(self, "_depth"):
            if isinstance(part, Tree):
                below = [p.__dict__["_depth"] + 1 for p in part.valued()]
                object.__setattr__(part, "_depth", max(below, default=0))
        return self.__dict__["_depth"]

    @property
    def temporal_depth(self) -> int:
        """Temporal operators that stand within each other."""
        for part in postorder(self, "_temporal_depth"):
            if isinstance(part, Tree):
                below = max((p.__dict__["_temporal_depth"] for p in part.valued()), default=0)
                own = bool(part.valued()) and bool(part.side)
                object.__setattr__(part, "_temporal_depth", below + own)
        return self.__dict__["_temporal_depth"]

    @property
    def side(self) -> str:
        """Where its own operator looks: `"ahead"`, `"back"`, or nowhere."""
        return "" if self.timeless else self.operator.side

    def span(self, dt: float) -> tuple[float, float]:
        """Return the first and the last second from an instant on at which its operator looks.

        **Arguments:**

        - `dt`: sampling period in seconds, by which `next` and `prev` look.
        """
        if not self.side:
            return 0.0, 0.0
        return (self.interval.start, self.interval.end) if self.operator.timed else (dt, dt)
