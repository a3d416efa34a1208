"""Tables in files of one kind of rows: Feather, lines of JSON, and NumPy's archives."""

import json
from pathlib import Path
from typing import Any

from verifai_jax.addons.monitoring.columns import LeftOut
from verifai_jax.addons.monitoring.containers import Table, table_of, table_of_arrays
from verifai_jax.addons.monitoring.readers import Asked
from verifai_jax.addons.monitoring.stamps import find_clock
from verifai_jax.addons.monitoring.topics import columns_of, flatten
from verifai_jax.core.messages.text import counted, shorten
from verifai_jax.core.store.foreign_archives import check_values, read_arrays
from verifai_jax.core.store.foreign_files import MAX_BYTES, decoded, open_file, read_bytes


def read_feather(path: Path, asked: Asked) -> list[Table]:
    """Read a Feather file (version 2, Arrow's own format), and of a cut one the whole batches."""
    from pyarrow import ArrowInvalid, Table, ipc

    with open_file(path, MAX_BYTES) as file:
        reader = ipc.open_file(file)
        batches = []
        for index in range(reader.num_record_batches):
            try:
                batches.append(reader.get_batch(index))
            except (ArrowInvalid, OSError) as error:
                if not batches:
                    raise
                asked.notes[f"{path} is damaged ({error}): {index} batches of rows are read"] = 1
                break
            check_values(sum(each.num_rows * each.num_columns for each in batches), str(path))
        return [Table.from_batches(batches, reader.schema)]


def read_json_lines(path: Path, asked: Asked) -> list[Table]:
    """Read a JSON object in each line; `{"pose": {"x": 1}}` gives the column `pose.x`."""
    text, note = decoded(path, read_bytes(path), cut=True)
    asked.notes.update({note: 1} if note else {})
    rows: list[dict[str, Any]] = []
    odd: list[tuple[int, str]] = []
    for number, line in enumerate(text.split("\n"), 1):
        if not line.strip("\0 \r\t"):
            continue
        row: dict[str, Any] = {}
        try:
            value = json.loads(line)
            if not isinstance(value, dict):
                raise ValueError("is no object")
            flatten("", value, row)
            rows.append(row)
        except (ValueError, RecursionError):
            odd.append((number, line))
    if len(odd) > len(rows):
        raise ValueError(f"{path} has no JSON object in line {odd[0][0]}: {shorten(odd[0][1])!r}")
    if odd:
        said = f"{counted(len(odd), 'line')} such as line {odd[0][0]} {shorten(odd[0][1])!r}"
        asked.notes[f"{said}: no JSON object, and left out"] = len(odd)
    return [table_of(columns_of(rows))]


def read_npz(path: Path, asked: Asked) -> list[Table]:
    """Read the arrays of an `.npz` file as columns; nothing in it is unpickled."""
    left_out: dict[str, str] = {}
    arrays = read_arrays(path, str(path), left_out=left_out)
    for name, why in left_out.items():
        asked.notes[LeftOut(f"column {name!r}: {why}: left out", name)] = 1
    return [table_of_arrays(arrays, find_clock(arrays, asked.time), asked.notes)]
