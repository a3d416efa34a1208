"""The dependency graph of the values of a compiled Scenic program.

    for node in nodes(scenario): ...                    # each after what it depends on
    law(node)                                           # the node that says how it is computed

A compiled scenario is a directed acyclic graph of `Samplable`s. Attributes are read from
`__dict__`, since a missing attribute of a random value is a new random value.
"""

import sys
from collections.abc import Iterable
from typing import Any

FRAMED = ("RectangularRegion", "CircularRegion", "SectorRegion")
"""Regions with coordinates of their own, whatever is random about them."""
PIECEWISE = ("PolygonalRegion", "PolylineRegion")
"""Regions made of triangles or segments, which are invertible where they are fixed."""


def field(node: Any, name: str) -> Any:
    """Return an attribute of a node as stored; None if it has none."""
    return vars(node).get(name)


def kind_of(node: Any) -> str:
    """Return the name of a node's class."""
    return type(node).__name__


def is_random(value: Any) -> bool:
    """Return whether a value differs from scene to scene."""
    return bool(sys.modules["scenic.core.distributions"].needsSampling(value))


def law(node: Any) -> Any:
    """Return the node that defines how this one is computed.

    Scenic replaces points in a region by points in its feasible part, which may have no inverse.
    Then the whole region is used, if it has coordinates; the requirements refuse the other points.
    """
    conditioned = field(node, "_conditioned")
    if conditioned is None or conditioned is node:
        return node
    if kind_of(node) == "PointInRegionDistribution":
        whole = field(node, "region")
        part = field(conditioned, "region")
        if kind_of(whole) in FRAMED or (_is_fixed_pieces(whole) and not _is_fixed_pieces(part)):
            return node
    return conditioned


def _is_fixed_pieces(region: Any) -> bool:
    return kind_of(region) in PIECEWISE and not is_random(region)


def children(node: Any) -> tuple[Any, ...]:
    """Return the nodes on which a random node depends."""
    dependencies = field(law(node), "_dependencies")
    return () if dependencies is None else tuple(dependencies)


def nodes(roots: Iterable[Any]) -> list[Any]:
    """Return the random nodes below some roots, each once, after all its dependencies."""
    order: list[Any] = []
    seen: set[int] = set()
    stack = [(root, False) for root in reversed(list(roots))]
    while stack:
        node, finished = stack.pop()
        if finished:
            order.append(node)
        elif id(node) not in seen and is_random(node):
            seen.add(id(node))
            stack.append((node, True))
            stack.extend((child, False) for child in reversed(children(node)))
    return order


def is_constructed(node: Any) -> bool:
    """Return whether a node is an object or a point made by `new` in the program."""
    return isinstance(node, sys.modules["scenic.core.object_types"].Constructible)
