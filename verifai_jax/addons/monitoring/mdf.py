"""MDF, the recordings of cars, by the package `asammdf`; frames of a CAN bus by a DBC file.

A channel with a table of texts has its words (`Gear == "DRIVE"`) and, where it has no text, its
number. No formula of a file is evaluated unless it is plain arithmetic, since the package would
hand it to Python's interpreter.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from verifai_jax.addons.monitoring.columns import LeftOut
from verifai_jax.addons.monitoring.containers import EXTRA, Table, table_of_arrays
from verifai_jax.addons.monitoring.enumerations import word_columns
from verifai_jax.addons.monitoring.flat_files import read_feather
from verifai_jax.addons.monitoring.readers import Asked
from verifai_jax.core.messages.errors import MissingExtra, require
from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.core.store.foreign_archives import check_values
from verifai_jax.core.store.foreign_files import (
    MAX_BYTES,
    decoded,
    open_file,
    read_bytes,
    read_json,
)

FRAMES = "CAN_DataFrame"
"""The channel of the frames of a CAN bus."""
PLAIN = re.compile(
    r"(?:X1?\b|\d+(?:\.\d*)?(?:[eE][-+]?\d{1,3})?|[-+/() ]|\*(?!\*)|sqrt|sin|cos|tan|exp|log)+"
)
"""Formulas that are plain arithmetic; a power of powers would never end."""
LINEAR, FORMULA, TEXTS, RANGES = (0, 1, 2, 4, 5, 6), 3, (7, 8), 8
"""Conversions of MDF 4: by numbers alone, by a formula, and by a table of texts."""
MAX_MEMORY = 8 << 30
"""Maximum bytes of memory of the process that reads, beside eight times the size of the file."""
Unread = (ValueError, TypeError, KeyError, IndexError, ArithmeticError, AttributeError, OSError)


class Channel(NamedTuple):
    """A channel of a group: its samples, their times, and what they mean."""

    group: str
    name: str
    samples: np.ndarray
    times: np.ndarray
    unit: str
    conversion: Any


def read_mdf(path: Path, asked: Asked) -> list[Table]:
    """Read the channels of an MDF file, each group with its own clock.

    The package reads in a process of its own, since a damaged file may make its C code crash.
    """
    with open_file(path, MAX_BYTES) as file:
        head = file.read(168)
    if not head.startswith((b"MDF ", b"UnFinMF ")) or head[64:68] != b"##HD" or len(head) < 168:
        raise ValueError(f"{path} is no file of MDF 4, or is cut")
    paths = os.pathsep.join(each or os.getcwd() for each in sys.path)
    command = [sys.executable, "-P", "-c", f"from {__name__} import main; main()", str(path)]
    with tempfile.TemporaryDirectory(prefix="vj-mdf-") as made:
        command += [made, asked.time, *map(str, asked.databases)]
        environment = {**os.environ, "PYTHONPATH": paths}
        done = subprocess.run(command, capture_output=True, env=environment, check=False)
        about = Path(made, "about.json")
        if not about.is_file():
            said = one_line(done.stderr.decode("utf-8", "replace")[-300:])
            raise ValueError(f"{path} is damaged, its reader died ({done.returncode}): {said}")
        result = read_json(about)
        if result["missing"]:
            require("asammdf", EXTRA)
        if result["error"]:
            raise ValueError(result["error"])
        for text, column in result["notes"]:
            asked.notes[text if column is None else LeftOut(text, column)] = 1
        files = [Path(made, f"{index}.feather") for index in range(result["tables"])]
        return [table for file in files for table in read_feather(file, asked)]


def main() -> None:
    """Read a file in this process: its path, a folder for the tables, the name of times, DBCs."""
    from pyarrow import feather

    path, made, time, *databases = sys.argv[1:]
    asked = Asked(time, databases=tuple(map(Path, databases)))
    result: dict[str, Any] = {"error": "", "missing": False, "tables": 0}
    if os.name == "posix":
        import resource

        limit = MAX_MEMORY + 8 * os.path.getsize(path)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    try:
        for table in _tables(Path(path), asked):
            feather.write_feather(table, Path(made, f"{result['tables']}.feather"), "uncompressed")
            result["tables"] += 1
    except MissingExtra:
        result["missing"] = True
    except BaseException as error:  # The package raises what it likes.
        result["error"] = str(error) if path in str(error) else f"{path} cannot be read: {error!r}"
    result["notes"] = [(note, getattr(note, "column", None)) for note in asked.notes]
    Path(made, "about.json").write_text(json.dumps(result), encoding="utf-8")


def _tables(path: Path, asked: Asked) -> list[Table]:
    asammdf, channels = require("asammdf", EXTRA), list[Channel]()
    opened = asammdf.MDF(path)
    busy = any(each.name == FRAMES for group in opened.groups for each in group.channels)
    channels += _channels(opened, asked.notes)
    for database in asked.databases if busy else ():
        channels += _decoded_frames(opened, database, asked.notes)
    if busy and not asked.databases:
        said = f"{FRAMES}: frames of a CAN bus are read with their database, as in dbc='car.dbc'"
        asked.notes[LeftOut(said, FRAMES)] = 1
    names = [channel.name for channel in channels]
    groups: dict[tuple[str, bytes], list[tuple[str, Channel]]] = {}
    for channel in channels:
        alone = names.count(channel.name) == 1
        name = channel.name if alone else f"{channel.group}.{channel.name}"
        key = channel.group, channel.times.tobytes()
        groups.setdefault(key, []).append((name, channel))
    return [_table(members, asked) for members in groups.values()]


def _table(members: list[tuple[str, Channel]], asked: Asked) -> Table:
    columns, units = {asked.time: members[0][1].times}, {asked.time: "s"}
    for name, channel in members:
        try:
            found = _converted(name, channel)
        except Unread as error:
            asked.notes[LeftOut(f"channel {name!r} is left out: {error}", name)] = 1
            continue
        columns |= found
        units[name] = channel.unit
    return table_of_arrays(columns, asked.time, asked.notes, units)


def _channels(opened: Any, notes: dict[str, int], frames: bool = False) -> Iterator[Channel]:
    """Yield the channels of all groups, unconverted."""
    for index, group in enumerate(opened.groups):
        about, master = group.channel_group, opened.masters_db.get(index)
        check_values(about.cycles_nr * max(1, len(group.channels)), f"group {index}")
        for at, each in enumerate(group.channels):
            if at == master or each.name.partition(".")[0] == FRAMES:
                continue
            try:
                found = opened.get(group=index, index=at, raw=True)
            except Exception as error:  # The package raises what it likes.
                why = one_line(format_error(error))
                notes[LeftOut(f"channel {each.name!r} cannot be read: {why}", each.name)] = 1
                continue
            name = about.acq_name or f"group_{index}"
            if frames and (message := re.search(r"message (\S+) 0x", about.comment or "")):
                name = message[1]
            own = found.samples, found.timestamps, found.unit or "", found.conversion
            yield Channel(name, each.name, *own)


def _decoded_frames(opened: Any, database: Path, notes: dict[str, int]) -> list[Channel]:
    """Return the signals of frames as a DBC file describes them."""
    if database.suffix.lower() != ".dbc":
        raise ValueError(f"a database of a CAN bus is a .dbc file; got {database.name}")
    text, note = decoded(database, read_bytes(database))
    notes |= {note: 1} if note else {}
    formats = require("canmatrix.formats", EXTRA)
    try:
        # The import type is fixed: formats of spreadsheets would run code of their cells.
        loaded = formats.loads(text.encode(), import_type="dbc", dbcImportEncoding="utf-8")
        (matrix,) = loaded.values()
        if not matrix.frames:
            raise ValueError("it describes no message")
    except Exception as error:
        raise ValueError(f"{database} is no DBC file: {one_line(format_error(error))}") from None
    buses = {"CAN": [(matrix, 0)]}
    found = opened.extract_bus_logging(buses, ignore_value2text_conversion=True)
    channels = list(_channels(found, notes, frames=True))
    if not channels:
        notes[f"no message of {database} was recorded"] = 1
    return channels


def _converted(name: str, channel: Channel) -> dict[str, np.ndarray]:
    """Return the columns of a channel: its numbers, and whether it has each of its words."""
    raw, conversion = channel.samples, channel.conversion
    kind = None if conversion is None else conversion.conversion_type
    if raw.dtype.names:
        raise ValueError("it is a structure")
    if raw.dtype.kind in "SUO":
        words = [_text(each) for each in raw.tolist()]
        # An empty text is a value: it has none of the words.
        return word_columns(name, words, None if all(words) else [True] * len(words))
    if conversion is None or kind not in TEXTS:
        return {name: _numbers(raw, conversion)}
    words = _looked_up(raw, conversion)
    rest = conversion.referenced_blocks.get("default_addr")
    if isinstance(rest, bytes | None):
        words[words == ""] = _text(rest or b"")
        rest = None
    numbers, worded = np.asarray(_numbers(raw, rest), float), words != ""
    if not worded.any():
        return {name: numbers}
    numbers = numbers if worded.all() else np.where(worded, np.nan, numbers)
    return {name: numbers, **word_columns(name, words.tolist(), (~worded).tolist())}


def _looked_up(raw: np.ndarray, conversion: Any) -> np.ndarray:
    """Return the text of each number by a table of texts, empty where there is none."""
    words, ranges = np.full(len(raw), "", object), conversion.conversion_type == RANGES
    blocks = conversion.referenced_blocks
    for index in range(len(blocks) - 1):
        text = blocks[f"text_{index}"]
        if not isinstance(text, bytes):
            raise ValueError("its table of texts refers to other conversions")
        low, high = (
            (conversion[f"{end}_{index}"] for end in ("lower", "upper"))
            if ranges
            else (conversion[f"val_{index}"],) * 2
        )
        below = raw < high if ranges and raw.dtype.kind == "f" else raw <= high
        hit = (raw >= low) & (below | (raw == low))
        words[hit & (words == "")] = _text(text)
    return words


def _numbers(raw: np.ndarray, conversion: Any) -> np.ndarray:
    """Convert by numbers alone, or by a formula that is plain arithmetic."""
    if conversion is None:
        return raw
    kind = conversion.conversion_type
    if kind == FORMULA and not (
        len(conversion.formula) < 200 and PLAIN.fullmatch(conversion.formula)
    ):
        raise ValueError(f"its formula {one_line(conversion.formula, 40)!r} is not evaluated")
    if kind not in (*LINEAR, FORMULA):
        raise ValueError("its conversion is not one of numbers")
    return np.asarray(conversion.convert(raw))


def _text(cell: Any) -> str:
    return (cell.decode("utf-8", "replace") if isinstance(cell, bytes) else str(cell)).strip("\0 ")
