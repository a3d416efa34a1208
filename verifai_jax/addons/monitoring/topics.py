"""Bags of messages: topics as tables, the files of one bag, and MCAP.

Each topic has a clock of its own, and fields of its messages become columns: `/odom` and
`twist.linear.x` become `odom.twist.linear.x`. What cannot be decoded is left out, with a note.
"""

import itertools
import json
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from verifai_jax.addons.monitoring.containers import EXTRA, Table, table_of
from verifai_jax.addons.monitoring.readers import Asked, named_errors
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.messages.errors import MissingExtra, require
from verifai_jax.core.messages.text import counted, format_error, one_line
from verifai_jax.core.store.foreign_files import open_file

Decoder: TypeAlias = Callable[[bytes], Any]
MAX_ENTRIES = 64
"""Numbers of a list in a message that is a vector signal, and characters of a word; longer ones are
images and clouds."""
STAMPS = ("header.stamp", "stamp", "timestamp")
"""Fields of a message that say when it was measured."""
SECONDS = ("sec", "secs", "seconds")
NANOSECONDS = ("nanosec", "nsec", "nsecs", "nanos", "nanoseconds")
BAG = re.compile(r"(.*?)(?:_\d{4}(?:-\d\d){5})?_(\d+)$")
"""The name of one of several files of a bag, in ROS 1 with the time when it was begun."""
BAGS = (".mcap", ".db3", ".bag")


class Sent(NamedTuple):
    """A message: its topic, when it was logged (in ns since 1970), and how to decode it."""

    topic: str
    logged: int
    decode: Callable[[], Any]


def bag_files(folder: Path) -> list[Path]:
    """Return the files of a folder that is one bag: those that ROS 2's `metadata.yaml` names.

    Without it, `NAME_0.mcap`, `NAME_1.mcap` and so on are one if their folder is called `NAME`, or
    if each begins within a second after the one before ends.
    """
    named = [
        (found[1], int(found[2]), file) for ending in BAGS for file in folder.glob(f"*{ending}")
        if (found := BAG.match(file.stem))
    ]  # fmt: skip
    if len({(stem, file.suffix) for stem, _, file in named}) != 1:
        alone = [file for ending in BAGS for file in folder.glob(f"*{ending}")]
        return alone if (folder / "metadata.yaml").is_file() and len(alone) == 1 else []
    files = [file for *_, file in sorted(named, key=operator.itemgetter(1))]
    whole = (folder / "metadata.yaml").is_file() or named[0][0] == folder.resolve().name
    return files if whole or _follow_each_other(files) else []


def _follow_each_other(files: Sequence[Path]) -> bool:
    spans = []
    for each in files:
        try:
            if each.suffix == ".mcap":
                with open_file(each) as file:
                    summary = require("mcap.reader", EXTRA).make_reader(file).get_summary()
                about = summary.statistics
                spans.append((about.message_start_time, about.message_end_time))
            else:
                spans.append(_ros_bags("span_of")(each))
        except MissingExtra:
            raise
        except Exception:
            return False  # A damaged file, or one without a summary.
    return all(0 <= b[0] - a[1] <= 10**9 for a, b in itertools.pairwise(spans))


def _ros_bags(name: str) -> Any:
    return lazy_import("verifai_jax.addons.monitoring.ros_bags", name)


def read_bag_files(files: Sequence[Path], asked: Asked) -> list[Table]:
    """Read the files of one bag."""
    messages = _mcap_messages if files[0].suffix == ".mcap" else _ros_bags("messages_of")
    sent = itertools.chain.from_iterable(messages(file, asked.notes) for file in files)
    return named_errors(files[0], tables_of_messages, files[0], sent, asked)


def read_mcap(path: Path, asked: Asked) -> list[Table]:
    """Read an MCAP file: JSON, ROS 2 and Protobuf messages; other topics are left out."""
    return read_bag_files([path], asked)


def _mcap_messages(path: Path, notes: dict[str, int]) -> Iterator[Sent]:
    decoders: dict[int, Decoder] = {}
    for schema, channel, message in _mcap_records(path, notes):
        encoding = channel.message_encoding
        if encoding != "json" and encoding not in PACKAGES:
            notes[f"topic {channel.topic} is left out: its messages are {encoding!r}"] = 1
            continue

        def decode(schema: Any = schema, channel: Any = channel, data: bytes = message.data) -> Any:
            if channel.message_encoding == "json":
                return json.loads(data)
            if channel.id not in decoders:
                factory = require(PACKAGES[channel.message_encoding], EXTRA).DecoderFactory()
                decoders[channel.id] = factory.decoder_for(channel.message_encoding, schema)
            return decoders[channel.id](data)

        yield Sent(channel.topic, message.log_time, decode)


PACKAGES = {"cdr": "mcap_ros2.decoder", "protobuf": "mcap_protobuf.decoder"}


