"""Texts, XML and YAML of files that may come from anywhere."""

import codecs
import contextlib
import warnings
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from verifai_jax.core.messages.errors import require

MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
    (b"", "utf-8-sig"),
)
"""Bytes that a text begins with, and the encoding that they say; that of UTF-32 comes first, since
it begins as that of UTF-16 does."""


UNMARKED = "utf-8-sig"
CUT = ("unexpected end of data", "truncated data")
"""What is said of a text whose last character is not whole."""


def read_text(path: Path) -> str:
    """Read a text, see `decoded`, with ends of lines as in C; Windows-1252 gives a warning.

    **Raises:** `ValueError` for another encoding, which cannot be known.
    """
    text, note = decoded(path, path.read_bytes())
    if "\0" in text:
        where = f"character {text.index(chr(0)) + 1} is 0"
        raise ValueError(f"{path} is not a text ({where}): save it as UTF-8")
    if note:
        warnings.warn(note, stacklevel=3)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def decoded(path: Path, data: bytes, cut: bool = False) -> tuple[str, str]:
    """Decode the content of a file: as its mark or its zeros say, as UTF-8, or Windows-1252.

    **Arguments:**
    - `cut`: whether the last character may be cut, as by a loss of power.
    **Returns:** the text, and a note for Windows-1252, which nothing in a file says.
    **Raises:** `ValueError` for another encoding.
    """
    encoding = next(name for mark, name in MARKS if data.startswith(mark))
    if encoding == UNMARKED and data[:2].count(0) == 1:
        encoding = "utf-16-be" if data[0] == 0 else "utf-16-le"
    try:
        return data.decode(encoding), ""
    except UnicodeDecodeError as error:
        if cut and error.reason in CUT:
            return data.decode(encoding, "replace"), ""
        where = f"byte {error.start + 1} is 0x{data[error.start]:02x}"
    with contextlib.suppress(UnicodeDecodeError):
        if encoding == UNMARKED:
            return data.decode("cp1252"), f"{path} is not UTF-8, and is read as Windows-1252"
    raise ValueError(
        f"{path} is not a text in {encoding.removesuffix('-sig').upper()} ({where}): save it as "
        "UTF-8, in Excel as CSV UTF-8"
    )


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
    except (expat.ExpatError, ElementTree.ParseError, ValueError, LookupError) as error:
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
