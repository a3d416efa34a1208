"""Conditions of an operational design domain, as ASAM OpenODD 1.0 writes them in YAML.

    INCLUDE_AND: {speed: "[0 .. 50] km/h", road: [street, lane], OR: {rain: no, speed: "< 9 m/s"}}
    EXCLUDE_OR: {lanes: "> 3"}

A test is a condition on one attribute, a group combines conditions, and a reference is true if
another module holds. Numbers are in the unit of the attribute; literals are given by index.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial, reduce
from typing import TypeAlias

import jax
import numpy as np

from verifai_jax.addons.monitoring.units import plain_unit
from verifai_jax.core.messages.errors import unknown_name

Values: TypeAlias = Mapping[str, np.ndarray | jax.Array]
"""Values of attributes, of the same shape."""
Truth: TypeAlias = np.ndarray | jax.Array | bool
Hull: TypeAlias = tuple[float, float] | frozenset[int]
"""Values that an attribute can have: an interval, or indices of literals."""
EVERYTHING = (-math.inf, math.inf)
NUMBER = r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?INF)"
RANGE = re.compile(rf"\[\s*{NUMBER}\s*\.\.\s*{NUMBER}\s*\]\s*(\S+)?")
COMPARED = re.compile(rf"(<=|>=|<|>)?\s*{NUMBER}\s*(\S+)?")
UNITS: dict[str, tuple[str, float]] = {
    "m/s": ("velocity", 1.0), "km/h": ("velocity", 1 / 3.6), "mph": ("velocity", 0.44704),
    "kt": ("velocity", 1852 / 3600), "m": ("length", 1.0), "km": ("length", 1e3),
    "cm": ("length", 1e-2), "mm": ("length", 1e-3), "ft": ("length", 0.3048),
    "mi": ("length", 1609.344), "s": ("time", 1.0), "ms": ("time", 1e-3), "min": ("time", 60.0),
    "h": ("time", 3600.0), "m/s^2": ("acceleration", 1.0), "g": ("acceleration", 9.80665),
    "rad": ("angle", 1.0), "deg": ("angle", math.pi / 180), "%": ("percentage", 1.0),
    "kg": ("mass", 1.0), "t": ("mass", 1e3), "lx": ("illuminance", 1.0),
    "klx": ("illuminance", 1e3), "mm/h": ("precipitation", 1.0), "degC": ("temperature", 1.0),
    "Hz": ("frequency", 1.0), "count": ("count", 1.0),
}  # fmt: skip
"""What a unit measures, and how many of the first unit of that kind it is."""
UNIT_OF = {"duration": "s"} | {kind: unit for unit, (kind, size) in UNITS.items() if size == 1}
"""The default unit of an attribute, by what it measures."""
Conversions: TypeAlias = Mapping[tuple[str, str], tuple[float, float]]
"""Scale and offset from one unit to another, as a file says them."""


def convert(value: float, unit: str, to: str, own: Conversions | None = None) -> float:
    """Convert a number to another, compatible unit, preferring the file's `own` conversions."""
    one, other = plain_unit(unit), plain_unit(to)
    for (source, target), (scale, offset) in (own or {}).items():
        if source == unit:
            return convert(value * scale + offset, target, to)
    if one == other or not one:
        return value
    (kind, size), (other_kind, other_size) = (UNITS.get(u, (u, 1.0)) for u in (one, other))
    if kind != other_kind:
        raise ValueError(f"{unit} cannot be converted into {to or 'a number without a unit'}")
    return value * size / other_size


@dataclass(frozen=True)
class Attribute:
    """An attribute of a domain, and the feature that varies it, if any.

    - `name`: its name with those of the concepts that contain it, `dynamic.ego_speed`.
    - `kind`: `"float"`, `"integer"`, `"boolean"`, `"string"` or `"literal"`.
    - `literals`, `groups`: its possible values, if they are listed, and named groups of them.
    - `unit`: the unit of the feature; by default the SI unit of its quantity.
    - `reason`, `source`: the reason for its values, and the source of that.
    """

    name: str
    kind: str
    literals: tuple[str, ...] = ()
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict, repr=False)
    feature: str = ""
    unit: str = ""
    reason: str = ""
    source: str = ""

    @property
    def everything(self) -> Hull:
        """All possible values of the attribute."""
        return frozenset(range(len(self.literals))) if self.literals else EVERYTHING


@dataclass(frozen=True)
class Test:
    """A test of one attribute: in an interval, without its ends if `strict`, or among literals."""

    attribute: str
    hull: Hull
    strict: bool = False

    def holds(self, x: np.ndarray | jax.Array) -> Truth:
        """Return which values satisfy the test."""
        if isinstance(self.hull, frozenset):
            allowed: Truth = x != x
            for code in sorted(self.hull):
                allowed = allowed | (x == code)
            return allowed
        low, high = self.hull
        return ((x > low) & (x < high)) if self.strict else ((x >= low) & (x <= high))


@dataclass(frozen=True)
class Group:
    """A group of conditions of which `every` one must hold, or at least one."""

    every: bool
    parts: "tuple[Condition, ...]"


@dataclass(frozen=True)
class Reference:
    """A condition that holds if another module holds."""

    module: str
    holds: bool


Condition: TypeAlias = Test | Group | Reference


@dataclass(frozen=True)
class Module:
    """A module; it holds if its included conditions hold and its excluded ones do not."""

    include: Group | None
    exclude: Group | None
    active: bool = True

    def conditions(self) -> Iterator[Condition]:
        """Yield all conditions and groups, including nested ones."""
        left: list[Condition] = [each for each in (self.include, self.exclude) if each]
        while left:
            yield (each := left.pop())
            left += each.parts if isinstance(each, Group) else ()


