"""The rows of an error table that an analysis looks at, and their features as matrices.

    samples = Samples.of(run)                            # its counterexamples
    samples = Samples.of(frame, "safe", ["x", "alg"])    # any DataFrame with feature columns
    samples.matrix()                                     # ordered columns in [0, 1], [n, k]
    samples.codes()                                      # unordered columns as integers, [n, m]
    samples.points()                                     # all columns, for Euclidean distances

Results always speak of row numbers of the table (`samples.rows`), never of places among the rows
looked at.
"""

import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.analysis.columns import Column, describe_columns, feature_columns
from verifai_jax.errors import check_names
from verifai_jax.features import FeatureSpace
from verifai_jax.problem import Problem
from verifai_jax.run import Run
from verifai_jax.table import ErrorTable

if TYPE_CHECKING:
    import pandas as pd

Which = Literal["counterexamples", "safe", "failed", "all"]
Scale = Literal["range", "rows", "standard", "raw"]
WHICH = ("counterexamples", "safe", "failed", "all")
SCALES = ("range", "rows", "standard", "raw")
# With it an absent entry is 0.87 to 1 away from every present one of a column in [0, 1].
_ABSENT = np.sqrt(3) / 2


@dataclass(frozen=True, eq=False)
class Samples:
    """Rows of a table and the columns of them that are analysed; made by `Samples.of`.

    **Fields:** `frame`: the rows looked at, with all columns of the table and its row numbers as
    index; `columns`: what is analysed; `which` rows these are; `name` of the run; `table`: the
    whole table; `space` of the features, if known.

    Entries that are missing (NaN, None) are absent items of arrays of variable length. `matrix`
    takes the mean of the rows that have the item, so that an absent one adds nothing to a
    covariance; `codes` says -1; in `points`, absence is a value of its own.
    """

    frame: "pd.DataFrame"
    columns: tuple[Column, ...]
    which: str
    name: str
    table: "pd.DataFrame"
    space: FeatureSpace | None = None

    @classmethod
    def of(
        cls,
        source: "Run | ErrorTable | pd.DataFrame | Samples",
        which: Which = "counterexamples",
        columns: Sequence[str] | None = None,
        space: Problem | FeatureSpace | None = None,
    ) -> "Samples":
        """The samples of a run, of its table, or of any DataFrame with feature columns.

        - `which`: `"counterexamples"`, `"safe"`, `"failed"` (rows without a verdict), or `"all"`
          rows with a verdict. A DataFrame is judged by its columns `violated` and `status`, else
          by `rho < 0`; without either, all of its rows are counterexamples.
        - `columns`: what to analyse; by default all features. `"rho"` and `"rho.NAME"`, the
          robustness, are columns too, but only if named here.
        - `space`: says which columns are ordered and what their ranges are; a run knows its own.

        `Samples` are taken as they are; only `columns` may select among the table's again.

        **Raises:** `TypeError` for another source; `ValueError` for another `which`, no rows,
        row numbers that are not unique integers, unknown columns (with the nearest names), or
        columns named twice.
        """
        import pandas as pd

        if isinstance(source, Samples):
            if columns is None:
                return source
            described = _described(source.table, columns, source.space)
            return replace(source, columns=described)
        if which not in WHICH:
            raise ValueError(f"which must be one of {', '.join(map(repr, WHICH))}; got {which!r}")
        name = "table"
        if isinstance(source, Run):
            name, table = source.name, source.table.all
            space = space if space is not None or source.problem is None else source.problem
        elif isinstance(source, ErrorTable):
            table = source.all
        elif isinstance(source, pd.DataFrame):
            table = source
        else:
            raise TypeError(
                "samples come from a run, its table or a DataFrame; "
                f"got {type(source).__name__}: {source!r}"[:300]
            )
        if isinstance(space, Problem):
            space = space.space
        if not table.index.is_unique or not pd.api.types.is_integer_dtype(table.index):
            raise ValueError(
                "row numbers (the index of the DataFrame) must be unique integers; "
                "reset_index(drop=True) numbers the rows anew"
            )
        features = feature_columns(table, space)
        if isinstance(source, ErrorTable | Run) and space is None:
            table_of = source.table if isinstance(source, Run) else source
            features = table_of.features
        described = _described(table, features if columns is None else columns, space)
        chosen = _chosen(table, which)
        if not chosen.any():
            raise ValueError(_nothing(table, which))
        return cls(table.loc[chosen], described, which, name, table, space)

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def rows(self) -> Int[np.ndarray, " n"]:
        """Row numbers in the table."""
        return self.frame.index.to_numpy()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns that are analysed."""
        return tuple(column.name for column in self.columns)

    @cached_property
    def ordered(self) -> tuple[Column, ...]:
        """Columns of numbers; those of `matrix`."""
        return tuple(column for column in self.columns if column.ordered)

    @cached_property
    def unordered(self) -> tuple[Column, ...]:
        """Columns of choices; those of `codes`."""
        return tuple(column for column in self.columns if not column.ordered)

    @cached_property
    def failing(self) -> Bool[np.ndarray, " n"]:
        """Which of the rows looked at are counterexamples."""
        return _verdicts(self.table)[0][self.table.index.get_indexer(self.frame.index)]

    @cached_property
    def rho(self) -> Float[np.ndarray, " n"]:
        """Robustness of the rows; NaN where the table has none."""
        if "rho" not in self.frame:
            return np.full(len(self), np.nan)
        return self.frame["rho"].to_numpy(np.float64)

    @property
    def worst(self) -> int:
        """Place (not the row number) of the least robustness; the first without any."""
        return int(np.argmin(np.nan_to_num(self.rho, nan=np.inf)))

    def others(self, which: Which) -> "Samples":
        """The same columns of other rows of the same table.

        **Raises:** `ValueError` if there are no such rows.
        """
        chosen = _chosen(self.table, which)
        if not chosen.any():
            raise ValueError(_nothing(self.table, which))
        return replace(self, frame=self.table.loc[chosen], which=which)

    def values(self) -> Float[np.ndarray, "n k"]:
        """Ordered columns as they are; NaN where absent."""
        names = [column.name for column in self.ordered]
        return self.frame[names].to_numpy(np.float64).reshape(len(self), len(names))

    def scaling(
        self, scale: Scale = "range"
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Offset and width of each ordered column: scaled is `(value - offset) / width`.

        - `"range"`: range in the feature space, or of the whole table where that is not known;
        - `"rows"`: least and greatest of the rows looked at (VerifAI's `build_normalized`);
        - `"standard"`: mean and standard deviation (of the population) of the rows;
        - `"raw"`: 0 and 1.

        The width of a column that does not vary is 1.

        **Raises:** `ValueError` for another scale.
        """
        if scale not in SCALES:
            raise ValueError(f"scale must be one of {', '.join(map(repr, SCALES))}; got {scale!r}")
        values = self.values()
        if scale == "raw":
            return np.zeros(values.shape[1]), np.ones(values.shape[1])
        if scale == "range":
            offset = np.array([column.near for column in self.ordered], np.float64)
            width = np.array([column.far for column in self.ordered], np.float64) - offset
        else:
            ends = [_statistics(values[:, j], scale) for j in range(values.shape[1])]
            offset, width = np.array(ends, np.float64).reshape(-1, 2).T
        return offset, np.where(width > 0, width, 1.0)

    def matrix(self, scale: Scale = "range") -> Float[np.ndarray, "n k"]:
        """Ordered columns, scaled; an absent entry is the mean of the present ones."""
        offset, width = self.scaling(scale)
        scaled = (self.values() - offset) / width
        absent = np.isnan(scaled)
        if absent.any():
            present = np.maximum((~absent).sum(axis=0), 1)
            means = np.where(absent, 0.0, scaled).sum(axis=0) / present
            scaled = np.where(absent, means, scaled)
        return scaled

    def codes(self) -> Int[np.ndarray, "n m"]:
        """Unordered columns as places in their `choices`; -1 where absent."""
        codes = [column.codes(self.frame[column.name]) for column in self.unordered]
        return np.stack(codes, axis=1) if codes else np.zeros((len(self), 0), np.int64)

    def points(self, scale: Scale = "range") -> Float[np.ndarray, "n d"]:
        """All columns, so that Euclidean distances treat ordered and unordered ones alike.

        The squared distance of two rows is the sum over ordered columns of squared scaled
        differences, and 1 for each unordered column in which they differ. Where only one of two
        has an item, its columns count 0.75 to 1 each; where neither has it, 0.
        """
        return embed(self, self.frame, scale)

    def need_ordered(self, purpose: str) -> None:
        """Raise `ValueError` unless there is an ordered column; `purpose` begins the message."""
        if not self.ordered:
            raise ValueError(
                f"{purpose} needs an ordered column (numbers); "
                f"{_listed(self.names)} {'are' if len(self.names) > 1 else 'is'} unordered"
            )

    def need_unordered(self, purpose: str) -> None:
        """Raise `ValueError` unless there is an unordered column."""
        if not self.unordered:
            raise ValueError(
                f"{purpose} needs an unordered column (choices); "
                f"{_listed(self.names)} {'are' if len(self.names) > 1 else 'is'} ordered"
            )

    def __repr__(self) -> str:
        return (
            f"Samples({len(self)} {'rows' if self.which == 'all' else self.which} of {self.name}: "
            f"ordered {_listed([c.name for c in self.ordered])}; "
            f"unordered {_listed([c.name for c in self.unordered])})"
        )


