"""Rules: descriptions of the failure region by conditions on features.

>>> print(rules(run))
masspole > 0.31 and theta0 > 0.04: covers 92 % of the failures, precision 0.95 (38 of 40 ...)

A rule is a box in the feature space. Boxes come from decision trees; conditions that do not help
are removed, and numbers are shortened. Boxes are added one by one until nearly all failures are
covered. Held-out rows measure their quality; conditions and boxes without support there are left
out.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.analysis.conditions import Condition, Region, everywhere
from verifai_jax.addons.analysis.data.columns import Column
from verifai_jax.addons.analysis.data.samples import Samples, Source
from verifai_jax.addons.analysis.trees import propose_regions
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.core.messages.text import format_percent
from verifai_jax.falsification.no_rate import why_no_rate
from verifai_jax.falsification.run import Run
from verifai_jax.statistics.binomial import Rate, clopper_pearson

MIN_FAILURES = 10
"""Failing rows, and safe rows, from which on rules are made and measured."""
FEW = 100
"""Failing rows below which their number may be why there is no rule."""
SUPPORT = 3
"""Failing rows in a rule at least, of those it is made from and of those it is measured on."""
MAX_MADE = 20_000
"""Failing rows, and safe rows, that rules are made from; all that are kept aside measure them."""
WORTH = 1.02
"""By how much a condition must raise the score of a rule."""
DENSER = 1.25
"""Times the share of failures everywhere that a rule's precision is at least."""
DOUBT = 0.003
"""Probability, without any relation, of what supports a condition on the rows kept aside: 5 % for
the 18 conditions of six rules together."""
KEY_VALUES = 2**16
"""Whole numbers from which on a feature may be a random key, which nothing depends on ..."""
DOUBT_OF_KEY = 1e-6
"""... so that a condition on it needs more support: a key is then never in a rule."""