def module_holds(name: str, values: Values, modules: Mapping[str, Module], unknown: bool) -> Truth:
    """Return whether a module holds; a missing value counts as `unknown`."""
    module = modules[name]
    found: Truth = True
    if module.include is not None:
        found = _holds(module.include, values, modules, unknown)
    if module.exclude is not None:
        found = found & _not(_holds(module.exclude, values, modules, not unknown))
    return found


def _holds(each: Condition, values: Values, modules: Mapping[str, Module], unknown: bool) -> Truth:
    match each:
        case Test(attribute):
            return each.holds(values[attribute]) if attribute in values else unknown
        case Reference(module, wanted):
            held = module_holds(module, values, modules, unknown if wanted else not unknown)
            return held if wanted else _not(held)
        case Group(every, parts):
            found: Truth = every
            for part in parts:
                held = _holds(part, values, modules, unknown)
                found = (found & held) if every else (found | held)
            return found


def _not(truth: Truth) -> Truth:
    return not truth if isinstance(truth, bool) else ~truth


def hull_of(attribute: Attribute, module: str, modules: Mapping[str, Module]) -> Hull:
    """Return the values that an attribute can have if a module holds, as an interval or set."""
    found, each = attribute.everything, modules[module]
    if each.include is not None:
        found = both(found, _hull(attribute, each.include, modules))
    if each.exclude is not None and (not each.exclude.every or len(each.exclude.parts) == 1):
        for part in each.exclude.parts:
            if isinstance(part, Test) and part.attribute == attribute.name:
                found = both(found, _complement(attribute, part.hull))
    return found


def _hull(attribute: Attribute, each: Condition, modules: Mapping[str, Module]) -> Hull:
    match each:
        case Test(name, hull) if name == attribute.name:
            return hull
        case Reference(module, True):
            return hull_of(attribute, module, modules)
        case Group(every, parts):
            hulls = [_hull(attribute, part, modules) for part in parts]
            return reduce(partial(both, every=every), hulls)
        case _:
            return attribute.everything


def both(one: Hull, other: Hull, every: bool = True) -> Hull:
    """Return the intersection of two intervals, or of two sets; unless `every`, their hull."""
    if isinstance(one, frozenset) or isinstance(other, frozenset):
        assert isinstance(one, frozenset) and isinstance(other, frozenset)  # noqa: PT018
        return one & other if every else one | other
    (low, high), (first, last) = one, other
    return (max(low, first), min(high, last)) if every else (min(low, first), max(high, last))


def _complement(attribute: Attribute, hull: Hull) -> Hull:
    whole = attribute.everything
    if isinstance(hull, frozenset):
        assert isinstance(whole, frozenset)
        return whole - hull
    if hull[0] == -math.inf:
        return hull[1], math.inf
    return (-math.inf, hull[0]) if hull[1] == math.inf else EVERYTHING


Resolve: TypeAlias = Callable[[str], Attribute | None]
"""What finds an attribute by the name in a condition; None for the name of a module."""


def read_group(
    where: str, section: object, every: bool, resolve: Resolve, modules: Sequence[str],
    conversions: Conversions,
) -> Group:  # fmt: skip
    """Read a section of conditions: a mapping from names to expressions."""
    if not isinstance(section, Mapping) or not section:
        raise ValueError(f"{where} maps attributes to expressions; got {section!r}")
    parts: list[Condition] = []
    for key, value in section.items():
        name, inside = str(key), f"{where}, {key}"
        if name in ("AND", "OR"):
            parts.append(read_group(inside, value, name == "AND", resolve, modules, conversions))
        elif (attribute := resolve(name)) is not None:
            try:
                parts.append(_read_test(attribute, value, conversions))
            except ValueError as error:
                raise ValueError(f"{inside}: {error}") from None
        elif name in modules:
            if not isinstance(value, bool):
                needed = "must be true (the module holds) or false (it does not)"
                raise ValueError(f"{inside}: {needed}; got {value!r}")
            parts.append(Reference(name, value))
        else:
            raise unknown_name(f"attribute or module of {where}", name, modules)
    return Group(every, tuple(parts))


def _read_test(attribute: Attribute, value: object, conversions: Conversions) -> Test:
    if attribute.literals:
        given = [written(each) for each in (value if isinstance(value, list) else [value])]
        said = [name for each in given for name in attribute.groups.get(each, (each,))]
        for each in said:
            if each not in attribute.literals:
                values = ", ".join(attribute.literals)
                raise ValueError(f"{each!r} is not one of its values, {values}")
        return Test(attribute.name, frozenset(map(attribute.literals.index, said)))
    if attribute.kind not in ("float", "integer"):
        raise ValueError(f"an attribute of kind {attribute.kind} has no values to compare with")
    text = str(value).strip()
    if found := RANGE.fullmatch(text):
        word, low, high, unit = "", float(found[1]), float(found[2]), found[3]
    elif found := COMPARED.fullmatch(text):
        word, unit = found[1] or "", found[3]
        low = high = float(found[2])
    else:
        raise ValueError(
            f'expected "[low .. high] unit", "> number unit" or a number; got {text!r}'
        )
    low, high = (convert(x, unit or "", attribute.unit, conversions) for x in (low, high))
    low = -math.inf if word[:1] == "<" else low
    high = math.inf if word[:1] == ">" else high
    return Test(attribute.name, (low, high), word in ("<", ">"))


def written(value: object) -> str:
    """Return a literal as written in a file."""
    return str(value).lower() if isinstance(value, bool | np.bool_) else str(value)
