"""Frequent patterns: values and combinations of values common among counterexamples.

    found = frequent_patterns(run)
    found.table                        combinations: how many, which share, how often they fail
    found.top                          the most frequent value of each feature
    found.rows(0)                      the row numbers that the first combination covers

A combination is at most as frequent as its rarest part, so rare parts need not be extended: Agrawal
and Srikant, Fast algorithms for mining association rules, VLDB 1994; depth first over sets of rows:
Zaki, Scalable algorithms for association mining, IEEE TKDE 12(3), 2000.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations as subsets
from itertools import pairwise
from math import prod
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Bool, Int

from verifai_jax.addons.analysis.data.columns import Column
from verifai_jax.addons.analysis.data.samples import Samples, Source, Which
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.text import counted, format_percent
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.problem import Problem

MAX_COMBINATIONS = 50_000


@dataclass(frozen=True)
class Item:
    """One value of one column, or one cell of an ordered column."""

    column: str
    value: Any
    text: str
    prior: float | None


@dataclass(frozen=True, eq=False)
class FrequentPatterns(Drawn, InNotebook):
    """Frequent combinations of values among `samples`.

    **Fields:** `items`: the single values, including those that never occur; `combinations`: each a
    tuple of indices in `items`; `counts` of rows; `minimum`: the smallest share searched for;
    `against`: the reference for the shares, `"table"`, `"prior"` or `"nothing"`; `expected`: the
    reference shares.
    """

    _picture = "verifai_jax.addons.analysis.pictures.frequent_patterns", "plot_frequent_patterns"
    """The shares of the most distinctive combinations, and those expected."""
    samples: Samples
    items: tuple[Item, ...]
    combinations: tuple[tuple[int, ...], ...]
    counts: Int[np.ndarray, " c"]
    expected: np.ndarray
    minimum: float
    against: str
    _present: Bool[np.ndarray, "i n"]

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row for each combination, single values first, then the most frequent first.

        `count` and `share` of the selected rows; `expected`: the share of the combination in the
        prior, or among all rows with a verdict; `lift`: share divided by expected. For
        counterexamples the lift is the failure rate of simulations with these values divided by the
        average failure rate. NaN without a reference.
        """
        share = self.counts / len(self.samples)
        lift = np.divide(
            share, self.expected, out=np.full(len(share), np.nan), where=self.expected > 0
        )
        return pd.DataFrame(
            {
                "combination": [
                    ", ".join(self.items[i].text for i in one) for one in self.combinations
                ],
                "size": [len(one) for one in self.combinations],
                "count": self.counts,
                "share": share,
                "expected": self.expected,
                "lift": lift,
            }
        )

    @cached_property
    def values(self) -> pd.DataFrame:
        """All values of each column, including rare ones: `column`, `value`, `count`, `share`."""
        counts = self._present.sum(axis=1)
        table = pd.DataFrame(
            {
                "column": [item.column for item in self.items],
                "value": [item.value for item in self.items],
                "count": counts,
                "share": counts / len(self.samples),
            }
        )
        order_of = {item.column: i for i, item in reversed(list(enumerate(self.items)))}
        order = np.lexsort((-counts, [order_of[item.column] for item in self.items]))
        return table.iloc[order].reset_index(drop=True)

    @cached_property
    def top(self) -> dict[str, Any]:
        """The most frequent value of each column; of equal ones the first of the choices."""
        first = self.values.drop_duplicates("column")
        return dict(zip(first["column"], first["value"], strict=True))

    def rows(self, index: int) -> Int[np.ndarray, " count"]:
        """Return the row numbers that the combination in row `index` of `table` covers.

        **Raises:** `IndexError` for an index that is not in the table.
        """
        if not 0 <= index < len(self.combinations):
            raise IndexError(
                f"combination {index} is not among the {len(self.combinations)} in the table"
            )
        return self.samples.rows[self._present[list(self.combinations[index])].all(axis=0)]

    def __str__(self) -> str:
        sizes = [len(one) for one in self.combinations]
        single = sizes.count(1)
        lines = [
            f"{counted(single, 'value')} and {counted(len(sizes) - single, 'combination')} in at "
            f"least {self.minimum:z.3g} of {self.samples.kind}"
        ]
        for column, value in list(self.top.items())[:8]:
            share = self.values.loc[self.values["column"] == column, "share"].max()
            lines.append(f"  most frequent: {column}={value} ({format_percent(share)})")
        against = {"table": "among all rows", "prior": "in the prior"}.get(self.against)
        rows: Any = self.distinctive.head(5).itertuples()
        for row in rows:
            if row.lift > 1:
                lines.append(
                    f"  {row.combination}: {format_percent(row.share)} of them, "
                    f"{row.lift:z.2f} times the share {against}"
                )
        return "\n".join(lines)

    @cached_property
    def distinctive(self) -> pd.DataFrame:
        """Rows of `table` by decreasing lift, without combinations that add nothing.

        A combination adds something if its lift is at least 1.1 times that of each of its parts.
        Without a reference these are the single values by decreasing frequency.
        """
        table: Any = self.table
        lift = table["lift"].to_numpy()
        if np.isnan(lift).all():
            return table[table["size"] == 1]
        by = dict(zip(self.combinations, lift, strict=True))
        kept = [
            all(by[one] > 1.1 * by[part] for part in subsets(one, len(one) - 1) if part)
            for one in self.combinations
        ]
        table = table[kept]
        return table.iloc[np.argsort(-table["lift"].to_numpy(), kind="stable")]


