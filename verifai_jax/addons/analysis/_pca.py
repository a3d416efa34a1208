"""Principal components: the directions in which failing features vary together.

    components = pca(run)
    components.table                       loadings, deviation and share of each direction
    components.generate(0, 100)            new features along the directions: a DataFrame
    components.plot()

Jolliffe, Principal Component Analysis, 2nd edition, 2002. New samples from principal components
are how VerifAI augments data: Dreossi et al., VerifAI: a toolkit for the design and analysis of
artificial intelligence-based systems, CAV 2019.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from verifai_jax.addons.analysis.data.columns import feature_columns
from verifai_jax.addons.analysis.data.samples import (
    Samples,
    Scale,
    Seed,
    Source,
    Which,
    generator,
    with_columns,
)
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_count, check_positive
from verifai_jax.core.messages.text import format_percent
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem

SHOWN = 5
"""Components that are described, and compared with chance."""
CHANCE = 0.99
"""Share of tables of unrelated features whose components explain less than a telling one does."""
_TABLES = 300
"""Such tables that are drawn."""
_NOTHING = 1e-12
"""Share of the total variance below which a component is rounding."""
_REDRAWS = 32
"""Rounds in which draws outside the bounds are drawn again."""


@dataclass(frozen=True, eq=False)
class Components(Drawn, InNotebook):
    """Principal components of the ordered features of `samples`, the strongest first.

    **Fields:** `pivot` `[k]`: mean of the rows, in units of the features; `directions` `[m, k]`:
    orthonormal in the scaled coordinates, with the largest entry of each positive; `deviations`
    `[m]`: standard deviation along each, in the scaled coordinates; `shares` `[m]` of the total
    variance; `offset` and `width` `[k]` of the scaling; `telling`: number of the first five
    components that explain more variance than chance: a component does if it exceeds the first
    component of independent features with the same deviations, after the earlier components were
    removed (Horn's parallel analysis, Psychometrika 30, 1965, at 99 %).

    Only directions in which the rows vary are included: none if all rows are equal.
    """

    _picture = "verifai_jax.addons.analysis.pictures.pca", "plot_components"
    """The rows along the first two components, and the loadings."""
    samples: Samples
    pivot: Float[np.ndarray, " k"]
    directions: Float[np.ndarray, "m k"]
    deviations: Float[np.ndarray, " m"]
    shares: Float[np.ndarray, " m"]
    offset: Float[np.ndarray, " k"]
    width: Float[np.ndarray, " k"]
    scale: Scale
    telling: int

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the `k` columns."""
        return tuple(column.name for column in self.samples.ordered)

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row for each component: its loadings, its deviation and its share of the variance."""
        index = pd.RangeIndex(1, len(self.directions) + 1, name="component")
        table = pd.DataFrame(self.directions, index=index, columns=list(self.names))
        own = pd.DataFrame({"deviation": self.deviations, "share": self.shares}, index=index)
        return with_columns(table, own)

    def project(self, rows: pd.DataFrame | Sequence[int] | None = None) -> pd.DataFrame:
        """Return coordinates along the components, in scaled units, as columns; 0 is the pivot.

        **Arguments:**
        - `rows`: row numbers of the table, or a DataFrame with the columns; by default the rows
          that were analysed.

        An absent entry counts as the pivot's. **Raises:** `IndexError` for a row that is not in the
        table.
        """
        frame = self.samples.frame
        if isinstance(rows, pd.DataFrame):
            frame = rows
        elif rows is not None:
            frame = self.samples.at(rows)
        values = frame[list(self.names)].to_numpy(np.float64)
        moved = np.where(np.isnan(values), 0.0, values - self.pivot) / self.width
        columns = range(1, len(self.directions) + 1)
        return pd.DataFrame(moved @ self.directions.T, index=frame.index, columns=list(columns))

    def generate(self, seed: Seed, n: int, spread: float = 1.0) -> pd.DataFrame:
        """Draw features from a normal distribution along the components, within the space's bounds.

        **Arguments:**
        - `seed`: an integer, a NumPy generator or a `jax.random` key.
        - `n`: number of draws.
        - `spread`: factor on the standard deviations of the rows.

        Draws outside the bounds (of the space, or of the whole table if no space is known) are
        repeated; after 32 rounds a draw moves towards the pivot until it is inside. Whole numbers
        are rounded. All other features, including choices and the number of items of arrays, are
        those of the nearest analysed row. Draws that break a constraint of the space are repeated
        too, and replaced by the nearest row after 32 rounds. The columns are all features, so
        `space.from_row` accepts a row.

        **Raises:** `ValueError` for `n < 0` or a spread that is not a positive finite number.
        """
        check_count("the number of samples", n, 0)
        check_positive("spread", spread, finite=True)
        rng = generator(seed)
        found, donors = self._features(self._draw(rng, n, spread))
        for turn in range(_REDRAWS + 1):
            again = np.flatnonzero(~_accepted(self.samples.space, found))
            if not len(again):
                break
            new, others = self._features(self._draw(rng, len(again), spread))
            if turn == _REDRAWS:
                new = self.samples.frame.iloc[donors[again]][list(found.columns)]
            donors[again] = others
            rest = found.drop(index=again)
            found = pd.concat([rest, new.set_index(again)]).sort_index()
        return found.rename_axis(index="sample")

    def _draw(self, rng: np.random.Generator, n: int, spread: float) -> Float[np.ndarray, "n k"]:
        """Draw values of the ordered columns within the bounds."""
        low, high = self._bounds
        steps = self.directions * self.width

        def normal(count: int) -> np.ndarray:
            return rng.normal(0, spread, (count, len(steps))) * self.deviations @ steps

        moves = normal(n)
        for _ in range(_REDRAWS):
            values = self.pivot + moves
            outside = ((values < low) | (values > high)).any(axis=1)
            if not outside.any():
                break
            moves[outside] = normal(int(outside.sum()))
        # The pivot is inside, and the bounds are convex: some fraction of the way is inside too.
        room = np.where(moves > 0, high - self.pivot, self.pivot - low)
        ratio = np.divide(room, np.abs(moves), out=np.ones_like(moves), where=moves != 0)
        fraction = np.clip(ratio, 0, 1).min(axis=1, initial=1)
        return np.clip(self.pivot + moves * fraction[:, None], low, high)

    def _features(
        self, values: Float[np.ndarray, "n k"]
    ) -> tuple[pd.DataFrame, Int[np.ndarray, " n"]]:
        """Return all features with these ordered values, and the rows that lend the others."""
        donors = self._nearest(values)
        names = feature_columns(self.samples.table, self.samples.space)
        found: Any = self.samples.frame.iloc[donors][list(names)].reset_index(drop=True)
        for j, column in enumerate(self.samples.ordered):
            if column.name not in names or column.length:
                continue
            kept = np.asarray(found[column.name], np.float64)
            new = np.where(np.isnan(kept), np.nan, values[:, j])
            if column.integer:
                new = np.round(new) if np.isnan(new).any() else np.round(new).astype(np.int64)
            found[column.name] = new
        return found, donors

    @cached_property
    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the space; of the table where none is known."""
        columns = self.samples.ordered
        low = [column.low if column.known else column.near for column in columns]
        high = [column.high if column.known else column.far for column in columns]
        # A table may hold rows outside the space: the pivot has to be inside.
        return np.minimum(low, self.pivot), np.maximum(high, self.pivot)

    def _nearest(self, values: np.ndarray) -> np.ndarray:
        from scipy.spatial import KDTree

        tree = KDTree(self.samples.matrix("raw") / self.width)
        return np.asarray(tree.query(values / self.width)[1], np.int64)

    def __str__(self) -> str:
        lines = [
            f"{len(self.directions)} principal components of {self.samples.kind}, "
            f"over {len(self.names)} ordered columns"
        ]
        for i, direction in enumerate(self.directions[:SHOWN]):
            order = np.argsort(-np.abs(direction), kind="stable")
            parts = [
                f"{direction[j]:+z.2f} {self.names[j]}" for j in order if abs(direction[j]) >= 0.05
            ]
            rest = ", ..." if len(parts) > 4 else ""
            chance = "" if i < self.telling else ", no more than chance"
            lines.append(
                f"  {i + 1}: {format_percent(self.shares[i])} of variance{chance}: "
                f"{', '.join(parts[:4])}{rest}"
            )
        if not len(self.directions):
            lines.append("  the rows do not vary")
        elif not self.telling:
            lines.append(
                "  no direction explains more than chance: as far as these rows show, no columns "
                "vary together"
            )
        return "\n".join(lines)


def pca(
    source: Source,
    components: int | None = None,
    columns: Sequence[str] | None = None,
    which: Which = "counterexamples",
    scale: Scale = "range",
    space: Problem | FeatureSpace | None = None,
) -> Components:
    """Compute principal components of the ordered features.

    **Arguments:**
    - `source`: a run, its table, a DataFrame with feature columns, or `Samples`.
    - `columns`, `which`, `space`: as in `Samples.of`. Unordered columns are left out.
    - `components`: number of components; by default all in which the rows vary, the maximum.
    - `scale`: `"range"` scales features by their range in the space, `"raw"` does not scale (as
      VerifAI), `"standard"` gives the components of the correlation matrix, `"rows"` scales by the
      range of the rows.
    **Returns:** `Components`.
    **Raises:** `ValueError` without an ordered column, or for more components than rows or columns.
    """
    samples = Samples.of(source, which, columns, space)
    samples.need_ordered("principal component analysis")
    offset, width = samples.scaling(scale)
    scaled = samples.matrix(scale)
    maximum = min(scaled.shape)
    if components is not None and check_count("components", components) > maximum:
        raise ValueError(
            f"components must be from 1 to {maximum}, the lesser of {scaled.shape[0]} rows and "
            f"{scaled.shape[1]} ordered columns; got {components}"
        )
    mean = scaled.mean(axis=0)
    # The mean of equal numbers is not always that number.
    constant = scaled.min(axis=0) == scaled.max(axis=0)
    mean = np.where(constant, scaled[0], mean)
    _, singular, directions = np.linalg.svd(scaled - mean, full_matrices=False)
    variances = singular**2 / max(len(scaled) - 1, 1)
    kept = variances > _NOTHING * variances.sum()
    directions = np.where(constant, 0.0, directions[kept][:components])
    largest = np.argmax(np.round(np.abs(directions), 9), axis=1)
    signs = np.sign(np.take_along_axis(directions, largest[:, None], axis=1))
    telling = min(_telling(scaled - mean, directions), components or SHOWN)
    variances, total = variances[kept][:components], variances.sum()
    return Components(
        samples=samples,
        pivot=mean * width + offset,
        directions=directions * signs + 0.0,  # No negative zeros.
        deviations=np.sqrt(variances),
        shares=variances / total if total > 0 else variances,
        offset=offset,
        width=width,
        scale=scale,
        telling=telling,
    )


def _telling(moved: Float[np.ndarray, "n k"], directions: Float[np.ndarray, "m k"]) -> int:
    """Return how many of the first components explain more than independent columns would.

    Covariances of these are normal, with a deviation of the product of those of the columns over
    the root of the rows.
    """
    count, k = moved.shape
    if count < 3 or k < 2:
        return 0
    drawn = np.random.default_rng(0).normal(size=(_TABLES, k, k)) / np.sqrt(count - 1)
    upper = np.triu(drawn, 1)
    correlations = upper + np.swapaxes(upper, 1, 2) + np.eye(k)
    for i, direction in enumerate(directions[:SHOWN]):
        deviations = np.sqrt((moved**2).sum(axis=0) / (count - 1))
        chance = np.linalg.eigvalsh(correlations * np.outer(deviations, deviations))[:, -1]
        along = moved @ direction
        if not (along**2).sum() / (count - 1) > np.quantile(chance, CHANCE):
            return i
        moved = moved - np.outer(along, direction)
    return min(SHOWN, len(directions))


def _accepted(space: FeatureSpace | None, frame: pd.DataFrame) -> np.ndarray:
    """Return the rows that keep the constraint of the space, if it has one."""
    if space is None or space.where is None or not len(frame):
        return np.ones(len(frame), bool)
    rows: Any = frame.to_dict("records")
    features = [space.from_row(row) for row in rows]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *features)
    return np.asarray(jax.vmap(space.accepts)(stacked), bool)
