"""How well the samples cover the feature space: how evenly, where the holes are, what is untried.

found = coverage(run)
found.hole                  features in the middle of the largest hole
found.untried               values and pairs of values that no row has
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.analysis.marginals import Marginal, marginals
from verifai_jax.analysis.samples import Samples, whole

if TYPE_CHECKING:
    import pandas as pd

    from verifai_jax.run import Run
    from verifai_jax.table import ErrorTable

MOST_ROWS = 2000
MOST_ENTRIES = 8e7
"""Rows that the discrepancy is computed from, and what their square times the features may be."""
MOST_VALUES = 20
"""Values up to which each one of a discrete feature is a cell of its own."""
MOST_FEATURES = 60
"""Features up to which all of their pairs are counted."""
PROBES = 4096
REPEATS = 8
MOST_UNTRIED = 1000
MOST_LISTED = 5
MOST_NAMED = 8
MOST_TREE = 8  # Dimensions up to which a tree finds neighbours faster than brute force.
BLOCK = 4096
REFINED = 4


@dataclass(frozen=True, eq=False)
class Coverage:
    """How well the rows cover the feature space.

    **Fields:** `table`: one row a feature, with the number of its `cells`, the share of them
    `occupied`, the share of pairs of cells with other features (`pairs`), and the share that as
    many uniform samples would occupy (`expected`, `expected_pairs`); `untried`: the discrete values
    and pairs of values that no row has, at most 1000 of `untried_count`; `discrepancy`: squared
    centred L2 discrepancy over that expected of as many uniform samples: 1 for those, less where
    the rows are more even, much more where they crowd; `dispersion`: radius of the largest empty
    ball of the ordered features, in unit coordinates, and `uniform_dispersion` that of as many
    uniform samples; `hole`: the features in its middle; all None without ordered features;
    `samples`.
    """

    table: "pd.DataFrame"
    untried: "pd.DataFrame"
    untried_count: int
    discrepancy: float
    dispersion: float | None
    uniform_dispersion: float | None
    hole: dict[str, Any] | None
    samples: Samples

    @property
    def occupied(self) -> float:
        """Share of all pairs of cells that some row lies in; of cells with a single feature."""
        column = "pairs" if len(self.table) > 1 else "occupied"
        return float(np.nanmean(self.table[column].to_numpy(float)))

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw how often each cell is occupied, and the least occupied pair; returns the figure."""
        from verifai_jax.analysis.coverage_plot import plot_coverage

        return plot_coverage(self, path)

    def __str__(self) -> str:
        from verifai_jax.run import told

        expected = "expected_pairs" if len(self.table) > 1 else "expected"
        what = "pairs of cells" if len(self.table) > 1 else "cells"
        share, uniform = self.occupied, float(np.nanmean(self.table[expected].to_numpy(float)))
        lines = [
            f"{len(self.samples):,} rows of {self.samples.name!r} lie in {100 * share:.0f} % of "
            f"all {what} ({100 * uniform:.0f} % if they were uniform), "
            + _evenness(self.discrepancy)
        ]
        if self.hole is not None:
            where = told(dict(list(self.hole.items())[:MOST_NAMED]))
            lines.append(
                f"largest hole: nothing within {self.dispersion:.2f} in unit coordinates "
                f"({self.uniform_dispersion:.2f} if uniform) around {where}"
                + (", ..." if len(self.hole) > MOST_NAMED else "")
            )
        shares = self.table["occupied"].to_numpy(float)
        if shares.min() < 1:
            worst = self.table.index[int(shares.argmin())]
            lines.append(f"least covered feature: {worst}, {100 * shares.min():.0f} % of its cells")
        if self.untried_count:
            shown = [_words(row) for row in self.untried.head(MOST_LISTED).to_dict("records")]
            more = self.untried_count - len(shown)
            lines.append("never tried: " + "; ".join(shown) + (f"; and {more:,} more" * (more > 0)))
        if getattr(self.samples.space, "where", None) is not None:
            lines.append("what the constraint of the space forbids counts as not covered")
        return "\n".join(lines)


