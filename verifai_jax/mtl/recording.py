"""Recorded signals as a trace: from CSV and Parquet files, and from uneven sample times.

read("flight.csv")                                        # a column `time`
read(frame, dt=0.02)                                      # a pandas.DataFrame
read("flight.parquet", dt=0.02)                           # rows 0.02 s apart
read("flight.csv", resample_to=0.1, method="linear")
resample(Trace({"x": xs}, times=ts), dt=0.1, method="hold")
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from verifai_jax.core.errors import missing_name
from verifai_jax.core.trace import Trace, check_period
from verifai_jax.mtl.setting import seconds

if TYPE_CHECKING:
    import pandas as pd

Method = Literal["hold", "linear"]

MOST_SAMPLES = 100_000_000
"""Samples that a resampled trace may have."""


class TimeColumnError(ValueError):
    """A recording without the column of its sample times.

    `fact` says so, without the advice of the message; `columns` are those it has.
    """

    def __init__(self, fact: str, columns: Sequence[str]) -> None:
        self.fact, self.columns = fact, tuple(columns)
        super().__init__(
            f"{fact}: give the sampling period dt, or the name of the column. "
            f"It has: {', '.join(columns)}"
        )


def resample(trace: Trace, dt: float, method: Method) -> Trace:
    """Resample signals on an even clock, from the first sample time to the last.

    **Arguments:**

    - `trace`: with `times` or another period; NumPy or JAX arrays, not under `jit`.
    - `dt`: the new sampling period in seconds.
    - `method`: `"hold"` keeps each value until the next sample; `"linear"` interpolates.

    **Raises:** `ValueError` for a period that is not positive or makes more than 100 million
    samples, an unknown method, or sample times that do not increase or are not finite.
    """
    if method not in ("hold", "linear"):
        raise ValueError(f"method is 'hold' or 'linear'; got {method!r}")
    check_period(dt)
    trace = trace.trim()
    times = seconds(trace)
    _check_increasing(times)
    with np.errstate(over="ignore"):
        steps = np.floor((times[-1] - times[0]) / dt * (1 + 1e-9) + 1e-9)
    if not steps < MOST_SAMPLES:
        raise ValueError(
            f"resampling {times[-1] - times[0]:g} s every {dt:g} s makes {steps + 1:.3g} samples, "
            f"more than {MOST_SAMPLES}: take a longer period"
        )
    count = int(steps) + 1
    clock = times[0] + dt * np.arange(count)
    # A sample due at `t` counts from `t` on, whatever the last digit of the clock says.
    index = np.searchsorted(times, clock + 1e-6 * dt, side="right") - 1
    following = np.minimum(index + 1, len(times) - 1)
    gap = times[following] - times[index]
    share = np.clip(np.where(gap > 0, (clock - times[index]) / np.where(gap > 0, gap, 1), 0), 0, 1)
    signals = {}
    for name, values in trace.signals.items():
        values = np.asarray(values)
        here, there = values[index], values[following]
        if method == "linear" and values.dtype != bool:
            weight = share.reshape((-1,) + (1,) * (values.ndim - 1))
            # Not a weighted sum, which would spread the NaN of a neighbour with no weight.
            signals[name] = np.where(weight == 0, here, here + weight * (there - here))
        else:
            signals[name] = here
    return replace(trace, signals=signals, dt=float(dt), times=None)


def read(
    source: "str | Path | pd.DataFrame",
    *,
    time: str = "time",
    dt: float | None = None,
    columns: Sequence[str] | None = None,
    resample_to: float | None = None,
    method: Method | None = None,
) -> Trace:
    """Read a trace from a CSV or Parquet file or a data frame, a column a signal, a row a sample.

    Columns `p[0]`, `p[1]`, ... make one vector signal `p`. Columns that hold no numbers are left
    out, unless named in `columns`. In a CSV file commas, semicolons or tabs separate the columns,
    whichever the first line has; numbers may have a decimal comma, if all of them do.

    **Arguments:**

    - `source`: the path of a `.csv` (first line: names) or `.parquet` file, or a
      `pandas.DataFrame`, whose index is read as a column if it has a name.
    - `time`: the column of sample times in seconds; of a data frame also dates or durations, which
      become seconds since the first.
    - `dt`: the sampling period, instead of a column of times.
    - `columns`: the signals to read; all when left out.
    - `resample_to`, `method`: a period to resample to, and how (`"hold"` or `"linear"`).

    **Raises:** `FileNotFoundError`; `ValueError` for another kind of file, no rows, a column that
    does not exist or holds no numbers, times that do not increase, or `resample_to` without
    `method`.
    """
    if (resample_to is None) != (method is None):
        raise ValueError('resampling needs both: resample_to=PERIOD, method="hold" or "linear"')
    if isinstance(source, str | Path):
        path = Path(source)
        if not path.exists():
            raise FileNotFoundError(f"there is no recording {path}")
        name, table = str(path), _file_columns(path)
    else:
        name, table = "the data frame", _frame_columns(source, time)
    if time not in table and dt is None:
        raise TimeColumnError(f"{name} has no column {time!r} of sample times", list(table))
    times = table.pop(time, None)
    signals = _signals(name, table, columns)
    if dt is not None:
        trace = Trace(signals, dt=dt)
    else:
        times = _numbers(name, time, times)
        _check_increasing(times)
        trace = Trace(signals, times=times)
    if resample_to is not None and method is not None:
        return resample(trace, resample_to, method)
    return trace


def _check_increasing(times: np.ndarray) -> None:
    if not np.all(np.isfinite(times)):
        k = int(np.argmin(np.isfinite(times)))
        raise ValueError(f"sample times must be finite; row {k + 1} has {times[k]:g} s")
    steps = np.diff(times)
    if not np.all(steps > 0):
        k = int(np.argmin(np.where(np.isnan(steps), -np.inf, steps)))
        raise ValueError(
            f"sample times must increase; row {k + 1} has {times[k]:g} s and row {k + 2} "
            f"{times[k + 1]:g} s"
        )


def _frame_columns(frame: "pd.DataFrame", time: str) -> dict[str, Any]:
    """Return the columns of a data frame by name, as Arrow arrays."""
    import pandas as pd
    import pyarrow

    if not isinstance(frame, pd.DataFrame):
        raise TypeError(
            f"a recording is the path of a file or a pandas.DataFrame; got a {type(frame).__name__}"
        )
    if frame.index.name is not None:
        frame = frame.reset_index()
    if not len(frame):
        raise ValueError("the data frame has no rows")
    names = [str(name) for name in frame.columns]
    _refuse_repeated("the data frame", names)
    table = {}
    for position, name in enumerate(names):
        column = frame.iloc[:, position]
        if name == time and pd.api.types.is_datetime64_any_dtype(column):
            column = column - column.iloc[0]
        if name == time and pd.api.types.is_timedelta64_dtype(column):
            column = column.dt.total_seconds()
        plain = pd.api.types.is_numeric_dtype(column) or pd.api.types.is_bool_dtype(column)
        table[name] = pyarrow.array(column if plain else column.astype(str), from_pandas=True)
    return table


def _refuse_repeated(source: str, names: Sequence[str]) -> None:
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"{source} has more than one column {', '.join(map(repr, repeated))}")


def _file_columns(path: Path) -> dict[str, Any]:
    """Read columns by name, as Arrow arrays."""
    import pyarrow
    from pyarrow import parquet

    readers = {".csv": _read_csv, ".parquet": parquet.read_table}
    if path.suffix.lower() not in readers:
        raise ValueError(f"a recording is a .csv or a .parquet file; got {path.name}")
    try:
        table = readers[path.suffix.lower()](path)
    except (pyarrow.ArrowInvalid, OSError) as error:
        # A row with more cells than the first line has names is often one of decimal commas.
        advice = ". Decimal commas need semicolons between the columns"
        advice = advice if "Expected" in str(error) else ""
        raise ValueError(f"{path} cannot be read: {error}{advice}") from None
    if table.num_rows == 0:
        raise ValueError(f"{path} has no rows")
    names = table.column_names
    _refuse_repeated(str(path), names)
    return {name: table.column(name) for name in names}


def _read_csv(path: Path) -> Any:
    """Read a CSV file as an Arrow table, whatever separates its columns and its decimals."""
    from pyarrow import csv

    with open(path, encoding="utf-8", errors="replace") as file:
        first = file.readline()
    separator = max((",", ";", "\t"), key=first.count)
    parsed = csv.ParseOptions(delimiter=separator)
    table = csv.read_csv(path, parse_options=parsed)
    named = list(zip(table.column_names, table.columns, strict=True))
    commas = [name for name, column in named if _decimal_commas(column)]
    if not commas:
        return table
    again = csv.read_csv(
        path, parse_options=parsed, convert_options=csv.ConvertOptions(decimal_point=",")
    )
    for (name, before), after in zip(named, again.columns, strict=True):
        if _numeric(before) and not _numeric(after):
            raise ValueError(
                f"{path} has decimal commas in column {commas[0]!r} and decimal points in column "
                f"{name!r}: write all numbers in one way"
            )
    return again


def _decimal_commas(column: Any) -> bool:
    """Return whether a column of text holds numbers such as `1,5`, and nothing else."""
    from pyarrow import compute, types

    if not types.is_string(column.type) or column.null_count == len(column):
        return False
    number = r"^\s*[-+]?\d*(,\d*)?([eE][-+]?\d+)?\s*$"
    fits = compute.match_substring_regex(column, number)  # pyright: ignore[reportAttributeAccessIssue]
    return bool(compute.all(fits, skip_nulls=True).as_py())  # pyright: ignore[reportAttributeAccessIssue]


def _numeric(column: Any) -> bool:
    from pyarrow import types

    kind = column.type
    return types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind)


def _numbers(source: str, name: str, column: Any) -> np.ndarray:
    if not _numeric(column):
        raise ValueError(
            f"column {name!r} of {source} holds no numbers; it starts with {column[0].as_py()!r}"
        )
    chunked = hasattr(column, "chunks")
    values = column.to_numpy() if chunked else column.to_numpy(zero_copy_only=False)
    # A column of truth values with gaps comes as objects, in which None is a gap.
    return values.astype(float) if values.dtype == object else values


def _signals(
    source: str, table: dict[str, Any], columns: Sequence[str] | None
) -> dict[str, np.ndarray]:
    if columns is None:
        table = {name: column for name, column in table.items() if _numeric(column)}
        if not table:
            raise ValueError(f"{source} has no column of numbers")
    vectors = vector_columns(table)
    in_vectors = {name for parts in vectors.values() for name in parts}
    scalars = [name for name in table if name not in in_vectors]
    wanted = [*scalars, *vectors] if columns is None else list(columns)
    signals = {}
    for name in wanted:
        if name in vectors:
            parts = [_numbers(source, part, table[part]) for part in vectors[name]]
            signals[name] = np.stack(parts, axis=1)
        elif name in table:
            signals[name] = _numbers(source, name, table[name])
        else:
            raise missing_name(source, "column", name, [*scalars, *vectors])
    return signals


def vector_columns(names: Collection[str]) -> dict[str, list[str]]:
    """Return the vector signals among columns, `{"p": ["p[0]", "p[1]"]}`, in order."""
    vectors: dict[str, dict[int, str]] = {}
    for name in names:
        stem, bracket, index = name.partition("[")
        if bracket and index.endswith("]") and index[:-1].isdigit():
            vectors.setdefault(stem, {})[int(index[:-1])] = name
    return {
        stem: [parts[i] for i in range(len(parts))]
        for stem, parts in vectors.items()
        if sorted(parts) == list(range(len(parts))) and stem not in names
    }
