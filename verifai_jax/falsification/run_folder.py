"""The folder of a run: its record, `run.json`, its table, and the state of its search.

    save_run(run, folder); load(folder, problem)
    write_record(run, folder)                           # `run.json`, all but the other two
    write_checkpoint(state, folder, rows, record)       # `search.state`, a log of one entry

The state contains checksums of the table's rows that the search has seen and of the record's
entries. So it is noticed if one of the three files comes from another run or another time.
"""

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from verifai_jax.core.display.extensions import extension
from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.core.store import files
from verifai_jax.core.store.files import DamagedError, is_of
from verifai_jax.core.store.locks import settled, write_lock
from verifai_jax.core.store.log import Log, write_log
from verifai_jax.core.store.replacements import replacing_all
from verifai_jax.core.user_code.sources import Sources
from verifai_jax.falsification.derived import as_simulated
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.segments import FAILURES, SEGMENTS, TAIL, list_segments
from verifai_jax.falsification.table import FINISHED, ErrorTable
from verifai_jax.problem.problem import Problem

RECORD = "run.json"
"""Name of the file with everything about a run but its table and its checkpoint."""
STATE = "search.state"
"""Name of the checkpoint in a run's folder."""
ROWS_CHECKSUM = "rows.checksum"
"""Entry of the checkpoint with the checksum of the rows seen, `ErrorTable.digest`."""
RECORD_CHECKSUM = "record.checksum"
"""Entry of the checkpoint with the checksum of the record, `deciding_checksum`."""
_ENTRY = "search"
RECORDED = tuple(
    field.name
    for field in fields(Run)
    if field.name not in ("table", "folder", "problem", "checkpoint", "damage")
)
"""Attributes of a run that its record stores, in addition to the table's `features`.
"""
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
"""Entries that determine the rows of a run; they do not change when it is resumed."""


def save_run(run: Run, folder: Path) -> Path:
    """Write a run to a folder; return the folder."""
    with write_lock(folder):
        check_not_continued(run, folder)
        if _is_own(run, folder):
            _write(run, folder)
        else:
            names = (TAIL, SEGMENTS, FAILURES, FINISHED, STATE, RECORD)
            with replacing_all(folder, names) as made:
                _write(run, made)
    return folder


def _write(run: Run, folder: Path) -> None:
    table = run.table.save(folder)
    checksum = write_record(run, folder)
    if run.checkpoint:
        rows = table.digest(int(run.checkpoint["rows"]))
        write_checkpoint(run.checkpoint, folder, rows, checksum)


def _is_own(run: Run, folder: Path) -> bool:
    return run.folder is not None and folder.absolute() == run.folder.absolute()


def load(path: str | Path, problem: Problem | None = None) -> Run:
    """Read a run from its folder, finished or cut off.

    - `problem`: needed to replay rows, because a record names no code to run.

    If the checkpoint is damaged the run still has its table; `damage` says what is missing.

    **Raises:** `FileNotFoundError` for a folder without a run; `ValueError` for a record or a table
    that is damaged, a record of another version, or a problem whose name, formulas or features
    differ from the recorded ones.
    """
    folder = Path(path)
    record = read_record(folder)
    _check_entries(record, folder)
    try:
        return _as_recorded(folder, record, problem)
    except (LookupError, TypeError, AttributeError, ArithmeticError) as error:
        raise _of_another_form(folder, format_error(error)) from error


def _as_recorded(folder: Path, record: Mapping[str, Any], problem: Problem | None) -> Run:
    features = tuple(record["features"])
    if problem is not None:
        problem = as_simulated(problem, record)
        texts = {name: str(formula) for name, formula in problem.formulas.items()}
        for what, recorded, given in (
            ("name", record["name"], problem.name),
            ("formulas", record["formulas"], texts),
            ("features", features, tuple(problem.space.columns)),
        ):
            if recorded != given:
                raise ValueError(
                    f"the run in {folder} is of another problem: its {what} is "
                    f"{one_line(repr(recorded))}, "
                    f"the given one's {given!r}"
                )
        if record.get("backend") is not None:
            problem = problem.on_backend(record["backend"])
    begun = ErrorTable.exists(folder) or record["stopped"] != "running"
    # A run that was cut off before its first batch came to the disk has no rows yet.
    table = ErrorTable(features)
    if begun:
        table = ErrorTable.load(folder, features, _numeric_features(record))
    checkpoint, damage = _read_state(folder, record, table)
    run = Run(
        table=table, folder=folder, problem=problem, checkpoint=checkpoint,
        damage="; ".join(damage), **{name: record[name] for name in RECORDED},
    )  # fmt: skip
    return as_made(run)


