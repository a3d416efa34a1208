"""Coverage of the feature space: evenness of the samples, holes, and untried values.

    found = coverage(run)
    found.hole                  features in the middle of the largest hole
    found.untried               values and pairs of values that no row has

The radius of the largest hole is the dispersion of the points: Niederreiter, Random number
generation and quasi-Monte Carlo methods (1992).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from verifai_jax.addons.analysis.data.cells import count_occupied, cut
from verifai_jax.addons.analysis.data.marginals import Marginal, marginals
from verifai_jax.addons.analysis.data.samples import Samples, Source
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.text import format_features, format_percent

MAX_ROWS = 2000
MAX_ENTRIES = 8e7
"""Rows that the discrepancy is computed from, and what their square times the features may be."""
REPEATS = 8
"""Sets of uniform samples whose dispersion is averaged ..."""
REPEATED = 100_000
"""... fewer where together they have more points than this: chance then hardly matters."""
ALLOWED = 8192
"""Samples drawn that fulfil a constraint."""
MIN_ACCEPTED = 0.005
"""Share of the space that a constraint must leave to be taken into account."""
MAX_LISTED = 5
"""Untried values written in words."""
MAX_NAMED = 8
"""Features named in words."""


@dataclass(frozen=True, eq=False)
class Coverage(Drawn, InNotebook):
    """Coverage of the feature space by the rows of a table.

    **Fields:** `table`: one row for each feature, with the number of its `cells`, the share of them
    that is `occupied`, the share of occupied pairs of cells with other features (`pairs`), the
    shares that as many uniform samples would occupy (`expected`, `expected_pairs`), and how much of
    the prior (`mass`) and of the range (`volume`) lies in occupied cells and pairs of cells
    (`pairs_mass`, `pairs_volume`); `untried`: the discrete values and pairs of values that no row
    has, at most 1000 of `untried_count`; `discrepancy`: squared centred L2 discrepancy divided by
    that expected of as many uniform samples: about 1 for uniform rows, less for more even ones,
    much more for clustered ones; `dispersion`: radius of the largest empty ball of the ordered
    features, in unit coordinates, and `uniform_dispersion` that for as many uniform samples;
    `hole`: the features at its centre; all None without ordered features; `samples`.
    """

    _picture = "verifai_jax.addons.analysis.pictures.coverage", "plot_coverage"
    """How often each cell is occupied, and the least occupied pair."""
    table: pd.DataFrame
    untried: pd.DataFrame
    untried_count: int
    discrepancy: float
    dispersion: float | None
    uniform_dispersion: float | None
    hole: dict[str, Any] | None
    samples: Samples

    @property
    def occupied(self) -> float:
        """Share of occupied pairs of cells; of occupied cells if there is a single feature."""
        column = "pairs" if len(self.table) > 1 else "occupied"
        return float(np.nanmean(self.table[column].to_numpy(float)))

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        expected = "expected_pairs" if len(self.table) > 1 else "expected"
        what = "pairs of cells" if len(self.table) > 1 else "cells"
        share, uniform = self.occupied, float(np.nanmean(self.table[expected].to_numpy(float)))
        lines = [
            f"{len(self.samples):,} rows of {self.samples.name!r} lie in {format_percent(share)} "
            f"of all {what} ({format_percent(uniform)} if they were uniform), "
            + _describe_evenness(self.discrepancy)
        ]
        pairs = "pairs_" * (len(self.table) > 1)
        mass, volume = (np.nanmean(self.table[f"{pairs}{n}"]) for n in ("mass", "volume"))
        if min(mass, volume) < 1:
            lines.append(
                f"these take {format_percent(float(mass))} of the prior and "
                f"{format_percent(float(volume))} of the volume"
            )
        if self.hole is not None:
            where = format_features(dict(list(self.hole.items())[:MAX_NAMED]))
            lines.append(
                f"largest hole: nothing within {self.dispersion:z.2f} in unit coordinates "
                f"({self.uniform_dispersion:z.2f} if uniform) around {where}"
                + (", ..." if len(self.hole) > MAX_NAMED else "")
            )
        shares = self.table["occupied"].to_numpy(float)
        if shares.min() < 1:
            worst = self.table.index[int(shares.argmin())]
            lines.append(
                f"least covered feature: {worst}, {format_percent(shares.min())} of its cells"
            )
        if self.untried_count:
            shown = [_describe_row(row) for row in self.untried.head(MAX_LISTED).to_dict("records")]
            more = self.untried_count - len(shown)
            lines.append("never tried: " + "; ".join(shown) + (f"; and {more:,} more" * (more > 0)))
        if self.samples.space is not None and self.samples.space.where is not None:
            lines.append("(uniform means samples of the prior that fulfil the space's constraint)")
        return "\n".join(lines)


def coverage(source: Source, *, cells: int = 10, seed: int = 0) -> Coverage:
    """Measure how well samples cover the space of features.

    **Arguments:**
    - `source`: a run, its table, a DataFrame, or `Samples`; of the first three all rows with a
      verdict are used.
    - `cells`: number of equal parts of a feature's range, fewer if there are too few rows to fill
      them; a discrete feature of up to 20 values has a cell for each value.
    - `seed`: the seed of all random draws.
    **Returns:** a `Coverage`.

    "Uniform" means distributed as the prior: coordinates are those in which the prior is uniform,
    or shares of the ranges in the table if no space is known. With a constraint between features,
    8192 samples that satisfy it replace the uniform samples, cells without any of them do not
    count, and the hole is centred on one of them; a constraint that fewer than one in 200 points
    satisfy is ignored. Absent entries are left out feature by feature, and put in the middle where
    a point is needed. The discrepancy uses at most 2000 rows, drawn by `seed`, with discrete values
    spread over their cells.

    Sources: Hickernell, A generalized discrepancy and quadrature error bound, Mathematics of
    Computation 67 (1998); its mean for uniform samples, `((5/4)^d - (13/12)^d) / n`, follows from
    the definition. For the others see `cells.py`.

    **Raises:** `ValueError` if there are no rows, if no feature varies, or for fewer than 2 cells.
    """
    cells = check_count("cells", cells, 2)
    samples = Samples.of(source, "all")
    samples = _drop_constant(samples)
    generator = np.random.default_rng(seed)
    parts = marginals(samples)
    allowed = _allowed(samples, seed)
    # With five rows a pair of cells, uniform samples leave one in a hundred and fifty empty.
    count = int(np.clip(np.sqrt(len(samples) / 5), 2, cells))
    table, untried, missing = count_occupied(
        len(samples),
        cut(samples, parts, count),
        None if allowed is None else cut(allowed, parts, count),
    )
    dispersion = uniform = hole = None
    ordered = parts[: len(samples.ordered)]
    if ordered:
        points = _units(samples, ordered)
        if allowed is None:
            among = None
            fewer = min(REPEATS, max(1, REPEATED // len(points)))
            repeats = fewer if len(ordered) <= MAX_TREE else 1
            others = [uniform_points(ordered, generator, len(points)) for _ in range(repeats)]
        else:
            among, other = np.array_split(_units(allowed, ordered), 2)
            others = [other[: len(points)]]
        dispersion, centre = largest_hole(points, ordered, seed, among)
        uniform = float(np.mean([largest_hole(p, ordered, seed, among)[0] for p in others]))
        hole = {
            part.column.name: part.value(float(u)) for part, u in zip(ordered, centre, strict=True)
        }
    return Coverage(
        table=table,
        untried=untried,
        untried_count=missing,
        discrepancy=_discrepancy(
            _units(samples, parts, generator),
            None if allowed is None else _units(allowed, parts, generator),
            generator,
        ),
        dispersion=dispersion,
        uniform_dispersion=uniform,
        hole=hole,
        samples=samples,
    )


def _units(
    samples: Samples, parts: Sequence[Marginal], generator: np.random.Generator | None = None
) -> Float[np.ndarray, "n d"]:
    return np.stack([part.unit(samples, generator) for part in parts], axis=1)


def _allowed(samples: Samples, seed: int) -> Samples | None:
    """Draw samples of the prior that fulfil the constraint of the space; None without one."""
    space = samples.space
    if space is None or space.where is None or space.check_where() < MIN_ACCEPTED:
        return None
    import jax

    key = jax.random.key(seed, impl="threefry2x32")
    rows = space.rows(space.sample(key, ALLOWED))
    return replace(samples, frame=pd.DataFrame(rows))


def _drop_constant(samples: Samples) -> Samples:
    """Drop columns that have a single value in the space, or in a table without a space."""
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


def _discrepancy(
    unit: Float[np.ndarray, "n d"], allowed: Float[np.ndarray, "m d"] | None,
    generator: np.random.Generator,
) -> float:  # fmt: skip
    """Return the squared centred discrepancy over that of as many samples of the prior."""
    from scipy.stats import qmc

    n, d = unit.shape
    maximum = int(min(MAX_ROWS, np.sqrt(MAX_ENTRIES / d)))
    if allowed is not None:
        maximum = min(maximum, len(allowed))
    if n > maximum:
        unit, n = unit[generator.choice(n, maximum, replace=False)], maximum
    expected = ((5 / 4) ** d - (13 / 12) ** d) / n
    if allowed is not None:
        expected = qmc.discrepancy(allowed[:n], method="CD")
    return float(qmc.discrepancy(unit, method="CD") / expected)


def _describe_row(row: dict[Any, Any]) -> str:
    def pair(name: str, value: Any) -> str:
        return f"{name}={value:zg}" if isinstance(value, float) else f"{name}={value}"

    words = pair(row["feature"], row["value"])
    return f"{words} with {pair(row['other'], row['other_value'])}" if row["other"] else words


def _describe_evenness(discrepancy: float) -> str:
    if discrepancy < 0.5:
        return f"more evenly than uniform samples (discrepancy {discrepancy:z.2g} times theirs)"
    if discrepancy <= 3:
        return f"as evenly as uniform samples (discrepancy {discrepancy:z.2g} times theirs)"
    return f"more crowded than uniform samples (discrepancy {discrepancy:z.3g} times theirs)"


PROBES = 4096
"""Points at which the distance to the nearest point is computed."""
REFINEMENTS = 4
"""Rounds of closer probes around the best one."""
MAX_TREE = 8
"""Dimensions up to which a tree finds neighbours faster than brute force."""
BLOCK = 4096
"""Points that distances are computed from at once."""


def largest_hole(
    points: Float[np.ndarray, "n k"], parts: Sequence[Marginal], seed: int,
    among: Float[np.ndarray, "m k"] | None = None,
) -> tuple[float, Float[np.ndarray, " k"]]:  # fmt: skip
    """Return the greatest distance of a probe to its nearest point, and that probe.

    Probes are 4096 points of a Sobol sequence (1024 in more than 8 dimensions), then ever closer
    points around the best.

    **Arguments:**
    - `points`: points of the unit cube.
    - `parts`: the prior distributions of their columns.
    - `among`: the only points that may be probes, if parts of the cube are not allowed.
    """
    from scipy.spatial import KDTree
    from scipy.stats import qmc

    k = points.shape[1]
    if among is not None and k <= MAX_TREE:
        distance = np.asarray(KDTree(points).query(among)[0])
        return float(distance.max()), among[int(np.argmax(distance))]
    probes = qmc.Sobol(k, rng=seed).random(PROBES if k <= MAX_TREE else PROBES // 4)
    probes = np.stack([part.snap(probes[:, j]) for j, part in enumerate(parts)], axis=1)
    probes = probes if among is None else among[: len(probes)]
    if k <= MAX_TREE:
        # Twice as fast to build, and asked only a few thousand times.
        tree = KDTree(points, balanced_tree=False, compact_nodes=False)
        distance = np.asarray(tree.query(probes)[0])
        best, radius = int(np.argmax(distance)), float(distance.max())
        for _ in range(REFINEMENTS):
            # Closer and closer around the emptiest place so far, which stays among the probes.
            radius /= 2
            near = np.clip(probes[best] + radius * (2 * probes[: PROBES // 4] - 1), 0, 1)
            near = [part.snap(near[:, j]) for j, part in enumerate(parts)]
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
    index = int(np.argmax(distance))
    return float(distance[index]), probes[index]


def uniform_points(
    parts: Sequence[Marginal], generator: np.random.Generator, n: int
) -> Float[np.ndarray, "n k"]:
    """Draw uniform samples of the same columns."""
    return np.stack([part.snap(generator.random(n)) for part in parts], axis=1)
