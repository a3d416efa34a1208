"""Clusters of failures: kinds of rows that lie together, with a typical row of each.

    found = clusters(run)
    found.table                  size, centre, a typical row and the worst row of each cluster
    found.labels                 cluster of each row number
    run.replay(int(found.table["representative"][0]))

k-means (Lloyd, Least squares quantization in PCM, IEEE Transactions on Information Theory 28(2),
1982) for numbers; `prototypes.py` for choices and mixtures; DBSCAN for clusters of any shape, where
rows lie densely and lonely rows are noise: Ester, Kriegel, Sander and Xu, A density-based algorithm
for discovering clusters in large spatial databases with noise, KDD 1996. The radius is the knee of
the curve of distances to the k-th nearest row, as proposed there; the knee is where the curve is
farthest from its chord, after Satopaa et al., Finding a "kneedle" in a haystack, ICDCS workshops
2011.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from verifai_jax.addons.analysis.clustering.prototypes import prototypes
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
from verifai_jax.core.messages.checks import check_count, check_positive
from verifai_jax.core.messages.text import format_features, format_percent
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem

Method = Literal["auto", "kmeans", "kmodes", "kprototypes", "dbscan"]
METHODS = ("auto", "kmeans", "kmodes", "kprototypes", "dbscan")
# Kaufman and Rousseeuw, Finding Groups in Data, 1990: below, there is no substantial structure.
MIN_SILHOUETTE = 0.25
_SILHOUETTE_ROWS = 2000
_TRIED = 5000
_STARTS = 8


@dataclass(frozen=True, eq=False)
class Clusters(Drawn, InNotebook):
    """A partition of `samples`.

    **Fields:** `assigned` `[n]`: the cluster of each analysed row, 0 the largest, -1 noise;
    `method`; `silhouette`: from -1 to 1, how much nearer rows are to their own cluster than to the
    next, on at most 2000 rows; NaN for fewer than two clusters; `radius` of DBSCAN, else None.
    """

    _picture = "verifai_jax.addons.analysis.pictures.clusters", "plot_clusters"
    """The clusters over the two columns that tell them apart best."""
    samples: Samples
    assigned: Int[np.ndarray, " n"]
    method: str
    silhouette: float
    scale: Scale
    weight: float = 1.0
    radius: float | None = None

    @property
    def count(self) -> int:
        """Number of clusters, without noise."""
        return int(self.assigned.max(initial=-1)) + 1

    @property
    def labels(self) -> pd.Series:
        """The cluster of each row number of the table; -1 is noise."""
        return pd.Series(self.assigned, index=self.samples.frame.index, name="cluster")

    def rows(self, cluster: int) -> Int[np.ndarray, " size"]:
        """Return the row numbers of a cluster.

        **Raises:** `IndexError` for a cluster that does not exist.
        """
        if cluster not in self.table.index:
            raise IndexError(f"there is no cluster {cluster} among {list(self.table.index)}")
        return self.samples.rows[self.assigned == cluster]

    @cached_property
    def centres(self) -> pd.DataFrame:
        """Mean of each ordered column and most frequent choice of each other one, by cluster."""
        kinds = np.unique(self.assigned)
        frame = self.samples.frame
        columns: dict[str, Any] = {}
        for column in self.samples.columns:
            entries: Any = frame[column.name].groupby(self.assigned)
            if column.ordered:
                columns[column.name] = entries.mean().reindex(kinds).to_numpy(np.float64)
            else:
                codes = column.codes(frame[column.name])
                commonest = [
                    np.argmax(np.bincount(codes[self.assigned == c] + 1)) - 1 for c in kinds
                ]
                choices = [column.choices[i] if i >= 0 else None for i in commonest]
                columns[column.name] = pd.Series(choices, dtype=object).to_numpy()
        return pd.DataFrame(columns, index=pd.Index(kinds, name="cluster"))

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row per cluster, the largest first, noise (-1) last.

        It has the centre in the features; `size` and `share` of the rows; `representative`: the row
        nearest to the centre; `worst`: the row of least robustness, and `worst_rho`. If a feature
        has one of these names, `_` is appended.
        """
        placed = _embed(self.samples, self.scale, self.weight)
        centred = _embed(self.samples, self.scale, self.weight, self.centres)
        rho = np.nan_to_num(self.samples.rho, nan=np.inf)
        own = []
        for i, cluster in enumerate(self.centres.index):
            members = np.flatnonzero(self.assigned == cluster)
            near = distances(
                (placed[0][members], placed[1][members]), (centred[0][i], centred[1][i])
            )
            worst = members[np.argmin(rho[members])]
            own.append(
                {
                    "size": len(members),
                    "share": len(members) / len(self.samples),
                    "representative": self.samples.rows[members[np.argmin(near)]],
                    "worst": self.samples.rows[worst],
                    "worst_rho": self.samples.rho[worst],
                }
            )
        table = with_columns(self.centres, pd.DataFrame(own, index=self.centres.index))
        return table.loc[[*range(self.count), *([-1] if -1 in table.index else [])]]

    def __str__(self) -> str:
        score = f", silhouette {self.silhouette:z.2f}" if np.isfinite(self.silhouette) else ""
        radius = f", radius {self.radius:z.3g}" if self.radius is not None else ""
        number = f"{self.count} cluster{'' if self.count == 1 else 's'}"
        lines = [f"{number} of {self.samples.kind} ({self.method}{score}{radius})"]
        features = list(self.samples.names)
        more = ", ..." if len(features) > 8 else ""
        for cluster in list(self.table.index)[:12]:
            where = format_features({name: self.centres.at[cluster, name] for name in features[:8]})
            size, share, typical, worst = (self.entry(cluster, name) for name in _OWN[:4])
            lines.append(
                f"  {f'{cluster}:' if cluster >= 0 else 'noise:'} {size:,} rows "
                f"({format_percent(share)}) around {where}{more}; typical row {typical}, "
                f"worst row {worst}"
            )
        return "\n".join(lines)

    def entry(self, cluster: int, name: str) -> Any:
        """Return an entry of `table` for a cluster, even if a feature has the same name."""
        return self.table.at[cluster, f"{name}_" if f"{name}_" in self.table else name]