def as_made(run: Run) -> Run:
    """Return a run as the class of the verb that made it: `FuzzRun` for `fuzz`."""
    return (
        run
        if run.derived is None
        else extension("verifai_jax.runs", run.derived["verb"]).as_made(run)
    )


ANEW = "begin anew, from what it has found: vj.falsify(problem, vj.Start(run=run))"
"""Advice for a run that cannot be resumed."""


def _read_state(
    folder: Path, record: Mapping[str, Any], table: ErrorTable
) -> tuple[dict[str, Any] | None, list[str]]:
    """Return the checkpoint, and the reason why the run cannot be resumed from it, if any."""
    damage, checkpoint = [table.damage] if table.damage else [], None
    try:
        checkpoint = read_checkpoint(folder)
    except DamagedError as error:
        damage.append(f"{error}; its rows can still be read: {ANEW}")
    seen = int(checkpoint["rows"]) if checkpoint else 0
    if checkpoint and checkpoint[RECORD_CHECKSUM] != deciding_checksum(record):
        damage.append(
            f"{folder / RECORD} is not the one that {STATE} was written with: the run's search, "
            f"seed, options or formulas have changed; {ANEW}"
        )
    if seen > len(table):
        damage.append(
            f"its search had seen {seen} simulations, of which its table has {len(table)}; files "
            f"of {folder} are missing or damaged"
        )
    elif checkpoint and not table.missing and checkpoint[ROWS_CHECKSUM] != table.digest(seen):
        changed = (
            f"the first {seen} rows of the table in {folder} are not those that its search had "
            f"seen: they have changed, or are of another run; {ANEW}"
        )
        table.distrust(changed)
        damage.append(changed)
    elif not len(table) and record["stopped"] != "running" and not (folder / FINISHED).exists():
        damage = damage or [f"{folder / TAIL} is damaged: it has no row that can be read"]
    elif checkpoint is None and not damage and len(table) and record["stopped"] != "running":
        damage.append(f"{folder / STATE} is missing, which says what its rows are; {ANEW}")
    return checkpoint, damage


def check_not_continued(run: Run, folder: Path) -> None:
    """Refuse to overwrite a folder that holds another run, or whose run has been continued.

    **Raises:** `ValueError`.
    """
    if not _is_own(run, folder) or not (folder / RECORD).exists():
        return
    record = read_record(folder)
    remedy = "load it, vj.load(folder, problem), or save this one elsewhere, run.save(folder)"
    if deciding_checksum(record) != deciding_checksum(_as_record(run)):
        raise ValueError(f"{folder} now holds another run, of {record.get('name')!r}; {remedy}")
    rows = 0
    if ErrorTable.exists(folder):
        rows = len(ErrorTable.load(folder, run.table.features))
    if rows > run.simulations:
        raise ValueError(
            f"the run in {folder} has been continued: it has {rows} simulations now, this one "
            f"{run.simulations}; {remedy}"
        )


def shown_folder(folder: Path) -> str:
    """Return the path of a folder as a command names it: relative to the current one, if below."""
    here, folder = Path.cwd().resolve(), folder.resolve()
    return folder.relative_to(here).as_posix() if folder.is_relative_to(here) else folder.as_posix()


def replay_command(run: Run, row: int | None = None) -> str:
    """Return the command that replays a row; without a row, its text before the row number."""
    number = "" if row is None else str(row)
    if run.folder is None:
        return f"run.replay({number})"
    if run.target is None:
        return f"vj.load({shown_folder(run.folder)!r}, problem).replay({number})"
    words = ["verifai-jax", "replay", shown_folder(run.folder), number]
    return shlex.join(words if number else words[:-1])


def write_record(run: Run, folder: Path) -> int:
    """Write everything but the table of a run to `run.json`; return its checksum."""
    return deciding_checksum(files.write_record(folder / RECORD, _as_record(run)))


