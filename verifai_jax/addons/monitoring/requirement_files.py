"""Files of requirements: sentences with their formulas.

read_requirements("requirements.toml")              # tables [[requirement]]
read_requirements("requirements.yaml")              # a list `requirements`
read_requirements("requirements.csv")               # a row a requirement; also ; and tabs
read_requirements("requirements.reqif")             # OMG's exchange format
write_requirements(requirements, "requirements.csv")
"""

import csv
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from itertools import zip_longest
from pathlib import Path
from reprlib import repr as shown

from verifai_jax.addons.monitoring.reqif import links_of, read_reqif, reqif_document
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_files import parse_toml, read_text, read_yaml
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.requirements import FIELDS, Requirement
from verifai_jax.mtl.setting import as_formula

ENDINGS = (".toml", ".yaml", ".yml", ".csv", ".reqif", ".reqifz")
"""Endings of files of requirements."""
Requirements = Formula | str | Mapping[str, Formula | str] | Iterable[Formula | str | Requirement]
"""Formulas, by identifier or in a sequence, or one alone."""


def requirements_of(formulas: Requirements) -> tuple[Requirement, ...]:
    """Return formulas as requirements; those without an identifier become `R1`, `R2`, ...

    **Raises:** `ValueError` for no formulas, a duplicate identifier, and a text that is not a
    formula.
    """
    if isinstance(formulas, Formula | str):
        formulas = [formulas]
    if isinstance(formulas, Mapping):
        formulas = [Requirement(str(name), as_formula(f)) for name, f in formulas.items()]
    found = [
        each if isinstance(each, Requirement) else Requirement(f"R{index}", as_formula(each))
        for index, each in enumerate(formulas, 1)
    ]
    return _checked("the requirements", found)


def read_requirements(
    path: str | Path, constants: Mapping[str, float] | None = None,
    definitions: Mapping[str, str] | None = None, need_formulas: bool = True,
) -> tuple[Requirement, ...]:  # fmt: skip
    """Read requirements from a TOML, YAML, CSV or ReqIF file, or an archive `.reqifz` of these.

    A TOML file has a table `[[requirement]]` for each, and may have tables `[constants]` and
    `[definitions]` of names that the formulas use; a YAML file has the same as a list
    `requirements` and two mappings. A CSV file has a row for each, below the column names. A
    requirement has `id` and `formula`, and may have `text`, `unit`, `source`, `rationale`,
    `severity` and `links`. Attributes of a ReqIF file are recognised by their long names, such as
    `ReqIF.ForeignID` (the id) and `ReqIF.Text`; others are ignored.

    **Arguments:**
    - `constants`, `definitions`: further names, which come before those of the file.
    - `need_formulas`: whether to refuse an entry without a formula.
    **Raises:** `FileNotFoundError`; `ValueError` that names an invalid entry, and for XML with a
    document type or entities, which is refused unread.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file of requirements {path}")
    suffix = path.suffix.lower()
    if suffix not in ENDINGS:
        raise ValueError(
            f"a file of requirements ends with {', '.join(ENDINGS)}; got {path.name}: write each "
            'as a table of TOML, [[requirement]] with id = "..." and formula = "..."'
        )
    numbers, parts = dict(constants or {}), dict(definitions or {})
    entries: Sequence[Mapping[str, object]]
    if suffix == ".csv":
        entries = _rows(path)
    elif suffix in (".reqif", ".reqifz"):
        entries = read_reqif(path, FIELDS)
    else:
        entries, numbers, parts = _tables(path, numbers, parts)
    found = []
    for index, entry in enumerate(entries, 1):
        where = f"requirement {index} of {path}"
        fields = _fields(where, entry, need_formulas)
        links = links_of(fields.pop("links", ""))
        try:
            text = fields.pop("formula", None)
            formula = None if text is None else parse(text, numbers, parts)
        except ValueError as error:
            raise ValueError(f"{where}, {fields['id']!r}: {error}") from None
        found.append(Requirement(formula=formula, links=links, file=str(path), **fields))
    return _checked(str(path), found)


def write_requirements(requirements: Iterable[Requirement], path: str | Path) -> Path:
    """Write requirements to a CSV or a ReqIF file, which `read_requirements` reads again.

    **Returns:** the path.
    **Raises:** `ValueError` for another file ending, and content that `read_requirements` would
    refuse.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".reqif"):
        raise ValueError(f"requirements are written to a .csv or a .reqif file; got {path.name}")
    entries = [each.entry() for each in _checked("the sequence", tuple(requirements))]
    with replacing(path) as partial:
        if suffix == ".reqif":
            partial.write_bytes(reqif_document(entries, FIELDS, path.stem))
        else:
            with open(partial, "w", encoding="utf-8", newline="") as file:
                writer = csv.DictWriter(file, [*map(str, FIELDS)])
                writer.writeheader()
                writer.writerows(entries)
    return path


