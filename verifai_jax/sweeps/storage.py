"""A sweep in a folder: numbers and text only.

    sweep.json            study, options, space of the hyper-parameters, worst features
    table.parquet         the table
    failing.parquet       what each row failed with
    curves.npz            the learning curves
    policies/12.npz       the policy of row 12; `rl.load_policy` reads it too

The study is code, which no file names to be run: `load_sweep(path, study)` gets it from a person.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from verifai_jax.core.targets import load_target
from verifai_jax.features import FeatureSpace
from verifai_jax.rl.policy import Policy, load_policy, save_policy
from verifai_jax.sweeps.record import Curve, SweepRecord
from verifai_jax.sweeps.result import Sweep
from verifai_jax.sweeps.study import Study

RECORD = "sweep.json"
TABLE = "table.parquet"
FAILING = "failing.parquet"
CURVES = "curves.npz"
POLICIES = "policies"
FORMAT = 1
_PLAIN = ("study", "seed", "hyperparameters", "certified", "options", "version", "seconds")


class SweepFileError(ValueError):
    """A folder that holds no sweep of ours, or one of another study."""


def save_sweep(sweep: Sweep, path: str | Path) -> Path:
    """Write a sweep to a folder, in place of one that it may hold; returns the folder."""
    folder, record = Path(path), sweep.record
    (folder / POLICIES).mkdir(parents=True, exist_ok=True)
    # Whole only once its record is there.
    (folder / RECORD).unlink(missing_ok=True)
    for old in (folder / POLICIES).glob("*.npz"):
        old.unlink()
    mixed = _mixed(sweep.table)
    texts = {name: [json.dumps(_plain(v)) for v in sweep.table[name]] for name in mixed}
    sweep.table.assign(**texts).to_parquet(folder / TABLE)
    for i, policy in enumerate(record.policies):
        if policy is not None:
            notes = {"study": record.study, "row": i, "verdict": str(sweep.table.loc[i, "verdict"])}
            save_policy(policy, folder / POLICIES / f"{i}.npz", **notes)
    _failing(sweep).to_parquet(folder / FAILING)
    arrays: dict[str, Any] = {}
    for (configuration, seed), curve in record.curves.items():
        arrays[f"{configuration}/{seed}/steps"] = np.asarray(curve.steps)
        arrays[f"{configuration}/{seed}/mean_return"] = np.asarray(curve.mean_return)
    np.savez_compressed(folder / CURVES, **arrays)
    data = {name: _plain(getattr(record, name)) for name in _PLAIN}
    data |= {"format": FORMAT, "complete": record.complete, "rows": record.rows}
    data |= {
        "used": _plain(sweep.used),
        "mixed": mixed,
        "worst": _plain(record.worst),
        "space": _space_data(sweep.space),
    }
    partial = folder / f"{RECORD}.part"
    partial.write_text(json.dumps(data, indent=2) + "\n")
    partial.replace(folder / RECORD)
    return folder


def load_sweep(path: str | Path, study: Study | str | None = None) -> Sweep:
    """Read a sweep back from the folder that `Sweep.save` wrote.

    - `study`: or its name, such as `"specs/cartpole.py:safe_training"`; needed for `.problem(i)`
      and new counterexamples. The file says which it was, and names no code to run.

    The certificates are those of the table, and what the policies failed with; the object that
    made them is not saved.

    **Raises:** `FileNotFoundError` for a folder without a sweep; `SweepFileError` for a damaged
    one, one of another format, or a study of another name or with other hyper-parameters.
    """
    folder = Path(path)
    if not (folder / RECORD).exists():
        raise FileNotFoundError(f"no sweep in {folder}: {RECORD} is missing")
    try:
        data = json.loads((folder / RECORD).read_text())
    except ValueError as error:
        raise SweepFileError(f"{folder / RECORD} is damaged: {error}") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else None
        raise SweepFileError(f"{folder / RECORD} has format {found!r}; this version reads {FORMAT}")
    if isinstance(study, str):
        study = load_target(study, Study)
    if study is not None:
        _check_same(folder, data, study)
    try:
        record = _record(folder, data)
        space = _space_from(data["space"])
        failing = _failing_from(folder)
    except FileNotFoundError as error:
        raise SweepFileError(f"the sweep in {folder} is not whole: {error}") from error
    except (KeyError, TypeError, ValueError, OSError) as error:
        raise SweepFileError(f"the sweep in {folder} is damaged: {error}") from error
    used = {name: tuple(has) for name, has in data.get("used", {}).items()}
    return Sweep(record, study, None if study is not None else space, folder, failing, used)


def _check_same(folder: Path, data: Mapping[str, Any], study: Study) -> None:
    for what, recorded, given in (
        ("name", data["study"], study.name),
        ("hyper-parameters", list(data["hyperparameters"]), list(study.space.columns)),
    ):
        if recorded != given:
            raise SweepFileError(
                f"the sweep in {folder} is of another study: its {what} is {recorded!r}, "
                f"the given one's {given!r}"
            )


def _record(folder: Path, data: Mapping[str, Any]) -> SweepRecord:
    import pandas as pd

    frame = pd.read_parquet(folder / TABLE)
    if len(frame) != data["rows"] or len(data["worst"]) != data["rows"]:
        raise SweepFileError(
            f"the sweep in {folder} is damaged: {len(frame)} rows in {TABLE}, "
            f"{data['rows']} in {RECORD}"
        )
    for name in data.get("mixed", ()):
        frame[name] = pd.Series([json.loads(v) for v in frame[name]], frame.index, dtype=object)
    curves: dict[tuple[int, int], Curve] = {}
    with np.load(folder / CURVES, allow_pickle=False) as arrays:
        for name in arrays.files:
            configuration, seed, part = name.split("/")
            if part == "steps":
                returns = arrays[f"{configuration}/{seed}/mean_return"]
                curves[int(configuration), int(seed)] = Curve(arrays[name], returns)
    policies: list[Policy | None] = []
    for i in range(len(frame)):
        file = folder / POLICIES / f"{i}.npz"
        policies.append(load_policy(file) if file.exists() else None)
    return SweepRecord(
        columns={str(name): frame[name].to_numpy() for name in frame.columns},
        policies=tuple(policies),
        worst=tuple(data["worst"]),
        curves=curves,
        certificates=None,
        complete=bool(data["complete"]),
        hyperparameters=tuple(data["hyperparameters"]),
        certified=tuple(data["certified"]),
        **{name: data[name] for name in ("study", "seed", "options", "version", "seconds")},
    )


def _mixed(table: Any) -> list[str]:
    """Columns of choices that are not all texts, which Parquet does not have: a number or None."""
    return [
        str(name)
        for name in table.columns
        if table[name].dtype == object and not all(isinstance(v, str) for v in table[name])
    ]


def _failing(sweep: Sweep) -> Any:
    """What the rows failed with, one below the other."""
    import pandas as pd

    parts = [sweep.met(i).assign(row=i) for i in range(sweep.record.rows)]
    return pd.concat([part for part in parts if len(part)] or [pd.DataFrame({"row": [0]})[:0]])


def _failing_from(folder: Path) -> dict[int, Any]:
    import pandas as pd

    frame: Any = pd.read_parquet(folder / FAILING)
    return {
        int(i): part.drop(columns="row").reset_index(drop=True) for i, part in frame.groupby("row")
    }


def _space_data(space: FeatureSpace | None) -> Any:
    try:
        return None if space is None else space.to_json()
    except ValueError:
        return None  # Domains of the user's own: the table alone has to do.


def _space_from(data: Any) -> FeatureSpace | None:
    # The constraint is code; the domains without it are enough for what a result does with them.
    try:
        return None if data is None else FeatureSpace.from_json({**data, "where": None})
    except ValueError:
        return None


def _plain(value: Any) -> Any:
    """NumPy numbers and tuples as JSON has them."""
    if isinstance(value, Mapping):
        return {str(name): _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(value)