def embed(samples: Samples, frame: "pd.DataFrame", scale: Scale) -> Float[np.ndarray, "n d"]:
    """Other rows in the coordinates of `samples.points(scale)`."""
    parts = []
    offset, width = samples.scaling(scale)
    middles: Any = np.full(len(samples.ordered), 0.5)
    if scale == "raw" or scale == "standard":
        middles = samples.matrix(scale).mean(axis=0)
    for j, column in enumerate(samples.ordered):
        entries: Any = frame[column.name]
        scaled = (entries.to_numpy(np.float64) - offset[j]) / width[j]
        absent = np.isnan(scaled)
        parts.append(np.where(absent, middles[j], scaled))
        if _has_absent(samples.table[column.name]):
            parts.append(_ABSENT * absent)
    for column in samples.unordered:
        # Two different rows of the unit matrix are the square root of two apart.
        unit = np.eye(len(column.choices) + 1) / np.sqrt(2)
        parts += list(unit[column.codes(frame[column.name])].T)
    return np.stack(parts, axis=1) if parts else np.zeros((len(frame), 0))


def whole(value: Any, what: str, least: int = 1) -> int:
    """A whole number of at least `least`; `what` names it in the error."""
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool) or number < least:
        raise ValueError(f"{what} must be a whole number of at least {least}; got {value!r}")
    return number


