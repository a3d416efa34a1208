"""Requirements in ReqIF, the exchange format of requirements tools.

entries = read_reqif("requirements.reqifz", fields)         # texts by field, for each object
reqif_document(entries, fields, "requirements")             # bytes of a document

Source: OMG, Requirements Interchange Format 1.2, formal/2016-07-01. A file with a document type is
refused unread, since its entities could read other files or expand without end.
"""

import io
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from verifai_jax.core.store.foreign_archives import open_archive, read_member
from verifai_jax.core.store.foreign_files import read_bytes, read_xml

NAMESPACE = "http://www.omg.org/spec/ReqIF/20110401/reqif.xsd"
STANDARD = "reqif."
"""Beginning of the names of attributes in the implementation guide of ReqIF."""
OTHER_NAMES = {
    "foreignid": "id", "foreigndeleted": "deleted",
    "description": "text", "object text": "text", "primary text": "text",
}  # fmt: skip
"""Names of this guide, and of tools, that stand for fields of ours."""
INLINE = frozenset((
    "a", "abbr", "acronym", "b", "bdo", "big", "cite", "code", "dfn", "em", "font", "i", "ins",
    "kbd", "label", "q", "s", "samp", "small", "span", "strike", "strong", "sub", "sup", "tt", "u",
    "var",
))  # fmt: skip
"""Elements of XHTML that stand within a word; all others are apart from what is next to them."""
INVISIBLE = dict.fromkeys(map(ord, "\u00ad\u200b\u2060\ufeff"))
"""Characters that only say where a line may be broken."""
MAX_LENGTH = 32000
"""Characters of an attribute that other tools need to keep."""
MAX_BYTES = 2**28
"""Bytes that the documents of an archive may have together."""


def read_reqif(path: Path, fields: Sequence[str]) -> list[dict[str, object]]:
    """Read the objects of a ReqIF file, or of all ReqIF files in a `.reqifz` archive.

    Each object with at least one of the fields becomes a dictionary of these, in the order of the
    specifications, unless its tool marks it as deleted. An attribute without a value has the
    default of its definition, an object without an id its identifier in the file. Its `links` are
    its own, and the targets of its relations.
    **Raises:** `ValueError` for a file that is not ReqIF, declares a document type, or is empty.
    """
    elements: list[Element] = []
    for name, data in _documents(path):
        root = read_xml(data, name)
        if _tag(root) != "REQ-IF":
            raise ValueError(f"{name} is not ReqIF: its first element is {_tag(root)}, not REQ-IF")
        elements += root.iter()
    choices = {
        str(each.get("IDENTIFIER")): each.get("LONG-NAME") or str(each.get("IDENTIFIER"))
        for each in _named(elements, "ENUM-VALUE")
    }
    names: dict[str, str] = {}
    defaults: dict[str, dict[str, str]] = {}
    for kind in _named(elements, "SPEC-OBJECT-TYPE"):
        own = defaults.setdefault(str(kind.get("IDENTIFIER")), {})
        for each in kind.iter():
            if _tag(each).startswith("ATTRIBUTE-DEFINITION-") and "IDENTIFIER" in each.attrib:
                identifier = str(each.get("IDENTIFIER"))
                names[identifier] = each.get("LONG-NAME", "").strip().lower()
                for value in _values(_named(each.iter(), "DEFAULT-VALUE")):
                    own[identifier] = _text(value, choices)
    found: dict[str, dict[str, object]] = {}
    for each in _named(elements, "SPEC-OBJECT"):
        given = dict(defaults.get(next(_references(each, "TYPE"), ""), {}))
        for value in _values([each]):
            given[next(_references(value, "DEFINITION"), "")] = _text(value, choices)
        ordered = sorted(given, key=lambda ref: _rank(names.get(ref, "")))
        said = {_field(names.get(ref, "")): given[ref] for ref in ordered if given[ref]}
        values: dict[str, object] = {name: text for name, text in said.items() if name in fields}
        if values and said.get("deleted", "false").lower() not in ("true", "1"):
            found[str(each.get("IDENTIFIER"))] = values
    for identifier, values in found.items():
        values.setdefault("id", identifier)
    relations: dict[str, list[str]] = {}
    for each in _named(elements, "SPEC-RELATION"):
        ends = [next(_references(each, end), "") for end in ("SOURCE", "TARGET")]
        if ends[0] in found and ends[1] in found:
            relations.setdefault(ends[0], []).append(str(found[ends[1]]["id"]))
    for identifier, targets in relations.items():
        own = links_of(str(found[identifier].get("links", "")))
        found[identifier]["links"] = list(dict.fromkeys((*own, *targets)))
    if not found:
        known = ", ".join(sorted({repr(name) for name in names.values()})) or "none"
        raise ValueError(
            f"{path} has no requirement: of its attributes, {known}, an object must have one that "
            f"is called {', '.join(fields)}, or {STANDARD}ForeignID and {STANDARD}Text"
        )
    lines = [next(_references(each, "OBJECT"), "") for each in _named(elements, "SPEC-HIERARCHY")]
    order = [*(line for line in lines if line in found), *found]
    return [found[identifier] for identifier in dict.fromkeys(order)]


