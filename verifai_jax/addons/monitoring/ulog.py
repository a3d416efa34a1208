"""ULog, the logs of PX4, by the package `pyulog`: each topic has its own clock.

`vehicle_attitude` and `q[0]` become `vehicle_attitude.q[0]`; of several instances of a topic those
after the first are `battery_status_1` and so on.
"""

import contextlib
import functools
import io
from pathlib import Path
from typing import Any

from verifai_jax.addons.monitoring.containers import EXTRA, Table, table_of_arrays
from verifai_jax.addons.monitoring.readers import Asked
from verifai_jax.core.messages.errors import require
from verifai_jax.core.store.foreign_files import MAX_BYTES, open_file

MAX_FIELDS = 10_000
"""Maximum numbers in one message, with the entries of its arrays."""
MAX_DEPTH = 16
"""Maximum depth of messages within messages."""
STAMP = "timestamp"


def read_ulog(path: Path, asked: Asked) -> list[Table]:
    """Read the topics of a ULog file; their times are microseconds since the start."""
    # The package prints what it finds damaged.
    with open_file(path, MAX_BYTES) as file, contextlib.redirect_stdout(io.StringIO()):
        log = _bounded_reader()(file)
    if log.file_corruption:
        asked.notes[f"{path} is damaged or was cut: only what is whole is read"] = 1
    tables = []
    for topic in sorted(log.data_list, key=lambda each: (each.name, each.multi_id)):
        name = f"{topic.name}_{topic.multi_id}" if topic.multi_id else topic.name
        clock, columns = topic.data.get(STAMP), {}
        for field, values in topic.data.items():
            own = field == STAMP
            columns[asked.time if own else f"{name}.{field}"] = values
        if clock is not None and len(clock):
            tables.append(table_of_arrays(columns, asked.time, asked.notes, {asked.time: "us"}))
    if not tables:
        raise ValueError(f"{path} has no topic with a {STAMP}")
    return tables


@functools.cache
def _bounded_reader() -> Any:
    """Return the reader, which refuses messages of more fields than are read."""
    ULog = require("pyulog", EXTRA).ULog

    class Bounded(ULog):
        class _MessageAddLogged(ULog._MessageAddLogged):
            counted = 0

            def _parse_nested_type(self, prefix: str, name: str, formats: Any) -> None:
                self.counted += sum(max(1, size) for _, size, _ in formats[name].fields)
                if self.counted > MAX_FIELDS or prefix.count(".") > MAX_DEPTH:
                    raise RuntimeError(f"a message {name!r} has more than {MAX_FIELDS:,} numbers")
                super()._parse_nested_type(prefix, name, formats)

    return Bounded
