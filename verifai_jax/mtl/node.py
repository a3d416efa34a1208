"""The nodes of formulas and expressions: compared, hashed and walked without recursion.

A sub-tree may occur several times (`f <-> g` holds each side twice), so nothing here takes
longer than there are different nodes, however many paths lead to them.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, TypeVar

from verifai_jax.core.notebook import ForUsers

N = TypeVar("N", bound="Node")


class MissingCaseError(TypeError):
    """A walk over a formula has no case for a kind of node, such as one made outside of here."""


def missing_case(walk: str, node: object) -> MissingCaseError:
    """Return the error for a node that a walk over a formula has no case for.

    **Arguments:**

    - `walk`: what the walk gives, such as `"the horizon"`.
    - `node`: the node; its own text is not asked for, since that is a walk, too.
    """
    kind = type(node)
    return MissingCaseError(
        f"{walk} of a formula has no case for a node {kind.__name__} (of {kind.__module__}): "
        "build formulas of the operators of verifai_jax.mtl"
    )


class Node(ForUsers):
    """A node that is equal to another of the same kind with equal fields."""

    _internal = frozenset((
        "below", "children", "compared", "depth", "first_look_ahead", "interval", "is_predicate",
        "is_signal", "meaning", "number", "operands", "operator", "side", "span", "temporal_depth",
        "terms", "text", "timeless", "valued", "word",
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
    """Yield a node and all below it, each once, children first.

    Nodes that have the attribute `known` already are left out, with what is below them.
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
