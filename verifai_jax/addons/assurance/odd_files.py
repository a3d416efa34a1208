"""Files of operational design domains: YAML of ASAM OpenODD 1.0 in and out.

read_odd("domain.yaml")                             # with those that it imports or names
odd_of(space, "town", units={"speed": "m/s"}).write("odd.yaml")
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from reprlib import repr as shown
from typing import Any

from verifai_jax.addons.assurance.odd_conditions import (
    UNIT_OF,
    UNITS,
    Attribute,
    Conversions,
    Group,
    Module,
    Reference,
    Resolve,
    convert,
    read_group,
    written,
)
from verifai_jax.addons.assurance.operational_domain import OperationalDomain
from verifai_jax.core.messages.errors import check_names, unknown_name
from verifai_jax.core.store.foreign_files import read_text, read_yaml
from verifai_jax.core.user_code.sources import hashed_files
from verifai_jax.features import FeatureSpace

ABOUT = ("attribute", "unit", "reason", "source")
"""What is said of a feature."""
SECTIONS = ("TAXONOMY", "ODD", "MODULES", "IMPORT", "conversion")
"""Parts of a file of OpenODD."""
OF_MODULE = ("TITLE", "DESCRIPTION", "ACTIVE", "LABEL", "LABELS")
"""Entries of a module, conditions apart."""
KINDS = {"number": "float", "real": "float", "int": "integer", "bool": "boolean"}
"""Other words for kinds; an attribute of any other kind has no values here."""


def read_odd(path: str | Path) -> OperationalDomain:
    """Read an operational design domain from a file of ASAM OpenODD 1.0, or a file that names one.

    Attributes are floats and integers with a unit, booleans and literals. A condition is a range,
    `"[0 .. 50] km/h"`, a comparison, a literal or a list of them, a group `AND` or `OR`, or a
    module that must or must not hold. Values are converted to the unit of the feature.

    **Arguments:**
    - `path`: the file. Without an entry `features` each attribute is a feature, named by the last
      part of its name.
    **Raises:** `FileNotFoundError`; `ValueError` naming the entry, for any other file.
    """
    path = Path(path)
    files: dict[Path, None] = {}
    whole = _mapping(path, files)
    said: dict[str, dict[str, str]] = {}
    if "openodd" in whole:
        check_names(f"entry of {path}", whole, ("openodd", "name", "features"))
        tree = {}
        for name in _listed(whole["openodd"]):
            tree = _joined(tree, _with_imports(path.parent / name, files))
        for feature, about in _section(whole, "features", path).items():
            if not isinstance(about, Mapping) or "attribute" not in about:
                raise ValueError(f"{path}: feature {feature!r} needs its attribute")
            check_names(f"entry of feature {feature!r} of {path}", about, ABOUT)
            said[str(feature)] = {key: str(value) for key, value in about.items()}
    else:
        tree = _joined({}, _with_imports(path, files))
    found = _domain(str(whole.get("name", path.stem)), str(path), tree, said)
    return replace(found, files=tuple(hashed_files(files, "the operational design domain")))


def odd_of(
    space: FeatureSpace, name: str = "odd", units: Mapping[str, str] | None = None
) -> OperationalDomain:
    """Return the domain spanned by a space of features, for `write`.

    **Raises:** `ValueError` for a constraint, and a feature that is neither a range nor a choice.
    """
    taxonomy: dict[str, Any] = {}
    include: dict[str, Any] = {}
    if space.where is not None:
        raise ValueError("a constraint is code, which an OpenODD file cannot contain")
    for feature, domain in space.domains.items():
        found, unit = domain.tuning, (units or {}).get(feature, "")
        if found is not None and found.choices:
            taxonomy[feature] = include[feature] = [written(each) for each in found.choices]
        elif found and isinstance(found.low, int | float) and isinstance(found.high, int | float):
            kind = "integer" if found.scale == "integer" else "float"
            measured, unit = (UNITS[unit][0], f" {unit}") if unit in UNITS else ("", "")
            taxonomy[feature] = f"{kind} {measured}".strip()
            include[feature] = f"[{found.low!r} .. {found.high!r}]{unit}"
        else:
            raise ValueError(f"feature {feature!r} is neither a range nor a choice; got {domain!r}")
    tree = {"TAXONOMY": taxonomy, "ODD": {name: {"INCLUDE_AND": include}}}
    return _domain(name, name, tree, {})


def _domain(
    name: str, where: str, tree: Mapping[str, Any], said: Mapping[str, Mapping[str, str]]
) -> OperationalDomain:
    found = list(_attributes((), tree.get("TAXONOMY") or {}, where))
    if not found:
        raise ValueError(f"{where} has no attribute; define one under TAXONOMY")
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
    sections = _section(tree, "MODULES", where) | _section(tree, "ODD", where)
    attributes = []
    for each in found:
        own = {key: value for key, value in mapped.get(each.name, {}).items() if value}
        if each.unit and own.get("unit"):
            convert(1.0, each.unit, own["unit"])
        attributes.append(replace(each, **own))
    resolve = _resolver(attributes)
    labels: dict[str, list[str]] = {}
    for key, section in sections.items():
        for word in ("LABEL", "LABELS"):
            for label in _listed(section.get(word) if isinstance(section, Mapping) else None):
                labels.setdefault(label, []).append(str(key))
    conversions = _conversions(tree.get("conversion") or {}, where)
    modules, known = {}, [*sections, *labels]
    for key, section in sections.items():
        name_of = f"module {key} of {where}"
        modules[str(key)] = _module(name_of, section, resolve, known, conversions)
    uses = {
        name: {each.module for each in module.conditions() if isinstance(each, Reference)}
        for name, module in modules.items()
    }
    for label in set().union(*uses.values()) - set(modules):
        # A label holds where any active module with it does.
        own = [Reference(each, True) for each in labels[label] if modules[each].active]
        modules[label] = Module(Group(False, tuple(own)) if own else None, None, active=False)
        uses[label] = {each.module for each in own}
    for start in modules:
        _refuse_circles(start, (), uses)
    roots = [*(tree.get("ODD") or {})] or [
        each for each in modules if not any(each in used for used in uses.values())
    ]
    active = tuple(each for each in roots if modules[each].active)
    return OperationalDomain(name, tuple(attributes), modules, active, tree)


def _module(
    where: str, section: object, resolve: Resolve, names: list[str], conversions: Conversions
) -> Module:
    if not isinstance(section, Mapping):
        raise ValueError(f"{where} must be a mapping; got {section!r}")
    words = [f"{verb}_{join}" for verb in ("INCLUDE", "EXCLUDE") for join in ("AND", "OR")]
    check_names(f"entry of {where}", section, (*OF_MODULE, *words))
    groups: dict[str, Group] = {}
    for word in words:
        if word in section:
            verb = word[:7]
            if verb in groups:
                both = f"{where} has both {verb}_AND and {verb}_OR"
                raise ValueError(f"{both}: use only one, and put a group into it")
            every, inside = word.endswith("AND"), f"{where}, {word}"
            groups[verb] = read_group(inside, section[word], every, resolve, names, conversions)
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
            groups: dict[str, tuple[str, ...]] = {}
            yield Attribute(name, "literal", _literals(value, groups), groups)
        elif isinstance(value, str) and value.split():
            kind, measured = value.split()[0], value.split()[-1]
            kind = KINDS.get(kind, kind)
            literals = ("false", "true") if kind == "boolean" else ()
            unit = measured if measured in UNITS else UNIT_OF.get(measured, "")
            yield Attribute(name, kind, literals, unit=unit)
        else:
            raise ValueError(
                f"{where}: {name} must be a list of literals, or boolean, integer or float with a "
                f'quantity, "float velocity"; got {value!r}'
            )


def _literals(values: list[Any], groups: dict[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Return literals; those below a name are a group of that name."""
    found: list[str] = []
    for value in values:
        if not isinstance(value, Mapping):
            found.append(written(value))
            continue
        for key, below in value.items():
            groups[str(key)] = _literals(below if isinstance(below, list) else [below], groups)
            found += groups[str(key)]
    return tuple(found)


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


