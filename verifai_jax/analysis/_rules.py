"""Rules that describe in words where a system fails.

>>> print(rules(run))
masspole > 0.31 and theta0 > 0.04: covers 92 % of the failures, precision 0.95 (38 of 40 ...)

A rule is a box in the feature space. Boxes come from decision trees, are freed of conditions that
do not help, written in short numbers, and taken one by one until nearly all failures are covered.
How well they do is measured on rows that were kept aside.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from verifai_jax.analysis.conditions import Condition, Region, everywhere
from verifai_jax.analysis.data.columns import Column
from verifai_jax.analysis.data.samples import Samples, Source
from verifai_jax.analysis.trees import propose_regions
from verifai_jax.core.checks import check_count, check_fraction
from verifai_jax.core.figure import Figure
from verifai_jax.core.lazy import late
from verifai_jax.core.text import format_percent
from verifai_jax.falsification.run import Run
from verifai_jax.statistics.binomial import Rate, clopper_pearson

FEWEST = 10
"""Failing rows, and safe rows, from which on some are kept aside."""
WORTH = 1.02
"""By how much a condition must raise the score of a rule."""


@dataclass(frozen=True)
class Rule:
    """One box in the feature space, and how well it describes the failures.

    **Fields:** `conditions`, all of which must be fulfilled; `coverage`: share of the measured
    failures inside; `precision`: how many of the measured rows inside fail, with its 95 %
    Clopper-Pearson interval, None where none lies inside.
    """

    conditions: tuple[Condition, ...]
    coverage: float
    precision: Rate | None
    region: Region = field(repr=False)

    def matches(self, frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
        """Return the rows of a table (any DataFrame with these features) that lie inside."""
        inside = np.ones(len(frame), bool)
        for condition in self.conditions:
            inside &= condition.matches(frame)
        return inside

    @property
    def words(self) -> str:
        """The conditions alone."""
        return " and ".join(map(str, self.conditions)) or "everywhere"

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        covered = f"covers {format_percent(self.coverage)} of the failures"
        return f"{self.words}: {covered}, {_describe_precision(self.precision)}"


@dataclass(frozen=True, eq=False)
class Rules:
    """Rules that together describe where a system fails, the best one first.

    **Fields:** `rules`; `coverage` and `precision` of all of them together; `held_out`: whether
    they were measured on rows kept aside; `measured`: how many rows that is; `doubt`: why
    precision is no rate of failure, empty where it is; `samples`: all rows with a verdict.
    """

    rules: tuple[Rule, ...]
    coverage: float
    precision: Rate | None
    held_out: bool
    measured: int
    doubt: str
    samples: Samples

    def matches(self, frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
        """Return the rows of a table that lie inside any of the rules."""
        inside = np.zeros(len(frame), bool)
        for rule in self.rules:
            inside |= rule.matches(frame)
        return inside

    @property
    def table(self) -> pd.DataFrame:
        """One row a rule: its words, coverage and precision as measured."""
        columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
        for rule in self.rules:
            rate = rule.precision
            values = (rule.words, rule.coverage, *_numbers(rate))
            for name, value in zip(_COLUMNS, values, strict=True):
                columns[name].append(value)
        return pd.DataFrame(columns)

    def plot(self, path: str | Path | None = None) -> Figure:
        """Draw the rules over the two features that they use most.

        **Arguments:**

        - `path`: of a picture to write; none when left out.

        **Returns:** the figure.
        """
        return late("verifai_jax.plotting.panels", "plot_rules")(self, path)

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        if not self.rules:
            return (
                f"no rule describes the failures of {self.samples.name!r} much better than chance: "
                "they lie everywhere, or depend on what is not in the table; "
                "a greater depth allows more conditions"
            )
        lines = [str(rule) for rule in self.rules]
        if len(self.rules) > 1:
            precision = _describe_precision(self.precision)
            lines.append(f"together: {format_percent(self.coverage)} of the failures, {precision}")
        lines.append(self.basis)
        return "\n".join(lines)

    @property
    def basis(self) -> str:
        """The rows that the numbers were measured on, and their meaning."""
        measured = (
            f"measured on {self.measured:,} rows kept aside"
            if self.held_out
            else f"measured on the {self.measured:,} rows that the rules were made from, so too "
            "good: there are too few to keep some aside"
        )
        if self.doubt:
            return f"({measured}; precision is no rate of failure: {self.doubt})"
        return f"({measured}; precision is the rate of failure inside)"


_COLUMNS = ("rule", "coverage", "precision", "low", "high", "failures", "rows")


def rules(
    source: Source,
    depth: int = 3,
    *,
    cover: float = 0.95,
    most: int = 6,
    held_out: float = 0.4,
    seed: int = 0,
) -> Rules:
    """Describe the failure region by a few boxes.

    **Arguments:**

    - `source`: a run, its table, a DataFrame, or `Samples` of `"all"` rows.
    - `depth`: features that a rule has conditions on at most.
    - `cover`: share of the failures to cover; `most` rules at most.
    - `held_out`: share of the rows that are kept aside to measure coverage and precision, drawn by
      `seed` among failing and safe rows alike. With fewer than 10 failing or safe rows all of them
      are used for both, and the result says so.
    - `seed`: of the rows kept aside.

    **Returns:** `Rules`.

    A rule is chosen for the share of the remaining failures that it covers times the square of its
    precision among the remaining rows, so that a precise half is worth more than a vague whole.
    Sources: trees of Breiman, Friedman, Olshen and Stone, Classification and regression
    trees (1984), whose theorem also gives the subsets of unordered values; rules one after another
    as in Clark and Niblett, The CN2 induction algorithm, Machine Learning 3 (1989).

    **Raises:** `ValueError` without failing or without safe rows, or for options out of range.
    """
    depth, most = check_count("depth", depth), check_count("most", most)
    check_fraction("cover", cover, one=True)
    check_fraction("held_out", held_out)
    samples = Samples.of(source, "all")
    failing = samples.failing
    check_both(samples, "rules tell failing rows from safe ones")
    aside = _aside(failing, held_out, seed)
    values, codes = samples.values(), samples.codes()
    made = ~aside
    regions = _select_regions(
        values[made], codes[made], failing[made], samples.unordered, depth, cover, most
    )
    integer = [column.integer for column in samples.ordered]
    regions = [region.round(values[made], codes[made], integer) for region in regions]
    measured = aside if aside.any() else made
    inside: Any = np.array([r.covers(values[measured], codes[measured]) for r in regions], bool)
    inside = inside.reshape(len(regions), int(measured.sum()))
    found = tuple(
        Rule(
            region.conditions(samples.ordered, samples.unordered),
            *_measured(covered, failing[measured]),
            region,
        )
        for region, covered in zip(regions, inside, strict=True)
    )
    coverage, precision = _measured(inside.any(axis=0), failing[measured])
    return Rules(
        rules=found,
        coverage=coverage,
        precision=precision,
        held_out=bool(aside.any()),
        measured=int(measured.sum()),
        doubt=_doubt(source),
        samples=samples,
    )


def _doubt(source: Source) -> str:
    """Explain why the share of failures among rows is not their probability; empty where it is."""
    if not isinstance(source, Run):
        return "the rows may not be samples of the prior"
    if not source.prior:
        return "this search does not sample the prior"
    if source.stopped == "stop_after":
        return "the run was stopped by its own counterexamples"
    return ""


def check_both(samples: Samples, purpose: str) -> None:
    """Check that there are failing and safe rows, which `purpose` needs.

    **Raises:** `ValueError` where there are not.
    """
    failures = int(samples.failing.sum())
    if failures == 0:
        raise ValueError(
            f"{purpose}, and no row of {len(samples):,} fails; search longer or with an active "
            "search, or look at the robustness: importance(run)"
        )
    if failures == len(samples):
        raise ValueError(
            f"{purpose}, and all of {failures:,} rows fail; simulate more of the space "
            "(search='uniform'), or look at the property"
        )


def _aside(failing: Bool[np.ndarray, " n"], share: float, seed: int) -> Bool[np.ndarray, " n"]:
    """Draw rows to keep aside: the same share of failing and of safe ones."""
    aside = np.zeros(len(failing), bool)
    if min(failing.sum(), (~failing).sum()) < FEWEST:
        return aside
    generator = np.random.default_rng(seed)
    for part in (failing, ~failing):
        rows = generator.permutation(np.flatnonzero(part))
        aside[rows[: max(1, round(share * len(rows)))]] = True
    return aside


def _select_regions(
    values: Float[np.ndarray, "n k"],
    codes: Int[np.ndarray, "n m"],
    failing: Bool[np.ndarray, " n"],
    unordered: tuple[Column, ...],
    depth: int,
    cover: float,
    most: int,
) -> list[Region]:
    """Select regions that together cover the failures, each from what those before left over."""
    base = failing.mean()
    # Twice as dense in failures as everywhere, or half of what is missing to all.
    dense = min(2 * base, (1 + base) / 2)
    remaining = np.ones(len(failing), bool)
    found: list[Region] = []
    while len(found) < most and (failing & remaining).sum() > (1 - cover) * failing.sum():

        def score(region: Region, left: Bool[np.ndarray, " n"] = remaining) -> float:
            inside = region.covers(values, codes) & left
            new = (inside & failing).sum()
            precision = new / max(inside.sum(), 1)
            return float(new / (failing & left).sum() * precision**2 * (precision >= dense))

        # The region of a tree, cut further by trees of what is left inside.
        best, grown = everywhere(values.shape[1], codes.shape[1]), True
        while grown:
            rows = remaining & best.covers(values, codes)
            tried = propose_regions(
                best, values[rows], codes[rows], failing[rows], unordered, depth
            )
            tried = [region for region in tried if region.size <= depth]
            finer = max(tried, key=score, default=best)
            grown = score(finer) > WORTH * score(best)
            best = _simplify(finer, score) if grown else best
        if score(best) == 0:
            break
        inside = best.covers(values, codes)
        if (inside & failing & remaining).sum() < 0.02 * failing.sum():
            break
        found.append(best)
        remaining = remaining & ~inside
    return found


def _simplify(region: Region, score: Callable[[Region], float]) -> Region:
    """Remove conditions of a region that hardly raise the score."""
    value = score(region)
    while looser := region.loosen():
        best = max(looser, key=score)
        if WORTH * score(best) < value:
            break
        region, value = best, score(best)
    return region


def _measured(
    inside: Bool[np.ndarray, " n"], failing: Bool[np.ndarray, " n"]
) -> tuple[float, Rate | None]:
    covered, hits = int(inside.sum()), int((inside & failing).sum())
    rate = clopper_pearson(hits, covered) if covered else None
    return hits / max(int(failing.sum()), 1), rate


def _numbers(rate: Rate | None) -> tuple[float, float, float, int, int]:
    if rate is None:
        return np.nan, 0.0, 1.0, 0, 0
    return rate.estimate, rate.low, rate.high, rate.failures, rate.simulations


def _describe_precision(rate: Rate | None) -> str:
    if rate is None:
        return "no measured row inside"
    return (
        f"precision {rate.estimate:.2f} ({rate.failures:,} of {rate.simulations:,}; "
        f"{rate.confidence * 100:g} % interval {rate.low:.2f} to {rate.high:.2f})"
    )
