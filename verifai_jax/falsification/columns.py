"""Rows as columns of NumPy arrays, made of verdicts, and their other forms: pandas, Arrow."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from jaxtyping import Bool, Int, Shaped

from verifai_jax.core.display.lazy import uncollected
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.files import checksum
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
Columns: TypeAlias = Mapping[str, np.ndarray]
"""Columns `[n]` by name, `rho` among them; texts are arrays of objects."""
Batch: TypeAlias = tuple[int, Columns]
"""Consecutive rows: number of the first, and their columns."""
ROW = "row"
"""Name of the column that numbers the rows."""


@uncollected()
def import_tables() -> None:
    """Import the libraries that tables use, which takes a fifth of a second."""
    import pandas as pd  # noqa: F401
    import pyarrow as pa  # noqa: F401


def length(columns: Columns) -> int:
    """Return the number of rows of a batch."""
    return len(next(iter(columns.values()), ()))


def cut(batch: Batch, begin: int, stop: int) -> Batch:
    """Return the rows of a batch numbered from `begin` to `stop - 1`, as views."""
    first, columns = batch
    rows = slice(max(begin - first, 0), max(stop - first, 0))
    return max(begin, first), {name: values[rows] for name, values in columns.items()}


def merge(batches: Sequence[Batch]) -> Columns:
    """Return the columns of batches, one after another."""
    if len(batches) == 1:
        return batches[0][1]
    return {name: np.concatenate([batch[name] for _, batch in batches]) for name in batches[0][1]}


def row_numbers(batches: Sequence[Batch]) -> Int[np.ndarray, " n"]:
    """Return the numbers of the rows of batches."""
    return np.concatenate([first + np.arange(length(columns)) for first, columns in batches])


def to_frame(
    numbers: Int[np.ndarray, " n"], columns: Columns, names: Sequence[str] | None = None
) -> "pd.DataFrame":
    """Return rows, or some columns of them, as a DataFrame that is indexed by their numbers."""
    import pandas as pd

    wanted = columns if names is None else {name: columns[name] for name in names}
    # Numbers are not copied: a table of a column each takes no more memory than its columns.
    return pd.DataFrame(dict(wanted), index=pd.Index(numbers, name=ROW), copy=False)


def from_frame(frame: "pd.DataFrame") -> Columns:
    """Return the columns of a DataFrame."""
    return {str(name): frame[name].to_numpy() for name in frame.columns}


def wrong_column(columns: Columns, numbers: Sequence[str] = ()) -> str:
    """Name the column that holds values of a wrong type; empty if all columns are right.

    **Arguments:**
    - `columns`: the columns, among them `status`, `violated` and `rho`.
    - `numbers`: names of the features that are numbers.
    """
    known = [status.name.lower() for status in Status]
    for each in columns["status"].tolist():
        if not (isinstance(each, str) and each in known):
            found = one_line(repr(each), 60)
            return f"its column 'status' must hold {', '.join(known)}; it holds {found}"
    for name, values in columns.items():
        wanted = _KINDS.get(name, "f" if name == "rho" or name.startswith("rho.") else "")
        if not wanted or values.dtype.kind in wanted:
            continue
        if wanted == "O" and values.dtype == object and {*map(type, values)} <= _TEXTS:
            continue
        return f"its column {name!r} must hold {_WORDS[wanted]}; it holds {_held(values)}"
    for name in numbers:
        if name in columns and columns[name].dtype.kind not in "biuf":
            return f"its column {name!r} must hold numbers; it holds {_held(columns[name])}"
    proper, rho = columns["status"] == "ok", columns["rho"]
    if np.any(proper & np.isnan(rho)):
        return "its column 'rho' lacks the robustness of a row that ended properly"
    violated = columns["violated"]
    if np.any(proper & (((rho < 0) & ~violated) | ((rho > 0) & violated))):
        return "its columns 'violated' and 'rho' contradict each other"
    return ""


_KINDS = {"violated": "b", "gradient_finite": "b", "differentiated": "b", "message": "O"}
"""Kinds of NumPy's types that columns have, except those of robustness."""
_TEXTS = {str, float, type(None)}
"""Types in a column of texts; a NaN of pandas is an absent one."""
_WORDS = {"b": "truth values", "f": "floating-point numbers", "O": "texts"}


