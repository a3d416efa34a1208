"""Comparison of two policies by pairs of real trials, valid after any number of pairs.

    print(compare_trials("pairs.csv", "old", "new"))

Both policies of a pair meet the same features. The interval holds at any time
(`statistics.paired_rates`), so it may be checked after each pair, and the trials may stop once it
decides.
"""

from dataclasses import dataclass
from pathlib import Path

from verifai_jax.addons.estimation.comparison.result import UNDECIDED, judge
from verifai_jax.addons.estimation.paired_rates import PairedRates, paired_rates
from verifai_jax.addons.estimation.trials import reading
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.core.messages.errors import missing_name, unknown_name

MAX_FACTOR = 1024
"""Times as many pairs, beyond which their number is not forecast."""


@dataclass(frozen=True)
class TrialComparison(InNotebook):
    """Two policies compared in pairs of real trials, as `compare_trials` returns it.

    - `baseline`, `candidate`: names of the policies.
    - `rates`: the difference of their failure rates, candidate minus baseline.
    - `both`: pairs in which both fail.
    - `margin`: the largest difference that does not matter.
    - `notes`: sentences on anything surprising.
    """

    baseline: str
    candidate: str
    rates: PairedRates
    both: int
    margin: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """`"worse"` (by more than the margin), `"better"`, `"the same"` or `"undecided"`."""
        return judge(self.rates, self.margin)

    @property
    def pairs_to_go(self) -> int | None:
        """Number of further pairs needed if they are like those so far; None if far too many."""
        rates, factor = self.rates, 1.0
        while factor <= MAX_FACTOR:
            counts = (rates.only_first, rates.only_second, rates.pairs)
            first, second, pairs = (round(factor * count) for count in counts)
            scaled = paired_rates(first, second, max(pairs, first + second), rates.confidence)
            if judge(scaled, self.margin) != UNDECIDED:
                return pairs - rates.pairs
            factor *= 1.1
        return None

    def __str__(self) -> str:
        rates = self.rates
        lines = [
            f"{self.candidate} is {self.verdict.upper()} than {self.baseline}: {rates}"
            if self.verdict in ("worse", "better")
            else f"{self.candidate} and {self.baseline}: {self.verdict.upper()}, {rates}",
            f"  {rates.pairs:,} pairs: {rates.only_second:,} fail with {self.candidate} only, "
            f"{rates.only_first:,} with {self.baseline} only, {self.both:,} with both, "
            f"{rates.undecided:,} undecided",
        ]
        if self.verdict == UNDECIDED:
            text = "  more than a thousand times as many pairs would be needed"
            if (more := self.pairs_to_go) is not None:
                text = f"  about {more:,} more pairs like these would decide"
            lines.append(text)
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])

    __repr__ = __str__


def compare_trials(
    trials: reading.TrialTable, baseline: str, candidate: str, *, key: str | Path | None = None,
    margin: float = 0.0, confidence: float = 0.95,
) -> TrialComparison:  # fmt: skip
    """Compare two policies by pairs of real trials; valid after any number of pairs.

    **Arguments:**
    - `trials`: a table with the columns `pair`, `policy` and `failed` (yes, no, or empty), such as
      the one that `trial_protocol` makes; pairs with a missing trial are left out.
    - `baseline`, `candidate`: the policies' names.
    - `key`: the table with the columns `code` and `policy` that `trial_protocol` made, if trials
      name a policy by its code.
    - `margin`: the largest difference of failure rates that does not matter, at least 0.
    - `confidence`: the probability that the verdict holds, whenever one stops.
    **Raises:** `FileNotFoundError`; `ValueError` for missing columns, an unknown policy, a pair
    that has a policy twice, trials without a complete pair, and numbers out of range.
    """
    check_fraction("confidence", confidence)
    if not 0 <= margin < 1:
        raise ValueError(f"margin must be a probability, from 0 to below 1; got {margin}")
    table, _ = reading.table_of(trials)
    for column in ("pair", "policy"):
        if column not in table.columns:
            raise missing_name("the table of trials", "column", column, list(table.columns))
    names = [str(name) for name in table["policy"]]
    if key is not None:
        codes, _ = reading.table_of(key)
        policy_of = {str(c): str(p) for c, p in zip(codes["code"], codes["policy"], strict=True)}
        names = [policy_of.get(name, name) for name in names]
    for name in (baseline, candidate):
        if name not in names:
            raise unknown_name("policy", name, sorted(set(names)))
    verdicts: dict[object, dict[str, bool | None]] = {}
    for pair, name, failed in zip(table["pair"], names, reading.verdicts_of(table), strict=True):
        own = verdicts.setdefault(pair, {})
        if name in own:
            raise ValueError(f"pair {pair} has the policy {name!r} twice")
        own[name] = failed
    pairs = [
        (p[baseline], p[candidate]) for p in verdicts.values() if {baseline, candidate} <= {*p}
    ]
    if not pairs:
        raise ValueError(f"no pair has a trial of both {baseline!r} and {candidate!r}")
    first, second = (pairs.count(each) for each in ((True, False), (False, True)))
    undecided = sum(None in pair for pair in pairs)
    rates = paired_rates(first, second, len(pairs), confidence, undecided)
    firsts = table.loc[[name == baseline for name in names]]
    notes = tuple(reading.copies(firsts.drop(columns=["pair", "policy", reading.FAILED])))
    return TrialComparison(baseline, candidate, rates, pairs.count((True, True)), margin, notes)
