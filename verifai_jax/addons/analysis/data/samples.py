"""The rows of an error table selected for an analysis, and their features as matrices.

    samples = Samples.of(run)                            # its counterexamples
    samples = Samples.of(frame, "safe", ["x", "alg"])    # any DataFrame with feature columns
    samples.matrix()                                     # ordered columns in [0, 1], [n, k]
    samples.codes()                                      # unordered columns as integers, [n, m]
    samples.points()                                     # all columns, for Euclidean distances

Results always use row numbers of the table (`samples.rows`), never indices among the selected rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.analysis.data.columns import Column, describe_columns, feature_columns
from verifai_jax.addons.analysis.data.verdicts import explain_empty, select_rows, standing, verdicts
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import check_names
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem

Which = Literal["counterexamples", "safe", "failed", "all"]
Scale = Literal["range", "rows", "standard", "raw"]
WHICH = ("counterexamples", "safe", "failed", "all")
SCALES = ("range", "rows", "standard", "raw")
Seed: TypeAlias = int | np.integer | np.random.Generator | jax.Array
"""An integer, a NumPy generator or a `jax.random` key."""
# With it an absent entry is 0.87 to 1 away from every present one of a column in [0, 1].
_ABSENT = np.sqrt(3) / 2


@dataclass(frozen=True, eq=False)
class Samples:
    """Rows of a table, and those of its columns that are analysed; made by `Samples.of`.

    **Fields:** `frame`: the selected rows, with all columns of the table and the row numbers as
    index; `columns`: the analysed columns; `which`: the kind of the rows; `name` of the run;
    `table`: the whole table; `space` of the features, if known.

    Missing entries (NaN, None) are absent items of arrays of variable length. `matrix` replaces
    them by the mean of the rows that have the item, so they add nothing to a covariance; `codes`
    has -1; in `points`, absence is a value of its own.
    """

    frame: pd.DataFrame
    columns: tuple[Column, ...]
    which: str
    name: str
    table: pd.DataFrame
    space: FeatureSpace | None = None

    @classmethod
    def of(
        cls, source: "Source", which: Which = "counterexamples",
        columns: Sequence[str] | None = None, space: Problem | FeatureSpace | None = None,
    ) -> "Samples":  # fmt: skip
        """Select samples of a run, of its table, or of any DataFrame with feature columns.

        **Arguments:**
        - `source`: a run, its table, a DataFrame with feature columns and row numbers as index, or
          `Samples`, which are returned unchanged, or with other `columns` if these are given.
        - `which`: `"counterexamples"`, `"safe"`, `"failed"` (rows without a verdict), or `"all"`
          rows with a verdict. In a DataFrame they are recognised by the columns `violated` and
          `status`, else by `rho < 0`; without either, all rows are counterexamples.
        - `columns`: the columns to analyse; by default all features. The robustness, `"rho"` and
          `"rho.NAME"`, is included only if named here.
        - `space`: the feature space, which determines the ordered columns and their ranges; a run
          has its own.
        **Raises:** `TypeError` for another source; `ValueError` for another `which`, rows of a run
        that have changed since they were written, no rows, row numbers that are not unique
        integers, unknown columns (with the nearest names), or columns named twice.
        """
        if isinstance(source, Samples):
            if columns is None:
                return source
            described = _columns(source.table, columns, source.space)
            return replace(source, columns=described)
        if which not in WHICH:
            raise ValueError(f"which must be one of {', '.join(map(repr, WHICH))}; got {which!r}")
        name = "table"
        rows = source.table if isinstance(source, Run) else source
        if isinstance(rows, ErrorTable) and rows.changed:
            raise ValueError(
                f"rows that have changed say nothing: {rows.damage}. Their DataFrame, .table.all, "
                "is analysed as it is"
            )
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
        described = _columns(table, features if columns is None else columns, space)
        rows = select_rows(table, which)
        if not rows.any():
            raise ValueError(explain_empty(table, which))
        return cls(table.loc[rows], described, which, name, table, space)

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
        """Verdicts of the selected rows: True for counterexamples."""
        return verdicts(self.table)[0][self.table.index.get_indexer(self.frame.index)]

    @cached_property
    def rho(self) -> Float[np.ndarray, " n"]:
        """Robustness of the rows; NaN if the table has none."""
        if "rho" not in self.frame:
            return np.full(len(self), np.nan)
        return self.frame["rho"].to_numpy(np.float64)

    @property
    def worst(self) -> int:
        """Index (not the row number) of the row with the least robustness; 0 if none has any."""
        return int(np.argmin(np.nan_to_num(self.rho, nan=np.inf)))

    def others(self, which: Which) -> "Samples":
        """Select the same columns of other rows in the same table.

        **Raises:** `ValueError` if there are no such rows.
        """
        rows = select_rows(self.table, which)
        if not rows.any():
            raise ValueError(explain_empty(self.table, which))
        return replace(self, frame=self.table.loc[rows], which=which)

    def at(self, rows: Sequence[int] | Int[np.ndarray, " k"]) -> pd.DataFrame:
        """Return rows of the table by their numbers, in this order.

        **Raises:** `IndexError` for a row number that is not in the table.
        """
        numbers = np.asarray(rows).reshape(-1)
        indices = self.table.index.get_indexer(numbers)
        if (indices < 0).any():
            stray = numbers[np.argmin(indices)]
            raise IndexError(f"row {stray} is not in the table of {len(self.table):,} rows")
        return self.table.iloc[indices]

    @property
    def kind(self) -> str:
        """A description of the rows, such as `"12 counterexamples of cart-pole"`."""
        nouns = {
            "failed": ("row without a verdict", "rows without a verdict"),
            "all": ("row", "rows"),
            "safe": ("safe row", "safe rows"),
            "counterexamples": ("counterexample", "counterexamples"),
        }
        one, several = nouns[self.which]
        left = int(np.sum(standing(self.frame)[0].not_replayed))
        if left and self.which == "counterexamples":
            return f"{len(self):,} failing rows of {self.name}, {left:,} of them not replayed"
        words = one if len(self) == 1 else several
        return f"{len(self):,} {words} of {self.name}"

    def values(self) -> Float[np.ndarray, "n k"]:
        """Return the ordered columns unscaled; NaN if absent."""
        names = [column.name for column in self.ordered]
        return self.frame[names].to_numpy(np.float64).reshape(len(self), len(names))

    def scaling(
        self, scale: Scale = "range"
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Return offset and width of each ordered column; scaled is `(value - offset) / width`.

        - `"range"`: the range in the feature space, or of the whole table if that is not known;
        - `"rows"`: minimum and maximum of the selected rows (VerifAI's `build_normalized`);
        - `"standard"`: mean and (population) standard deviation of the rows;
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
        """Return the ordered columns, scaled; an absent entry is the mean of the present ones."""
        offset, width = self.scaling(scale)
        scaled = (self.values() - offset) / width
        absent = np.isnan(scaled)
        if absent.any():
            present = np.maximum((~absent).sum(axis=0), 1)
            means = np.where(absent, 0.0, scaled).sum(axis=0) / present
            scaled = np.where(absent, means, scaled)
        return scaled

    def codes(self) -> Int[np.ndarray, "n m"]:
        """Return the unordered columns as indices in their `choices`; -1 where absent."""
        return self.embed()[1]

    def points(self, scale: Scale = "range") -> Float[np.ndarray, "n d"]:
        """Return all columns such that Euclidean distances treat ordered and unordered ones alike.

        The squared distance of two rows is the sum of squared scaled differences of ordered
        columns, plus 1 for each unordered column in which they differ. If only one of two rows has
        an item, each of its columns counts 0.75 to 1; if neither has it, 0.
        """
        coordinates, codes = self.embed(scale)
        parts = [coordinates]
        for column, code in zip(self.unordered, codes.T, strict=True):
            # Two different rows of the unit matrix are the square root of two apart.
            parts.append((np.eye(len(column.choices) + 1) / np.sqrt(2))[code])
        return np.concatenate(parts, axis=1)

    def embed(
        self, scale: Scale = "range", frame: pd.DataFrame | None = None
    ) -> tuple[Float[np.ndarray, "n p"], Int[np.ndarray, "n m"]]:
        """Return coordinates of ordered columns and codes of unordered ones; see `distances`.

        - `frame`: other rows, to be embedded in the same coordinates.
        """
        offset, width = self.scaling(scale)
        middles: Any = np.full(len(self.ordered), 0.5)
        if scale in ("raw", "standard"):
            middles = self.matrix(scale).mean(axis=0)
        rows: Any = self.frame if frame is None else frame
        parts = []
        for j, column in enumerate(self.ordered):
            scaled = (rows[column.name].to_numpy(np.float64) - offset[j]) / width[j]
            absent = np.isnan(scaled)
            parts.append(np.where(absent, middles[j], scaled))
            if bool(self.table[column.name].isna().any()):
                parts.append(_ABSENT * absent)
        coordinates = np.stack(parts, axis=1) if parts else np.zeros((len(rows), 0))
        codes = [column.codes(rows[column.name]) for column in self.unordered]
        return coordinates, (
            np.stack(codes, axis=1) if codes else np.zeros((len(rows), 0), np.int64)
        )

    def need_ordered(self, purpose: str) -> None:
        """Check that an ordered column exists; `purpose` says in the error what needs it.

        **Raises:** `ValueError` if there is none.
        """
        if not self.ordered:
            raise ValueError(
                f"{purpose} needs an ordered column (numbers); "
                f"{_listed(self.names)} {'are' if len(self.names) > 1 else 'is'} unordered"
            )

    def need_unordered(self, purpose: str) -> None:
        """Check that an unordered column exists; `purpose` says in the error what needs it.

        **Raises:** `ValueError` if there is none.
        """
        if not self.unordered:
            raise ValueError(
                f"{purpose} needs an unordered column (choices); "
                f"{_listed(self.names)} {'are' if len(self.names) > 1 else 'is'} ordered"
            )

    def __repr__(self) -> str:
        return (
            f"Samples({self.kind}: "
            f"ordered {_listed([c.name for c in self.ordered])}; "
            f"unordered {_listed([c.name for c in self.unordered])})"
        )


def distances(
    rows: tuple[Float[np.ndarray, "n p"], Int[np.ndarray, "n m"]],
    one: tuple[Float[np.ndarray, " p"], Int[np.ndarray, " m"]],
) -> Float[np.ndarray, " n"]:
    """Return distances of rows from one row, both as returned by `Samples.embed`; see `points`."""
    squared = ((rows[0] - one[0]) ** 2).sum(axis=1) + (rows[1] != one[1]).sum(axis=1)
    return np.sqrt(squared)


Source: TypeAlias = Run | ErrorTable | pd.DataFrame | Samples
"""A run, its table, a DataFrame with feature columns, or samples of one of them."""


def with_columns(frame: pd.DataFrame, own: pd.DataFrame) -> pd.DataFrame:
    """Append the columns of `own` to those of `frame`; names that are taken get `_` appended."""
    return frame.join(own.rename(columns={name: f"{name}_" for name in own if name in frame}))


def generator(seed: Seed) -> np.random.Generator:
    """Make a NumPy generator from a seed or a `jax.random` key; equal seeds give equal ones.

    **Raises:** `ValueError` for anything else.
    """
    if isinstance(seed, np.random.Generator):
        return seed
    if isinstance(seed, jax.Array):
        keyed = jnp.issubdtype(seed.dtype, jax.dtypes.prng_key)
        data = np.asarray(jax.random.key_data(seed) if keyed else seed)
        return np.random.default_rng([int(word) for word in data.ravel()])
    return np.random.default_rng(check_count("the seed", seed, 0))


def _columns(
    table: pd.DataFrame, names: Sequence[str], space: FeatureSpace | None
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


def _statistics(values: np.ndarray, scale: str) -> tuple[float, float]:
    present = values[~np.isnan(values)]
    if not len(present):
        return 0.0, 1.0
    if scale == "rows":
        return float(present.min()), float(present.max() - present.min())
    # All equal entries have a deviation of zero only up to rounding.
    deviation = float(present.std()) if present.min() < present.max() else 0.0
    return float(present.mean()), deviation


def _listed(names: Sequence[str], maximum: int = 8) -> str:
    shown = ", ".join(names[:maximum]) + (
        f", and {len(names) - maximum} more" if names[maximum:] else ""
    )
    return shown or "none"