_OWN = ("size", "share", "representative", "worst", "worst_rho")


def clusters(
    source: Source,
    method: Method = "auto",
    count: int | None = None,
    seed: Seed = 0,
    columns: Sequence[str] | None = None,
    which: Which = "counterexamples",
    scale: Scale = "range",
    max_clusters: int = 8,
    radius: float | None = None,
    space: Problem | FeatureSpace | None = None,
) -> Clusters:
    """Find clusters of rows.

    **Arguments:**
    - `source`: a run, its table, a DataFrame with feature columns, or `Samples`.
    - `columns`, `which`, `space`: as in `Samples.of`.
    - `method`: `"kmeans"` uses ordered columns only, `"kmodes"` unordered ones only,
      `"kprototypes"` both; `"auto"` takes the one that fits the columns. `"dbscan"` uses both, and
      finds the number of clusters and the noise itself.
    - `count`: number of clusters; by default the one between 2 and `max_clusters` with the greatest
      silhouette (Rousseeuw, Journal of Computational and Applied Mathematics 20, 1987), or 1 if
      none is above 0.25, or if there are fewer than three rows. It is chosen on at most 5000 rows.
    - `radius`: the radius of DBSCAN, by default the knee of the distances to the k-th neighbour,
      where k is twice the number of columns, but at least 4.
    - `seed`: an integer, a NumPy generator or a `jax.random` key.
    - `scale`: as in `Samples.scaling`.
    - `max_clusters`: maximum number of clusters if `count` is left out.
    **Returns:** `Clusters`; the same seed gives the same ones.
    **Raises:** `ValueError` for an unknown method; a method without a column that it can use; a
    `count` that exceeds the number of different rows, or is given for DBSCAN; a radius that is not
    positive, or is given for another method.
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(map(repr, METHODS))}; got {method!r}")
    samples = Samples.of(source, which, columns, space)
    if method == "auto":
        mixed = "kprototypes" if samples.unordered else "kmeans"
        method = mixed if samples.ordered else "kmodes"
    if method == "kmeans":
        samples.need_ordered("k-means")
        samples = replace(samples, columns=samples.ordered)
    if method == "kmodes":
        samples.need_unordered("k-modes")
        samples = replace(samples, columns=samples.unordered)
    rng = generator(seed)
    if method == "dbscan":
        return _dense(samples, count, radius, scale, rng)
    if radius is not None:
        raise ValueError(f"a radius is for method='dbscan'; got {radius!r} with {method!r}")
    weight = _weight(samples, scale)
    placed = _embed(samples, scale, weight)
    different = len(np.unique(np.concatenate(placed, axis=1), axis=0))
    if count is None:
        count = _best_count(placed, min(check_count("max_clusters", max_clusters), different), rng)
    elif check_count("count", count) > different:
        raise ValueError(
            f"count must be from 1 to {different}, the number of different rows among "
            f"{samples.kind}; got {count}"
        )
    found = _partition(placed, count, rng)
    score = _silhouette(placed, found, rng)
    return Clusters(samples, _by_size(found), method, score, scale, weight)


def _weight(samples: Samples, scale: Scale) -> float:
    """Return the weight with which numbers and choices differ equally on average."""
    coordinates, codes = samples.embed(scale)
    apart = 2 * coordinates.var(axis=0).sum() / max(len(samples.ordered), 1)
    if not codes.shape[1] or apart <= 0:
        return 1.0
    unlike = [1 - (np.unique(c, return_counts=True)[1] ** 2).sum() / len(c) ** 2 for c in codes.T]
    return float(apart / np.mean(unlike)) if np.mean(unlike) > 0 else 1.0


def _embed(
    samples: Samples, scale: Scale, weight: float, frame: pd.DataFrame | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return `Samples.embed`, divided so that a different choice has this weight."""
    coordinates, codes = samples.embed(scale, frame)
    return coordinates / np.sqrt(weight), codes


