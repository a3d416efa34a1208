"""The operational design domain as a file: `vj.read_odd`.

    domain = vj.read_odd("domain.yaml")
    problem = vj.Problem("brake", domain.space(), system, formula)
    print(domain.coverage(run))                         # and .next_points(10)

The file is YAML of ASAM OpenODD 1.0, or one that names such files and says by which features a
problem varies their attributes, in which units, why, and who says so:

    openodd: [odd.yaml]
    features:
      speed: {attribute: dynamic.ego_speed, unit: m/s, reason: limit of the road, source: StVO 3}
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from verifai_jax.analysis.data.samples import Source
from verifai_jax.analysis.odd_conditions import (
    UNIT_OF,
    UNITS,
    Attribute,
    Group,
    Hull,
    Module,
    Reference,
    Resolve,
    Test,
    Values,
    both,
    convert,
    hull_of,
    module_holds,
    read_group,
)
from verifai_jax.core.atomic_files import replacing
from verifai_jax.core.errors import check_names, unknown_name
from verifai_jax.core.lazy import lazy_import
from verifai_jax.core.reads import documents
from verifai_jax.core.yaml import read_yaml, write_yaml
from verifai_jax.features import Box, Categorical, DiscreteBox, Domain, FeatureSpace

ABOUT = ("attribute", "unit", "reason", "source")
"""What is said of a feature."""
SECTIONS = ("TAXONOMY", "ODD", "MODULES", "IMPORT", "conversion")
"""Parts of a file of OpenODD."""
OF_MODULE = ("TITLE", "DESCRIPTION", "ACTIVE", "LABEL", "LABELS")
"""Entries of a module, conditions apart."""
KINDS = ("float", "integer", "boolean", "string")


@dataclass(frozen=True, eq=False)
class OperationalDomain:
    """An operational design domain, as `read_odd` reads it.

    - `name`: of the domain.
    - `attributes`: in the order of the taxonomy.
    - `modules`: by name; those of `roots` have to hold.
    - `document`: the tree of the file, which `write` writes.
    """

    name: str
    attributes: tuple[Attribute, ...]
    modules: Mapping[str, Module] = field(repr=False)
    roots: tuple[str, ...]
    document: Mapping[str, Any] = field(repr=False)

    @property
    def features(self) -> dict[str, Attribute]:
        """The attributes that features stand for, by feature."""
        return {each.feature: each for each in self.attributes if each.feature}

    @property
    def units(self) -> dict[str, str]:
        """The units of features, as `run.report(units=...)` takes them."""
        return {name: each.unit for name, each in self.features.items() if each.unit}

    @property
    def reasons(self) -> dict[str, str]:
        """The reasons of features with their sources, as `run.report(reasons=...)` takes them."""
        said = {name: (each.reason, each.source) for name, each in self.features.items()}
        return {name: ", ".join(filter(None, each)) for name, each in said.items() if any(each)}

    def hull(self, attribute: Attribute) -> Hull:
        """Return the interval, or the indices of literals, that an attribute has inside."""
        hulls = (hull_of(attribute, name, self.modules) for name in self.roots)
        return reduce(both, hulls, attribute.everything)

    def holds(self, rows: pd.DataFrame | Mapping[str, Any]) -> Bool[np.ndarray, " n"]:
        """Return which rows of features lie inside. What a row does not have is not asked for."""
        frame = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame([dict(rows)])
        found = self._inside(self.values(frame))
        return np.broadcast_to(np.asarray(found, bool), len(frame))

    def values(self, frame: pd.DataFrame) -> dict[str, Float[np.ndarray, " n"]]:
        """Return the values of attributes in rows of features; literals by index, -1 for others."""
        found = {}
        for name, each in self.features.items():
            if name not in frame:
                continue
            column = frame[name]
            if each.literals:
                codes = {literal: index for index, literal in enumerate(each.literals)}
                written = [_plain(value) for value in column]
                found[each.name] = np.array([codes.get(text, -1) for text in written], float)
            else:
                found[each.name] = column.to_numpy(float)
        return found

    def _inside(self, values: Values) -> Any:
        found: Any = True
        for name in self.roots:
            found = found & module_holds(name, values, self.modules, unknown=True)
        return found

    @property
    def is_box(self) -> bool:
        """True if no condition couples attributes, so that each has its own values."""
        each = [condition for name in self.roots for condition in self.modules[name].conditions()]
        groups = [condition for condition in each if isinstance(condition, Group)]
        tests = [condition for condition in each if isinstance(condition, Test)]
        plain = all(self.modules[name].exclude is None for name in self.roots)
        simple = all(group.every for group in groups) and len(groups) + len(tests) == len(each)
        return plain and simple and not any(test.strict for test in tests)

    def space(self) -> FeatureSpace:
        """Return the features, uniform over the domain.

        **Raises:** `ValueError` for an attribute that the domain does not bound, or leaves empty.
        """
        domains: dict[str, Domain] = {}
        for name, each in self.features.items():
            values = choices_of(each, self.hull(each))
            if isinstance(values, list):
                domains[name] = Categorical(*values)
            else:
                box = DiscreteBox if each.kind == "integer" else Box
                domains[name] = box(*values)
        return FeatureSpace(domains, None if self.is_box else self._accepts)

    def _accepts(self, features: Mapping[str, Any]) -> Any:
        values = {}
        for name, each in self.features.items():
            value, hull = features[name], self.hull(each)
            if isinstance(hull, frozenset) and each.kind != "boolean":
                value = jnp.asarray(sorted(hull))[value]  # An index among the allowed ones.
            values[each.name] = value
        return self._inside(values)

    def coverage(self, source: Source, *, cells: int = 10, seed: int = 0) -> Any:
        """Measure how much of the domain rows cover, as `odd_coverage.odd_coverage` does."""
        measure = lazy_import("verifai_jax.analysis.odd_coverage", "odd_coverage")
        return measure(self, source, cells=cells, seed=seed)

    def write(self, path: str | Path) -> Path:
        """Write the domain as OpenODD's YAML, which `read_odd` reads again."""
        with replacing(path) as partial:
            partial.write_text(write_yaml(dict(self.document)), encoding="utf-8")
        return Path(path)

    def __str__(self) -> str:
        lines = [f"{self.name}: {len(self.attributes)} attributes, inside where "
                 f"{' and '.join(self.roots) or 'anything'} holds"]  # fmt: skip
        for each in self.attributes:
            feature = f"feature {each.feature}" if each.feature else "no feature"
            lines.append(f"  {each.name}: {words(each, self.hull(each))}, {feature}")
        return "\n".join(lines)


