"""Readable names for the objects and the random values of a Scenic program.

A value that the program assigns to a variable has the name of this variable. Any other value has
the name of the first property or global parameter that depends on it: `ego.position.x`,
`cone1.heading`, `param.brightness`; without one, it has the name of its kind: `range1`.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from verifai_jax.addons.scenic.graph import children, field, is_constructed, is_random, kind_of, law

FIRST = ("position", "yaw", "parentOrientation", "heading", "orientation", "width", "length")
"""Properties that give their name to a value before others that depend on it too."""
FRAME = ("position", "center", "heading", "width", "length", "radius", "angle")
"""Parts of a region that may be random."""
ANGLES = ("yaw", "parentOrientation", "heading", "orientation", "pitch", "roll")
"""Properties that a person calls the heading."""
LOCAL = ("offsetLocally", "offsetRotated", "offsetRadially")
"""Operations in which a vector is measured from another place, in axes of its own."""


def owner_names(
    scenario: Any, variables: Mapping[int, str], order: Iterable[Any]
) -> dict[int, str]:
    """Return the names of the objects and points that a program makes by `new`, by identity.

    **Arguments:**
    - `scenario`: Scenic's `Scenario`.
    - `variables`: names of variables by the identity of their values.
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
    """Return a unique name for each random node that is not an object, by identity."""
    found: dict[int, str] = {}
    made = [node for node in (*field(scenario, "_instances"), *order) if id(node) in owners]
    for owner in made:
        properties = [p for p in FIRST if p in owner.properties]
        properties += [p for p in owner.properties if p not in FIRST]
        for prop in owner.properties:
            if prop not in ANGLES and _is_own(field(owner, prop)):
                found.setdefault(id(_inner(field(owner, prop))), f"{owners[id(owner)]}.{prop}")
        for prop in properties:
            label = "heading" if prop in ANGLES else prop
            _visit(field(owner, prop), f"{owners[id(owner)]}.{label}", found, owners, variables)
    for name, value in scenario.params.items():
        _visit(value, f"param.{name}", found, owners, variables)
    for node in order:
        found.setdefault(id(node), "")
        if id(node) in variables and id(node) not in owners:
            found[id(node)] = variables[id(node)]
            if kind_of(law(node)) in ("Options", "VerifaiOptions", "UniformDistribution"):
                part = "selector" if "selector" in vars(law(node)) else "index"
                found[id(field(law(node), part))] = variables[id(node)]
    return found


def unique(name: str, taken: Iterable[str]) -> str:
    """Return the name, with a number appended if it is taken."""
    known = set(taken)
    if name not in known:
        return name
    stem = f"{name}_" if name[-1:].isdigit() else name
    return next(f"{stem}{i}" for i in range(2, len(known) + 3) if f"{stem}{i}" not in known)


def _inner(node: Any) -> Any:
    """Return what Scenic checks the type of, where it does."""
    return field(node, "_dist") if kind_of(node) == "TypecheckedDistribution" else node


def _is_own(node: Any) -> bool:
    """Return whether a property is a random number or choice itself, and not computed from any."""
    inner = _inner(node)
    return is_random(inner) and not is_constructed(inner) and not children(inner)


def _visit(
    root: Any, label: str, found: dict[int, str], owners: Mapping[int, str],
    variables: Mapping[int, str],
) -> None:  # fmt: skip
    """Name everything unnamed below a property, except what belongs to other objects."""
    stack = [(root, label, "")]
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
        offsets = {id(operand) for operand in field(drawn, "operands")} if moved else set()
        coordinates = vars(drawn).get("coordinates", ())
        region = kind_of(drawn).endswith("Region")
        frame = {id(field(drawn, part)): part for part in FRAME} if region else {}
        below_node = list(reversed(children(node)))
        # The last is visited first, before what is computed from it.
        below_node.sort(key=lambda child, frame=frame: id(child) in frame)
        for child in below_node:
            own = suffix
            for axis, coordinate in zip("xyz", coordinates, strict=False):
                if coordinate is child:
                    own = axis
            below = label
            inner = node is not root and bool(coordinates)
            if (inner or id(child) in offsets) and label.endswith(".position"):
                below = label.removesuffix("position") + "offset"
            if id(child) in frame:
                coordinate = variables.get(id(node), f"{label}.region")
                below, own = f"{coordinate}.{frame[id(child)]}", ""
            stack.append((child, below, own))