@dataclass(frozen=True)
class Rule:
    """A box in the feature space, and how well it describes the failures.

    **Fields:** `conditions`, which must all hold; `coverage`: share of the held-out failures
    inside; `precision`: the share of held-out rows inside that fail, with its 95 % Clopper-Pearson
    interval.
    """

    conditions: tuple[Condition, ...]
    coverage: float
    precision: Rate
    region: Region = field(repr=False)

    def matches(self, frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
        """Return which rows of a table (any DataFrame with these features) lie inside."""
        inside = np.ones(len(frame), bool)
        for condition in self.conditions:
            inside &= condition.matches(frame)
        return inside

    @property
    def words(self) -> str:
        """The conditions as text."""
        return " and ".join(map(str, self.conditions)) or "everywhere"

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        covered = f"covers {format_percent(self.coverage)} of the failures"
        return f"{self.words}: {covered}, {_describe_precision(self.precision)}"


@dataclass(frozen=True, eq=False)
class Rules(Drawn, InNotebook):
    """Rules that together describe the failure region of a system, the best one first.

    **Fields:** `rules`; `coverage` and `precision` of all of them together, 0 and None without a
    rule; `unsupported`: number of further boxes that the held-out rows do not support; `made`:
    number of rows that rules are made from; `measured`: number of held-out rows; `doubt`: why
    precision is not a failure rate, empty if it is; `samples`: all rows with a verdict.
    """

    _picture = "verifai_jax.addons.analysis.pictures.panels", "plot_rules"
    """The rules over the two features that they use most."""
    rules: tuple[Rule, ...]
    coverage: float
    precision: Rate | None
    unsupported: int
    made: int
    measured: int
    doubt: str
    samples: Samples

    def matches(self, frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
        """Return which rows of a table lie inside at least one rule."""
        inside = np.zeros(len(frame), bool)
        for rule in self.rules:
            inside |= rule.matches(frame)
        return inside

    @property
    def table(self) -> pd.DataFrame:
        """One row for each rule: its text, and its coverage and precision on held-out rows."""
        columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
        for rule in self.rules:
            rate = rule.precision
            values = (rule.words, rule.coverage, rate.estimate, rate.low, rate.high)
            values += (rate.failures, rate.simulations)
            for name, value in zip(_COLUMNS, values, strict=True):
                columns[name].append(value)
        return pd.DataFrame(columns)

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        if not self.rules:
            return self._no_rule()
        lines = [str(rule) for rule in self.rules]
        if len(self.rules) > 1 and self.precision is not None:
            precision = _describe_precision(self.precision)
            lines.append(f"together: {format_percent(self.coverage)} of the failures, {precision}")
        if self.unsupported:
            lines.append(f"({self.unsupported} more left out: {_UNSUPPORTED})")
        lines.append(self.basis)
        return "\n".join(lines)

    def _no_rule(self) -> str:
        """Say why there is no rule."""
        name, failures = self.samples.name, int(self.samples.failing.sum())
        if few := _too_few(self.samples.failing):
            return f"no rules for {name!r}: {few}"
        if self.unsupported:
            return (
                f"no rule for the {failures:,} failures of {name!r}: {_UNSUPPORTED}. With more "
                "failures there may be one"
            )
        few = f", or are too few ({failures:,} of {len(self.samples):,})" if failures < FEW else ""
        return (
            f"no rule describes the failures of {name!r} much better than chance: "
            f"they lie everywhere, or depend on what is not in the table{few}; "
            "a greater depth allows more conditions"
        )

    @property
    def basis(self) -> str:
        """A description of the rows on which the numbers were measured, and of their meaning."""
        measured = f"measured on {self.measured:,} rows kept aside"
        if self.made < (others := len(self.samples) - self.measured):
            measured = f"made from {self.made:,} of {others:,} rows, {measured}"
        if self.doubt:
            return f"({measured}; precision is no rate of failure: {self.doubt})"
        return f"({measured}; precision is the rate of failure inside)"


_UNSUPPORTED = "what fits some failures does not hold on those kept aside"
_COLUMNS = ("rule", "coverage", "precision", "low", "high", "failures", "rows")


def rules(
    source: Source, depth: int = 3, *, cover: float = 0.95, max_rules: int = 6,
    held_out: float = 0.4, seed: int = 0,
) -> Rules:  # fmt: skip
    """Describe the failure region by a few boxes.

    **Arguments:**
    - `source`: a run, its table, a DataFrame, or `Samples` of `"all"` rows.
    - `depth`: maximum number of features with conditions in a rule.
    - `cover`: share of the failures to cover; `max_rules`: maximum number of rules.
    - `held_out`: share of the rows that are held out to measure coverage and precision, drawn by
      `seed` separately among failing and safe rows.
    - `seed`: the seed of the held-out rows.
    **Returns:** `Rules`. With fewer than 10 failing or safe rows there are no rules, and the result
    says so. A box is left out if it holds fewer than 3 held-out failures, or if failures in it are
    not clearly denser than overall (by the interval of its precision). A condition is left out if
    failures are not clearly denser inside than outside it, on the held-out rows (Fisher's exact
    test at 0.3 %; at one in a million for whole numbers with 65 536 values or more, which may be a
    random key).

    The next rule maximises the share of the remaining failures that it covers times the square of
    its precision among the remaining rows, so that precise rules are preferred to broad ones.
    Sources: trees of Breiman, Friedman, Olshen and Stone, Classification and regression trees
    (1984), whose theorem also gives the subsets of unordered values; sequential rules as in Clark
    and Niblett, The CN2 induction algorithm, Machine Learning 3 (1989).

    **Raises:** `ValueError` without failing or without safe rows, or for options out of range.
    """
    depth, max_rules = check_count("depth", depth), check_count("max_rules", max_rules)
    check_fraction("cover", cover, one=True)
    check_fraction("held_out", held_out)
    samples = Samples.of(source, "all")
    failing = samples.failing
    check_both(samples, "rules tell failing rows from safe ones")
    doubt = _doubt(source)
    if _too_few(failing):
        return Rules((), 0.0, None, 0, made=0, measured=0, doubt=doubt, samples=samples)
    aside = rows_set_aside(failing, held_out, seed)
    values, codes = samples.values(), samples.codes()
    made, weights = _thinned(failing, ~aside, seed)
    regions = _select_regions(
        values[made], codes[made], failing[made], weights, samples.unordered, depth, cover,
        max_rules,
    )  # fmt: skip
    integer = [column.integer for column in samples.ordered]
    regions = [region.round(values[made], codes[made], integer) for region in regions]
    found: list[Rule] = []
    union = np.zeros(int(aside.sum()), bool)
    unsupported = 0
    for region in regions:
        region = _supported(region, values[aside], codes[aside], failing[aside], samples)
        inside = region.covers(values[aside], codes[aside])
        measured = _measured(inside, failing[aside])
        if measured is None:
            unsupported += 1
        elif (inside & ~union & failing[aside]).any():
            # Without a condition, a box may have become one of those before it.
            conditions = region.conditions(samples.ordered, samples.unordered)
            found.append(Rule(conditions, *measured, region))
            union |= inside
    coverage, precision = _measured(union, failing[aside]) or (0.0, None)
    return Rules(
        rules=tuple(found), coverage=coverage, precision=precision, unsupported=unsupported,
        made=len(made), measured=int(aside.sum()), doubt=doubt, samples=samples,
    )  # fmt: skip


def _too_few(failing: Bool[np.ndarray, " n"]) -> str:
    """Say that there are too few failing or safe rows for rules; empty if there are enough."""
    counts = {"fail": int(failing.sum()), "are safe": int((~failing).sum())}
    for verb, count in counts.items():
        if count < MIN_FAILURES:
            return (
                f"only {count} of {len(failing):,} rows {verb}, and rules need {MIN_FAILURES} to "
                "be made from some and measured on others; simulate more"
            )
    return ""


def _doubt(source: Source) -> str:
    """Explain why the share of failures among rows is not their probability; empty if it is."""
    if not isinstance(source, Run):
        return "the rows may not be samples of the prior"
    if not source.prior:
        if source.origin in ("learned", "coverage"):
            return "this search does not sample the prior"
        return why_no_rate(source)
    return {
        "stop_after": "the run was stopped by its own counterexamples",
        "stop_when": "the run was stopped by its own outcomes",
        "interrupted": "a person ended the run, who may have seen its outcomes",
    }.get(source.stopped, "")


def check_both(samples: Samples, purpose: str) -> None:
    """Check that there are failing and safe rows; `purpose` says in the error what needs them.

    **Raises:** `ValueError` if one kind is missing.
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


def rows_set_aside(
    failing: Bool[np.ndarray, " n"], share: float, seed: int
) -> Bool[np.ndarray, " n"]:
    """Draw rows to hold out: the same share of failing and of safe ones."""
    aside = np.zeros(len(failing), bool)
    generator = np.random.default_rng(seed)
    for part in (failing, ~failing):
        rows = generator.permutation(np.flatnonzero(part))
        aside[rows[: max(1, round(share * len(rows)))]] = True
    return aside


def _thinned(
    failing: Bool[np.ndarray, " n"], among: Bool[np.ndarray, " n"], seed: int
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Draw at most `MAX_MADE` failing and safe rows each; return how many each stands for, too."""
    rows, weights = [], []
    for part in (np.flatnonzero(failing & among), np.flatnonzero(~failing & among)):
        kept = part
        if len(part) > MAX_MADE:
            kept = np.random.default_rng(seed).choice(part, MAX_MADE, replace=False)
        rows.append(kept)
        weights.append(np.full(len(kept), len(part) / max(len(kept), 1)))
    order = np.argsort(np.concatenate(rows), kind="stable")
    return np.concatenate(rows)[order], np.concatenate(weights)[order]


def _select_regions(
    values: Float[np.ndarray, "n k"], codes: Int[np.ndarray, "n m"],
    failing: Bool[np.ndarray, " n"], weights: Float[np.ndarray, " n"],
    unordered: tuple[Column, ...], depth: int, cover: float, max_rules: int,
) -> list[Region]:  # fmt: skip
    """Select regions that together cover the failures, each from what those before left over."""
    bad = failing * weights
    base = bad.sum() / weights.sum()
    # Denser in failures than everywhere, or half of what is missing to all.
    dense = min(DENSER * base, (1 + base) / 2)
    remaining = np.ones(len(failing), bool)
    found: list[Region] = []
    while len(found) < max_rules and bad[remaining].sum() > (1 - cover) * bad.sum():

        def score(region: Region, left: Bool[np.ndarray, " n"] = remaining) -> float:
            inside = region.covers(values, codes) & left
            new = bad[inside].sum()
            precision = new / max(weights[inside].sum(), 1)
            return float(new / bad[left].sum() * precision**2 * (precision >= dense))

        # The region of a tree, cut further by trees of what is left inside.
        best, grown = everywhere(values.shape[1], codes.shape[1]), True
        while grown:
            rows = remaining & best.covers(values, codes)
            tried = propose_regions(
                best, values[rows], codes[rows], failing[rows], weights[rows], unordered, depth
            )
            tried = [region for region in tried if region.size <= depth]
            finer = max(tried, key=score, default=best)
            grown = score(finer) > WORTH * score(best)
            best = _simplify(finer, score) if grown else best
        if score(best) == 0:
            break
        inside = best.covers(values, codes)
        if (inside & failing & remaining).sum() < max(SUPPORT, 0.02 * failing.sum()):
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


def _supported(
    region: Region, values: Float[np.ndarray, "n k"], codes: Int[np.ndarray, "n m"],
    failing: Bool[np.ndarray, " n"], samples: Samples,
) -> Region:  # fmt: skip
    """Remove the conditions that rows kept aside do not support, the worst one first."""
    while region.size:
        inside = region.covers(values, codes)
        doubts = []
        for looser in region.loosen():
            beyond = looser.covers(values, codes) & ~inside
            excess = _chance_of_more(inside, beyond, failing) / _doubt_allowed(
                region, looser, samples
            )
            doubts.append((excess, looser))
        worst, looser = max(doubts, key=lambda doubt: doubt[0])
        if worst <= 1:
            break
        region = looser
    return region


def _chance_of_more(
    inside: Bool[np.ndarray, " n"], beyond: Bool[np.ndarray, " n"], failing: Bool[np.ndarray, " n"]
) -> float:
    """Return the probability of this number of failures inside if the condition had no effect."""
    from scipy.stats import hypergeom

    both = inside | beyond
    failures, hits = int((both & failing).sum()), int((inside & failing).sum())
    return float(hypergeom.sf(hits - 1, int(both.sum()), failures, int(inside.sum())))


def _doubt_allowed(region: Region, looser: Region, samples: Samples) -> float:
    """Return how probable, without any relation, what supports a condition may be."""
    for j, column in enumerate(samples.ordered):
        ends = ("above", "upto")
        changed = any(getattr(region, end)[j] != getattr(looser, end)[j] for end in ends)
        if changed and column.integer and column.far - column.near >= KEY_VALUES - 1:
            return DOUBT_OF_KEY
    return DOUBT


def _measured(
    inside: Bool[np.ndarray, " n"], failing: Bool[np.ndarray, " n"]
) -> tuple[float, Rate] | None:
    """Measure coverage and precision on rows kept aside; None if these do not support it."""
    hits = int((inside & failing).sum())
    if hits < SUPPORT:
        return None
    rate = clopper_pearson(hits, int(inside.sum()))
    return (hits / int(failing.sum()), rate) if rate.low > failing.mean() else None


def _describe_precision(rate: Rate) -> str:
    return (
        f"precision {rate.estimate:z.2f} ({rate.failures:,} of {rate.simulations:,}; "
        f"{rate.confidence * 100:zg} % interval {rate.low:z.2f} to {rate.high:z.2f})"
    )
