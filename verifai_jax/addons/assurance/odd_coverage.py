"""Coverage of an operational design domain by the rows of a table.

found = odd_coverage(domain, run)
found.table                                         # by attribute: cells, rows, volume, prior mass
found.pairs                                         # by pair of attributes
found.next_points(10)                               # what to simulate next
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import jax
import numpy as np
import pandas as pd
from jaxtyping import Int

from verifai_jax.addons.analysis.data.samples import Samples, Source
from verifai_jax.addons.assurance.odd_conditions import Attribute
from verifai_jax.addons.assurance.operational_domain import OperationalDomain, choices_of, words
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import Tabular
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.text import format_percent

DRAWN = 2**15
"""Points of the domain, and of the prior, by which shares are measured: to half a percent."""
MAX_VALUES = 20
"""Maximum number of values of an integer that each get a cell."""
MAX_CELLS = 2**30
"""Cells of an attribute at most, for which a pair of cells is one number."""
CANDIDATES = 4096
"""Points of the domain among which the next ones are chosen."""
Codes = dict[str, np.ndarray]
"""The cell of each row by attribute; -1 outside."""


@dataclass(frozen=True, eq=False)
class OddCoverage(Tabular):
    """Coverage of a domain, as `odd_coverage` measures it.

    - `table`: one row for each attribute: its `feature`, `inside` (the values the domain allows),
      `cells`, the number `occupied` by a row, and the shares of the domain's `volume` and of the
      prior's `mass` in occupied cells. The mass is NaN if no prior is known.
    - `pairs`: the same for pairs of attributes.
    - `rows`, `outside`: number of rows, and of those outside the domain.
    - `prior_inside`: share of the prior inside the domain.
    """

    domain: OperationalDomain = field(repr=False)
    table: pd.DataFrame
    pairs: pd.DataFrame = field(repr=False)
    rows: int
    outside: int
    prior_inside: float
    _codes: Codes = field(repr=False)
    _points: pd.DataFrame = field(repr=False)
    _drawn: Codes = field(repr=False)

    def on_page(self, page: Any) -> Any:
        """Return a report's page with a section on this coverage."""
        return lazy_import("verifai_jax.addons.assurance.odd_section", "with_odd")(page, self)

    def next_points(self, count: int = 10) -> pd.DataFrame:
        """Return points inside the domain that occupy many empty cells and pairs of cells.

        **Arguments:**
        - `count`: number of points.
        **Returns:** their features, a row each, with `new`, the number of cells and pairs that each
        occupies first.
        """
        check_count("count", count)
        drawn = {name: codes[:CANDIDATES] for name, codes in self._drawn.items()}
        known = self._codes
        open_cells = []
        for names in [*((name,) for name in drawn), *combinations(drawn, 2)]:
            taken = np.isin(_keys(drawn, names), _keys(known, names)) if known else False
            open_cells.append((_keys(drawn, names), ~np.broadcast_to(taken, len(self._points))))
        chosen, new = [], []
        for _ in range(count):
            gain = np.sum([still for _, still in open_cells], axis=0)
            best = int(np.argmax(gain))
            if not gain[best]:
                break
            chosen.append(best)
            new.append(int(gain[best]))
            open_cells = [(keys, still & (keys != keys[best])) for keys, still in open_cells]
        found = self._points.iloc[chosen].reset_index(drop=True)
        return found.assign(new=new)

    def __str__(self) -> str:
        outside = f"{self.outside:,} of them outside the domain"
        lines = [f"{self.domain.name}: {self.rows:,} rows, {outside}"]
        if self.prior_inside == self.prior_inside:
            lines[0] += f"; {format_percent(self.prior_inside)} of the prior is inside"
        for name, row in self.table.to_dict("index").items():
            if not row["feature"]:
                lines.append(f"  {name}: never varied, as no feature stands for it")
                continue
            mass = row["mass"]
            prior = f", {format_percent(mass)} of the prior" if mass == mass else ""
            lines.append(
                f"  {name}: {row['occupied']} of {row['cells']} cells of {row['inside']}, "
                f"{format_percent(row['volume'])} of the volume{prior}"
            )
        if len(self.pairs):
            volumes = {each: row["volume"] for each, row in self.pairs.to_dict("index").items()}
            mean = float(np.mean([*volumes.values()]))
            text = f"{format_percent(mean)} of the volume on average"
            if len(volumes) > 1:
                worst: Any = min(volumes, key=volumes.__getitem__)
                text += f", {format_percent(volumes[worst])} of {' with '.join(worst)}"
            lines.append(f"  pairs of attributes: {text}")
        return "\n".join(lines)

    __repr__ = __str__


