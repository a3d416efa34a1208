"""Trials as a table: features, and whether each trial failed.

read_trials(problem, "trials.csv")                  # columns of features, and `failed`
read_trials(problem, frame)                         # ... or `recording`, which the formulas judge
"""

from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from verifai_jax.addons.monitoring.judging import judge
from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.messages.text import listed
from verifai_jax.core.store.foreign_archives import read_parquet
from verifai_jax.core.store.foreign_files import MAX_BYTES, open_file
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd
TrialTable: TypeAlias = "str | Path | pd.DataFrame"
"""Trials: the path of a CSV or Parquet file, or a data frame, with a row for each."""
SHOWN = 5
"""Groups of equal trials that are named."""
FAILED, RECORDING = "failed", "recording"
"""Columns that say whether a trial failed, or which recording says so."""
WORDS = {
    True: ("true", "yes", "y", "1", "fail", "failed", "fails"),
    False: ("false", "no", "n", "0", "ok", "pass", "passed", "holds", "success"),
    None: ("", "nan", "none", "?", "undecided", "aborted"),
}
"""Texts of a verdict, in small letters; None is for trials that may have failed."""


def read_trials(
    problem: Problem, trials: TrialTable, *, time: str = "time", dt: float | None = None
) -> "tuple[pd.DataFrame, dict[str, int]]":
    """Read trials, and judge those that have a recording instead of a verdict.

    `time` and `dt` are the time column and the period of recordings, as in `mtl.read`.
    **Returns:** the features with a column `failed` of True, False or None (undecided), and the
    reasons why recordings have no verdict, with their counts.
    **Raises:** `FileNotFoundError`; `ValueError` for a table without trials, verdicts or features.
    """
    table, folder = table_of(trials)
    if FAILED not in table.columns and RECORDING not in table.columns:
        raise ValueError(
            f"trials need a column {FAILED!r} (yes or no; empty if undecided), or {RECORDING!r} "
            f"with a file for each trial; this table has {', '.join(map(str, table.columns))}"
        )
    for column in problem.space.columns:
        if column not in table.columns:
            raise missing_name("the table of trials", "column", column, list(table.columns))
    notes: dict[str, int] = {}
    verdicts: list[bool | None] = [None] * len(table)
    if FAILED in table.columns:
        verdicts = verdicts_of(table)
    if RECORDING in table.columns:
        for row, (known, file) in enumerate(zip(verdicts, table[RECORDING], strict=True)):
            if known is None and isinstance(file, str) and file.strip():
                verdicts[row], why = _judged(problem, folder / file.strip(), time, dt)
                if why:
                    notes[why] = notes.get(why, 0) + 1
    features = table[list(problem.space.columns)].reset_index(drop=True)
    import pandas as pd

    return features.assign(failed=pd.Series(verdicts, dtype=object)), notes


def copies(features: "pd.DataFrame") -> list[str]:
    """Return a note on trials that agree in all real numbers, as copies of one trial would."""
    real = features.select_dtypes("floating")
    real = real.loc[:, real.nunique() > 1]
    names = list(real.columns)
    groups = real.groupby(names, dropna=False, sort=False).indices.values() if names else ()
    same = [", ".join(map(str, rows)) for rows in groups if len(rows) > 1]
    note = (
        f"trials that agree in every digit of all real features ({listed(names)}) count as "
        f"separate ones: rows {'; '.join(same[:SHOWN])}{'; ...' * (len(same) > SHOWN)}. If they "
        "are copies, the interval is too narrow"
    )
    return [note] * bool(same)


def table_of(trials: TrialTable) -> "tuple[pd.DataFrame, Path]":
    """Return trials, one at least, as a frame, and the folder to which its paths are relative."""
    import pandas as pd

    folder = Path()
    if isinstance(trials, str | Path):
        path = Path(trials)
        if not path.exists():
            raise FileNotFoundError(f"there is no file {path} of trials")
        folder = path.parent
        if path.suffix.lower() == ".parquet":
            trials = read_parquet(path).to_pandas()
        else:
            with open_file(path, MAX_BYTES) as file:
                trials = pd.read_csv(file)
    if not isinstance(trials, pd.DataFrame):
        raise TypeError(
            f"trials are the path of a table or a pandas.DataFrame; got {type(trials).__name__}"
        )
    if not len(trials):
        raise ValueError("the table of trials has no rows")
    return trials.reset_index(drop=True), folder


def verdicts_of(table: "pd.DataFrame") -> list[bool | None]:
    """Return the column `failed` as True, False or None (undecided)."""
    if FAILED not in table.columns:
        raise missing_name("the table of trials", "column", FAILED, list(table.columns))
    meaning = {word: value for value, words in WORDS.items() for word in words}
    verdicts = []
    for row, entry in enumerate(table[FAILED]):
        word = "" if entry is None else str(entry).strip().lower().removesuffix(".0")
        if word not in meaning:
            raise ValueError(
                f"row {row}: {FAILED} must be yes or no, or empty if undecided; got {entry!r}"
            )
        verdicts.append(meaning[word])
    return verdicts


def _judged(problem: Problem, file: Path, time: str, dt: float | None) -> tuple[bool | None, str]:
    """Return whether a recording breaks a formula, and why it has no verdict."""
    if not file.exists():
        raise FileNotFoundError(f"there is no recording {file}, which the table of trials names")
    judged = judge(
        dict(problem.formulas), {str(file): file}, time=time, dt=dt, end=problem.end, explain=False
    )
    if any(row.verdict == "fails" for row in judged.rows):
        return True, ""
    without = [row.error for row in judged.rows if row.error]
    return (None, without[0]) if without else (False, "")
