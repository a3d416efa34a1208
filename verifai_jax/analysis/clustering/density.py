"""DBSCAN: clusters are where rows lie densely, of any shape; lonely rows are noise.

Ester, Kriegel, Sander and Xu, A density-based algorithm for discovering clusters in large spatial
databases with noise, KDD 1996. The radius is the knee of the curve of distances to the k-th
nearest row, as proposed there; the knee is where the curve is farthest from its chord, after
Satopaa et al., Finding a "kneedle" in a haystack, ICDCS workshops 2011.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

# Beyond, a random part is clustered, and the other rows join the part's dense ones.
MAX_ROWS = 20_000


def dbscan(
    points: Float[np.ndarray, "n d"], needed: int, radius: float | None, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " n"], float]:
    """Clusters from 0, -1 for noise, and the radius.

    A row is dense if `needed` rows, itself included, are within the radius.
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
    """Return the distance to the `k`-th nearest row, itself included, that makes a row lonely."""
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
