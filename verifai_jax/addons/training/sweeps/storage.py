"""A sweep in a folder, as numbers and text only.

    sweep.json            study, options, space of the hyper-parameters, worst features
    table.parquet         the table
    failing.parquet       counterexamples of each row
    curves.npz            the learning curves
    policies/12.npz       the policy of row 12; `vj.policy` reads it too

`sweep.json` has the checksums of all files including itself, so changed files are reported by name.
The files never name code: pass the study to `load_sweep(folder, study)`.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from reprlib import repr as shown
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from verifai_jax.addons.rl.policies import policy as load
from verifai_jax.addons.rl.policy import Policy, save_policy
from verifai_jax.addons.training.sweeps.record import Curve, SweepRecord, TrainedPolicy
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store import files
from verifai_jax.core.store.files import DamagedError, checksum, plain
from verifai_jax.core.store.foreign_archives import read_arrays, read_parquet
from verifai_jax.core.store.foreign_files import read_bytes
from verifai_jax.core.store.locks import settled, write_lock
from verifai_jax.core.store.replacements import replacing_all
from verifai_jax.core.user_code.sources import Sources
from verifai_jax.features import FeatureSpace

if TYPE_CHECKING:
    import pandas as pd
Sweep: TypeAlias = Any
"""A `Sweep`, whose file imports this one."""
RECORD = "sweep.json"
"""File of everything that is neither table, policy nor curve."""
TABLE = "table.parquet"
"""File of the table."""
FAILING = "failing.parquet"
"""File of the counterexamples."""
CURVES = "curves.npz"
"""File of the learning curves."""
POLICIES = "policies"
"""Folder of the policies."""
_PLAIN = ("study", "seed", "hyperparameters", "certified", "options", "version", "seconds")
"""Fields of the record that are plain data."""
_KINDS: dict[str, Any] = {
    "study": str, "seed": int, "version": str, "complete": bool, "rows": int,
    "hyperparameters": list[str], "mixed": list[str], "certified": list[int],
    "options": dict[str, Any], "seconds": dict[str, float], "checksums": dict[str, int],
    "used": dict[str, list[str]], "worst": list[dict[str, Any] | None],
    "sources": list[dict[str, Any]], "space": dict[str, Any] | None,
}  # fmt: skip
"""What the entries of the record are."""


class SweepFileError(ValueError):
    """An error for a folder without a sweep, or with that of another study."""


def write_sweep(sweep: Sweep, failing: "pd.DataFrame", folder: Path) -> Path:
    """Write a sweep to a folder, replacing one there.

    **Arguments:**
    - `failing`: counterexamples of all rows, with a column `row`.
    - `folder`: the folder; it is created.
    **Raises:** `FolderInUse` if another process writes there; `OSError` if the file system refuses,
    in which case the old content stays.
    """
    names = (TABLE, FAILING, CURVES, POLICIES, RECORD)
    with write_lock(folder), replacing_all(folder, names) as made:
        _write_files(sweep, failing, made)
    return folder


def _write_files(sweep: Sweep, failing: "pd.DataFrame", folder: Path) -> None:
    record, table = sweep.record, sweep.table
    (folder / POLICIES).mkdir()
    mixed = _mixed_columns(table)
    texts = {name: [json.dumps(plain(v)) for v in table[name]] for name in mixed}
    table.assign(**texts).to_parquet(folder / TABLE)
    for i, policy in enumerate(record.policies):
        if policy is not None:
            notes = {"study": record.study, "row": i, "verdict": str(table.loc[i, "verdict"])}
            sources = record.sources[-1] if record.sources else {}
            file = folder / POLICIES / f"{i}.npz"
            if isinstance(policy, Policy):
                save_policy(policy, file, sources=sources, **notes)
            else:
                policy.save(file)
    failing.to_parquet(folder / FAILING)
    arrays: dict[str, np.ndarray] = {}
    for (configuration, seed), curve in record.curves.items():
        arrays[f"{configuration}/{seed}/steps"] = np.asarray(curve.steps)
        arrays[f"{configuration}/{seed}/mean_return"] = np.asarray(curve.mean_return)
    np.savez_compressed(folder / CURVES, **arrays)  # pyright: ignore[reportArgumentType]
    data = {name: getattr(record, name) for name in _PLAIN}
    data |= {
        "complete": record.complete, "rows": record.rows, "sources": list(record.sources),
        "used": sweep.used, "mixed": mixed, "worst": record.worst,
        "space": _space_to_json(sweep.space),
        "checksums": {
            file.relative_to(folder).as_posix(): checksum(read_bytes(file))
            for file in _files(folder, record.rows)
        },
    }  # fmt: skip
    files.write_record(folder / RECORD, plain(data))


def _files(folder: Path, rows: int) -> list[Path]:
    """Return the files next to the record; rows may have no policy."""
    policies = (folder / POLICIES / f"{row}.npz" for row in range(rows))
    return [folder / TABLE, folder / FAILING, folder / CURVES, *(p for p in policies if p.exists())]


def read_description(folder: Path) -> dict[str, Any]:
    """Read the file that describes the sweep in a folder.

    **Raises:** `FileNotFoundError` for a folder without one; `SweepFileError` for a damaged file.
    """
    file = settled(folder) / RECORD
    if not file.exists():
        raise FileNotFoundError(f"no sweep in {folder}: {RECORD} is missing")
    try:
        found = files.read_record(file)
    except DamagedError as error:
        raise SweepFileError(str(error)) from error
    for name, kind in _KINDS.items():
        if not files.is_of(found.get(name), kind):
            value = shown(found.get(name))
            raise SweepFileError(f"{file} is damaged: its {name} cannot be {value}")
    if not files.is_of(found["options"].get("p"), float | None):
        raise SweepFileError(f"{file} is damaged: its p cannot be {shown(found['options']['p'])}")
    return found


def check_study(
    description: Mapping[str, Any], folder: Path, name: str, columns: Sequence[str]
) -> None:
    """Check that the sweep in a folder belongs to this study.

    **Raises:** `SweepFileError` for another name or other hyper-parameters.
    """
    for what, recorded, given in (
        ("name", description["study"], name),
        ("hyper-parameters", list(description["hyperparameters"]), list(columns)),
    ):
        if recorded != given:
            raise SweepFileError(
                f"the sweep in {folder} is of another study: its {what} is {recorded!r}, "
                f"the given one's {given!r}"
            )


def read_sweep(
    description: Mapping[str, Any], folder: Path
) -> "tuple[SweepRecord, FeatureSpace | None, pd.DataFrame, dict[str, tuple[str, ...]]]":
    """Read the record of a sweep from a folder of this description, without its certificates.

    **Returns:** the record, and of the sweep `space`, counterexamples with a column `row`, `used`.
    **Raises:** `SweepFileError` if a file is missing or damaged.
    """
    try:
        _check_files(folder, description["checksums"])
        used = {name: tuple(names) for name, names in description["used"].items()}
        record, space = _read_record(folder, description), _space_from_json(description["space"])
        return record, space, read_parquet(folder / FAILING).to_pandas(), used
    except FileNotFoundError as error:
        raise SweepFileError(f"the sweep in {folder} is incomplete: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError, OSError) as error:
        reason = one_line(str(error))
        raise SweepFileError(f"the sweep in {folder} is damaged: {reason}") from error


def _check_files(folder: Path, checksums: Mapping[str, int]) -> None:
    """Check that the files are those that were written; a policy may have been removed."""
    for name, own in checksums.items():
        file = folder / name
        optional = name.startswith(f"{POLICIES}/")
        if optional and not file.exists():
            continue
        if checksum(read_bytes(file, within=folder)) != own:
            hint = "; the rest can be read without this file" if optional else ""
            raise SweepFileError(f"{name} has changed since it was written{hint}")


def _read_record(folder: Path, description: Mapping[str, Any]) -> SweepRecord:
    import pandas as pd

    table = read_parquet(folder / TABLE).to_pandas()
    rows = description["rows"]
    if len(table) != rows or len(description["worst"]) != rows:
        raise SweepFileError(
            f"the sweep in {folder} is damaged: {len(table)} rows in {TABLE}, {rows} in {RECORD}"
        )
    if absent := {*description["hyperparameters"]} - {*table.columns}:
        raise SweepFileError(f"{TABLE} has no column {min(absent)!r}")
    for name in description["mixed"]:
        table[name] = pd.Series([json.loads(v) for v in table[name]], table.index, dtype=object)
    curves: dict[tuple[int, int], Curve] = {}
    arrays = read_arrays(folder / CURVES, CURVES)
    for name, steps in arrays.items():
        configuration, seed, part = name.split("/")
        if part == "steps":
            returns = arrays[f"{configuration}/{seed}/mean_return"]
            curves[int(configuration), int(seed)] = Curve(steps, returns)
    policies: list[TrainedPolicy | None] = []
    for i in range(len(table)):
        file = folder / POLICIES / f"{i}.npz"
        policies.append(load(file) if file.exists() else None)
    return SweepRecord(
        columns={str(name): table[name].to_numpy() for name in table.columns},
        policies=tuple(policies), worst=tuple(description["worst"]), curves=curves,
        certificates=None, complete=bool(description["complete"]),
        hyperparameters=tuple(description["hyperparameters"]),
        certified=tuple(description["certified"]),
        sources=tuple(Sources.from_json(each).to_json() for each in description["sources"]),
        **{name: description[name] for name in ("study", "seed", "options", "version", "seconds")},
    )  # fmt: skip


def _mixed_columns(table: "pd.DataFrame") -> list[str]:
    """Return the names of columns with choices of several types, which Parquet does not have."""
    return [
        str(name)
        for name in table.columns
        if table[name].dtype == object and not all(isinstance(v, str) for v in table[name])
    ]


def _space_to_json(space: FeatureSpace | None) -> dict[str, Any] | None:
    try:
        return None if space is None else space.to_json()
    except ValueError:
        return None  # Domains of the user's own cannot be stored; the table is enough.


def _space_from_json(data: Mapping[str, Any] | None) -> FeatureSpace | None:
    # The constraint is code; the domains without it are enough for a result.
    try:
        return None if data is None else FeatureSpace.from_json({**data, "where": None})
    except ValueError:
        return None