def coverage(
    source: "Run | ErrorTable | pd.DataFrame | Samples", *, cells: int = 10, seed: int = 0
) -> Coverage:
    """Measure how well samples cover the space of features.

    - `source`: a run, its table, a DataFrame, or `Samples`; of the first three all rows with a
      verdict.
    - `cells`: into how many equal parts the range of a feature is cut, fewer where rows are too few
      to fill them; a discrete feature of up to 20 values has a cell for each.

    Uniform means distributed by the prior: coordinates are those in which it is uniform, or shares
    of the ranges in the table where no space is known. A constraint between features is not known
    here: what it forbids counts as not covered. Absent entries are left out feature by feature, and
    are in the middle where a point is needed. The discrepancy is of 2000 rows at most, drawn by
    `seed`, with a discrete value spread over its cell. The hole is the emptiest of 4096 points of a
    Sobol sequence, searched further around it (of 1024 with more than 8 ordered features).

    Sources: Hickernell, A generalized discrepancy and quadrature error bound, Mathematics of
    Computation 67 (1998); its mean for uniform samples, `((5/4)^d - (13/12)^d) / n`, follows from
    the definition. Dispersion: Niederreiter, Random number generation and quasi-Monte Carlo methods
    (1992). Pairs: t-wise coverage of combinatorial testing (Kuhn, Kacker and Lei, Introduction to
    combinatorial testing, 2013).

    **Raises:** `ValueError` for no rows, no feature that varies, or fewer than 2 cells.
    """
    cells = whole(cells, "cells", 2)
    samples = Samples.of(source, "all")
    samples = _varying(samples)
    generator = np.random.default_rng(seed)
    parts = marginals(samples)
    table, untried, missing = _occupied(len(samples), _cells(samples, parts, cells))
    dispersion = uniform = hole = None
    ordered = parts[: len(samples.ordered)]
    if ordered:
        points = np.stack([part.unit(samples) for part in ordered], axis=1)
        dispersion, place = _largest_hole(points, ordered, seed)
        repeats = REPEATS if len(ordered) <= MOST_TREE else 1
        others = [
            _largest_hole(_alike(ordered, generator, len(points)), ordered, seed)[0]
            for _ in range(repeats)
        ]
        uniform = float(np.mean(others))
        hole = {
            part.column.name: part.value(float(u)) for part, u in zip(ordered, place, strict=True)
        }
    spread = np.stack([part.unit(samples, generator) for part in parts], axis=1)
    return Coverage(
        table,
        untried,
        missing,
        _discrepancy(spread, generator),
        dispersion,
        uniform,
        hole,
        samples,
    )


def _varying(samples: Samples) -> Samples:
    """Without the columns that have a single value in the space, or in a table without a space."""
    names = [
        column.name
        for column in samples.columns
        if (column.far > column.near if column.ordered else len(column.choices) > 1)
    ]
    if not names:
        raise ValueError(
            f"nothing varies among {len(samples):,} rows of {samples.name!r}: "
            f"{', '.join(samples.names)} has one value each"
        )
    return Samples.of(samples, columns=names)


def _discrepancy(unit: Float[np.ndarray, "n d"], generator: Any) -> float:
    from scipy.stats import qmc

    n, d = unit.shape
    most = int(min(MOST_ROWS, np.sqrt(MOST_ENTRIES / d)))
    if n > most:
        unit, n = unit[generator.choice(n, most, replace=False)], most
    expected = ((5 / 4) ** d - (13 / 12) ** d) / n
    return float(qmc.discrepancy(unit, method="CD") / expected)


