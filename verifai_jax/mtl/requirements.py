"""Files of requirements: sentences with their formulas.

    read_requirements("requirements.toml")              # tables [[requirement]]
    read_requirements("requirements.yaml")              # a list `requirements`
    read_requirements("requirements.csv")               # a row a requirement
    read_requirements("requirements.reqif")             # OMG's exchange format
    write_requirements(requirements, "requirements.csv")

Source of ReqIF: OMG, Requirements Interchange Format 1.2, formal/2016-07-01. A file with a document
type is refused unread, since its entities could read other files or expand without end.
"""

import csv
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_files import read_xml, read_yaml
from verifai_jax.core.user_code.reads import documents
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.setting import as_formula

ENDINGS = (".toml", ".yaml", ".yml", ".csv", ".reqif")
"""Endings of files of requirements."""
FIELDS: tuple[str, ...] = (
    "id",
    "formula",
    "text",
    "unit",
    "source",
    "rationale",
    "severity",
    "links",
)
"""What an entry may say; each has an `id`, and a `formula` where recordings are judged by it."""


@dataclass(frozen=True)
class Requirement:
    """A requirement with an identifier, and its formula.

    - `id`: its identifier in tables and reports.
    - `formula`: the required property; None if a problem has the formula, or it is not written yet.
    - `text`: the sentence that the formula formalises.
    - `unit`: the unit of its robustness.
    - `source`: a standard or a document, with its number.
    - `rationale`: the reason for the requirement.
    - `severity`: the severity of a violation, in the project's terms.
    - `links`: other requirements or documents from which it is derived.
    - `file`: the file from which it was read.
    """

    id: str
    formula: Formula | None = None
    text: str = ""
    unit: str = ""
    source: str = ""
    rationale: str = ""
    severity: str = ""
    links: tuple[str, ...] = ()
    file: str = field(default="", compare=False)

    @property
    def formalized(self) -> Formula:
        """The formula.

        **Raises:** `ValueError` for a requirement without one.
        """
        if self.formula is None:
            raise ValueError(f"requirement {self.id!r} has no formula: give it one in its file")
        return self.formula

    def entry(self) -> dict[str, str]:
        """Return its fields as texts; empty ones are left out."""
        formula = "" if self.formula is None else str(self.formula)
        said = {name: getattr(self, name) for name in FIELDS}
        said |= {"formula": formula, "links": " ".join(self.links)}
        return {name: value for name, value in said.items() if value}


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
    path: str | Path,
    constants: Mapping[str, float] | None = None,
    definitions: Mapping[str, str] | None = None,
    need_formulas: bool = True,
) -> tuple[Requirement, ...]:
    """Read requirements from a TOML, YAML, CSV or ReqIF file.

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
    documents.add(os.path.abspath(path))
    numbers, parts = dict(constants or {}), dict(definitions or {})
    entries: Sequence[Mapping[str, object]]
    if suffix == ".csv":
        with open(path, encoding="utf-8-sig", newline="") as file:
            entries = list(csv.DictReader(file))
    elif suffix == ".reqif":
        entries = read_reqif(path, FIELDS)
    else:
        entries, numbers, parts = _tables(path, numbers, parts)
    found = []
    for index, entry in enumerate(entries, 1):
        where = f"requirement {index} of {path}"
        fields = _fields(where, entry, need_formulas)
        links = tuple(fields.pop("links", "").replace(";", " ").replace(",", " ").split())
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
                writer = csv.DictWriter(file, FIELDS)
                writer.writeheader()
                writer.writerows(entries)
    return path


def _tables(
    path: Path, numbers: dict[str, float], parts: dict[str, str]
) -> tuple[Sequence[Mapping[str, object]], dict[str, float], dict[str, str]]:
    """Return the entries of a TOML or YAML file, and all names that their formulas may use."""
    kind = "TOML" if path.suffix.lower() == ".toml" else "YAML"
    try:
        text = path.read_text(encoding="utf-8")
        whole: object = tomllib.loads(text) if kind == "TOML" else read_yaml(text)
    except ValueError as error:
        raise ValueError(f"{path} is not {kind}: {error}") from None
    if not isinstance(whole, dict):
        raise ValueError(f"{path} must have a list `requirements`; got {type(whole).__name__}")
    listed = "requirements" if "requirements" in whole else "requirement"
    check_names(f"table of {path}", map(str, whole), (listed, "constants", "definitions"))
    entries, own, named = (
        whole.get(listed, []), whole.get("constants", {}), whole.get("definitions", {}),
    )  # fmt: skip
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        begins = "[[requirement]]" if kind == "TOML" else "- id: ..."
        raise ValueError(f"{path}: each requirement begins with a line {begins}")
    for name, value in own.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{path}: constant {name!r} must be a number; got {value!r}")
    for name, value in named.items():
        if not isinstance(value, str):
            raise ValueError(f"{path}: definition {name!r} must be a text; got {value!r}")
    return entries, {**own, **numbers}, {**named, **parts}


def _fields(where: str, entry: Mapping[str, object], need_formulas: bool) -> dict[str, str]:
    check_names(f"field of {where}", [str(name) for name in entry], FIELDS)
    fields = {str(name): value for name, value in entry.items() if value not in (None, "", [])}
    for name, value in fields.items():
        if name == "links" and isinstance(value, list):
            fields[name] = " ".join(map(str, value))
        elif name == "severity" and isinstance(value, int) and not isinstance(value, bool):
            fields[name] = str(value)
        elif not isinstance(value, str):
            raise ValueError(f"{where}: {name} must be a text; got {value!r}")
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


NAMESPACE = "http://www.omg.org/spec/ReqIF/20110401/reqif.xsd"
OTHER_NAMES = {"foreignid": "id"}
"""Names of attributes in the implementation guide of ReqIF that stand for fields of ours."""
MAX_LENGTH = 32000
"""Characters of an attribute that other tools need to keep."""


def read_reqif(path: Path, fields: Sequence[str]) -> list[dict[str, object]]:
    """Read the objects of a ReqIF file.

    **Arguments:**
    - `fields`: the fields of a requirement; other attributes are left out.
    **Returns:** a dictionary of texts for each object with at least one of the fields. An object
    without an id gets its identifier in the file. Its `links` are its own, and the targets of its
    relations.
    **Raises:** `ValueError` for a file that is not ReqIF, or declares a document type.
    """
    root = read_xml(path.read_bytes(), str(path))
    if _tag(root) != "REQ-IF":
        raise ValueError(f"{path} is not ReqIF: its first element is {_tag(root)}, not REQ-IF")
    names = {
        str(each.get("IDENTIFIER")): _field(each.get("LONG-NAME", ""))
        for each in root.iter()
        if _tag(each).startswith("ATTRIBUTE-DEFINITION-") and each.get("IDENTIFIER")
    }
    choices = {
        str(each.get("IDENTIFIER")): each.get("LONG-NAME", "")
        for each in root.iter()
        if _tag(each) == "ENUM-VALUE"
    }
    found: dict[str, dict[str, object]] = {}
    for each in _named(root, "SPEC-OBJECT"):
        values: dict[str, object] = {}
        for value in each.iter():
            if not _tag(value).startswith("ATTRIBUTE-VALUE-"):
                continue
            name = next((names.get(ref, "") for ref in _references(value, "DEFINITION")), "")
            if name in fields and (text := _text(value, choices)):
                values[name] = text
        if values:
            found[str(each.get("IDENTIFIER"))] = values
    for identifier, values in found.items():
        values.setdefault("id", identifier)
    for each in _named(root, "SPEC-RELATION"):
        ends = [next(_references(each, end), "") for end in ("SOURCE", "TARGET")]
        if ends[0] in found and ends[1] in found:
            links = str(found[ends[0]].get("links", "")).split()
            target = str(found[ends[1]]["id"])
            found[ends[0]]["links"] = " ".join(dict.fromkeys((*links, target)))
    return list(found.values())


def _tag(element: Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _named(root: Element, tag: str) -> Iterator[Element]:
    return (each for each in root.iter() if _tag(each) == tag)


def _field(name: str) -> str:
    plain = name.lower().removeprefix("reqif.").strip()
    return OTHER_NAMES.get(plain, plain)


def _references(element: Element, within: str) -> Iterator[str]:
    """Yield the identifiers that a part of an element refers to."""
    for part in _named(element, within):
        for each in part.iter():
            if _tag(each).endswith("-REF") and each.text:
                yield each.text.strip()


def _text(value: Element, choices: Mapping[str, str]) -> str:
    """Return the text of a value: plain, formatted, or chosen from a list."""
    if (plain := value.get("THE-VALUE")) is not None:
        return plain.strip()
    for each in _named(value, "THE-VALUE"):
        return " ".join("".join(each.itertext()).split())
    return ", ".join(choices.get(ref, ref) for ref in _references(value, "VALUES"))


def reqif_document(
    entries: Sequence[Mapping[str, str]], fields: Sequence[str], title: str
) -> bytes:
    """Write entries as a ReqIF document: an object for each, in one specification.

    **Arguments:**
    - `entries`: texts by field, one dictionary for each object.
    - `fields`: the possible fields of an object.
    """
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")

    def add(parent: Element, tag: str, text: str = "", **given: str) -> Element:
        named = {name.replace("_", "-"): value for name, value in given.items()}
        element = ElementTree.SubElement(parent, tag, named)
        element.text = text or None
        return element

    def known(parent: Element, tag: str, identifier: str, **more: str) -> Element:
        return add(parent, tag, IDENTIFIER=identifier, LAST_CHANGE=now, **more)

    root = Element("REQ-IF", xmlns=NAMESPACE)
    header = add(add(root, "THE-HEADER"), "REQ-IF-HEADER", IDENTIFIER="_header")
    add(header, "CREATION-TIME", now)
    for tag, text in (
        ("REQ-IF-TOOL-ID", "verifai_jax"),
        ("REQ-IF-VERSION", "1.0"),
        ("SOURCE-TOOL-ID", "verifai_jax"),
        ("TITLE", title),
    ):
        add(header, tag, text)
    content = add(add(root, "CORE-CONTENT"), "REQ-IF-CONTENT")
    known(
        add(content, "DATATYPES"), "DATATYPE-DEFINITION-STRING", "_text",
        LONG_NAME="text", MAX_LENGTH=str(MAX_LENGTH),
    )  # fmt: skip
    kinds = add(content, "SPEC-TYPES")
    kind = known(kinds, "SPEC-OBJECT-TYPE", "_requirement", LONG_NAME="requirement")
    attributes = add(kind, "SPEC-ATTRIBUTES")
    for name in fields:
        long = {"id": "ReqIF.ForeignID", "text": "ReqIF.Text"}.get(name, name)
        attribute = known(attributes, "ATTRIBUTE-DEFINITION-STRING", f"_{name}", LONG_NAME=long)
        add(add(attribute, "TYPE"), "DATATYPE-DEFINITION-STRING-REF", "_text")
    known(kinds, "SPECIFICATION-TYPE", "_document", LONG_NAME="document")
    objects = add(content, "SPEC-OBJECTS")
    specification = known(
        add(content, "SPECIFICATIONS"), "SPECIFICATION", "_specification", LONG_NAME=title
    )
    add(add(specification, "TYPE"), "SPECIFICATION-TYPE-REF", "_document")
    children = add(specification, "CHILDREN")
    for index, entry in enumerate(entries, 1):
        one = known(objects, "SPEC-OBJECT", f"_object-{index}")
        values = add(one, "VALUES")
        for name, text in entry.items():
            value = add(values, "ATTRIBUTE-VALUE-STRING", THE_VALUE=text)
            add(add(value, "DEFINITION"), "ATTRIBUTE-DEFINITION-STRING-REF", f"_{name}")
        add(add(one, "TYPE"), "SPEC-OBJECT-TYPE-REF", "_requirement")
        child = known(children, "SPEC-HIERARCHY", f"_line-{index}")
        add(add(child, "OBJECT"), "SPEC-OBJECT-REF", f"_object-{index}")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