def _rows(path: Path) -> list[dict[str, object]]:
    """Return the entries of a CSV file, separated by commas, semicolons or tabs."""
    lines = StringIO(read_text(path)).readlines()
    # Excel may say its separator first.
    says = bool(lines) and lines[0].lower().startswith("sep=")
    named = lines.pop(0)[4:].rstrip("\n") if says else ""
    head = lines[0] if lines else ""
    try:
        separator = named or max((",", ";", "\t"), key=head.count)
        table = [row for row in csv.reader(lines, delimiter=separator, strict=True) if any(row)]
    except (csv.Error, TypeError) as error:
        raise ValueError(f"{path} is not CSV: {error}") from None
    names = [name.strip() for name in table[0]] if table else []
    for name in filter(None, names):
        if names.count(name) > 1:
            raise ValueError(f"{path} has more than one column {name!r}")
    for number, row in enumerate(table[1:], 1):
        if over := [cell for cell, name in zip_longest(row, names) if cell and not name]:
            raise ValueError(
                f"requirement {number} of {path} has the cell {shown(over[0])} below no name: "
                f"quote a text that contains {separator!r}"
            )
    return [dict(zip(names, row, strict=False)) for row in table[1:]]


def _tables(
    path: Path, numbers: dict[str, float], parts: dict[str, str]
) -> tuple[Sequence[Mapping[str, object]], dict[str, float], dict[str, str]]:
    """Return the entries of a TOML or YAML file, and all names that their formulas may use."""
    kind = "TOML" if path.suffix.lower() == ".toml" else "YAML"
    text = read_text(path)
    try:
        whole: object = (parse_toml if kind == "TOML" else read_yaml)(text)
    except ValueError as error:
        raise ValueError(f"{path} is not {kind}: {error}") from None
    if not isinstance(whole, dict):
        raise ValueError(f"{path} must have a list `requirements`; got {type(whole).__name__}")
    listed = "requirements" if "requirements" in whole else "requirement"
    check_names(f"table of {path}", map(str, whole), (listed, "constants", "definitions"))
    entries = whole.get(listed) or []
    own, named = (whole.get(name) or {} for name in ("constants", "definitions"))
    for name, table in (("constants", own), ("definitions", named)):
        if not isinstance(table, dict):
            raise ValueError(f"{path}: {name} must be a table of names; got {shown(table)}")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        begins = "[[requirement]]" if kind == "TOML" else "- id: ..."
        raise ValueError(f"{path}: each requirement begins with a line {begins}")
    for name, value in own.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{path}: constant {name!r} must be a number; got {shown(value)}")
    for name, value in named.items():
        if not isinstance(value, str):
            raise ValueError(f"{path}: definition {name!r} must be a text; got {shown(value)}")
    return entries, {**own, **numbers}, {**named, **parts}


def _fields(where: str, entry: Mapping[str, object], need_formulas: bool) -> dict[str, str]:
    check_names(f"field of {where}", [str(name) for name in entry], FIELDS)
    fields = {str(name): value for name, value in entry.items() if value not in (None, "", [])}
    for name, value in fields.items():
        if name == "links" and isinstance(value, list):
            fields[name] = "".join(f"{link}; " for link in value)
        elif name == "severity" and isinstance(value, int) and not isinstance(value, bool):
            fields[name] = str(value)
        elif not isinstance(value, str):
            raise ValueError(f"{where}: {name} must be a text; got {shown(value)}")
    for name in FIELDS[: 1 + need_formulas]:
        if name not in fields:
            needed = "an id and a formula" if need_formulas else "an id"
            raise ValueError(f"{where} has no {name}: it needs {needed}")
    return {name: str(value).strip() for name, value in fields.items()}


def _checked(source: str, found: Sequence[Requirement]) -> tuple[Requirement, ...]:
    if not found:
        raise ValueError(f"{source} has no requirement")
    names = [each.id for each in found]
    if repeated := next((name for name in names if names.count(name) > 1), None):
        raise ValueError(f"{source} has more than one requirement {repeated!r}")
    return tuple(found)
