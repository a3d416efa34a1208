"""Scores that other evaluators wrote, as one table: a row for each episode.

read_scores("eval_info.json")                       # LeRobot's, of one or of many tasks
read_scores(["seed0/eval_info.json", "seed1/eval_info.json"])
read_scores("successes.csv")                        # success or score, by seed and task
read_scores(np.array([[0.8, 0.4], [0.7, 0.6]]))     # scores of runs [runs, tasks]
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard

import numpy as np

from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.store.foreign_archives import check_values, read_arrays, read_parquet
from verifai_jax.core.store.foreign_files import read_json, read_text

if TYPE_CHECKING:
    import pandas as pd
Scores: TypeAlias = "str | Path | pd.DataFrame | np.ndarray | Sequence[str | Path]"
"""A file, a table or a matrix of scores, or the files of several runs."""
ENDINGS = (".csv", ".json", ".npz", ".parquet")
KEYS = ("run", "seed", "task", "episode")
"""Columns that say which episode a score is of."""
SCORES = ("success", "score", "failed")
"""Names of the column of scores. A table has one of them, or `successes` and `episodes`."""
WORDS = {"true": 1.0, "yes": 1.0, "1": 1.0, "false": 0.0, "no": 0.0, "0": 0.0}


def is_scores(given: object) -> TypeGuard[Any]:
    """Return whether something is a table of scores, and not a problem or its name."""
    if isinstance(given, list | tuple):
        return bool(given) and all(map(is_scores, given))
    if isinstance(given, str | Path):
        return Path(given).suffix.lower() in ENDINGS
    return isinstance(given, np.ndarray) or hasattr(given, "columns")


def read_scores(given: Any) -> "pd.DataFrame":
    """Read `Scores` as a table of `score` and of the columns of `KEYS` that are known.

    **Raises:** `FileNotFoundError`; `ValueError` for what is no table of scores; the errors of
    `open_file`.
    """
    import pandas as pd

    name, suffix = "the table", ""
    if isinstance(given, str | Path):
        name, suffix = str(given), Path(given).suffix.lower()
        if not Path(given).exists():
            raise FileNotFoundError(f"there is no file {given} of scores")
    if isinstance(given, list | tuple):
        runs = [read_scores(one).assign(run=i) for i, one in enumerate(given)]
        table: Any = pd.concat(runs, ignore_index=True)
    elif suffix == ".json":
        table = _of_json(read_json(given), name)
    elif suffix == ".npz":
        arrays = read_arrays(Path(given), name)
        if len(arrays) != 1:
            raise ValueError(f"{name} must hold one array of scores; it has {', '.join(arrays)}")
        table = _of_matrix(next(iter(arrays.values())), name)
    elif isinstance(given, np.ndarray):
        table = _of_matrix(given, name)
    elif suffix == ".parquet":
        table = _of_table(read_parquet(Path(given)).to_pandas(), name)
    else:
        read = pd.read_csv(io.StringIO(read_text(given))) if suffix else given
        table = _of_table(read, name)
    scores = table["score"].to_numpy(float)
    if not len(scores) or not np.isfinite(scores).all():
        what = f"row {int(np.argmin(np.isfinite(scores)))} is not finite" if len(scores) else "none"
        raise ValueError(f"{name} needs scores that are finite numbers: {what}")
    return table.assign(score=scores)


def _of_json(data: Any, name: str) -> "pd.DataFrame":
    """Read an `eval_info.json` of LeRobot, or a matrix of scores as nested lists."""
    import pandas as pd

    try:
        if isinstance(data, list):
            return _of_matrix(np.array(data, float), name)
        if "per_task" in data:
            rows = [
                {"task": f"{task['task_group']}/{task['task_id']}", "episode": i, "score": success}
                for task in data["per_task"]
                for i, success in enumerate(task["metrics"]["successes"])
            ]
        else:
            rows = [
                {"seed": each["seed"], "score": each["success"]} for each in data["per_episode"]
            ]
        if any(type(row["score"]) is not bool for row in rows):
            raise TypeError("a success is neither true nor false")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{name} is neither an eval_info.json of LeRobot, with per_task or per_episode, nor a "
            f"matrix of scores [runs, tasks]: {error!r}"
        ) from None
    return pd.DataFrame(rows, columns=None if rows else ["score"]).dropna(axis="columns")


def _of_matrix(scores: np.ndarray, name: str) -> "pd.DataFrame":
    import pandas as pd

    if scores.ndim != 2 or scores.dtype.kind not in "biuf":
        shape = f"{scores.dtype} with the shape {list(scores.shape)}"
        raise ValueError(f"{name} must have the scores of runs [runs, tasks]; got {shape}")
    runs, tasks = np.indices(scores.shape)
    return pd.DataFrame({"run": runs.ravel(), "task": tasks.ravel(), "score": scores.ravel()})


def _of_table(table: Any, name: str) -> "pd.DataFrame":
    table = table.rename(columns=lambda column: str(column).strip().lower())
    keys = [key for key in KEYS if key in table.columns]
    if {"successes", "episodes"} <= {*table.columns}:
        won, count = (table[c].to_numpy() for c in ("successes", "episodes"))
        if np.result_type(won, count).kind not in "iu" or (won < 0).any() or (won > count).any():
            raise ValueError(f"successes of {name} must be whole numbers from 0 to episodes")
        check_values(int(count.sum()), name)
        rows = np.repeat(np.arange(len(table)), count)
        episode = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
        return table[keys].iloc[rows].assign(episode=episode, score=episode < won[rows])
    column = next((each for each in SCORES if each in table.columns), None)
    if column is None:
        raise missing_name(name, "column", "success", list(table.columns))
    values = table[column]
    if values.dtype.kind not in "biuf":
        values = values.map(lambda word: WORDS.get(str(word).strip().lower()))
        for row in np.flatnonzero(values.isna())[:1]:
            got = table[column].iloc[row]
            raise ValueError(f"row {row} of {name}: {column} must be yes or no; got {got!r}")
    return table[keys].assign(score=1.0 - values if column == "failed" else values)
