"""Trees of operators: the table entry of a node, and the distances that a formula looks.

This file handles nodes in general; `formula` defines the kinds of nodes. They are compared, hashed
and walked without recursion. A sub-tree may occur several times (`f <-> g` holds each side twice),
so all walks visit each different node once.
"""

import abc
import dataclasses
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from verifai_jax.core.display.notebook import ForUsers
from verifai_jax.mtl.words import OPERATORS, Operator, number_text

N = TypeVar("N", bound="Node")


class MissingCaseError(TypeError):
    """An error for a kind of node that a walk over a formula does not handle, such as a user's."""


def missing_case(walk: str, node: object) -> MissingCaseError:
    """Return the error for a node that a walk over a formula does not handle.

    **Arguments:**
    - `walk`: the result of the walk, such as `"the horizon"`.
    - `node`: the node; its text is not used, since writing it is a walk, too.
    """
    kind = type(node)
    return MissingCaseError(
        f"{walk} of a formula has no case for a node {kind.__name__} (of {kind.__module__}): "
        "build formulas of the operators of verifai_jax.mtl"
    )


class Node(ForUsers):
    """A node of a tree; nodes are compared by kind and fields."""

    _internal = frozenset((
        "asked", "below", "children", "compared", "depth", "interval",
        "is_predicate", "is_signal", "meaning", "number", "operands", "operator", "side", "span",
        "temporal_depth", "terms", "text", "timeless", "valued", "word",
    ))  # fmt: skip

    def below(self) -> tuple["Node", ...]:
        """Return the nodes among its fields, left to right."""
        found: list[Node] = []
        for name in _fields(type(self)):
            value = getattr(self, name)
            if isinstance(value, Node):
                found.append(value)
            elif isinstance(value, tuple):
                found.extend(value)
        return tuple(found)

    def __hash__(self) -> int:
        if "_hash" not in self.__dict__:
            for node in postorder(self, "_hash"):
                values = (getattr(node, name) for name in _fields(type(node)))
                object.__setattr__(node, "_hash", hash((type(node).__name__, *values)))
        return self.__dict__["_hash"]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Node):
            return NotImplemented
        pairs: list[tuple[Any, Any]] = [(self, other)]
        compared: set[tuple[int, int]] = set()
        while pairs:
            one, two = pairs.pop()
            if one is two or (id(one), id(two)) in compared:
                continue
            if type(one) is not type(two) or hash(one) != hash(two):
                return False
            compared.add((id(one), id(two)))
            for name in _fields(type(one)):
                a, b = getattr(one, name), getattr(two, name)
                if isinstance(a, Node):
                    pairs.append((a, b))
                elif isinstance(a, tuple):
                    if len(a) != len(b):
                        return False
                    pairs.extend(zip(a, b, strict=True))
                elif a != b:
                    return False
        return True

    def __repr__(self) -> str:
        try:
            text = repr(str(self))
        except MissingCaseError:
            text = "..."  # Whoever shows it, such as a debugger or another error, goes on.
        return f"{type(self).__name__}({text})"

    def __getstate__(self) -> dict[str, Any]:
        # What is remembered is of this process: texts have other hashes in the next.
        return {name: getattr(self, name) for name in _fields(type(self))}


@functools.cache
def _fields(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))


def postorder(root: N, known: str = "") -> Iterator[N]:
    """Yield a node and all nodes below it, each once, children first.

    Nodes that already have the attribute `known` are left out, with all below them.
    """
    seen: set[int] = set()
    stack: list[tuple[Any, bool]] = [(root, False)]
    while stack:
        node, ready = stack.pop()
        if ready:
            yield node
        elif id(node) not in seen and known not in node.__dict__:
            seen.add(id(node))
            stack.append((node, True))
            stack.extend((child, False) for child in reversed(node.below()))