def links_of(text: str) -> tuple[str, ...]:
    """Return links that semicolons separate or, without any, commas and spaces."""
    parts = text.split(";") if ";" in text else text.replace(",", " ").split()
    return tuple(part.strip() for part in parts if part.strip())


def _documents(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the names and contents of the ReqIF files in a file."""
    data = read_bytes(path, MAX_BYTES)
    if not zipfile.is_zipfile(io.BytesIO(data)):
        if path.suffix.lower() == ".reqifz":
            raise ValueError(f"{path} is not a ZIP archive of ReqIF files: export it again")
        yield str(path), data
        return
    archive = open_archive(data, str(path), MAX_BYTES)
    inside = [name for name in archive.namelist() if name.lower().endswith(".reqif")]
    if not inside:
        raise ValueError(f"{path} contains no file .reqif")
    for name in inside:
        yield f"{name} in {path}", read_member(archive, name, str(path))


def _tag(element: Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _named(elements: Iterable[Element], tag: str) -> Iterator[Element]:
    return (each for each in elements if _tag(each) == tag)


def _values(within: Iterable[Element]) -> Iterator[Element]:
    parts = (each for element in within for each in element.iter())
    return (each for each in parts if _tag(each).startswith("ATTRIBUTE-VALUE-"))


def _field(name: str) -> str:
    plain = name.removeprefix(STANDARD)
    return OTHER_NAMES.get(plain, plain)


def _rank(name: str) -> tuple[bool, bool]:
    """Return the rank of an attribute among those for its field; the greatest one counts."""
    plain = name.removeprefix(STANDARD)
    return OTHER_NAMES.get(plain) != "text", name.startswith(STANDARD)


def _references(element: Element, within: str) -> Iterator[str]:
    """Yield the identifiers that a part of an element refers to."""
    for part in _named(element.iter(), within):
        for each in part.iter():
            if _tag(each).endswith("-REF") and each.text:
                yield each.text.strip()


def _text(value: Element, choices: Mapping[str, str]) -> str:
    """Return the text of a value: plain, formatted, or chosen from a list."""
    if (plain := value.get("THE-VALUE")) is not None:
        return plain.translate(INVISIBLE).strip()
    for content in _named(value.iter(), "THE-VALUE"):
        for each in [*content.iter()]:
            tag = _tag(each).lower()
            apart = " " if tag not in INLINE else ""
            if tag == "del":  # What it contains is not part of the text any more.
                for part in [*each.iter()]:
                    part.text, part.tail = "", part.tail if part is each else ""
            # A power is no longer number.
            each.text = f"{apart}{'^' * (tag == 'sup')}{each.text or ''}"
            each.tail = f"{apart}{each.tail or ''}"
        return " ".join("".join(content.itertext()).translate(INVISIBLE).split())
    return ", ".join(choices.get(ref, ref) for ref in _references(value, "VALUES"))


def reqif_document(
    entries: Sequence[Mapping[str, str]], fields: Sequence[str], title: str
) -> bytes:
    """Write texts by field as a ReqIF document: an object for each entry, in one specification."""
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
    for tag in ("REQ-IF-TOOL-ID", "REQ-IF-VERSION", "SOURCE-TOOL-ID"):
        add(header, tag, "1.0" if tag == "REQ-IF-VERSION" else "verifai_jax")
    add(header, "TITLE", title)
    content = add(add(root, "CORE-CONTENT"), "REQ-IF-CONTENT")
    types = add(content, "DATATYPES")
    size = str(MAX_LENGTH)
    known(types, "DATATYPE-DEFINITION-STRING", "_text", LONG_NAME="text", MAX_LENGTH=size)
    kinds = add(content, "SPEC-TYPES")
    kind = known(kinds, "SPEC-OBJECT-TYPE", "_requirement", LONG_NAME="requirement")
    attributes = add(kind, "SPEC-ATTRIBUTES")
    for name in fields:
        long = {"id": "ReqIF.ForeignID", "text": "ReqIF.Text"}.get(name, name)
        attribute = known(attributes, "ATTRIBUTE-DEFINITION-STRING", f"_{name}", LONG_NAME=long)
        add(add(attribute, "TYPE"), "DATATYPE-DEFINITION-STRING-REF", "_text")
    known(kinds, "SPECIFICATION-TYPE", "_document", LONG_NAME="document")
    objects = add(content, "SPEC-OBJECTS")
    whole = add(content, "SPECIFICATIONS")
    specification = known(whole, "SPECIFICATION", "_specification", LONG_NAME=title)
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
