"""Rows near each other or near given features, and rows drawn at random.

    k_closest(run, 5)                      the tightest group of five counterexamples
    nearest(run, {"x": 0.1, "alg": "sac"}, 5)
    random_rows(run, 5, seed=0)

Distances are those of `Samples.points`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from verifai_jax.analysis.data.samples import (
    Samples,
    Scale,
    Seed,
    Source,
    Which,
    distances,
    generator,
    with_columns,
)
from verifai_jax.analysis.tightest import tightest
from verifai_jax.core.checks import check_count
from verifai_jax.core.errors import check_names
from verifai_jax.core.figure import Drawn
from verifai_jax.core.notebook import InNotebook
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Neighbours(Drawn, InNotebook):
    """Rows chosen from `samples`.

    **Fields:** `rows` `[k]`: row numbers of the table; `distances` `[k]` of each from the centre,
    in the coordinates of `samples.points`, NaN for rows drawn at random; `centre`: the row around
    which they lie, None if that is not a row; `how`: how they were chosen, as text.
    """

    _picture = "neighbours", "plot_neighbours"
    """The rows among the others, over the two features that vary most."""

    samples: Samples
    rows: Int[np.ndarray, " k"]
    distances: Float[np.ndarray, " k"]
    centre: int | None
    how: str

    @cached_property
    def table(self) -> pd.DataFrame:
        """The rows of the error table, with their `distance` (`distance_` if a feature is it)."""
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
    """Select the tightest group: a row and its `k - 1` nearest, of the least sum of distances.

    **Arguments:**

    - `source`: a run, its table, a DataFrame with feature columns, or `Samples`.
    - `columns`, `which`, `space`: as in `Samples.of`.
      Unordered columns count 1 where they differ; VerifAI leaves them out and includes `rho`:
      name the columns for that.
    - `k`: how many; None or more than there are gives all.
    - `scale`: as in `Samples.scaling`; `"rows"` is VerifAI's.

    **Returns:** `Neighbours`, the nearest first.

    Takes about `n log n` steps over up to 20 ordered columns, `n^2` over more; see `tightest.py`.

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
      a row of the table, which need not be among those looked at.
    - `k`: how many; all rows if there are no more.
    - `scale`: as in `Samples.scaling`.

    **Returns:** `Neighbours`, the nearest first.

    **Raises:** `ValueError` for a `k` below 1, or a feature that is missing or none of the choices;
    `IndexError` for a row number that is not in the table.
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
    source: Source,
    k: int,
    seed: Seed,
    which: Which = "counterexamples",
    columns: Sequence[str] | None = None,
    space: Problem | FeatureSpace | None = None,
) -> Neighbours:
    """Draw `k` different rows, each as likely as any other; all of them if there are no more.

    **Arguments:**

    - `source`: a run, its table, a DataFrame with feature columns, or `Samples`.
    - `columns`, `which`, `space`: as in `Samples.of`.
    - `k`: how many.
    - `seed`: an integer, a NumPy generator or a `jax.random` key.

    **Returns:** `Neighbours`, in the order drawn.

    **Raises:** `ValueError` for a `k` below 1.
    """
    samples = Samples.of(source, which, columns, space)
    k = min(check_count("k", k), len(samples))
    chosen = generator(seed).permutation(len(samples))[:k]
    return Neighbours(samples, samples.rows[chosen], np.full(k, np.nan), None, f"{k} at random")