def _best_count(
    placed: tuple[np.ndarray, np.ndarray], max_clusters: int, rng: np.random.Generator
) -> int:
    """Return the number of clusters with the greatest silhouette, tried on at most 5000 rows."""
    rows = rng.permutation(len(placed[0]))[:_TRIED]
    part = placed[0][rows], placed[1][rows]
    best, reached = 1, MIN_SILHOUETTE
    # The same rows for each count, so that chance does not decide between them.
    measured = np.random.default_rng(0).permutation(len(rows))[:_SILHOUETTE_ROWS]
    between = _between(part, measured)
    for count in range(2, min(max_clusters, len(rows) - 1) + 1):
        score = _silhouette_of(between, _partition(part, count, rng)[measured])
        if score > reached:
            best, reached = count, score
    return best


def _partition(
    placed: tuple[np.ndarray, np.ndarray], count: int, rng: np.random.Generator
) -> Int[np.ndarray, " n"]:
    coordinates, codes = placed
    if codes.shape[1]:
        return prototypes(coordinates, codes, count, rng)
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    means: Any = KMeans(count, n_init=_STARTS, random_state=int(rng.integers(2**31)))  # pyright: ignore[reportArgumentType]
    # Its threads wait for each other in a loop, which is slow where the processor is shared.
    with threadpool_limits(1):
        return means.fit(coordinates).labels_.astype(np.int64)


