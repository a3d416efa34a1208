"""Bags of ROS 1, and of ROS 2 in SQLite, by the package `rosbags`.

The package makes Python code of the definitions of messages in a bag and runs it. So names of types
and fields are checked first: they are the only texts of a file that get into that code.
"""

import bz2
import functools
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from verifai_jax.addons.monitoring.containers import EXTRA, Table
from verifai_jax.addons.monitoring.readers import Asked
from verifai_jax.addons.monitoring.topics import Sent, read_bag_files
from verifai_jax.core.messages.errors import require
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.foreign_files import open_file

PLAIN = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", re.ASCII)
"""Names that are nothing but names in Python code."""
MAX_CHUNK = 1 << 28
"""Maximum bytes of a message, and of an unpacked chunk of a bag."""


def read_bag(path: Path, asked: Asked) -> list[Table]:
    """Read the topics of a bag in one file, each with its own clock."""
    return read_bag_files([path], asked)


def span_of(path: Path) -> tuple[int, int]:
    """Return the times of the first and the last message of a bag in ns since 1970."""
    with _opened(path) as reader:
        return reader.start_time, reader.end_time - 1


def messages_of(path: Path, notes: dict[str, int]) -> Iterator[Sent]:
    """Yield the messages of a bag; of one that is damaged, those before the damage."""
    count, decoders = 0, dict[int, Callable[[bytes], Any]]()
    reader = _opened(path)
    try:
        with reader:
            storage = getattr(reader, "storage", None)
            if storage is not None:  # A database may compute values that it does not hold.
                storage.dbconn.limit(require("apsw", EXTRA).SQLITE_LIMIT_LENGTH, MAX_CHUNK)
            for link, stamp, data in reader.messages(reader.connections):

                def decode(link: Any = link, data: bytes = data) -> Any:
                    if link.id not in decoders:
                        decoders[link.id] = _decoder(link, storage is None)
                    return decoders[link.id](data)

                count += 1
                yield Sent(link.topic, stamp, decode)
    except Exception as error:  # The package raises what it likes.
        why = one_line(str(error) or type(error).__name__)
        if not count:
            raise ValueError(f"{path} cannot be read: {why}") from None
        notes[f"{path} is damaged ({why}): only its first {count} messages are read"] = 1


def _opened(path: Path) -> Any:
    """Return a reader of a bag."""
    with open_file(path) as file:
        head = file.read(16)
    if path.suffix.lower() == ".bag":
        return _bounded_reader()(path)
    if not head.startswith(b"SQLite format 3\0"):
        raise ValueError(f"{path} cannot be read: a bag of ROS 2 (.db3) is a database of SQLite")
    return require("rosbags.rosbag2", EXTRA).Reader(path)


@functools.cache
def _bounded_reader() -> Any:
    """Return the reader of bags of ROS 1, which unpacks no chunk beyond the greatest size."""
    module = require("rosbags.rosbag1.reader", EXTRA)
    kinds = {unpack: kind for kind, unpack in module.decompressors.items()}

    class Bounded(module.Reader):
        def read_chunk(self) -> Any:
            chunk = super().read_chunk()
            unpack = functools.partial(_unpacked, kinds[chunk.decompressor])
            return chunk._replace(decompressor=unpack)

    return Bounded


def _unpacked(kind: str, data: bytes) -> bytes:
    if kind == "none":
        return data
    lz4 = kind == "lz4"
    unpacking: Any = (
        require("lz4.frame", EXTRA).LZ4FrameDecompressor if lz4 else bz2.BZ2Decompressor
    )
    unpacking = unpacking()
    whole = unpacking.decompress(data, MAX_CHUNK)
    if not unpacking.eof:
        raise ValueError(f"a chunk is cut, or unpacks to more than {MAX_CHUNK:,} bytes")
    return whole


def _decoder(link: Any, ros1: bool) -> Callable[[bytes], Any]:
    """Return the function that decodes the messages of a topic."""
    typesys, interfaces = require("rosbags.typesys", EXTRA), require("rosbags.interfaces", EXTRA)
    name, form = link.msgtype, interfaces.MessageDefinitionFormat
    if link.msgdef.format == form.NONE:  # Bags older than ROS 2 Iron have no definitions.
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        if name not in store.fielddefs:
            raise ValueError(f"the bag does not define {name}, which is none of ROS 2's own types")
    elif link.msgdef.format == form.MSG:
        _check_name(name)
        types = typesys.get_types_from_msg(link.msgdef.data, name)
        _check_types(types, interfaces.Nodetype)
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        store.register(types)
    else:
        raise ValueError(f"{name} is defined in IDL, which is not read")
    decode = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    return functools.partial(decode, typename=name)


def _check_types(types: Mapping[str, tuple[Any, Any]], node: Any) -> None:
    """Refuse definitions that are no names and types alone, and arrays of nothing."""

    def is_empty(kind: Any) -> bool:
        if kind[0] != node.NAME:
            return False
        fields = types.get(kind[1], ((), [("", (node.BASE, ("", 0)))]))[1]
        return all(is_empty(field) for _, field in fields)

    for name, (constants, fields) in types.items():
        for each in (name, *(c[0] for c in constants), *(c[1] for c in constants)):
            _check_name(each)
        for field, kind in fields:
            _check_name(field)
            inner = kind[1][0] if kind[0] in (node.ARRAY, node.SEQUENCE) else kind
            _check_name(inner[1] if inner[0] == node.NAME else inner[1][0])
            if inner is not kind and is_empty(inner):
                raise ValueError(f"{name} has an array {field} of messages without a field")


def _check_name(name: object) -> None:
    if not (isinstance(name, str) and PLAIN.fullmatch(name)):
        raise ValueError(f"{name!r} is no name of a type or a field")