def frequent_patterns(
    source: Source,
    columns: Sequence[str] | None = None,
    size: int = 2,
    minimum: float = 0.05,
    bins: int | None = None,
    against: Literal["auto", "table", "prior"] = "auto",
    which: Which = "counterexamples",
    space: Problem | FeatureSpace | None = None,
) -> FrequentPatterns:
    """Find frequent values of unordered columns, and combinations of up to `size` of them.

    **Arguments:**
    - `source`: a run, its table, a DataFrame with feature columns, or `Samples`.
    - `columns`, `which`, `space`: as in `Samples.of`.
    - `size`: maximum number of values in a combination.
    - `minimum`: minimum share of the rows that have a combination.
    - `bins`: if given, ordered columns are included, cut into this many equally wide cells of their
      range; whole numbers with fewer values are used directly.
    - `against`: the reference for a share: the share among all rows with a verdict (`"table"`), or
      the prior probability (`"prior"`). By default the table if it has rows with the other verdict,
      else the prior if it is known. After a search that learns both depend on where it searched.

    An absent item of an array has no value.

    **Returns:** `FrequentPatterns`.
    **Raises:** `ValueError` if there is no unordered column and no `bins`; for a `size` or number
    of bins below 1; a minimum outside (0, 1]; `against="prior"` without a space that knows the
    prior; more than 50 000 combinations.
    """
    samples = Samples.of(source, which, columns, space)
    check_count("size", size)
    if not (isinstance(minimum, float | int) and 0 < minimum <= 1):
        raise ValueError(f"minimum is a share, above 0 and at most 1; got {minimum!r}")
    if against not in ("auto", "table", "prior"):
        raise ValueError(f"against must be 'auto', 'table' or 'prior'; got {against!r}")
    if bins is None:
        samples.need_unordered("frequent patterns without bins=...")
    else:
        check_count("bins", bins)
    items, present = _items(samples, bins, samples.frame)
    verdicts = _has_both_verdicts(samples)
    priors = all(item.prior is not None for item in items)
    if against == "prior" and not priors:
        unknown = next(item.column for item in items if item.prior is None)
        raise ValueError(
            f"against='prior' needs the feature space to know the prior of every column; that of "
            f"{unknown} is not known"
        )
    if against == "auto":
        against = "table" if verdicts or not priors else "prior"
    if against == "table" and verdicts:
        _, elsewhere = _items(samples, bins, samples.others("all").frame)
    else:
        elsewhere = np.zeros((len(items), 0), bool)
    min_count = max(1, int(np.ceil(minimum * len(samples) - 1e-9)))
    combinations, counts, expected = _frequent(items, present, elsewhere, min_count, size)
    if against == "prior":
        expected = np.array([prod(items[i].prior or 0.0 for i in one) for one in combinations])
    order = sorted(range(len(counts)), key=lambda i: (len(combinations[i]), -counts[i], i))
    return FrequentPatterns(
        samples=samples,
        items=items,
        combinations=tuple(combinations[i] for i in order),
        counts=counts[order],
        expected=np.asarray(expected, np.float64)[order],
        minimum=float(minimum),
        against=against if against == "prior" or verdicts else "nothing",
        _present=present,
    )


