"""One problem as a test: replay earlier counterexamples, then search for more with a budget.

    outcome = Check(budget=2000).run(problem, corpus="counterexamples")
    outcome.failed; print(outcome); outcome.properties

Without `max_failure_probability` a search looks for a counterexample, and the first one fails the
test. With it, independent samples are drawn until the failure probability is known to lie below or
above this limit.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from verifai_jax.addons.checking._replay_counterexamples import CorpusReplay
from verifai_jax.addons.checking._replay_counterexamples import replay_counterexamples as replay
from verifai_jax.addons.checking.corpus import SavedCounterexample, save_counterexamples
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.core.messages.text import format_features, format_percent, printable
from verifai_jax.falsification import Run, falsify
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.statistics.binomial import Rate
from verifai_jax.statistics.confidence_sequences import anytime_interval
from verifai_jax.statistics.stopping import Decided, Stop

BUDGET = 1000
"""Default number of simulations of a test."""
SHRINKING = 1000
"""Maximum number of simulations to shrink a counterexample."""


class CounterexampleFound(AssertionError):
    """An error for a problem that failed as a test; its `outcome` has the run and the corpus."""

    def __init__(self, outcome: "CheckOutcome") -> None:
        super().__init__(str(outcome))
        self.outcome = outcome


@dataclass(frozen=True)
class Check:
    """The settings with which a problem is tested.

    - `budget`: maximum number of simulations.
    - `max_failure_probability`: largest accepted failure probability; None accepts no
      counterexample at all.
    - `seed`: the seed of the search and the samples.
    - `search`: the search for counterexamples, if none is accepted.
    - `confidence`: the confidence of statements about the failure probability.
    - `rename`: new names of features, for older files of the corpus.

    **Raises:** `ValueError` for numbers out of range, and a budget with which no test could pass.
    """

    budget: int = BUDGET
    max_failure_probability: float | None = None
    seed: int = 0
    search: str | Search = "portfolio"
    confidence: float = 0.95
    rename: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_count("budget", self.budget)
        check_count("seed", self.seed, 0)
        check_fraction("confidence", self.confidence)
        if self.max_failure_probability is None:
            return
        check_fraction("max_failure_probability", self.max_failure_probability)
        minimum = min_budget(self.max_failure_probability, self.confidence)
        if self.budget < minimum:
            raise ValueError(
                f"a budget of {self.budget:,} simulations cannot show a failure probability of at "
                f"most {format_percent(self.max_failure_probability)}: it needs {minimum:,}, if "
                "none fails"
            )

    def run(self, problem: Problem, corpus: str | Path | None = None) -> "CheckOutcome":
        """Replay the corpus and, if all of it is fixed, search with the budget.

        **Arguments:**
        - `problem`: the problem to test.
        - `corpus`: folder of saved counterexamples, to which a new one is added; None for none.
        **Returns:** the outcome.
        **Raises:** `ValueError` for a corpus that is a file; the errors of `falsify`.
        """
        replayed = None
        if corpus is not None and Path(corpus).is_file():
            raise ValueError(
                f"the corpus must be a folder of saved counterexamples, and {corpus} is a file; "
                "verifai-jax replay-counterexamples replays a single one"
            )
        if corpus is not None and Path(corpus).is_dir():
            replayed = replay(problem, corpus, rename=self.rename)
            if not replayed.passed:
                return CheckOutcome(problem.name, self, problem.target, replayed)
        if self.max_failure_probability is None:
            search, stop = self.search, Stop(after=1)
        else:
            rule = Decided(self.max_failure_probability, self.confidence)
            search, stop = "uniform", Stop(when=rule)
        run = falsify(problem, search, self.budget, seed=self.seed, stop=stop, progress=False)
        outcome = CheckOutcome(problem.name, self, problem.target, replayed, run)
        if corpus is None or not outcome.refuted or not run.table.counts.claimed:
            return outcome
        try:
            saved = save_counterexamples(run, corpus, max_count=1, budget=SHRINKING)
        except OSError as error:
            # A checkout that cannot be written, or a full disk, hides no failure.
            return replace(outcome, unsaved=str(error))
        return replace(outcome, saved=tuple(saved))


@dataclass(frozen=True, eq=False)
class CheckOutcome(InNotebook):
    """The outcome of testing a problem.

    - `problem`: the name of the problem.
    - `check`: the settings.
    - `target`: the problem's name on the command line, if known.
    - `replayed`: the replayed corpus; None without one.
    - `run`: the run on which the budget was spent; None if the corpus failed already.
    - `saved`: files that were added to the corpus.
    - `unsaved`: the reason why a counterexample could not be added, else empty.
    """

    problem: str
    check: Check
    target: str | None = None
    replayed: CorpusReplay | None = None
    run: Run | None = None
    saved: tuple[Path, ...] = ()
    unsaved: str = ""

    @property
    def rate(self) -> Rate | None:
        """Failure rate with its interval, if a probability was given."""
        if self.run is None or self.check.max_failure_probability is None:
            return None
        counts = self.run.table.counts
        return anytime_interval(
            counts.violating, self.run.simulations, self.check.confidence, counts.without_verdict
        )

    @property
    def refuted(self) -> bool:
        """True if the run shows that the problem fails, or fails too often."""
        if self.run is None:
            return False
        if self.rate is None:
            return self.run.table.counts.claimed > 0
        return self.rate.low > (self.check.max_failure_probability or 0.0)

    @property
    def failed(self) -> bool:
        """True unless the corpus is fixed and the run shows what was required."""
        if self.run is None or self.refuted:
            return True
        counts = self.run.table.counts
        if counts.without_verdict == self.run.simulations:
            return True
        if self.rate is None and counts.may_fail:
            return True
        return self.rate is not None and self.rate.high > (self.check.max_failure_probability or 0)

    @property
    def properties(self) -> dict[str, str | int | float]:
        """Plain numbers and texts about the outcome, for a test report."""
        result: dict[str, str | int | float] = {
            "vj_problem": self.problem,
            "vj_seed": self.check.seed,
            "vj_budget": self.check.budget,
        }
        if self.check.max_failure_probability is not None:
            result["vj_max_failure_probability"] = self.check.max_failure_probability
        if self.replayed is not None:
            result["vj_replayed"] = len(self.replayed.replayed)
            result["vj_replayed_failing"] = len(self.replayed.failing)
        if self.run is not None:
            counts = self.run.table.counts
            result["vj_simulations"] = self.run.simulations
            result["vj_formulas"] = json.dumps(self.run.formulas)
            result["vj_model"] = self.run.model
            result["vj_counterexamples"] = counts.claimed
            result["vj_without_verdict"] = counts.without_verdict
            if counts.without_verdict < self.run.simulations:
                result["vj_least_robustness"] = counts.lowest
        if self.rate is not None:
            result["vj_failure_rate_low"] = self.rate.low
            result["vj_failure_rate_high"] = self.rate.high
        if self.saved:
            result["vj_saved"] = ", ".join(map(str, self.saved))
        return result

    def __str__(self) -> str:
        if self.run is None:
            assert self.replayed is not None
            return printable(
                f"{self.replayed}\n  saved counterexamples are replayed first, and some of these "
                "are not fixed; to accept a failure, delete its file"
            )
        parts = [self.run.summary()]
        if self.rate is not None:
            parts.append(f"  {self._probability()}")
        for path in self.saved:
            parts.append(_describe_saved(path))
        if self.unsaved:
            parts.append(f"  not saved    {self.unsaved}")
        return printable("\n".join(parts))

    def _probability(self) -> str:
        assert self.rate is not None
        accepted = format_percent(self.check.max_failure_probability or 0.0)
        interval = (
            f"{format_percent(self.check.confidence)} interval {format_percent(self.rate.low)} to "
            f"{format_percent(self.rate.high)}"
        )
        if not self.failed:
            return f"accepted     the failure probability is at most {accepted}: {interval}"
        if self.refuted:
            return f"too often    the failure probability is above {accepted}: {interval}"
        return (
            f"undecided    {self.check.budget:,} simulations do not show whether the failure "
            f"probability is at most {accepted}: {interval}; a larger budget may"
        )


def _describe_saved(path: Path) -> str:
    """Write a saved counterexample: the features that are not nominal, or all features."""
    saved = SavedCounterexample.read(path)
    robustness = ", ".join(
        f"{value:z.4g}" for value in saved.robustness.values() if value is not None
    )
    if saved.changed is None:
        lines = [f"  counterexample, robustness {robustness}: {format_features(saved.features)}"]
    else:
        lines = [f"  counterexample, shrunk, robustness {robustness}; away from nominal:"]
        width = max(map(len, saved.changed), default=0)
        lines += [f"    {name:<{width}}  {_change(*ends)}" for name, ends in saved.changed.items()]
    return "\n".join([*lines, f"  saved as {path}"])


def _change(nominal: object, value: object) -> str:
    return f"{_short(nominal)} -> {_short(value)}"


def _short(value: object) -> str:
    return f"{value:z.6g}" if isinstance(value, float) else str(value)


def min_budget(probability: float, confidence: float) -> int:
    """Return the number of simulations without a failure that prove a failure probability."""
    low, high = 0, 1
    while anytime_interval(0, high, confidence).high > probability:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        enough = anytime_interval(0, middle, confidence).high <= probability
        low, high = (low, middle) if enough else (middle, high)
    return high
