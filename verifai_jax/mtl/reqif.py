"""Requirements as ReqIF, the exchange format of tools for requirements.

read_reqif(Path("requirements.reqif"), ("id", "text"))      # [{"id": "REQ-1", "text": "..."}]
reqif_document([{"id": "REQ-1"}], ("id", "text"), "title")  # bytes of a file

Source: OMG, Requirements Interchange Format 1.2, formal/2016-07-01. A file may come from anywhere:
one that declares a document type is refused before anything of it is read, and with it every entity
that could read another file or grow without end.
"""

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from verifai_jax.core.xml import read_xml

NAMESPACE = "http://www.omg.org/spec/ReqIF/20110401/reqif.xsd"
OTHER_NAMES = {"foreignid": "id"}
"""Names of attributes in the implementation guide of ReqIF that stand for fields of ours."""
MAX_LENGTH = 32000
"""Characters of an attribute that other tools need to keep."""


def read_reqif(path: Path, fields: Sequence[str]) -> list[dict[str, object]]:
    """Read the objects of a ReqIF file.

    **Arguments:**

    - `path`: the path of the file.
    - `fields`: the fields of a requirement; attributes of other names are left out.

    **Returns:** a dictionary of texts for each object that has one of the fields. An object without
    an id has its identifier in the file as one. Its `links` are those that it has, and the targets
    of its relations.

    **Raises:** `ValueError` for what is no ReqIF, or declares a document type.
    """
    root = read_xml(path.read_bytes(), str(path))
    if _tag(root) != "REQ-IF":
        raise ValueError(f"{path} is no ReqIF: its first element is {_tag(root)}, not REQ-IF")
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
    """Write entries as a ReqIF document: an object each, in one specification.

    **Arguments:**

    - `entries`: texts by field.
    - `fields`: that an object may have.
    - `title`: the title of the document.
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
