"""Rows near each other or near given features, and rows drawn at random.

    k_closest(run, 5)                      the tightest group of five counterexamples
    nearest(run, {"x": 0.1, "alg": "sac"}, 5)
    random_rows(run, 5, seed=0)

Distances are those of `Samples.points`.

To find the tightest group, rows with the same choices form a group, searched by a k-d tree
(Bentley, Multidimensional binary search trees used for associative searching, CACM 18(9), 1975).
Rows of other groups are at least 1 away, so nearly always the tree alone suffices.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from verifai_jax.addons.analysis.data.samples import (
    Samples,
    Scale,
    Seed,
    Source,
    Which,
    distances,
    generator,
    with_columns,
)
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import check_names
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Neighbours(Drawn, InNotebook):
    """Rows chosen from `samples`.

    **Fields:** `rows` `[k]`: row numbers of the table; `distances` `[k]` of each from the centre,
    in the coordinates of `samples.points`, NaN for rows drawn at random; `centre`: the row around
    which they lie, None if it is not a row; `how`: how they were chosen, as text.
    """

    _picture = "verifai_jax.addons.analysis.pictures.clusters", "plot_neighbours"
    """The rows among the others, over the two features that vary most."""
    samples: Samples
    rows: Int[np.ndarray, " k"]
    distances: Float[np.ndarray, " k"]
    centre: int | None
    how: str

    @cached_property
    def table(self) -> pd.DataFrame:
        """The rows of the error table with their `distance` (`distance_` if that name is taken)."""
        own = pd.DataFrame({"distance": self.distances}, index=pd.Index(self.rows))
        return with_columns(self.samples.at(self.rows), own)

    def __len__(self) -> int:
        return len(self.rows)

    def __str__(self) -> str:
        shown = ", ".join(map(str, self.rows[:12].tolist())) + ", ..." * (len(self.rows) > 12)
        reach = np.max(self.distances, initial=0)
        far = f"; the farthest is {reach:z.3g} away" if np.isfinite(reach) and reach > 0 else ""
        return f"{self.how}, {self.samples.kind}: rows {shown}{far}"


def k_closest(
    source: Source,
    k: int | None,
    columns: Sequence[str] | None = None,
    which: Which = "counterexamples",
    scale: Scale = "range",
    space: Problem | FeatureSpace | None = None,
) -> Neighbours:
    """Select the tightest group: the row and `k - 1` nearest ones with the least sum of distances.

    **Arguments:**
    - `source`: a run, its table, a DataFrame with feature columns, or `Samples`.
    - `columns`, `which`, `space`: as in `Samples.of`. Unordered columns count 1 if they differ; to
      compare as VerifAI, which leaves them out and includes `rho`, name the columns.
    - `k`: number of rows; all rows if None, or if there are fewer.
    - `scale`: as in `Samples.scaling`; `"rows"` is VerifAI's.
    **Returns:** `Neighbours`, the nearest first.

    The time grows with `n log n` for up to 20 ordered columns, with `n^2` for more.

    **Raises:** `ValueError` for a `k` below 1.
    """
    samples = Samples.of(source, which, columns, space)
    n = len(samples)
    k = n if k is None else min(check_count("k", k), n)
    rows = samples.embed(scale)
    centre = tightest(*rows, k) if k < n else _middle(rows)
    far = distances(rows, (rows[0][centre], rows[1][centre]))
    # The centre comes first, also among rows that equal it.
    far[centre] = -1
    group = np.argsort(far, kind="stable")[:k]
    far[centre] = 0
    how = f"The {k} closest" if k < n else f"All {n}"
    return Neighbours(samples, samples.rows[group], far[group], int(samples.rows[centre]), how)


def _middle(rows: tuple[np.ndarray, np.ndarray]) -> int:
    # All rows are the group of each of them: the one nearest to their mean may stand for it.
    return int(np.argmin(((rows[0] - rows[0].mean(axis=0)) ** 2).sum(axis=1)))


def nearest(
    source: Source,
    point: Mapping[str, Any] | pd.Series | int | np.integer,
    k: int = 1,
    columns: Sequence[str] | None = None,
    which: Which = "counterexamples",
    scale: Scale = "range",
    space: Problem | FeatureSpace | None = None,
) -> Neighbours:
    """Select the `k` rows nearest to a point, the nearest first.

    **Arguments:**
    - `source`: a run, its table, a DataFrame with feature columns, or `Samples`.
    - `columns`, `which`, `space`: as in `Samples.of`.
    - `point`: features (a mapping with all analysed columns, or a row of a table), or the number of
      any row of the table.
    - `k`: number of rows; all rows if there are fewer.
    - `scale`: as in `Samples.scaling`.
    **Returns:** `Neighbours`, the nearest first.
    **Raises:** `ValueError` for a `k` below 1, or a feature that is missing or not one of the
    choices; `IndexError` for a row number that is not in the table.
    """
    samples = Samples.of(source, which, columns, space)
    k = min(check_count("k", k), len(samples))
    if isinstance(point, int | np.integer):
        frame = samples.at([int(point)])
        what = f"row {int(point)}"
    else:
        values = dict(point.items())
        check_names("feature", samples.names, map(str, values))
        frame = pd.DataFrame([{name: values[name] for name in samples.names}])
        what = "the point"
    coordinates, codes = samples.embed(scale, frame)
    far = distances(samples.embed(scale), (coordinates[0], codes[0]))
    group = np.argsort(far, kind="stable")[:k]
    centre = int(point) if isinstance(point, int | np.integer) else None
    return Neighbours(
        samples, samples.rows[group], far[group], centre, f"The {k} nearest to {what}"
    )


def random_rows(
    source: Source, k: int, seed: Seed, which: Which = "counterexamples",
    columns: Sequence[str] | None = None, space: Problem | FeatureSpace | None = None,
) -> Neighbours:  # fmt: skip
    """Draw `k` different rows with equal probability; all of them if there are fewer.

    **Arguments:**
    - `source`: a run, its table, a DataFrame with feature columns, or `Samples`.
    - `columns`, `which`, `space`: as in `Samples.of`.
    - `k`: number of rows.
    - `seed`: an integer, a NumPy generator or a `jax.random` key.
    **Returns:** `Neighbours`, in the order drawn.
    **Raises:** `ValueError` for a `k` below 1.
    """
    samples = Samples.of(source, which, columns, space)
    k = min(check_count("k", k), len(samples))
    chosen = generator(seed).permutation(len(samples))[:k]
    return Neighbours(samples, samples.rows[chosen], np.full(k, np.nan), None, f"{k} at random")


_MAX_DIMENSIONS = 20
"""Dimensions beyond which a k-d tree looks at nearly every point."""
_ENTRIES = 20_000_000
"""Entries of the arrays of a block at most."""


def tightest(coordinates: Float[np.ndarray, "n p"], codes: Int[np.ndarray, "n m"], k: int) -> int:
    """Return the index of the row whose `k` nearest, including itself, have the least sum.

    The squared distance is that of the coordinates plus the number of differing codes.
    """
    # Equal rows are one with a weight: they would all lie in one leaf of a tree.
    joined = np.concatenate([coordinates, codes.astype(np.float64)], axis=1)
    _, first, weights = np.unique(joined, axis=0, return_index=True, return_counts=True)
    coordinates, codes = coordinates[first], codes[first]
    groups = list(_groups(codes))
    bound, exact = np.empty(len(first)), np.empty(len(first), bool)
    for members in groups:
        bound[members], exact[members] = _within(
            coordinates[members], weights[members], k, alone=len(groups) == 1
        )
    best = np.min(bound[exact], initial=np.inf)
    left = np.flatnonzero(~exact & (bound < best))
    left = left[np.lexsort((first[left], bound[left]))]
    size = max(1, min(256, _ENTRIES // len(first)))
    for start in range(0, len(left), size):
        some = left[start : start + size]
        if bound[some[0]] >= best:
            break
        far, which = _nearest_of_all(coordinates, codes, some, min(k, len(first)))
        bound[some], exact[some] = (far * _taken(weights[which], k)).sum(axis=1), True
        best = min(best, bound[some].min())
    sums = np.where(exact, bound, np.inf)
    return int(first[sums == sums.min()].min())


def _groups(codes: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the indices of rows with the same codes, group by group."""
    if codes.shape[1] == 0:
        yield np.arange(len(codes))
        return
    _, group = np.unique(codes, axis=0, return_inverse=True)
    group = group.reshape(-1)
    order = np.argsort(group, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


def _within(
    coordinates: np.ndarray, weights: np.ndarray, k: int, alone: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Bound the sums of distances of the rows of a group; return whether the bounds are exact.

    Unless the group is `alone`, neighbours farther than 1, and those that it lacks, may be rows of
    other groups at a distance of 1.
    """
    n = len(weights)
    tree = _tree(coordinates) if n > 1 and coordinates.shape[1] <= _MAX_DIMENSIONS else None
    count = min(k, n)
    size = max(1, min(1024, _ENTRIES // (count if tree is not None else n)))
    bounds, exact = np.empty(n), np.empty(n, bool)
    for start in range(0, n, size):
        some = np.arange(start, min(start + size, n))
        if tree is None:
            far, which = _nearest_of_all(coordinates, np.zeros((n, 0), np.int64), some, count)
        else:
            far, which = tree.query(
                coordinates[some], k=np.arange(1, count + 1), workers=-1 if n > 10_000 else 1
            )
        taken = _taken(weights[which], k)
        lowest = far if alone else np.minimum(far, 1.0)
        lacking = k - taken.sum(axis=1)
        bounds[some] = (lowest * taken).sum(axis=1) + lacking
        exact[some] = (lacking == 0) & ~((far > lowest) & (taken > 0)).any(axis=1)
    return bounds, exact


def _taken(weights: Int[np.ndarray, "n k"], k: int) -> Int[np.ndarray, "n k"]:
    """Count how many of each neighbour, the nearest first, are among the `k` nearest rows."""
    before = np.cumsum(weights, axis=1) - weights
    return np.clip(k - before, 0, weights)


def _tree(coordinates: np.ndarray) -> Any:
    from scipy.spatial import KDTree

    return KDTree(coordinates)


def _nearest_of_all(
    coordinates: np.ndarray, codes: np.ndarray, some: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances and indices of the `k` nearest rows of `some`, compared with all rows."""
    # From the middle of the cloud, so that large coordinates cost no digits.
    centred = coordinates - coordinates.mean(axis=0)
    squares = (centred**2).sum(axis=1)
    squared = squares[some, None] + squares - 2 * centred[some] @ centred.T
    for code in codes.T:
        squared += code[some, None] != code
    which = np.argpartition(squared, k - 1, axis=1)[:, :k]
    exact = np.zeros(which.shape)
    for column in coordinates.T:
        exact += (column[some, None] - column[which]) ** 2
    for code in codes.T:
        exact += code[some, None] != code[which]
    order = np.argsort(exact, axis=1, kind="stable")
    return (
        np.sqrt(np.take_along_axis(exact, order, axis=1)),
        np.take_along_axis(which, order, axis=1),
    )