def _has_both_verdicts(samples: Samples) -> bool:
    """Return whether some rows with a verdict are not looked at."""
    if samples.which == "all":
        return False
    try:
        return len(samples.others("all")) > len(samples)
    except ValueError:
        return False


def _frequent(
    items: tuple[Item, ...], present: np.ndarray, elsewhere: np.ndarray, min_count: int, size: int
) -> tuple[list[tuple[int, ...]], np.ndarray, np.ndarray]:
    """Return combinations of up to `size` items of different columns with `min_count` rows."""
    combinations: list[tuple[int, ...]] = []
    counts: list[int] = []
    shares: list[float] = []

    def extend(one: tuple[int, ...], rows: np.ndarray, others: np.ndarray) -> None:
        for i in range(one[-1] + 1 if one else 0, len(items)):
            if one and items[i].column == items[one[-1]].column:
                continue
            covered = rows & present[i]
            count = int(np.count_nonzero(covered))
            if count < min_count:
                continue
            if len(combinations) == MAX_COMBINATIONS:
                raise ValueError(
                    f"more than {MAX_COMBINATIONS:,} combinations of up to {size} values are in "
                    f"{min_count} rows or more; raise minimum, or lower size"
                )
            beyond = others & elsewhere[i]
            combinations.append((*one, i))
            counts.append(count)
            shares.append(float(beyond.mean()) if len(beyond) else np.nan)
            if len(one) + 1 < size:
                extend((*one, i), covered, beyond)

    extend((), np.ones(present.shape[1], bool), np.ones(elsewhere.shape[1], bool))
    return combinations, np.array(counts, np.int64), np.array(shares)


def _items(
    samples: Samples, bins: int | None, frame: pd.DataFrame
) -> tuple[tuple[Item, ...], Bool[np.ndarray, "i n"]]:
    """Return the values of all columns, and the rows of `frame` that have them."""
    items: list[Item] = []
    present: list[np.ndarray] = []
    for column in samples.columns:
        entries: Any = frame[column.name]
        if column.ordered and bins is None:
            continue
        if column.ordered:
            labels, codes, prior = _cells(column, entries.to_numpy(np.float64), bins or 1)
        else:
            labels, codes, prior = column.choices, column.codes(entries), column.prior
        for index, label in enumerate(labels):
            text = f"{column.name}={label}"
            if column.ordered and isinstance(label, str):
                text = f"{column.name} in {label}"
            items.append(Item(column.name, label, text, prior[index] if prior else None))
            present.append(codes == index)
    return tuple(items), np.array(present).reshape(len(items), len(frame))


def _cells(
    column: Column, values: np.ndarray, bins: int
) -> tuple[Sequence[Any], np.ndarray, Sequence[float] | None]:
    """Return labels of the cells of an ordered column, the cell of each value, and the prior."""
    width = column.far - column.near
    if column.integer and width + 1 <= bins:
        labels: list[Any] = list(range(int(column.near), int(column.far) + 1))
        edges = np.append(np.array(labels) - 0.5, column.far + 0.5)
    elif width <= 0:
        labels, edges = [column.near], np.array([column.near, column.near])
    else:
        edges = np.linspace(column.near, column.far, bins + 1)
        ends = [f"{edge:z.4g}" for edge in edges]
        labels = [f"[{a}, {b})" for a, b in pairwise(ends)]
        labels[-1] = labels[-1][:-1] + "]"
    codes = np.searchsorted(edges, values, side="right") - 1
    codes = np.clip(codes, 0, len(labels) - 1)
    codes = np.where(np.isnan(values), -1, codes)
    prior = (1 / len(labels),) * len(labels) if column.uniform else None
    if prior and column.integer and len(labels) == bins < width + 1:
        numbers = np.arange(column.near, column.far + 1)
        inside = np.clip(np.searchsorted(edges, numbers, side="right") - 1, 0, bins - 1)
        prior = tuple(np.bincount(inside, minlength=bins) / len(numbers))
    return labels, codes, prior
