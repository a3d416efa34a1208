"""The result of a comparison: failure rates, their difference, and the differing features."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Array, Key

from verifai_jax.addons.estimation.paired_rates import PairedRates
from verifai_jax.core.compute.keys import run_keys, simulation_key
from verifai_jax.core.display.figure import Drawn, Reported
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook, picture_html
from verifai_jax.core.messages.text import format_percent
from verifai_jax.core.values.trace import Trace
from verifai_jax.features import FeatureSpace

if TYPE_CHECKING:
    import pandas as pd
WORSE, BETTER, SAME, UNDECIDED = "worse", "better", "the same", "undecided"
"""Verdicts on the second of two problems."""


@dataclass(frozen=True, eq=False)
class Compared:
    """One candidate against the baseline.

    - `name`: the name of the candidate.
    - `rates`: the difference of their failure rates, candidate minus baseline.
    - `both`: pairs in which both fail.
    - `margin`: the largest difference that does not matter.
    - `discordant`: the pairs in which only one fails, a row each with the features; `worse` is true
      if the candidate fails. Its index is the number of the pair; `Comparison.random_key` gives the
      key.
    - `pairs`: features of all pairs, with `worse` and `better`; None if they were not kept.
    - `undisturbed`: the difference in the same pairs without disturbances, and the failures of
      both there; None if the problem has none.
    """

    name: str
    rates: PairedRates
    both: int
    margin: float
    discordant: "pd.DataFrame" = field(repr=False)
    pairs: "pd.DataFrame" = field(repr=False)
    space: FeatureSpace = field(repr=False)
    undisturbed: tuple[PairedRates, int, int] | None = None

    @property
    def verdict(self) -> str:
        """`"worse"` (by more than the margin), `"better"`, `"the same"` or `"undecided"`."""
        return judge(self.rates, self.margin)

    def rules(self, **options: Any) -> Any:
        """Describe the region where only the candidate fails by boxes; see `analysis.rules`.

        **Raises:** `ValueError` if there is no such pair.
        """
        rows = self.pairs.assign(violated=self.pairs["worse"]).drop(columns=["worse", "better"])
        return _rules(rows, self.space, options)

    def __str__(self) -> str:
        rates, words = self.rates, self.verdict.upper()
        margin = "" if not self.margin else f" (margin {100 * self.margin:zg} points)"
        first = rates.only_first + self.both
        second = rates.only_second + self.both
        known = rates.pairs - rates.undecided
        without = f", {rates.undecided:,} without a verdict" if rates.undecided else ""
        shares = "no pair has both verdicts"
        if known:
            shares = (
                f"fails in {format_percent(second / known)} of {known:,} pairs, the baseline in "
                f"{format_percent(first / known)}: {rates}"
            )
        calm = f"\n    {self.calm}" if self.calm else ""
        return (
            f"{self.name} is {words}{margin}: {shares}\n"
            f"    {rates.only_second:,} pairs fail with it only, {rates.only_first:,} with the "
            f"baseline only, {self.both:,} with both{without}{calm}"
        )

    @property
    def calm(self) -> str:
        """A sentence on the pairs without disturbances; empty if the problem has none."""
        if self.undisturbed is None:
            return ""
        rates, first, second = self.undisturbed
        return (
            f"without disturbances it fails in {format_percent(second / rates.pairs)} of the "
            f"same pairs, the baseline in {format_percent(first / rates.pairs)}: {rates}"
        )


@dataclass(frozen=True, eq=False)
class Comparison(Reported, InNotebook):
    """Candidates against a baseline on common samples, as `compare` returns them.

    - `baseline`: the name of the baseline.
    - `candidates`: a `Compared` for each.
    - `simulations`: number of all simulations.
    - `stopped`: `"decided"`, `"budget"`, `"max_seconds"` or `"interrupted"`.
    - `seconds`, `seed`: time and seed of the comparison.
    - `notes`: differences of the two sides, apart from the system.
    - `sources`: the files of each side's model, by its name, as a run records them; the baseline
      has the name `"baseline"`.
    """

    _report = "verifai_jax.addons.estimation.report.comparison_report", "comparison_page"

    baseline: str
    candidates: tuple[Compared, ...]
    simulations: int
    stopped: str
    seconds: float
    seed: int
    notes: tuple[str, ...] = ()
    sources: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, repr=False)

    def __getitem__(self, name: str) -> Compared:
        """Return the candidate of this name."""
        return {candidate.name: candidate for candidate in self.candidates}[name]

    def random_key(self, pair: int) -> Key[Array, ""]:
        """Return the random key of both sides of a pair, by its index in `discordant`.

        If a system draws random numbers, its failure occurs again under this key.
        """
        return simulation_key(run_keys(self.seed)[1], pair)

    @property
    def verdict(self) -> str:
        """The verdict on the only candidate, or the worst of several."""
        verdicts = [candidate.verdict for candidate in self.candidates]
        return min(verdicts, key=(WORSE, UNDECIDED, SAME, BETTER).index)

    @property
    def regression(self) -> bool:
        """True if a candidate is worse by more than the margin."""
        return any(candidate.verdict == WORSE for candidate in self.candidates)

    def __str__(self) -> str:
        confidence = self.candidates[0].rates.confidence
        together = ""
        if len(self.candidates) > 1:
            whole = 1 - len(self.candidates) * (1 - confidence)
            together = f"; all intervals hold together at {format_percent(whole)}"
        lines = [f"against {self.baseline}, on the same samples{together}"]
        lines += [f"  {candidate}" for candidate in self.candidates]
        lines.append(
            f"  {self.simulations:,} simulations in {self.seconds:z.1f} s, seed {self.seed}; "
            f"stopped: {self.stopped}"
        )
        lines += [f"  note: {note}" for note in self.notes]
        return "\n".join(lines)

    __repr__ = __str__


def _rules(rows: "pd.DataFrame", space: FeatureSpace, options: Mapping[str, Any]) -> Any:
    """Describe the violating ones of these rows by boxes of their features."""
    samples = lazy_import("verifai_jax.addons.analysis.data.samples", "Samples")
    return lazy_import("verifai_jax.addons.analysis", "rules")(
        samples.of(rows, "all", list(space.columns), space), **options
    )


def judge(rates: PairedRates, margin: float) -> str:
    """Decide from an interval: worse or better by more than the margin, the same, or undecided."""
    if rates.low > margin:
        return WORSE
    if margin and rates.low >= -margin and rates.high <= margin:
        return SAME
    return BETTER if rates.high < 0 else UNDECIDED


def judge_score(low: float, high: float, margin: float) -> str:
    """Decide from the interval of a difference of scores, of which more is better."""
    if high < -margin:
        return WORSE
    if margin and low >= -margin and high <= margin:
        return SAME
    return BETTER if low > 0 else UNDECIDED


@dataclass(frozen=True, eq=False)
class Transfer(Drawn, Reported, InNotebook):
    """The same policy in two engines, `a` and `b`, as `transfer` returns it.

    - `names`: the names of the two problems.
    - `table`: a row for each pair: its features; `robustness_a`, `violated_a` and those of b; the
      greatest `gap` of the traces in units of the range of a `signal`; `rounding`, the gap that
      rounding can cause; `parted`, the first time in seconds at which the traces differ by more;
      `differs`, whether they ever do; `searched`, whether the search chose the pair; `proper`,
      whether both simulations ended.
    - `space`: the space of the common features.
    - `influence`: each coordinate's share of the gap's variance among samples, from 0 to 1.
    - `worst`: the row with the largest gap, with both traces; None if no pair differs.
    - `tolerance`, `seed`: as given to `transfer`.
    - `stopped`: `"budget"` or `"interrupted"`.
    - `seconds`: duration of the comparison.
    - `notes`: further differences of the two problems.
    - `sources`: the files of each model, as a run records them.
    """

    _report = "verifai_jax.addons.estimation.report.transfer_report", "transfer_page"
    _picture = "verifai_jax.addons.estimation.pictures.transfer", "plot_transfer"
    """The pair that parts most, and the gaps of all by the feature that matters most."""
    names: tuple[str, str]
    table: "pd.DataFrame" = field(repr=False)
    space: FeatureSpace = field(repr=False)
    influence: Mapping[str, float]
    worst: tuple[int, Trace, Trace] | None = field(repr=False)
    tolerance: float
    stopped: str
    seconds: float
    seed: int
    notes: tuple[str, ...] = ()
    sources: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, repr=False)

    @property
    def differs(self) -> bool:
        """True if the traces of a pair differ by more than rounding can explain."""
        return bool(self.table["differs"].any())

    @property
    def flips(self) -> "pd.DataFrame":
        """The pairs that differ and in which only one simulation fails."""
        table: Any = self.table
        return table[table["differs"] & (table["violated_a"] != table["violated_b"])]

    def random_key(self, row: int) -> Key[Array, ""]:
        """Return the random key of both simulations of a row of the table."""
        return simulation_key(run_keys(self.seed)[1], row)

    def rules(self, **options: Any) -> Any:
        """Describe the region where only one of the two fails by boxes; see `analysis.rules`.

        **Raises:** `ValueError` if there is no such pair.
        """
        rows: Any = self.table[self.table["proper"]]
        rows = rows.assign(violated=rows.index.isin(self.flips.index), rho=-rows["gap"])
        return _rules(rows, self.space, options)

    def _notebook_parts(self) -> Iterable[str]:
        yield picture_html(self.plot())

    def __str__(self) -> str:
        table: Any = self.table[self.table["proper"]]
        sampled, found = table[~table["searched"]], table[table["searched"]]
        a, b = self.names
        lines = [f"the same policy in {a} and in {b}"]
        if not self.differs:
            largest = table["gap"].max()
            lines.append(
                f"  no difference beyond rounding in {len(table):,} pairs, {len(found):,} of them "
                f"searched: traces part by {largest:z.1g} of a signal's range at most"
            )
        else:
            lines += self._differences(sampled, found)
        lost = len(self.table) - len(table)
        if lost:
            lines.append(f"  {lost:,} pairs have no verdict in one of the two")
        lines.append(f"  {len(self.table):,} pairs in {self.seconds:z.1f} s, seed {self.seed}")
        return "\n".join(lines + [f"  note: {note}" for note in self.notes])

    def _differences(self, sampled: "pd.DataFrame", found: "pd.DataFrame") -> list[str]:
        """Return sentences on pairs that differ."""
        lines, flips = [], self.flips
        for rows, kind in ((sampled, "sampled"), (found, "searched")):
            if not len(rows):
                continue
            turned: Any = rows[rows.index.isin(flips.index)]
            only_b = int(turned["violated_b"].sum())
            sides = ""
            if len(turned):
                sides = f": {only_b:,} fail in {self.names[1]} only, {len(turned) - only_b:,} in "
                sides += f"{self.names[0]} only"
            lines.append(
                f"  verdicts differ in {len(turned):,} of {len(rows):,} {kind} pairs "
                f"({format_percent(len(turned) / len(rows))}){sides}"
            )
        apart: Any = self.table[self.table["differs"]]
        worst = apart.loc[apart["gap"].idxmax()]
        lines.append(
            f"  traces part in {len(apart):,} of {len(sampled) + len(found):,} pairs, by up to "
            f"{format_percent(worst['gap'])} of the usual range of {worst['signal']}; the first "
            f"after {apart['parted'].min():z.3g} s, half of them by "
            f"{apart['parted'].median():z.3g} s"
        )
        named = [f"{n} ({format_percent(s)})" for n, s in self.influence.items() if s > 0.05][:3]
        if named:
            lines.append(f"  how far depends on {', '.join(named)}")
        values = ", ".join(
            f"{n} = {v:z.4g}" if isinstance(v := worst[n], float | np.floating) else f"{n} = {v}"
            for n in self.space.columns
        )
        lines.append(f"  furthest in row {worst.name}: {values}")
        return lines

    __repr__ = __str__
