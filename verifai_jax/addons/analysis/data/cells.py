"""Cells of one feature and of pairs of features, and the samples in them.

Coverage of pairs of discrete values is 2-wise coverage in combinatorial testing (Kuhn, Kacker and
Lei, Introduction to combinatorial testing, 2013).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.analysis.data.marginals import Marginal
from verifai_jax.addons.analysis.data.samples import Samples

MAX_VALUES = 20
"""Maximum number of values of a discrete feature that each get a cell."""
MAX_FEATURES = 60
"""Features up to which all of their pairs are counted."""
MAX_UNTRIED = 1000
BLOCK = 4096


class Cells(NamedTuple):
    """One feature cut into cells.

    **Fields:** `name` of the feature; `ids` `[n]`: the cell of each row, -1 if absent; `prior`
    probabilities of the cells; `marginal` of the feature; `single_values`: whether each cell is one
    value; `volume`: the cells' shares of the range.
    """

    name: str
    ids: Int[np.ndarray, " n"]
    prior: Float[np.ndarray, " cells"]
    marginal: Marginal
    single_values: bool
    volume: Float[np.ndarray, " cells"]


def cut(samples: Samples, parts: Sequence[Marginal], count: int) -> list[Cells]:
    """Cut features into cells: one for each value of a discrete one, else `count` of its range."""
    found = []
    for part in parts:
        name = part.column.name
        if part.edges is not None and (part.count <= MAX_VALUES or not part.column.ordered):
            ids, prior = part.cells(samples), np.diff(part.edges)
            volume = np.full(len(prior), 1 / len(prior))
            found.append(Cells(name, ids, prior, part, True, volume))
        else:
            ids = np.clip(np.floor(part.unit(samples) * count), 0, count - 1).astype(np.int64)
            absent = samples.frame[name].isna().to_numpy()
            prior = np.full(count, 1 / count)
            inner = [float(part.value(k / count)) for k in range(1, count)]
            ends = np.array([part.column.near, *inner, part.column.far], float)
            volume = np.diff(ends) / (ends[-1] - ends[0])
            found.append(Cells(name, np.where(absent, -1, ids), prior, part, False, volume))
    return found


def count_occupied(
    n: int, rows: list[Cells], allowed: list[Cells] | None = None
) -> tuple[pd.DataFrame, pd.DataFrame, int]:
    """Count the occupied cells.

    **Arguments:**
    - `rows`: the features in cells.
    - `allowed`: samples of the prior in the same cells, if it is not uniform on all of them: cells
      without any of these samples do not count.
    **Returns:** a table with a row for each feature, a table of the values and pairs of values that
    were never tried (at most 1000), and their number.
    """
    maximum = min(len(rows), MAX_FEATURES)
    counts = np.array([len(cells.prior) for cells in rows])
    edges = np.concatenate([[0], np.cumsum(counts[:maximum])])
    together = pair_counts(_ids(rows[:maximum]), counts[:maximum])
    possible = (
        together if allowed is None else pair_counts(_ids(allowed[:maximum]), counts[:maximum])
    )
    table = np.full((len(rows), len(_COLUMNS)), np.nan)
    untried: list[tuple[Any, ...]] = []
    missing = 0
    for i, one in enumerate(rows):
        seen = _count(one, len(one.prior)) > 0
        prior = one.prior if allowed is None else _shares(_count(allowed[i], len(one.prior)))
        real = seen | (prior > 0)
        table[i, :3] = real.sum(), np.mean(seen[real]), np.mean(_chance(prior[real], n))
        table[i, 5:7] = _part(seen, prior), _part(seen, one.volume * real)
        if one.single_values:
            never = np.flatnonzero(real & ~seen)
            missing += len(never)
            untried += [(one.name, one.marginal.shown(int(cell)), "", "") for cell in never]
        shares = []
        for j, other in enumerate(rows[:maximum]):
            if i == j or i >= maximum:
                continue
            block = np.s_[edges[i] : edges[i + 1], edges[j] : edges[j + 1]]
            both = together[block] > 0
            pair = np.outer(one.prior, other.prior)
            pair = pair if allowed is None else _shares(possible[block])
            real = both | (pair > 0)
            volume = np.outer(one.volume, other.volume) * real
            shares.append(
                (
                    np.mean(both[real]),
                    np.mean(_chance(pair[real], n)),
                    _part(both, pair),
                    _part(both, volume),
                )
            )
            if i < j and one.single_values and other.single_values:
                # A value that was never tried is not listed again with all of its partners.
                alive = np.outer(both.any(axis=1), both.any(axis=0))
                empty = np.argwhere(~both & real & alive)
                missing += len(empty)
                for a, b in empty[: max(0, MAX_UNTRIED - len(untried))].tolist():
                    first = (one.name, one.marginal.shown(a))
                    untried.append((*first, other.name, other.marginal.shown(b)))
        if shares:
            table[i, [3, 4, 7, 8]] = np.mean(shares, axis=0)
    untried.sort(key=lambda entry: entry[2] != "")
    index = pd.Index([c.name for c in rows], name="feature")
    heads = ["feature", "value", "other", "other_value"]
    return (
        pd.DataFrame(table, columns=list(_COLUMNS), index=index).astype({"cells": int}),
        pd.DataFrame(untried[:MAX_UNTRIED], columns=heads),
        missing,
    )


_COLUMNS = (
    *("cells", "occupied", "expected", "pairs", "expected_pairs"),
    *("mass", "volume", "pairs_mass", "pairs_volume"),
)


def _part(seen: Bool[np.ndarray, "*cells"], size: Float[np.ndarray, "*cells"]) -> float:
    """Return the share of the size of all cells that those with rows have."""
    return float(size[seen].sum() / max(size.sum(), 1e-300))


def _ids(rows: list[Cells]) -> Int[np.ndarray, "n d"]:
    return np.stack([cells.ids for cells in rows], axis=1)


def _count(cells: Cells, count: int) -> Int[np.ndarray, " cells"]:
    return np.bincount(cells.ids[cells.ids >= 0], minlength=count)


def _shares(counts: np.ndarray) -> Float[np.ndarray, "..."]:
    return counts / max(counts.sum(), 1)


def _chance(prior: Float[np.ndarray, "*cells"], n: int) -> Float[np.ndarray, "*cells"]:
    """Return the probabilities that some of `n` samples of the prior lie in a cell."""
    return 1 - (1 - prior) ** n


def pair_counts(
    ids: Int[np.ndarray, "n d"], counts: Int[np.ndarray, " d"]
) -> Float[np.ndarray, "cells cells"]:
    """Count the rows in each pair of cells, for all pairs of features."""
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
