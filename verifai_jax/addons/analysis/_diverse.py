"""A diverse subset: rows that represent all others, each as far as possible from earlier ones.

    found = diverse(run, 10)
    found.table                    the rows, the worst first, and how far each was from those before

Greedy farthest points: Gonzalez, Clustering to minimize the maximum intercluster distance,
Theoretical Computer Science 38, 1985. Every row is within twice the least possible distance of
some chosen one, and the least distance between chosen ones is half the greatest possible or more
(Ravi, Rosenkrantz and Tayi, Operations Research 42(2), 1994).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from verifai_jax.addons.analysis.data.samples import (
    Samples,
    Scale,
    Source,
    Which,
    distances,
    with_columns,
)
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_count
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Diverse(Drawn, InNotebook):
    """Rows chosen from `samples`, in the order in which they were added.

    **Fields:** `rows` `[k]`: row numbers of the table; `distances` `[k]`: the distance of each from
    the nearest one chosen earlier, in the coordinates of `samples.points`, infinite for the first;
    `radius`: the largest distance of any row from its nearest chosen one.
    """

    _picture = "verifai_jax.addons.analysis.pictures.clusters", "plot_diverse"
    """The rows among all, in their order, and the distances."""
    samples: Samples
    rows: Int[np.ndarray, " k"]
    distances: Float[np.ndarray, " k"]
    radius: float

    @cached_property
    def table(self) -> pd.DataFrame:
        """The rows of the error table with their `distance` (`distance_` if that name is taken)."""
        own = pd.DataFrame({"distance": self.distances}, index=pd.Index(self.rows))
        return with_columns(self.samples.at(self.rows), own)

    def __len__(self) -> int:
        return len(self.rows)

    def __str__(self) -> str:
        shown = ", ".join(map(str, self.rows[:12].tolist())) + ", ..." * (len(self.rows) > 12)
        apart = ""
        if len(self.rows) > 1:
            apart = f"; they are {self.distances[1:].min():z.3g} apart or more"
        return (
            f"{len(self.rows)} diverse rows, {self.samples.kind}: {shown}{apart}; "
            f"every row is within {self.radius:z.3g} of one of them"
        )


def diverse(
    source: Source,
    k: int,
    start: int | None = None,
    columns: Sequence[str] | None = None,
    which: Which = "counterexamples",
    scale: Scale = "range",
    space: Problem | FeatureSpace | None = None,
) -> Diverse:
    """Select `k` rows: the worst one first, then each time the row farthest from those chosen.

    **Arguments:**
    - `source`: a run, its table, a DataFrame with feature columns, or `Samples`.
    - `columns`, `which`, `space`: as in `Samples.of`.
    - `k`: number of rows; all rows if there are fewer.
    - `start`: the number of the first row; by default the one with the least robustness.
    - `scale`: as in `Samples.scaling`.
    **Returns:** a `Diverse`.

    Rows that equal a chosen one come last, with distance 0. Ties go to the first row in the table.
    The time grows with `n k`.

    **Raises:** `ValueError` for a `k` below 1; `IndexError` for a start that is not among the rows.
    """
    samples = Samples.of(source, which, columns, space)
    k = min(check_count("k", k), len(samples))
    index = samples.worst
    if start is not None:
        index = int(samples.frame.index.get_indexer(np.array([start]))[0])
        if index < 0:
            raise IndexError(f"row {start} is not among the {samples.kind}")
    placed = samples.embed(scale)
    nearest = np.full(len(samples), np.inf)
    chosen, added = [], []
    for _ in range(k):
        chosen.append(index)
        added.append(nearest[index])
        nearest = np.minimum(nearest, distances(placed, (placed[0][index], placed[1][index])))
        # Chosen ones are below the rows that equal them.
        nearest[index] = -1
        index = int(np.argmax(nearest))
    return Diverse(
        samples, samples.rows[chosen], np.array(added), float(max(nearest.max(initial=0), 0))
    )