def _mcap_records(path: Path, notes: dict[str, int]) -> Iterator[tuple[Any, Any, Any]]:
    """Yield the messages of an MCAP file; of one that is damaged, those before the damage."""
    require("mcap", EXTRA)
    reader, count = require("mcap.reader", EXTRA), 0
    try:
        with open_file(path) as file:
            for each in reader.make_reader(file).iter_messages():
                count += 1
                yield each
        return
    except Exception as error:  # Those of decompression are no McapError.
        if count:
            raise ValueError(f"{path} cannot be read: {one_line(str(error))}") from None
        damage = error
    try:
        with open_file(path) as file:
            for each in reader.NonSeekingReader(file).iter_messages(log_time_order=False):
                count += 1
                yield each
    except Exception as error:
        damage = error
    if not count:
        raise ValueError(f"{path} cannot be read: {one_line(format_error(damage))}")
    notes[f"{path} is damaged or was cut: only its first {count} messages are read"] = 1


def tables_of_messages(path: Path, messages: Iterable[Sent], asked: Asked) -> list[Table]:
    """Return the topics of messages, each with the times of the log or of the headers.

    **Raises:** `MissingExtra`; `ValueError` for no topic whose messages can be decoded.
    """
    import pyarrow

    topics: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    faults: dict[str, list[Exception]] = {}
    for sent in messages:
        topic = sent.topic.strip("/").replace("/", ".")
        row: dict[str, Any] = {}
        # Decoders of other packages raise what they like, and one topic is not the others.
        try:
            flatten(topic, sent.decode(), row)
        except MissingExtra:
            raise
        except Exception as error:
            faults.setdefault(sent.topic, []).append(error)
            continue
        topics.setdefault(topic, []).append((sent.logged, row))
    for topic, errors in faults.items():
        said, why = counted(len(errors), "message"), f"{type(errors[0]).__name__}: {errors[0]}"
        note = f"{said} of topic {topic} cannot be decoded, and left out: {one_line(why)}"
        asked.notes[note] = len(errors)
    if not topics:
        said = "".join(f"; {note}" for note in asked.notes)
        raise ValueError(f"{path} has no topic of messages that can be decoded{said}")
    tables = []
    for topic, rows in topics.items():
        if asked.stamps == "header":
            rows = _by_header(topic, rows, asked.notes)
        rows.sort(key=operator.itemgetter(0))
        columns = columns_of([row for _, row in rows])
        stamps = pyarrow.array([at for at, _ in rows], pyarrow.timestamp("ns"))
        tables.append(table_of({asked.time: stamps, **columns}))
    return tables


def columns_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the columns of rows that `flatten` has made."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: _cells([row.get(name) for row in rows]) for name in names}


def _by_header(
    topic: str, rows: list[tuple[int, dict[str, Any]]], notes: dict[str, int]
) -> list[tuple[int, dict[str, Any]]]:
    """Return the rows of a topic with the times of their headers, if all have one."""
    stamps = [_header_stamp(topic, row) for _, row in rows]
    if all(stamps):
        return [(at, row) for at, (_, row) in zip(stamps, rows, strict=True)]
    notes[f"messages of topic {topic} have no stamps of their own: the log's times count"] = 1
    return rows


def _header_stamp(topic: str, row: Mapping[str, Any]) -> int:
    """Return when a message was measured, in ns since 1970; 0 for one that does not say it."""
    for stamp in STAMPS:
        parts = [
            next((row[n] for each in names if (n := f"{topic}.{stamp}.{each}") in row), None)
            for names in (SECONDS, NANOSECONDS)
        ]
        if parts[0] is not None:
            return int(parts[0]) * 10**9 + int(parts[1] or 0)
    return 0


def flatten(prefix: str, value: Any, row: dict[str, Any]) -> None:
    """Put the numbers and words of a message, and its short lists of numbers, into a row."""
    if isinstance(value, np.ndarray):
        value = value.tolist() if value.size <= MAX_ENTRIES else None
    if isinstance(value, bool | int | float):
        row[prefix] = value
    elif isinstance(value, str):
        if len(value) <= MAX_ENTRIES and not prefix.endswith("frame_id"):
            row[prefix] = value
    elif isinstance(value, bytes | None):
        return
    elif isinstance(value, Mapping):
        for name, part in value.items():
            flatten(f"{prefix}.{name}" if prefix else str(name), part, row)
    elif hasattr(value, "DESCRIPTOR"):
        for part in value.DESCRIPTOR.fields:
            own = getattr(value, part.name)
            known = part.enum_type.values_by_number if part.enum_type is not None else {}
            own = known[own].name if isinstance(own, int) and own in known else own
            flatten(f"{prefix}.{part.name}", own, row)
    elif hasattr(value, "__len__"):
        entries = list(value) if len(value) <= MAX_ENTRIES else []
        if entries and all(isinstance(entry, bool | int | float) for entry in entries):
            row[prefix] = entries
    else:
        for name in getattr(value, "__slots__", vars(value)):
            flatten(f"{prefix}.{name}", getattr(value, name), row)


def _cells(cells: list[Any]) -> Any:
    """Return cells of one kind unchanged, and others as texts, which do not become a signal."""
    import pyarrow

    try:
        return pyarrow.array(cells)
    except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError, OverflowError):
        return pyarrow.array([None if cell is None else str(cell) for cell in cells])
