"""XML and YAML of files that may come from anywhere."""

from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from verifai_jax.core.messages.errors import require


def read_xml(data: bytes, name: str) -> Element:
    """Read XML from an untrusted source.

    **Raises:** `ValueError` for a text that is not XML, and a document type, which can declare
    entities.
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
        raise ValueError(f"{name} is not XML: {error}") from None


def read_yaml(text: str) -> object:
    """Read YAML without Python tags.

    **Raises:** `ValueError` for anything else; `MissingExtra` without PyYAML.
    """
    yaml = require("yaml", "yaml")
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from None


def write_yaml(value: object) -> str:
    """Return a YAML text that `read_yaml` can read."""
    return require("yaml", "yaml").safe_dump(value, sort_keys=False, allow_unicode=True)