class Term(Node, abc.ABC):
    """A number at every instant, which predicates compare; instances are `Expression`s."""

    @abc.abstractmethod
    def text(self, outer: int = 0) -> str:
        """Return the text, in parentheses if its operator binds weaker than `outer`."""

    opened: ClassVar[int] = 0
    """Above zero for an expression that a recording completes, by the class methods `fitted` and
    `assumed` of its kind; in this order."""

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
    """An interval of time in seconds; `end` may be infinite.

    It is closed unless `open_start` or `open_end` leaves out that end, as in `[0,5)`.
    """

    start: float = 0.0
    end: float = math.inf
    open_start: bool = False
    open_end: bool = False

    def __post_init__(self) -> None:
        start, end = float(self.start), float(self.end)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "end", end)
        if not (start >= 0 and math.isfinite(start)):
            raise ValueError(f"an interval starts at a finite time, at least 0; got {self}")
        if not end >= start:
            raise ValueError(f"an interval ends no earlier than it starts; got {self}")
        if not self.closed and (end == start or (self.open_end and math.isinf(end))):
            raise ValueError(f"an interval without one of its ends is longer; got {self}")

    @property
    def closed(self) -> bool:
        """True if both ends belong to it."""
        return not (self.open_start or self.open_end)

    @property
    def everything(self) -> bool:
        """True for `[0, inf]`, which is not written."""
        return self == EVERYTHING

    def __str__(self) -> str:
        ends = f"{number_text(self.start)},{number_text(self.end)}"
        return f"{'[('[self.open_start]}{ends}{'])'[self.open_end]}"


EVERYTHING = Interval()
"""The interval of an operator that is written without one."""


class Tree(Node):
    """A node that is an operator over other nodes, or a leaf."""

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
        """Return the formulas whose values determine its own."""
        raise NotImplementedError

    def horizon(self, dt: float = 0.0) -> float:
        """Return the number of seconds after an instant on which its value there depends.

        Infinite for an unbounded future operator. Past operators look back, so they add nothing
        (and are not subtracted, which keeps the bound simple).

        **Arguments:**
        - `dt`: sampling period in seconds, by which `next` looks ahead.
        """
        return self._total_reach(dt, "ahead")

    def history(self, dt: float = 0.0) -> float:
        """Return the number of seconds before an instant on which its value there depends.

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

    def asked(self, dt: float = 0.0) -> dict["Tree", tuple[float, float]]:
        """Return the interval in seconds in which each part is evaluated if the whole is at 0.

        **Arguments:**
        - `dt`: sampling period in seconds, by which `next` and `prev` look.
        """
        spans: dict[Tree, tuple[float, float]] = {self: (0.0, 0.0)}
        for part in reversed(list(postorder(self))):
            if not isinstance(part, Tree):
                continue
            (first, last), (near, far) = spans[part], part.span(dt)
            ahead = part.side == "ahead"
            window = (first + near, last + far) if ahead else (first - far, last - near)
            # What stands on the left of until and since is asked from now on to the witness.
            left = (first, last + far) if ahead else (first - far, last)
            witness = bool(part.side) and part.operator.operands == 2
            for index, below in enumerate(part.valued()):
                own = left if witness and index == 0 else window
                known = spans.get(below, own)
                spans[below] = min(own[0], known[0]), max(own[1], known[1])
        return spans

    @property
    def depth(self) -> int:
        """Nesting depth of operators; 0 for a leaf."""
        for part in postorder(self, "_depth"):
            if isinstance(part, Tree):
                below = [p.__dict__["_depth"] + 1 for p in part.valued()]
                object.__setattr__(part, "_depth", max(below, default=0))
        return self.__dict__["_depth"]

    @property
    def temporal_depth(self) -> int:
        """Nesting depth of temporal operators."""
        for part in postorder(self, "_temporal_depth"):
            if isinstance(part, Tree):
                below = max((p.__dict__["_temporal_depth"] for p in part.valued()), default=0)
                own = bool(part.valued()) and bool(part.side)
                object.__setattr__(part, "_temporal_depth", below + own)
        return self.__dict__["_temporal_depth"]

    @property
    def side(self) -> str:
        """The direction of its own operator: `"ahead"`, `"back"`, or none."""
        return "" if self.timeless else self.operator.side

    def span(self, dt: float) -> tuple[float, float]:
        """Return the first and the last second, relative to an instant, that its operator reads.

        **Arguments:**
        - `dt`: sampling period in seconds, by which `next` and `prev` look.
        """
        if not self.side:
            return 0.0, 0.0
        if not self.operator.timed:
            return dt, dt
        i = self.interval
        return i.start + dt * i.open_start, i.end - dt * i.open_end