def _conversions(section: object, where: str) -> dict[tuple[str, str], tuple[float, float]]:
    """Read `{KIND: {UNIT: {OTHER: {scale: NUMBER, offset: NUMBER}}}}`."""
    try:
        return {
            (str(unit), str(other)): (float(how.get("scale", 1)), float(how.get("offset", 0)))
            for kind in section.values()  # pyright: ignore[reportAttributeAccessIssue]
            for unit, others in kind.items()
            for other, how in others.items()
        }
    except (AttributeError, TypeError, ValueError):
        raise ValueError(
            f"conversion of {where} must be {{KIND: {{UNIT: {{OTHER: {{scale: NUMBER}}}}}}}}"
        ) from None


def _refuse_circles(name: str, above: tuple[str, ...], uses: Mapping[str, set[str]]) -> None:
    if name in above:
        raise ValueError(f"modules refer to each other in a circle: {' -> '.join([*above, name])}")
    for other in uses[name]:
        _refuse_circles(other, (*above, name), uses)


def _section(tree: Mapping[str, Any], name: str, where: object) -> dict[str, Any]:
    if not isinstance(section := tree.get(name) or {}, dict):
        raise ValueError(f"{name} of {where} must be a mapping; got {shown(section)}")
    return section


def _mapping(path: Path, files: dict[Path, None]) -> dict[str, Any]:
    if not path.exists():
        raise FileNotFoundError(f"there is no file of an operational design domain {path}")
    files[path] = None
    text = read_text(path)
    try:
        whole = read_yaml(text)
    except ValueError as error:
        raise ValueError(f"{path} is not YAML: {error}") from None
    if not isinstance(whole, dict):
        raise ValueError(f"{path} must be a mapping, TAXONOMY: ...; got {type(whole).__name__}")
    return whole


def _with_imports(
    path: Path, files: dict[Path, None], above: tuple[Path, ...] = ()
) -> dict[str, Any]:
    """Return a file of OpenODD together with those that it imports."""
    if path in above:
        raise ValueError(f"{path} imports itself")
    whole = _mapping(path, files)
    check_names(f"section of {path}", whole, SECTIONS)
    tree: dict[str, Any] = {}
    for name in _listed(whole.pop("IMPORT", None)):
        tree = _joined(tree, _with_imports(path.parent / name, files, (*above, path)))
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