def _held(values: Shaped[np.ndarray, " n"]) -> str:
    if values.dtype != object:
        return f"numbers of type {values.dtype}"
    kinds = {type(value).__name__: None for value in values}
    return f"values of type {', '.join([*kinds][:3])}"


def to_arrow(columns: Columns) -> "pa.RecordBatch":
    """Return rows as a record batch of Arrow."""
    import pyarrow as pa

    arrays = {name: column_to_arrow(each) for name, each in columns.items()}
    return pa.RecordBatch.from_pydict(arrays)


def column_to_arrow(values: Shaped[np.ndarray, " n"]) -> "pa.Array":
    """Return a column as an Arrow array; text has type string, with nulls, even if all are null."""
    import pandas as pd
    import pyarrow as pa

    if values.dtype != object:
        return pa.array(values)
    known = values[~pd.isna(values)]
    texts = all(isinstance(value, str) for value in known)
    return pa.array(values, pa.string() if texts else None, from_pandas=True)


def column_checksum(values: Shaped[np.ndarray, " n"], before: int | None = None) -> int:
    """Return a column's checksum, continuing `before`, the checksum of its earlier part."""
    import pandas as pd

    if values.dtype == object and len(values) and not isinstance(values[0], str):
        # Numbers as objects come back from the disk as what they are.
        values = to_arrow({"": values}).column(0).to_numpy(zero_copy_only=False)
    text = values.dtype.kind in "OUT"
    if before is None:
        before = checksum(b"text" if text else values.dtype.str.encode())
    if text:
        codes, known = pd.factorize(values)
        each = [*(checksum(str(text).encode(errors="replace")) for text in known), 0]
        values = np.array(each, np.uint32)[codes]
    return checksum(values.tobytes(), before)


STATUS_NAMES = np.array([status.name.lower() for status in Status], dtype=object)


def rows_of(
    problem: Problem, verdicts: Verdicts, differentiates: bool = False
) -> dict[str, np.ndarray]:
    """Return the columns of the table for a round, before any row is confirmed.

    **Arguments:**
    - `problem`: the problem; its features and formulas name columns.
    - `verdicts`: the verdicts of the round, with features.
    - `differentiates`: whether some rounds differentiate clauses; a column then marks those rows.
    """
    count = len(verdicts.status)
    assert verdicts.features is not None
    columns: dict[str, np.ndarray] = {**problem.space.rows(verdicts.features)}
    # Adding 0 makes a robustness of -0 one of 0.
    columns["rho"] = verdicts.lowest + 0.0
    if len(problem.formulas) > 1:
        for i, name in enumerate(problem.formulas):
            columns[f"rho.{name}"] = verdicts.rho[:, i] + 0.0
    columns |= {"violated": verdicts.violated, "status": STATUS_NAMES[verdicts.status]}
    if verdicts.gradient is not None:
        columns["gradient_finite"] = np.all(np.isfinite(verdicts.gradient), axis=1)
    if differentiates:
        columns["differentiated"] = np.full(count, verdicts.clause_gradients is not None)
        columns["gradient_finite"] = np.ones(count, bool)
    if differentiates and verdicts.clause_gradients is not None:
        columns["gradient_finite"] = np.all(np.isfinite(verdicts.clause_gradients), axis=(1, 2))
    if verdicts.messages is not None:
        columns["message"] = np.array(verdicts.messages, dtype=object)
    return columns


def without_failure(verdicts: Verdicts, rows: Bool[np.ndarray, " n"]) -> Verdicts:
    """Raise the robustness of these rows' clauses until none is broken."""
    if verdicts.clauses is None or not rows.any():
        return verdicts
    lift = np.where(rows, 1e-6 - np.max(verdicts.clauses, axis=1), 0.0)
    return verdicts._replace(clauses=verdicts.clauses + lift[:, None])