def choices_of(attribute: Attribute, hull: Hull) -> tuple[float, float] | list[str] | list[bool]:
    """Return the ends of an attribute's interval, or its literals.

    **Raises:** `ValueError` for an interval without an end, and for nothing.
    """
    if isinstance(hull, frozenset):
        found = [attribute.literals[code] for code in sorted(hull)]
        if not found:
            raise ValueError(f"no value of {attribute.name} is inside the domain")
        return [each == "true" for each in found] if attribute.kind == "boolean" else found
    low, high = hull
    if attribute.kind == "integer":
        low, high = np.ceil(low), np.floor(high)
    if not np.isfinite([low, high]).all() or low > high or attribute.kind == "string":
        raise ValueError(
            f"{attribute.name} has no range in the domain ({words(attribute, hull)}): a module "
            'bounds it, INCLUDE_AND: {NAME: "[low .. high] unit"}'
        )
    return (int(low), int(high)) if attribute.kind == "integer" else (low, high)


def words(attribute: Attribute, hull: Hull) -> str:
    """Write the values of an attribute."""
    if isinstance(hull, frozenset):
        return ", ".join(attribute.literals[code] for code in sorted(hull)) or "nothing"
    return " ".join(filter(None, (f"{hull[0]:zg} to {hull[1]:zg}", attribute.unit)))


