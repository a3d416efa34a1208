"""Conversion of each feature column to coordinates in `[0, 1]` in which its prior is uniform.

Intervals and choices are uniform over their range, and so is every column without a known space. In
a space with other domains the distribution function of each column is computed from 4096 points of
a Sobol sequence, which works for any domain.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from verifai_jax.addons.analysis.data.columns import Column
from verifai_jax.addons.analysis.data.samples import Samples

POINTS = 12  # As a power of two.


@dataclass(frozen=True, eq=False)
class Marginal:
    """Prior distribution of one column.

    **Fields:** `column`; `edges`: for a discrete column, the ends `[values + 1]` of its cells in
    `[0, 1]`; None for a continuous one, whose distribution function passes through `heights` at
    `knots`.
    """

    column: Column
    edges: Float[np.ndarray, " e"] | None
    knots: Float[np.ndarray, " k"]
    heights: Float[np.ndarray, " k"]

    @property
    def count(self) -> int:
        """Number of values; 0 if continuous."""
        return 0 if self.edges is None else len(self.edges) - 1

    def cells(self, samples: Samples) -> Int[np.ndarray, " n"]:
        """Return the cell of each row of a discrete column; -1 if absent."""
        entries = samples.frame[self.column.name]
        if not self.column.ordered:
            return self.column.codes(entries)
        values = entries.to_numpy(np.float64)
        cells = np.clip(np.nan_to_num(values) - self.column.near, 0, self.count - 1)
        return np.where(np.isnan(values), -1, np.round(cells)).astype(np.int64)

    def unit(
        self, samples: Samples, generator: np.random.Generator | None = None
    ) -> Float[np.ndarray, " n"]:
        """Return the rows' coordinates; discrete ones in mid-cell, or drawn by a generator.

        An absent entry gets the middle of the range.
        """
        if self.edges is not None:
            cells = self.cells(samples)
            within = 0.5 if generator is None else generator.random(len(cells))
            low, high = self.edges[cells], self.edges[cells + 1]
            return np.where(cells < 0, 0.5, low + within * (high - low))
        values = samples.frame[self.column.name].to_numpy(np.float64)
        unit = np.interp(np.nan_to_num(values), self.knots, self.heights, left=0, right=1)
        return np.where(np.isnan(values), 0.5, unit)

    def snap(self, u: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return coordinates moved to the middles of their cells, if there are cells."""
        if self.edges is None:
            return u
        cells = np.clip(np.searchsorted(self.edges, u, side="right") - 1, 0, self.count - 1)
        return (self.edges[cells] + self.edges[cells + 1]) / 2

    def value(self, u: float) -> Any:
        """Return the entry at a coordinate."""
        if self.edges is not None:
            index = int(
                np.clip(np.searchsorted(self.edges, u, side="right") - 1, 0, self.count - 1)
            )
            return self.shown(index)
        return float(np.interp(u, self.heights, self.knots))

    def shown(self, cell: int) -> Any:
        """Return the value of a discrete column as printed in the table."""
        if not self.column.ordered:
            return self.column.choices[cell]
        return int(self.column.near + cell)


def marginals(samples: Samples) -> tuple[Marginal, ...]:
    """Return the prior distributions of the columns, ordered ones first."""
    prior = _prior(samples)
    return tuple(
        _marginal(column, prior.get(column.name))
        for column in (*samples.ordered, *samples.unordered)
    )


def _prior(samples: Samples) -> dict[str, Any]:
    if samples.space is None or samples.space.root.uniform:
        return {}
    import jax.numpy as jnp
    from scipy.stats import qmc

    u = qmc.Sobol(samples.space.dim, rng=0).random_base2(POINTS)
    # One program: step by step, each of the columns would compile its own.
    features = samples.space.features_at(jnp.asarray(u, jnp.float32))
    return {name: pd.Series(v) for name, v in samples.space.rows(features).items()}


def _marginal(column: Column, prior: pd.Series | None) -> Marginal:
    none = np.zeros(0)
    if not column.ordered or column.integer:
        count = round(column.far - column.near) + 1 if column.ordered else len(column.choices)
        if prior is None:
            return Marginal(column, np.linspace(0, 1, count + 1), none, none)
        if column.ordered:
            numbers = prior.dropna().to_numpy(np.float64) - column.near
            cells = np.clip(np.round(numbers), 0, count - 1).astype(np.int64)
        else:
            cells = column.codes(prior)
            cells = cells[cells >= 0]
        share = np.bincount(cells, minlength=count) / max(len(cells), 1)
        equal = np.abs(share - 1 / count).max(initial=0) < 0.01 / count + 2**-POINTS
        edges = np.linspace(0, 1, count + 1) if equal else np.append(0, np.cumsum(share))
        return Marginal(column, edges, none, none)
    numbers = none if prior is None else np.unique(prior.dropna().to_numpy(np.float64))
    if len(numbers) < 2:
        return Marginal(column, None, np.array([column.near, column.far]), np.array([0.0, 1.0]))
    return Marginal(column, None, numbers, (np.arange(len(numbers)) + 0.5) / len(numbers))