def _described(
    table: "pd.DataFrame", names: Sequence[str], space: FeatureSpace | None
) -> tuple[Column, ...]:
    if isinstance(names, str):
        raise ValueError(f"columns are given as a list of names; got {names!r}")
    twice = [name for i, name in enumerate(names) if name in list(names)[:i]]
    if twice:
        raise ValueError(f"column {twice[0]!r} is named twice")
    if not names:
        raise ValueError("there is no column to analyse: no feature varies")
    check_names("column", names, map(str, table.columns))
    return describe_columns(table, names, space)


def _verdicts(table: "pd.DataFrame") -> tuple[np.ndarray, np.ndarray]:
    """Which rows violate the property, and which keep it."""
    judged = np.ones(len(table), bool)
    if "status" in table:
        judged = np.asarray(table["status"] == "ok", bool)
    if "violated" in table:
        violated = np.asarray(table["violated"], bool)
    elif "rho" in table:
        rho = np.asarray(table["rho"], np.float64)
        judged &= ~np.isnan(rho)
        violated = rho < 0
    else:
        violated = np.ones(len(table), bool)
    return judged & violated, judged & ~violated


def _chosen(table: "pd.DataFrame", which: str) -> np.ndarray:
    violating, safe = _verdicts(table)
    if which == "counterexamples":
        return violating
    if which == "safe":
        return safe
    return violating | safe if which == "all" else ~(violating | safe)


def _nothing(table: "pd.DataFrame", which: str) -> str:
    if not len(table):
        return "the table is empty: there are no simulations to analyse"
    violating, safe = (int(part.sum()) for part in _verdicts(table))
    what = {"safe": "safe rows", "failed": "rows without a verdict", "all": "rows with a verdict"}
    return (
        f"no {what.get(which, which)} among {len(table):,} simulations ({violating:,} "
        f"counterexamples, {safe:,} safe, {len(table) - violating - safe:,} without a verdict); "
        "which=... looks at other rows"
    )


def _statistics(values: np.ndarray, scale: str) -> tuple[float, float]:
    present = values[~np.isnan(values)]
    if not len(present):
        return 0.0, 1.0
    if scale == "rows":
        return float(present.min()), float(present.max() - present.min())
    # All equal entries have a deviation of zero only up to rounding.
    deviation = float(present.std()) if present.min() < present.max() else 0.0
    return float(present.mean()), deviation


def _has_absent(entries: Any) -> bool:
    return bool(entries.isna().any())


def _listed(names: Sequence[str], most: int = 8) -> str:
    shown = ", ".join(names[:most]) + (f", and {len(names) - most} more" if names[most:] else "")
    return shown or "none"