def read_odd(path: str | Path) -> OperationalDomain:
    """Read an operational design domain from a file of ASAM OpenODD 1.0, or one that names such.

    Attributes are floats and integers with a unit, booleans and literals. A condition is a range,
    `"[0 .. 50] km/h"`, a comparison, a literal or a list of them, a group `AND` or `OR`, or a
    module that holds or not. Units are converted into that of the feature.

    **Arguments:**

    - `path`: the file. Without `features` each attribute is a feature of its last name.

    **Raises:** `FileNotFoundError`; `ValueError` that names the entry, for what is no such file.
    """
    path = Path(path)
    whole = _mapping(path)
    said: dict[str, dict[str, str]] = {}
    if "openodd" in whole:
        check_names(f"entry of {path}", whole, ("openodd", "name", "features"))
        tree = {}
        for name in _listed(whole["openodd"]):
            tree = _joined(tree, _with_imports(path.parent / name))
        for feature, about in (whole.get("features") or {}).items():
            if not isinstance(about, Mapping) or "attribute" not in about:
                raise ValueError(f"{path}: feature {feature!r} needs its attribute")
            check_names(f"entry of feature {feature!r} of {path}", about, ABOUT)
            said[str(feature)] = {key: str(value) for key, value in about.items()}
    else:
        tree = _joined({}, _with_imports(path))
    return _domain(str(whole.get("name", path.stem)), str(path), tree, said)


def odd_of(
    space: FeatureSpace, name: str = "odd", units: Mapping[str, str] | None = None
) -> OperationalDomain:
    """Return the domain that a space of features spans, for `write`.

    **Raises:** `ValueError` for a feature that is no range and no choice, and for a constraint.
    """
    taxonomy: dict[str, Any] = {}
    include: dict[str, Any] = {}
    if space.where is not None:
        raise ValueError("a constraint is code, which a file of OpenODD does not hold")
    for feature, domain in space.domains.items():
        found, unit = domain.tuning, (units or {}).get(feature, "")
        if found.choices:
            taxonomy[feature] = include[feature] = [_plain(each) for each in found.choices]
        elif isinstance(found.low, int | float) and isinstance(found.high, int | float):
            kind = "integer" if found.scale == "integer" else "float"
            measured, unit = (UNITS[unit][0], f" {unit}") if unit in UNITS else ("", "")
            taxonomy[feature] = f"{kind} {measured}".strip()
            include[feature] = f"[{found.low!r} .. {found.high!r}]{unit}"
        else:
            raise ValueError(f"feature {feature!r} is no range and no choice; got {domain!r}")
    tree = {"TAXONOMY": taxonomy, "ODD": {name: {"INCLUDE_AND": include}}}
    return _domain(name, name, tree, {})


def _domain(
    name: str, where: str, tree: Mapping[str, Any], said: Mapping[str, Mapping[str, str]]
) -> OperationalDomain:
    found = list(_attributes((), tree.get("TAXONOMY") or {}, where))
    if not found:
        raise ValueError(f"{where} has no attribute: TAXONOMY names them")
    resolve = _resolver(found)
    if said:
        mapped = {}
        for feature, about in said.items():
            attribute = resolve(about["attribute"])
            if attribute is None:
                names = [each.name for each in found]
                raise unknown_name(f"attribute of {where}", about["attribute"], names)
            own = {key: about.get(key, "") for key in ("unit", "reason", "source")}
            mapped[attribute.name] = {"feature": feature, **own}
    else:
        last = [each.name.rpartition(".")[2] for each in found]
        mapped = {
            each.name: {"feature": end if last.count(end) == 1 else each.name.replace(".", "_")}
            for each, end in zip(found, last, strict=True)
        }
    sections = {**(tree.get("MODULES") or {}), **(tree.get("ODD") or {})}
    attributes = []
    for each in found:
        own = {key: value for key, value in mapped.get(each.name, {}).items() if value}
        if each.unit and own.get("unit"):
            convert(1.0, each.unit, own["unit"])
        attributes.append(replace(each, **own))
    resolve = _resolver(attributes)
    modules = {
        str(key): _module(f"module {key} of {where}", section, resolve, [*sections])
        for key, section in sections.items()
    }
    uses = {name: _used(module) for name, module in modules.items()}
    for start in modules:
        _refuse_circles(start, (), uses)
    roots = [*(tree.get("ODD") or {})] or [
        each for each in modules if not any(each in used for used in uses.values())
    ]
    active = tuple(each for each in roots if modules[each].active)
    return OperationalDomain(name, tuple(attributes), modules, active, tree)


