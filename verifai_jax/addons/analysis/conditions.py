"""Conditions on features, and the regions of the feature space that they define.

>>> print(Between("masspole", above=0.31))
masspole > 0.31
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.analysis.data.columns import Column


@dataclass(frozen=True)
class Between:
    """A condition on numbers: greater than `above`, at most `upto`; `integer` for whole numbers.

    An absent entry never satisfies a condition.
    """

    feature: str
    above: float = -np.inf
    upto: float = np.inf
    integer: bool = False

    def matches(self, frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
        """Return which rows satisfy the condition."""
        values = frame[self.feature].to_numpy(np.float64)
        return (values > self.above) & (values <= self.upto)

    def __str__(self) -> str:
        if self.integer and self.upto - self.above == 1:
            return f"{self.feature} = {_number(self.upto)}"
        if np.isinf(self.above):
            return f"{self.feature} <= {_number(self.upto)}"
        if np.isinf(self.upto):
            return f"{self.feature} > {_number(self.above)}"
        return f"{_number(self.above)} < {self.feature} <= {_number(self.upto)}"


@dataclass(frozen=True)
class OneOf:
    """A condition on choices: one of those at `indices` of a column's `choices`."""

    column: Column
    indices: tuple[int, ...]

    @property
    def feature(self) -> str:
        """Name of the column."""
        return self.column.name

    def matches(self, frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
        """Return which rows satisfy the condition."""
        return np.isin(self.column.codes(frame[self.feature]), self.indices)

    def __str__(self) -> str:
        choices = self.column.choices
        others = [i for i in range(len(choices)) if i not in self.indices]
        excluded = len(others) < len(self.indices)
        named = ", ".join(str(choices[i]) for i in (others if excluded else self.indices))
        several = len(others if excluded else self.indices) > 1
        verb = ("is none of" if several else "is not") if excluded else "is"
        return f"{self.feature} {verb} {'one of ' * (several and not excluded)}{named}"


Condition: TypeAlias = Between | OneOf


@dataclass(frozen=True)
class Region:
    """A box: bounds on the ordered columns, and allowed choices of the unordered ones.

    **Fields:** `above` and `upto`: one bound for each column of `Samples.values()`, infinite for no
    bound; `allowed`: for each column of `Samples.codes()` the allowed indices, None for all.
    """

    above: tuple[float, ...]
    upto: tuple[float, ...]
    allowed: tuple[frozenset[int] | None, ...]

    def covers(
        self, values: Float[np.ndarray, "n k"], codes: Int[np.ndarray, "n m"]
    ) -> Bool[np.ndarray, " n"]:
        """Return which rows lie inside; absent entries only fit columns without a condition."""
        inside = np.ones(len(values), bool)
        for j, (above, upto) in enumerate(zip(self.above, self.upto, strict=True)):
            if np.isfinite(above):
                inside &= values[:, j] > above
            if np.isfinite(upto):
                inside &= values[:, j] <= upto
        for j, allowed in enumerate(self.allowed):
            if allowed is not None:
                inside &= np.isin(codes[:, j], list(allowed))
        return inside

    @property
    def size(self) -> int:
        """Number of columns with conditions."""
        ends = zip(self.above, self.upto, strict=True)
        bounded = sum(bool(np.isfinite(above) or np.isfinite(upto)) for above, upto in ends)
        return bounded + sum(allowed is not None for allowed in self.allowed)

    def bound(self, j: int, above: float = -np.inf, upto: float = np.inf) -> "Region":
        """Return the part of the region that satisfies a further bound on ordered column `j`."""
        return replace(
            self,
            above=_put(self.above, j, max(self.above[j], above)),
            upto=_put(self.upto, j, min(self.upto[j], upto)),
        )

    def restrict(self, j: int, indices: frozenset[int]) -> "Region":
        """Return the part of the region with only these choices of unordered column `j`."""
        before = self.allowed[j]
        indices = indices if before is None else before & indices
        return replace(self, allowed=_put(self.allowed, j, indices))

    def loosen(self) -> list["Region"]:
        """Return the regions that have one bound or restriction fewer."""
        found = []
        for j in range(len(self.above)):
            if np.isfinite(self.above[j]):
                found.append(replace(self, above=_put(self.above, j, -np.inf)))
            if np.isfinite(self.upto[j]):
                found.append(replace(self, upto=_put(self.upto, j, np.inf)))
        for j, allowed in enumerate(self.allowed):
            if allowed is not None:
                found.append(replace(self, allowed=_put(self.allowed, j, None)))
        return found

    def round(
        self, values: Float[np.ndarray, "n k"], codes: Int[np.ndarray, "n m"],
        integer: Sequence[bool],
    ) -> "Region":  # fmt: skip
        """Round the bounds to short numbers such that the region covers the same of these rows.

        **Arguments:**
        - `values` and `codes`: those of the rows.
        - `integer`: for each ordered column, whether it holds only whole numbers.
        """
        region = self
        for j in range(len(self.above)):
            for ends in ("above", "upto"):
                end = getattr(region, ends)[j]
                if np.isinf(end):
                    continue
                open_end = -np.inf if ends == "above" else np.inf
                without = replace(region, **{ends: _put(getattr(region, ends), j, open_end)})
                # Only rows that fulfil all else can tell where the bound is.
                present = np.unique(values[without.covers(values, codes), j])
                present = present[~np.isnan(present)]
                moved = _between_values(end, present, integer[j])
                region = replace(region, **{ends: _put(getattr(region, ends), j, moved)})
        return region

    def conditions(
        self, ordered: Sequence[Column], unordered: Sequence[Column]
    ) -> tuple[Condition, ...]:
        """Return the conditions of the region, one for each column."""
        found: list[Condition] = []
        for column, above, upto in zip(ordered, self.above, self.upto, strict=True):
            if np.isfinite(above) or np.isfinite(upto):
                found.append(Between(column.name, above, upto, column.integer))
        for column, allowed in zip(unordered, self.allowed, strict=True):
            if allowed is not None:
                found.append(OneOf(column, tuple(sorted(allowed))))
        return tuple(found)


def everywhere(ordered: int, unordered: int) -> Region:
    """Return the region without any condition."""
    return Region((-np.inf,) * ordered, (np.inf,) * ordered, (None,) * unordered)


def short_number(lowest: float, below: float, near: float) -> float:
    """Return the number with fewest decimals in `[least, below)`, of those the closest to `near`.

    >>> short_number(0.3071, 0.3164, 0.31175)
    0.31
    """
    if not lowest < below:
        return lowest
    first = int(np.floor(np.log10(max(abs(lowest), abs(below))))) + 1
    for decimals in range(-first, 18 - first):
        number = round(near, decimals)
        if lowest <= number < below:
            return number + 0.0  # No negative zero.
    return lowest


def _between_values(end: float, values: Float[np.ndarray, " n"], integer: bool) -> float:
    """Return a short number that divides values as `end` does."""
    index = int(np.searchsorted(values, end, side="right"))
    if index in (0, len(values)):
        # All values are on one side: no bound at all, as far as these rows can tell.
        return -np.inf if index == 0 else np.inf
    lowest, below = float(values[index - 1]), float(values[index])
    return float(np.floor(lowest)) if integer else short_number(lowest, below, (lowest + below) / 2)


def _put(entries: tuple, j: int, entry: object) -> tuple:
    return (*entries[:j], entry, *entries[j + 1 :])


def _number(value: float) -> str:
    return f"{value:z.12g}"
