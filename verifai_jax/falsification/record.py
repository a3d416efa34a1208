"""The record of a run, `run.json`: everything about it but its table and its checkpoint."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from verifai_jax.core.text import one_line
from verifai_jax.falsification.segments import SEGMENTS, list_segments
from verifai_jax.falsification.table import FINISHED
from verifai_jax.falsification.tail import TAIL
from verifai_jax.store import files
from verifai_jax.store.files import DamagedError

RECORD = "run.json"
"""Name of the file with everything about a run but its table and its checkpoint."""

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
    """Read the record of a run.

    **Raises:** `FileNotFoundError` where there is none; `DamagedError` for one that is damaged.
    Both say where the rows are, which are none the worse for it.
    """
    file = folder / RECORD
    if not file.is_file():
        raise FileNotFoundError(f"no run in {folder}: {RECORD} is missing{_rows_beside(folder)}")
    try:
        return files.read_record(file)
    except DamagedError as error:
        raise DamagedError(f"no run in {folder}: {error}{_rows_beside(folder)}") from error


def check_entries(record: Mapping[str, Any], folder: Path, names: Sequence[str]) -> None:
    """Refuse the record of a version of verifai_jax with other entries than these.

    **Raises:** `DamagedError`.
    """
    if other := sorted(record.keys() ^ set(names)):
        version = one_line(str(record.get("version", "unknown")), 40)
        raise DamagedError(
            f"{folder / RECORD} is of another version of verifai_jax, {version}, which can load "
            f"it: {one_line(', '.join(map(repr, other)), 80)} is not in both{_rows_beside(folder)}"
        )


def deciding_checksum(record: Mapping[str, Any]) -> int:
    """Return a checksum of the entries of a record that decide what the rows of its run are."""
    return files.record_checksum({name: record.get(name) for name in DECIDING})


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


def _rows_beside(folder: Path) -> str:
    """Say how the rows of a folder are read without its record."""
    if (folder / FINISHED).is_file():
        return f"; the rows are in {folder / FINISHED}, which pandas.read_parquet reads"
    if list_segments(folder / SEGMENTS) and not (folder / TAIL).exists():
        return f"; the rows are in {folder / SEGMENTS}, which pandas.read_parquet reads"
    if list_segments(folder / SEGMENTS) or (folder / TAIL).is_file():
        return f"; the rows are in {folder}: vj.ErrorTable.load(folder, features)"
    return ""