def _largest_hole(
    points: Float[np.ndarray, "n k"], parts: Sequence[Marginal], seed: int
) -> tuple[float, Any]:
    """The greatest distance of a probe to its nearest point, and that probe."""
    from scipy.spatial import KDTree
    from scipy.stats import qmc

    k = points.shape[1]
    probes = qmc.Sobol(k, rng=seed).random(PROBES if k <= MOST_TREE else PROBES // 4)
    probes = np.stack([part.snapped(probes[:, j]) for j, part in enumerate(parts)], axis=1)
    if k <= MOST_TREE:
        tree = KDTree(points)
        distance = np.asarray(tree.query(probes)[0])
        best, radius = int(np.argmax(distance)), float(distance.max())
        for _ in range(REFINED):
            # Closer and closer around the emptiest place so far, which stays among the probes.
            radius /= 2
            near = np.clip(probes[best] + radius * (2 * probes[: PROBES // 4] - 1), 0, 1)
            near = [part.snapped(near[:, j]) for j, part in enumerate(parts)]
            probes = np.concatenate([probes[best : best + 1], np.stack(near, axis=1)])
            distance = np.asarray(tree.query(probes)[0])
            best = int(np.argmax(distance))
    else:
        # Trees do not prune in many dimensions; one matrix product a block does it.
        nearest = np.full(len(probes), np.inf)
        single = probes.astype(np.float32)
        own = np.sum(single**2, axis=1)
        for begin in range(0, len(points), BLOCK):
            block = points[begin : begin + BLOCK].astype(np.float32)
            squares = own[:, None] + np.sum(block**2, axis=1) - 2 * single @ block.T
            nearest = np.minimum(nearest, squares.min(axis=1))
        distance = np.sqrt(np.maximum(nearest, 0))
    place = int(np.argmax(distance))
    return float(distance[place]), probes[place]


def _alike(parts: Sequence[Marginal], generator: Any, n: int) -> Float[np.ndarray, "n k"]:
    """Uniform samples of the same columns."""
    return np.stack([part.snapped(generator.random(n)) for part in parts], axis=1)


class _Cells(NamedTuple):
    """One feature cut into cells: the cell of each row (-1 where absent), and their prior."""

    name: str
    ids: Int[np.ndarray, " n"]
    prior: Float[np.ndarray, " cells"]
    marginal: Marginal
    listed: bool  # Whether each cell is one value.


def _cells(samples: Samples, parts: Sequence[Marginal], most: int) -> list[_Cells]:
    # With five rows a pair of cells, uniform samples leave one in a hundred and fifty empty.
    count = int(np.clip(np.sqrt(len(samples) / 5), 2, most))
    found = []
    for part in parts:
        name = part.column.name
        if part.edges is not None and (part.count <= MOST_VALUES or not part.column.ordered):
            ids, prior = part.cells(samples), np.diff(part.edges)
            found.append(_Cells(name, ids, prior, part, True))
        else:
            ids = np.clip(np.floor(part.unit(samples) * count), 0, count - 1).astype(np.int64)
            absent = samples.frame[name].isna().to_numpy()
            prior = np.full(count, 1 / count)
            found.append(_Cells(name, np.where(absent, -1, ids), prior, part, False))
    return found


def _occupied(n: int, cut: list[_Cells]) -> tuple["pd.DataFrame", "pd.DataFrame", int]:
    """The tables of features and of what was never tried, and how much that is."""
    import pandas as pd

    d, most = len(cut), min(len(cut), MOST_FEATURES)
    counts = np.array([len(cells.prior) for cells in cut])
    together = pair_counts(np.stack([c.ids for c in cut[:most]], axis=1), counts[:most])
    edges = np.concatenate([[0], np.cumsum(counts[:most])])
    columns: dict[str, Any] = {"cells": counts}
    columns |= {name: np.full(d, np.nan) for name in _SHARES}
    untried: list[tuple[Any, ...]] = []
    missing = 0
    for i, one in enumerate(cut):
        seen = np.bincount(one.ids[one.ids >= 0], minlength=counts[i])
        columns["occupied"][i] = np.mean(seen > 0)
        columns["expected"][i] = np.mean(_chance(one.prior, n))
        if one.listed:
            never = np.flatnonzero(seen == 0)
            missing += len(never)
            untried += [(one.name, one.marginal.shown(int(cell)), "", "") for cell in never]
        shares = []
        for j, other in enumerate(cut[:most]):
            if i == j or i >= most:
                continue
            block = together[edges[i] : edges[i + 1], edges[j] : edges[j + 1]]
            shares.append(
                (np.mean(block > 0), np.mean(_chance(np.outer(one.prior, other.prior), n)))
            )
            if i < j and one.listed and other.listed:
                # A value that was never tried is not listed again with all of its partners.
                alive = np.outer(block.any(axis=1), block.any(axis=0))
                empty = np.argwhere((block == 0) & alive)
                missing += len(empty)
                for a, b in empty[: max(0, MOST_UNTRIED - len(untried))].tolist():
                    first = (one.name, one.marginal.shown(a))
                    untried.append((*first, other.name, other.marginal.shown(b)))
        if shares:
            columns["pairs"][i], columns["expected_pairs"][i] = np.mean(shares, axis=0)
    untried.sort(key=lambda entry: entry[2] != "")
    heads = ["feature", "value", "other", "other_value"]
    return (
        pd.DataFrame(columns, index=pd.Index([c.name for c in cut], name="feature")),
        pd.DataFrame(untried[:MOST_UNTRIED], columns=heads),
        missing,
    )


_SHARES = ("occupied", "expected", "pairs", "expected_pairs")


def _chance(prior: Float[np.ndarray, "*cells"], n: int) -> Float[np.ndarray, "*cells"]:
    """The probabilities that some of `n` samples of the prior lie in a cell."""
    return 1 - (1 - prior) ** n


def pair_counts(ids: Int[np.ndarray, "n d"], counts: Int[np.ndarray, " d"]) -> Any:
    """How many rows lie in each two cells of all features, `[sum of counts] * 2`."""
    edges = np.concatenate([[0], np.cumsum(counts)])[:-1]
    total = int(counts.sum())
    together = np.zeros((total, total))
    for begin in range(0, len(ids), BLOCK):
        block = ids[begin : begin + BLOCK]
        unit = np.zeros((len(block), total), np.float32)
        row, column = np.nonzero(block >= 0)
        unit[row, edges[column] + block[row, column]] = 1
        together += unit.T @ unit
    return together


def _words(row: dict[Any, Any]) -> str:
    def pair(name: str, value: Any) -> str:
        return f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}"

    words = pair(row["feature"], row["value"])
    return f"{words} with {pair(row['other'], row['other_value'])}" if row["other"] else words


def _evenness(discrepancy: float) -> str:
    if discrepancy < 0.5:
        return f"more evenly than uniform samples (discrepancy {discrepancy:.2g} times theirs)"
    if discrepancy <= 3:
        return f"as evenly as uniform samples (discrepancy {discrepancy:.2g} times theirs)"
    return f"more crowded than uniform samples (discrepancy {discrepancy:.3g} times theirs)"