def _as_record(run: Run) -> dict[str, Any]:
    record = {"features": list(run.table.features)}
    record |= {name: getattr(run, name) for name in RECORDED}
    return record | {"sources": list(run.sources)}


def read_record(folder: Path) -> dict[str, Any]:
    """Read the record of a run.

    **Raises:** `FileNotFoundError` if there is none; `DamagedError` for one that is damaged. Both
    errors name the files of the rows, which are not affected.
    """
    file = settled(folder) / RECORD
    if not file.is_file():
        raise FileNotFoundError(f"no run in {folder}: {RECORD} is missing{_rows_alongside(folder)}")
    try:
        return files.read_record(file)
    except DamagedError as error:
        raise DamagedError(f"no run in {folder}: {error}{_rows_alongside(folder)}") from error


def _check_entries(record: Mapping[str, Any], folder: Path) -> None:
    """Refuse a record with other entries, written by another version of verifai_jax."""
    if other := sorted(record.keys() ^ {"features", *RECORDED}):
        version = one_line(str(record.get("version", "unknown")), 40)
        names = one_line(", ".join(map(repr, other)), 80)
        raise DamagedError(
            f"{folder / RECORD} is of another version of verifai_jax, {version}, which can load "
            f"it: {names} is not in both{_rows_alongside(folder)}"
        )
    kinds = {field.name: field.type for field in fields(Run)} | {"features": Sequence[str]}
    if wrong := [name for name, value in record.items() if not is_of(value, kinds[name])]:
        raise _of_another_form(folder, f"its {wrong[0]} cannot be {record[wrong[0]]!r}")
    for part in record["sources"]:
        Sources.from_json(part)


def _of_another_form(folder: Path, why: str) -> DamagedError:
    return DamagedError(
        f"{folder / RECORD} is damaged: {one_line(why, 160)}{_rows_alongside(folder)}"
    )


def deciding_checksum(record: Mapping[str, Any]) -> int:
    """Return a checksum of those entries of a record that determine the rows of its run."""
    return files.record_checksum({name: record.get(name) for name in DECIDING})


def write_checkpoint(
    checkpoint: Mapping[str, Any], folder: Path, rows_checksum: int, record_checksum: int
) -> None:
    """Replace the checkpoint in `folder` atomically.

    **Arguments:**
    - `checkpoint`: the state of the search, with the number of `rows` that it has observed.
    - `folder`: the folder of the run.
    - `rows_checksum`: the checksum of these rows.
    - `record_checksum`: the checksum of the record.
    """
    arrays = {name: _plain(value) for name, value in checkpoint.items()}
    arrays[ROWS_CHECKSUM] = np.array(rows_checksum, np.uint32)
    arrays[RECORD_CHECKSUM] = np.array(record_checksum, np.uint32)
    write_log(folder / STATE, {_ENTRY: arrays})


def read_checkpoint(folder: Path) -> dict[str, Any] | None:
    """Return the checkpoint in `folder`; None if there is none.

    **Raises:** `DamagedError` for one that cannot be read.
    """
    file = folder / STATE
    if not file.exists():
        return None
    arrays = Log(file).get(_ENTRY)
    if arrays is None:
        raise DamagedError(f"{file} is damaged: it holds no state of a search")
    rows = arrays.get("rows")
    if rows is None or rows.shape != () or rows.dtype.kind not in "iu" or rows < 0:
        raise DamagedError(f"{file} is damaged: it does not say how many rows its search saw")
    return arrays


def _plain(value: ArrayLike) -> np.ndarray:
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return np.asarray(jax.random.key_data(value))
    return np.asarray(value)


def _numeric_features(record: Mapping[str, Any]) -> tuple[str, ...]:
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
    """Describe how to read the rows of a folder without its record."""
    if (folder / FINISHED).is_file():
        return f"; the rows are in {folder / FINISHED}, which pandas.read_parquet reads"
    if list_segments(folder / SEGMENTS) and not (folder / TAIL).exists():
        return f"; the rows are in {folder / SEGMENTS}, which pandas.read_parquet reads"
    if list_segments(folder / SEGMENTS) or (folder / TAIL).is_file():
        return f"; the rows are in {folder}: vj.ErrorTable.load(folder, features)"
    return ""
