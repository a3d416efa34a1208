"""XML of files that may come from anywhere."""

from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat


def read_xml(data: bytes, name: str) -> Element:
    """Read XML that may come from anywhere.

    **Raises:** `ValueError` for a document type, with which entities are declared, and for what is
    no XML.
    """

    def refuse(*declared: object) -> None:
        raise ValueError(
            f"{name} declares a document type, <!DOCTYPE {declared[0]}>, which is refused: "
            "entities in it could read other files; remove the declaration"
        )

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data, True)
        return ElementTree.fromstring(data)
    except (expat.ExpatError, ElementTree.ParseError) as error:
        raise ValueError(f"{name} is no XML: {error}") from None