def odd_coverage(
    domain: OperationalDomain, source: Source, *, cells: int = 10, seed: int = 0
) -> OddCoverage:
    """Measure how much of a domain rows cover: by attribute, pair, volume and prior mass.

    **Arguments:**
    - `domain`: the domain; its attributes, not the features, are cut into cells of equal width.
    - `source`: a run, its table, or a DataFrame; all rows with a verdict are used.
    - `cells`: number of cells of a range; literals, and integers of up to 20 values, have a cell
      for each value.
    - `seed`: the seed of the points of the prior, and of those that measure shares of a domain
      whose conditions couple attributes.
    **Returns:** an `OddCoverage`.
    **Raises:** `ValueError` without rows, and for an attribute that has a feature but no range.
    """
    check_count("cells", cells, 2)
    samples = Samples.of(source, "all")
    frame = samples.table.loc[samples.rows]
    cuts = {each.name: _Cut(each, domain, cells) for each in domain.features.values()}
    rng = np.random.default_rng(seed)
    points = pd.DataFrame({cut.attribute.feature: cut.draw(rng) for cut in cuts.values()})
    points = _rows(points, domain.holds(points))
    if not len(points):
        raise ValueError(f"no point of {domain.name} was found: its conditions leave nothing")
    exact = domain.is_box
    inside = domain.holds(frame)
    codes = _coded(cuts, domain, _rows(frame, inside))
    drawn = _coded(cuts, domain, points)
    share, mass_of = float("nan"), {}
    if samples.space is not None:
        key = jax.random.key(seed, impl="threefry2x32")
        prior = pd.DataFrame(samples.space.rows(samples.space.sample(key, DRAWN)))
        within = domain.holds(prior)
        share = float(np.mean(within))
        mass_of = _coded(cuts, domain, _rows(prior, within))

    def measured(names: tuple[str, ...]) -> dict[str, float]:
        possible = np.unique(_keys(drawn, names))
        total = int(np.prod([cuts[name].count for name in names])) if exact else len(possible)
        if any(name not in codes for name in names):
            mass = 0.0 if mass_of else np.nan
            return {"cells": total, "occupied": 0, "volume": 0.0, "mass": mass}
        taken = np.unique(_keys(codes, names))
        taken = taken[taken >= 0]
        volume = len(taken) / total if exact else np.mean(np.isin(_keys(drawn, names), taken))
        mass = np.nan
        if all(name in mass_of for name in names) and len(mass_of[names[0]]):
            mass = float(np.mean(np.isin(_keys(mass_of, names), taken)))
        return {"cells": total, "occupied": len(taken), "volume": float(volume), "mass": mass}

    rows = {}
    for each in domain.attributes:
        about = {"feature": each.feature, "inside": words(each, domain.hull(each))}
        empty = {"cells": 0, "occupied": 0, "volume": 0.0, "mass": 0.0}
        rows[each.name] = about | (measured((each.name,)) if each.feature else empty)
    pairs = {names: measured(names) for names in combinations(cuts, 2)}
    return OddCoverage(
        domain, pd.DataFrame.from_dict(rows, orient="index"),
        pd.DataFrame.from_dict(pairs, orient="index"), len(frame), int(np.sum(~inside)), share,
        codes, points.head(CANDIDATES), drawn,
    )  # fmt: skip


class _Cut:
    """An attribute cut into cells."""

    def __init__(self, attribute: Attribute, domain: OperationalDomain, cells: int) -> None:
        self.attribute, hull = attribute, domain.hull(attribute)
        ends = choices_of(attribute, hull)
        self.codes = np.array(sorted(hull)) if isinstance(hull, frozenset) else None
        self.values = ends if isinstance(ends, list) else None
        self.low, self.high = (0.0, 0.0) if isinstance(ends, list) else ends
        whole = attribute.kind == "integer"
        wide = int(self.high - self.low) + 1 if whole else 0
        self.integer = whole
        if whole:
            self.low, self.high = self.low - 0.5, self.high + 0.5
        self.count = cells if not 0 < wide <= MAX_VALUES else wide
        if self.values is not None:
            self.count = len(self.values)
        elif self.low == self.high:
            self.count = 1

    def code(self, x: np.ndarray) -> Int[np.ndarray, " n"]:
        """Return the cell of each value; -1 outside."""
        if self.codes is not None:
            at = np.searchsorted(self.codes, x).clip(0, self.count - 1)
            return np.where(self.codes[at] == x, at, -1)
        width = (self.high - self.low) or 1.0
        at = np.floor((x - self.low) / width * self.count)
        found = np.where(x == self.high, self.count - 1, at)
        return np.where((x >= self.low) & (x <= self.high), found, -1).astype(int)

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """Return values that are uniform over the attribute."""
        if self.values is not None:
            return np.array(self.values, object)[rng.integers(0, self.count, DRAWN)]
        found = rng.uniform(self.low, self.high, DRAWN)
        return np.clip(np.rint(found), self.low + 0.5, self.high - 0.5) if self.integer else found


def _rows(frame: pd.DataFrame, which: np.ndarray) -> pd.DataFrame:
    found: Any = frame[which]
    return found.reset_index(drop=True)


def _coded(cuts: Mapping[str, _Cut], domain: OperationalDomain, frame: pd.DataFrame) -> Codes:
    return {name: cuts[name].code(x) for name, x in domain.values(frame).items()}


def _keys(codes: Codes, names: tuple[str, ...]) -> Int[np.ndarray, " n"]:
    """Return one number for the cells of several attributes; -1 where one is outside."""
    if any(name not in codes for name in names):
        return np.array([], int)
    found, lost = np.zeros(len(codes[names[0]]), int), np.zeros(len(codes[names[0]]), bool)
    for name in names:
        found, lost = found * MAX_CELLS + codes[name], lost | (codes[name] < 0)
    return np.where(lost, -1, found)
