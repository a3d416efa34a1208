"""The result of a comparison: how often each fails, by how much they differ, and where."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxtyping import Array, Key

from verifai_jax.core.keys import run_keys, simulation_key
from verifai_jax.core.lazy import lazy_import
from verifai_jax.core.notebook import InNotebook
from verifai_jax.core.text import format_percent
from verifai_jax.features import FeatureSpace
from verifai_jax.statistics.paired_rates import PairedRates

if TYPE_CHECKING:
    import pandas as pd

WORSE, BETTER, SAME, UNDECIDED = "worse", "better", "the same", "undecided"
"""Verdicts on the second of two problems."""


@dataclass(frozen=True, eq=False)
class Compared:
    """One candidate against the baseline.

    - `name`: of the candidate.
    - `rates`: the difference of their failure rates, candidate minus baseline.
    - `both`: pairs in which both fail.
    - `margin`: difference that does not matter.
    - `discordant`: the pairs in which only one fails, a row each with the features; `worse` is true
      where it is the candidate. Its index is the number of the pair, of which
      `Comparison.random_key` is the key.
    - `pairs`: features of all pairs, and `worse` and `better`; None if they were not kept.
    """

    name: str
    rates: PairedRates
    both: int
    margin: float
    discordant: "pd.DataFrame" = field(repr=False)
    pairs: "pd.DataFrame" = field(repr=False)
    space: FeatureSpace = field(repr=False)

    @property
    def verdict(self) -> str:
        """`"worse"` (by more than the margin), `"better"`, `"the same"` or `"undecided"`."""
        return judge(self.rates, self.margin)

    def rules(self, **options: Any) -> Any:
        """Describe by a few boxes where only the candidate fails; see `analysis.rules`.

        **Raises:** `ValueError` where there is no such pair.
        """
        rows = self.pairs.assign(violated=self.pairs["worse"]).drop(columns=["worse", "better"])
        samples = lazy_import("verifai_jax.analysis.data.samples", "Samples")
        return lazy_import("verifai_jax.analysis", "rules")(
            samples.of(rows, "all", list(self.space.columns), self.space), **options
        )

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
        return (
            f"{self.name} is {words}{margin}: {shares}\n"
            f"    {rates.only_second:,} pairs fail with it only, {rates.only_first:,} with the "
            f"baseline only, {self.both:,} with both{without}"
        )


@dataclass(frozen=True, eq=False)
class Comparison(InNotebook):
    """Candidates against a baseline on common samples, as `compare` returns them.

    - `baseline`: its name.
    - `candidates`: a `Compared` for each.
    - `simulations`: made in all.
    - `stopped`: `"decided"`, `"budget"`, `"max_seconds"` or `"interrupted"`.
    - `seconds`, `seed`: of the comparison.
    - `notes`: differences of the two sides other than the system.
    - `sources`: what each side was made of, by its name, as a run records it; that of the baseline
      has the name `"baseline"`.
    """

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

        Where a system draws, its failure comes again under this key.
        """
        return simulation_key(run_keys(self.seed)[1], pair)

    @property
    def verdict(self) -> str:
        """The verdict on the only candidate, or the gravest of several."""
        verdicts = [candidate.verdict for candidate in self.candidates]
        return min(verdicts, key=(WORSE, UNDECIDED, SAME, BETTER).index)

    @property
    def regression(self) -> bool:
        """True where a candidate is worse by more than the margin."""
        return any(candidate.verdict == WORSE for candidate in self.candidates)

    def report(self, path: str | Path, **options: Any) -> Path:
        """Write the evidence report on the comparison as HTML, and its claims as JSON.

        **Arguments:**

        - `path`: of the HTML file.
        - `options`: of `reports.write_report`: `problem`, `units`, `reasons`.

        **Returns:** the path.
        """
        return lazy_import("verifai_jax.reports", "write_report")(self, path, **options)

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


def judge(rates: PairedRates, margin: float) -> str:
    """Decide from an interval: worse by more than the margin, better, the same within it, open."""
    if rates.low > margin:
        return WORSE
    if margin and rates.low >= -margin and rates.high <= margin:
        return SAME
    return BETTER if rates.high < 0 else UNDECIDED