def _module(where: str, section: object, resolve: Resolve, names: list[str]) -> Module:
    if not isinstance(section, Mapping):
        raise ValueError(f"{where} must be a mapping; got {section!r}")
    words = [f"{verb}_{join}" for verb in ("INCLUDE", "EXCLUDE") for join in ("AND", "OR")]
    check_names(f"entry of {where}", section, (*OF_MODULE, *words))
    groups: dict[str, Group] = {}
    for word in words:
        if word in section:
            verb = word[:7]
            if verb in groups:
                raise ValueError(
                    f"{where} has {verb}_AND and {verb}_OR: take one, with a group in it"
                )
            every = word.endswith("AND")
            groups[verb] = read_group(f"{where}, {word}", section[word], every, resolve, names)
    active = section.get("ACTIVE", True) is not False
    return Module(groups.get("INCLUDE"), groups.get("EXCLUDE"), active)


def _attributes(above: tuple[str, ...], tree: object, where: str) -> Iterator[Attribute]:
    if not isinstance(tree, Mapping):
        raise ValueError(f"{where}: TAXONOMY maps names to kinds; got {tree!r}")
    for key, value in tree.items():
        names = (*above, str(key))
        name = ".".join(names)
        if isinstance(value, Mapping):
            yield from _attributes(names, value, where)
        elif isinstance(value, list) and value:
            yield Attribute(name, "literal", tuple(map(_plain, value)))
        elif isinstance(value, str) and value.split()[:1] and value.split()[0] in KINDS:
            kind, measured = value.split()[0], value.split()[-1]
            literals = ("false", "true") if kind == "boolean" else ()
            yield Attribute(name, kind, literals, unit=UNIT_OF.get(measured, ""))
        else:
            raise ValueError(
                f"{where}: {name} is a list of literals, or {', '.join(KINDS)} with what it "
                f'measures, "float velocity"; got {value!r}'
            )


def _resolver(attributes: list[Attribute]) -> Resolve:
    """Return what finds an attribute by its whole name, or by the end of it that is its own."""

    def resolve(name: str) -> Attribute | None:
        found = [a for a in attributes if a.name == name or a.name.endswith(f".{name}")]
        exact = [each for each in found if each.name == name]
        if len(found) > 1 and not exact:
            names = ", ".join(each.name for each in found)
            raise ValueError(f"{name!r} may be {names}: write it whole")
        return (exact or found or [None])[0]

    return resolve


def _used(module: Module) -> set[str]:
    return {each.module for each in module.conditions() if isinstance(each, Reference)}


def _refuse_circles(name: str, above: tuple[str, ...], uses: Mapping[str, set[str]]) -> None:
    if name in above:
        raise ValueError(f"modules refer to each other in a circle: {' -> '.join([*above, name])}")
    for other in uses[name]:
        _refuse_circles(other, (*above, name), uses)


def _mapping(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise FileNotFoundError(f"there is no file of an operational design domain {path}")
    documents.add(str(path.resolve()))
    try:
        whole = read_yaml(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is no YAML: {error}") from None
    if not isinstance(whole, dict):
        raise ValueError(f"{path} must be a mapping, TAXONOMY: ...; got {type(whole).__name__}")
    return whole


def _with_imports(path: Path, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return a file of OpenODD together with those that it imports."""
    if path in above:
        raise ValueError(f"{path} imports itself")
    whole = _mapping(path)
    check_names(f"section of {path}", whole, SECTIONS)
    tree: dict[str, Any] = {}
    for name in _listed(whole.pop("IMPORT", None)):
        tree = _joined(tree, _with_imports(path.parent / name, (*above, path)))
    return _joined(tree, whole)


def _listed(value: object) -> list[str]:
    return [] if value is None else [*map(str, value)] if isinstance(value, list) else [str(value)]


def _joined(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return two trees as one; entries of the second go first."""
    found = dict(one)
    for key, value in other.items():
        both = isinstance(value, Mapping) and isinstance(found.get(key), Mapping)
        found[key] = _joined(found[key], value) if both else value
    return found


def _plain(value: object) -> str:
    return str(value).lower() if isinstance(value, bool | np.bool_) else str(value)
