"""Files that may come from anywhere: the one way to open them, and their texts, JSON and XML.

    with open_file("drive.mcap") as file: ...       # a regular file of a bounded size
    read_json(path)                                 # ValueError of one sentence, which names it

Only regular files are opened: a pipe would wait for ever, and a device may have no end. Whatever
such a file says about sizes is checked before anything of that size is made.
"""

import codecs
import contextlib
import io
import json
import os
import stat
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from verifai_jax.core.messages.errors import require
from verifai_jax.core.messages.text import one_line

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element
MAX_BYTES = 1 << 32
"""Maximum bytes of a file that is read as a whole."""
MAX_LENGTH = 1 << 40
"""Maximum bytes of a file of which parts are read."""
MAX_DEPTH = 200
"""Maximum depth of nested elements of XML."""
MAX_NODES = 1_000_000
"""Maximum count of values of a YAML text, with each alias written out."""
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
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


class ForeignFileError(OSError, ValueError):
    """An error for a file that is not regular, too large, damaged, or in another folder."""


def open_file(
    path: str | Path, max_bytes: int = MAX_LENGTH, within: Path | None = None
) -> io.BufferedReader:
    """Open a regular file for reading bytes.

    **Arguments:**
    - `max_bytes`: maximum size in bytes.
    - `within`: a folder out of which no link may lead; None follows all links.
    **Raises:** `ForeignFileError` for anything else; `OSError` of the file system.
    """
    if within is not None:
        real, folder = os.path.realpath(path), os.path.realpath(within)
        if os.path.commonpath((real, folder)) != folder:
            raise ForeignFileError(f"{path} is a link out of {within}; give a regular file")
    try:
        number = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", os.O_RDONLY))
        mode, size = os.fstat(number).st_mode, os.fstat(number).st_size
    except OSError:
        mode = os.stat(path).st_mode  # Sockets cannot be opened, nor folders on Windows.
        if stat.S_ISREG(mode):
            raise
        number = None
    if number is not None and stat.S_ISREG(mode) and size <= max_bytes:
        return os.fdopen(number, "rb")
    if number is not None:
        os.close(number)
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "no file")
        raise ForeignFileError(f"{path} is {kind}; give a regular file")
    raise ForeignFileError(f"{path} has {size:,} bytes; at most {max_bytes:,} are read")


def read_bytes(path: str | Path, max_bytes: int = MAX_BYTES, within: Path | None = None) -> bytes:
    """Read a regular file."""
    with open_file(path, max_bytes, within) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: str | Path) -> str:
    """Read a text, see `decoded`, with ends of lines as in C; Windows-1252 gives a warning.

    **Raises:** `ValueError` for another encoding, which cannot be known; the errors of `open_file`.
    """
    text, note = decoded(path, read_bytes(path))
    if "\0" in text:
        where = f"character {text.index(chr(0)) + 1} is 0"
        raise ValueError(f"{path} is not a text ({where}): save it as UTF-8")
    if note:
        warnings.warn(note, stacklevel=3)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def decoded(path: str | Path, data: bytes, cut: bool = False) -> tuple[str, str]:
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


def read_xml(data: bytes, name: str) -> "Element":
    """Read XML from an untrusted source.

    **Raises:** `ValueError` for a text that is not XML, and a document type, which can declare
    entities.
    """
    from xml.etree import ElementTree
    from xml.parsers import expat

    def refuse(*declared: object) -> None:
        raise ValueError(
            f"{name} declares a document type, <!DOCTYPE {declared[0]}>, which is refused: "
            "entities in it could read other files; remove the declaration"
        )

    depth = 0

    def step(by: int) -> None:
        nonlocal depth
        depth += by
        if depth > MAX_DEPTH:
            raise ValueError(f"its elements are nested deeper than {MAX_DEPTH}")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = lambda *_: step(1)
    parser.EndElementHandler = lambda *_: step(-1)
    try:
        parser.Parse(data, True)
        return ElementTree.fromstring(data)
    except (expat.ExpatError, ElementTree.ParseError, ValueError, LookupError) as error:
        raise ValueError(f"{name} is not XML: {error}") from None


def read_json(path: str | Path, max_bytes: int = MAX_BYTES, within: Path | None = None) -> Any:
    """Read JSON.

    **Raises:** `ValueError` for anything else; the errors of `open_file`.
    """
    data = read_bytes(path, max_bytes, within)
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read as JSON ({one_line(str(error))})") from error


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML.

    **Raises:** `ValueError` for anything else, and for tables that are nested too deeply.
    """
    import tomllib

    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its values are nested too deeply") from None


def read_yaml(text: str) -> object:
    """Read YAML without Python tags.

    **Raises:** `ValueError` for anything else; `MissingExtra` without PyYAML.
    """
    yaml = require("yaml", "yaml")
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        check_shared(node, _yaml_parts, MAX_NODES, "its aliases stand for")
        return None if node is None else loader.construct_document(node)
    except RecursionError:
        raise ValueError("its values are nested too deeply") from None
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(" ".join(str(error).split())) from None


def _yaml_parts(node: Any) -> list[Any]:
    inner = node.value if isinstance(getattr(node, "value", None), list) else []
    return [each for part in inner for each in (part if isinstance(part, tuple) else (part,))]


def check_shared(
    root: Any, parts: Callable[[Any], Iterable[Any]], max_count: int, what: str,
    cycles: bool = False,
) -> None:  # fmt: skip
    """Refuse a value that has too many values when each that it shares is written out.

    **Arguments:**
    - `parts`: a function that returns the values directly below one; they must outlive the call.
    - `what`: the beginning of the error.
    - `cycles`: whether a value may contain itself, and then counts once.
    **Raises:** `ForeignFileError`.
    """
    known: dict[int, int] = {}

    def count(value: Any) -> int:
        if id(value) not in known:
            known[id(value)] = 0 if cycles else max_count
            known[id(value)] = total = 1 + sum(map(count, parts(value)))
            if total > max_count:
                raise ForeignFileError(f"{what} more than {max_count:,} values")
        return known[id(value)]

    count(root)


def write_yaml(value: object) -> str:
    """Return a YAML text that `read_yaml` can read."""
    return require("yaml", "yaml").safe_dump(value, sort_keys=False, allow_unicode=True)
