"""Names for the objects and the random values of a Scenic program that a person recognises.

A value that the program calls by a variable of its own has this name. Any other is called by the
first object's property, or global parameter, that it feeds: `ego.position.x`, `cone1.heading`,
`param.brightness`. What feeds none of them has the name of its kind: `range1`.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from verifai_jax.scenes.graph import children, field, is_constructed, is_random, kind_of, law

FIRST = ("position", "yaw", "parentOrientation", "heading", "orientation")
"""Properties that give their name to a value before others that depend on it too."""

ANGLES = ("yaw", "parentOrientation", "heading", "orientation", "pitch", "roll")
"""Properties that a person calls the heading."""

LOCAL = ("offsetLocally", "offsetRotated", "offsetRadially")
"""Operations in which a vector is measured from another place, in axes of its own."""


def owner_names(
    scenario: Any, variables: Mapping[int, str], order: Iterable[Any]
) -> dict[int, str]:
    """Return the names of the objects and points that a program makes by `new`, by identity.

    **Arguments:**

    - `scenario`: Scenic's.
    - `variables`: names of variables by the identity of what they hold.
    - `order`: random nodes.
    """
    owners: list[Any] = []
    random_owners = [node for node in order if is_constructed(node)]
    for node in (*field(scenario, "_instances"), *scenario.objects, *random_owners):
        if all(node is not owner for owner in owners):
            owners.append(node)
    names: dict[int, str] = {}
    if scenario.egoObject is not None:
        names[id(scenario.egoObject)] = "ego"
    for owner in owners:
        given = field(owner, "name")
        if id(owner) in names:
            continue
        if id(owner) in variables:
            names[id(owner)] = variables[id(owner)]
        elif isinstance(given, str) and given and given not in names.values():
            names[id(owner)] = given
    counts: Counter[str] = Counter()
    for owner in owners:
        if id(owner) not in names:
            kind = kind_of(owner).removesuffix("2D").lower()
            while True:
                counts[kind] += 1
                name = f"{kind}{counts[kind]}"
                if name not in names.values():
                    break
            names[id(owner)] = name
    return names


def leaf_names(
    scenario: Any, owners: Mapping[int, str], variables: Mapping[int, str], order: list[Any]
) -> dict[int, str]:
    """Return a name for each random node that is not an object, by identity; all are different."""
    found: dict[int, str] = {}
    made = [node for node in (*field(scenario, "_instances"), *order) if id(node) in owners]
    for owner in made:
        properties = [p for p in FIRST if p in owner.properties]
        properties += [p for p in owner.properties if p not in FIRST]
        for prop in properties:
            label = "heading" if prop in ANGLES else prop
            _visit(field(owner, prop), f"{owners[id(owner)]}.{label}", "", found, owners)
    for name, value in scenario.params.items():
        _visit(value, f"param.{name}", "", found, owners)
    for node in order:
        found.setdefault(id(node), "")
        if id(node) in variables and id(node) not in owners:
            found[id(node)] = variables[id(node)]
            if kind_of(law(node)) in ("Options", "VerifaiOptions", "UniformDistribution"):
                part = "selector" if "selector" in vars(law(node)) else "index"
                found[id(field(law(node), part))] = variables[id(node)]
    return found


def unique(name: str, taken: Iterable[str]) -> str:
    """Return a name that is not taken, by a number behind it."""
    known = set(taken)
    if name not in known:
        return name
    stem = f"{name}_" if name[-1:].isdigit() else name
    return next(f"{stem}{i}" for i in range(2, len(known) + 3) if f"{stem}{i}" not in known)


def _visit(
    root: Any, label: str, suffix: str, found: dict[int, str], owners: Mapping[int, str]
) -> None:
    """Name everything below a property that has no name yet, but for other objects' own."""
    stack = [(root, label, suffix)]
    seen: set[int] = set()
    while stack:
        node, label, suffix = stack.pop()
        if not is_random(node) or id(node) in owners or id(node) in seen:
            continue
        seen.add(id(node))
        drawn = law(node)
        pointed = kind_of(drawn) == "PointInRegionDistribution"
        found.setdefault(id(node), label if pointed or not suffix else f"{label}.{suffix}")
        moved = field(drawn, "operator") in LOCAL
        operands = [field(drawn, "operands")] if moved else []
        offsets = {id(operand) for operand in (operands[0] if operands else ())}
        places = vars(drawn).get("coordinates", ())
        for child in reversed(children(node)):
            own = suffix
            for axis, place in zip("xyz", places, strict=False):
                if place is child:
                    own = axis
            below = label
            if id(child) in offsets and label.endswith(".position"):
                below = label.removesuffix("position") + "offset"
            stack.append((child, below, own))