def _dense(
    samples: Samples, count: int | None, radius: float | None, scale: Scale,
    rng: np.random.Generator,
) -> Clusters:  # fmt: skip
    if count is not None:
        raise ValueError(f"dbscan finds the number of clusters itself; got count={count!r}")
    if radius is not None:
        check_positive("radius", radius, finite=True)
    needed = max(4, 2 * len(samples.columns))
    found, radius = dbscan(samples.points(scale), needed, radius, rng)
    score = _silhouette(samples.embed(scale), found, rng)
    return Clusters(samples, _by_size(found), "dbscan", score, scale, radius=radius)


def _silhouette(
    placed: tuple[np.ndarray, np.ndarray], labels: np.ndarray, rng: np.random.Generator
) -> float:
    """Return the silhouette of at most 2000 rows, noise left out; NaN where it is not defined."""
    rows = rng.permutation(np.flatnonzero(labels >= 0))[:_SILHOUETTE_ROWS]
    return _silhouette_of(_between(placed, rows), labels[rows]) if len(rows) else np.nan


def _between(
    placed: tuple[np.ndarray, np.ndarray], rows: Int[np.ndarray, " k"]
) -> Float[np.ndarray, "k k"]:
    """Return the distances of rows from each other."""
    part = placed[0][rows], placed[1][rows]
    return np.stack([distances(part, (one, code)) for one, code in zip(*part, strict=True)])


def _silhouette_of(between: Float[np.ndarray, "k k"], labels: Int[np.ndarray, " k"]) -> float:
    from sklearn.metrics import silhouette_score

    if not 2 <= len(np.unique(labels)) < len(labels):
        return np.nan
    return float(silhouette_score(between, labels, metric="precomputed"))


def _by_size(labels: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Renumber clusters, the largest first; of equal ones that with the first row."""
    kinds, first, counts = np.unique(labels[labels >= 0], return_index=True, return_counts=True)
    order = np.lexsort((first, -counts))
    new = np.full(int(labels.max(initial=-1)) + 2, -1, np.int64)
    new[kinds[order]] = np.arange(len(kinds))
    return new[labels]


# Beyond, a random part is clustered, and the other rows join the part's dense ones.
MAX_ROWS = 20_000


def dbscan(
    points: Float[np.ndarray, "n d"], needed: int, radius: float | None, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " n"], float]:
    """Return clusters from 0, with -1 for noise, and the radius.

    A row is dense if at least `needed` rows, including itself, lie within the radius.
    """
    from scipy.spatial import KDTree
    from sklearn.cluster import DBSCAN

    n = len(points)
    part = np.arange(n) if n <= MAX_ROWS else np.sort(rng.permutation(n)[:MAX_ROWS])
    if radius is None:
        radius = knee(points[part], min(needed, len(part)))
    elif n > MAX_ROWS:
        # So many of the rows within a radius that was meant for all of them are in the part.
        needed = max(3, round(needed * len(part) / n))
    found = DBSCAN(eps=radius, min_samples=needed).fit(points[part])
    labels = np.full(n, -1, np.int64)
    labels[part] = found.labels_
    dense = part[found.core_sample_indices_]
    if n > MAX_ROWS and len(dense):
        far, which = KDTree(points[dense]).query(points, workers=-1)
        left = np.setdiff1d(np.flatnonzero(np.asarray(far) <= radius), part)
        labels[left] = labels[dense[np.asarray(which)[left]]]
    return labels, radius


def knee(points: Float[np.ndarray, "n d"], k: int) -> float:
    """Return the knee of the distances to the `k`-th nearest row; beyond it rows are isolated."""
    from scipy.spatial import KDTree

    tree: Any = KDTree(points)
    far = tree.query(points, k=[k], workers=-1)[0][:, 0]
    far = np.sort(far[np.isfinite(far)])
    if not len(far) or far[-1] <= 0:
        # All rows have equals: any radius will do that separates different ones.
        return 1e-9
    across, up = np.linspace(0, 1, len(far)), (far - far[0]) / max(far[-1] - far[0], 1e-300)
    at = int(np.argmax(across - up)) if far[-1] > far[0] else -1
    return float(far[at]) if far[at] > 0 else float(far[far > 0][0])
