"""The record of a run, `run.json`: everything about it but its table and its checkpoint."""

import json
import re
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from verifai_jax.core.seals import is_intact
from verifai_jax.core.sources import Sources
from verifai_jax.core.text import one_line
from verifai_jax.falsification.origin import ORIGINS
from verifai_jax.falsification.segments import SEGMENTS, list_segments
from verifai_jax.falsification.table import FINISHED
from verifai_jax.falsification.tail import TAIL

RECORD = "run.json"
"""Name of the file with everything about a run but its table and its checkpoint."""
FORMAT = 3
"""Number of the format of a run's files; others are refused."""

DECIDING = (
    "features",
    "name",
    "formulas",
    "search_data",
    "seed",
    "batch",
    "precision",
    "backend",
    "confirm",
    "prior",
    "guide",
)
"""Entries that decide what the rows of a run are; they stay what they are when it is resumed."""


def read_record(folder: Path) -> dict[str, Any]:
    """Read the record of a run, and check that it has what a run needs.

    **Raises:** `FileNotFoundError` where there is none; `ValueError` for one that is damaged or of
    another format. Both say where the rows are, which are none the worse for it.
    """
    file = folder / RECORD
    if not file.is_file():
        raise FileNotFoundError(f"no run in {folder}: {RECORD} is missing{_rows_alongside(folder)}")
    try:
        record = json.loads(file.read_text())
    except (ValueError, RecursionError):
        record = None
    if not isinstance(record, dict) or not isinstance(record.get("format"), int):
        raise ValueError(
            f"no run in {folder}: its {RECORD} is damaged, or of another program"
            f"{_rows_alongside(folder)}"
        )
    if record.get("format") != FORMAT:
        raise ValueError(
            f"{file} has format {one_line(repr(record.get('format')), 40)}, and this version of "
            f"verifai_jax reads format {FORMAT}: load it with the version that wrote it, "
            f"{one_line(str(record.get('version', 'unknown')), 40)}"
        )
    for name, fits in _FORMS.items():
        if name not in record or not fits(record[name]):
            what = f"has no {name!r}" if name not in record else f"has {name!r} of another form"
            raise ValueError(f"{file} is damaged: it {what}{_rows_alongside(folder)}")
    if not is_intact(record):
        raise ValueError(
            f"{file} is damaged: its content has changed since it was "
            f"written{_rows_alongside(folder)}"
        )
    return record


def record_checksum(record: Mapping[str, Any]) -> int:
    """Return a checksum of the entries of a record that decide what the rows of its run are."""
    deciding = {name: record.get(name) for name in DECIDING}
    return zlib.crc32(json.dumps(deciding, sort_keys=True).encode())


def numeric_features(record: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the feature columns that are numbers, as far as the recorded space says so."""
    space = record.get("space_data") or {"features": []}
    known = {name: domain.get("kind") for name, domain in space["features"]}
    return tuple(
        column
        for column in record["features"]
        if known.get(re.sub(r"(\[\d+\])+$", "", column)) in _NUMERIC
    )


_NUMERIC = ("Box", "DiscreteBox", "Normal", "TruncatedNormal", "LogUniform", "LogNormal", "Signal")
"""Kinds of domains, the usual ones, whose columns are numbers."""


def _rows_alongside(folder: Path) -> str:
    """Say how the rows of a folder are read without its record."""
    if (folder / FINISHED).is_file():
        return f"; the rows are in {folder / FINISHED}, which pandas.read_parquet reads"
    if list_segments(folder / SEGMENTS) and not (folder / TAIL).exists():
        return f"; the rows are in {folder / SEGMENTS}, which pandas.read_parquet reads"
    if list_segments(folder / SEGMENTS) or (folder / TAIL).is_file():
        return f"; the rows are in {folder}: vj.ErrorTable.load(folder, features)"
    return ""


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_flag(value: object) -> bool:
    return isinstance(value, bool)


def _is_texts(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(each, str) for each in value)


def _is_mapping(value: object) -> bool:
    return value is None or isinstance(value, dict)


def _is_space(value: object) -> bool:
    if not isinstance(value, dict) or not isinstance(value.get("features"), list):
        return value is None
    pairs = all(
        isinstance(each, list)
        and len(each) == 2
        and isinstance(each[0], str)
        and isinstance(each[1], dict)
        for each in value["features"]
    )
    return pairs and (value.get("where", 0) is None or isinstance(value.get("where"), str))


def _is_sources(value: object) -> bool:
    if not isinstance(value, list):
        return False
    try:
        return all(isinstance(Sources.from_json(part), Sources) for part in value)
    except ValueError:
        return False


_FORMS: dict[str, Callable[[Any], bool]] = {
    "features": _is_texts,
    "name": _is_text,
    "formulas": lambda value: isinstance(value, dict) and all(map(_is_text, value.values())),
    "search": _is_text,
    "seed": _is_count,
    "batch": _is_count,
    "stopped": _is_text,
    "compile_seconds": _is_number,
    "run_seconds": _is_number,
    "version": _is_text,
    "prior": _is_flag,
    "target": lambda value: True,
    "budget": _is_count,
    "search_data": _is_mapping,
    "space_data": _is_space,
    "acceptance": lambda value: value is None or _is_number(value),
    "precision": lambda value: value in ("float32", "float64"),
    "backend": lambda value: value is None or _is_text(value),
    "notes": _is_texts,
    "lasting_notes": _is_texts,
    "confirm": _is_flag,
    "confirm_seconds": _is_number,
    "search_seconds": _is_number,
    "simulate_seconds": _is_number,
    "checks": _is_texts,
    "first": lambda value: isinstance(value, list),
    "guide": _is_mapping,
    "origin": lambda value: value in ("", *ORIGINS),
    "sources": _is_sources,
    "derived": _is_mapping,
}
"""What each entry of a record must be."""
RECORDED = tuple(name for name in _FORMS if name != "features")
"""Entries of a record that are attributes of its run."""
