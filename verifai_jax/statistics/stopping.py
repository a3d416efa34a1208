"""Conditions that end a run before its budget: counterexamples, seconds, a known failure rate.

    falsify(problem, stop=Stop(after=1, seconds=60))
    falsify(problem, "uniform", stop=Stop(when=Within(0.005)))
    falsify(problem, "uniform", stop=Stop(when=Decided(0.01)))

Outcomes decide when a rule is fulfilled, so rules use intervals that hold at all times
simultaneously (`confidence_sequences`).
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from verifai_jax.core.messages.checks import check_count, check_fraction, check_positive
from verifai_jax.statistics.confidence_sequences import anytime_interval


@runtime_checkable
class StoppingRule(Protocol):
    """A rule that ends a run of prior samples; `Stop(when=rule)`."""

    def done(self, failures: int, simulations: int, without_verdict: int) -> bool:
        """Return whether to stop; called after every batch.

        **Arguments:**
        - `failures`: samples that failed so far, as simulated.
        - `simulations`: number of samples so far.
        - `without_verdict`: number of those without a verdict.
        """
        ...


@dataclass(frozen=True)
class Within:
    """A rule that stops when the failure rate is known to within `half_width`, such as 0.005.

    - `half_width`: half of the required length of the interval.
    - `confidence`: the probability that the interval holds.

    **Raises:** `ValueError` unless `0 < half_width < 0.5` and `0 < confidence < 1`.
    """

    half_width: float
    confidence: float = 0.95

    def __post_init__(self) -> None:
        if not 0 < self.half_width < 0.5:
            raise ValueError(f"half_width must lie between 0 and 0.5; got {self.half_width}")
        check_fraction("confidence", self.confidence)

    def done(self, failures: int, simulations: int, without_verdict: int = 0) -> bool:
        """Return whether the interval is short enough."""
        if simulations < 1:
            return False
        rate = anytime_interval(failures, simulations, self.confidence, without_verdict)
        return rate.high - rate.low <= 2 * self.half_width


@dataclass(frozen=True)
class Decided:
    """A rule that stops when it is clear whether the failure rate is above or below `rate`.

    - `rate`: failure rate to compare with.
    - `confidence`: the probability that the answer is right.

    **Raises:** `ValueError` unless `0 < rate < 1` and `0 < confidence < 1`.
    """

    rate: float
    confidence: float = 0.95

    def __post_init__(self) -> None:
        check_fraction("rate", self.rate)
        check_fraction("confidence", self.confidence)

    def done(self, failures: int, simulations: int, without_verdict: int = 0) -> bool:
        """Return whether the interval excludes `rate`."""
        if simulations < 1:
            return False
        interval = anytime_interval(failures, simulations, self.confidence, without_verdict)
        return not interval.low <= self.rate <= interval.high


@dataclass(frozen=True)
class Stop:
    """The conditions that end the work of a verb before its budget is spent.

    - `after`: number of counterexamples; a run stops after the round that reaches it. With
      `search.Diverse` only failures far from each other count.
    - `seconds`: wall-clock seconds, compilation included, after which no round begins; the result
      is made from what is finished.
    - `when`: a rule, `Within(0.005)` or `Decided(0.01)`, that stops when the failure rate is known
      well enough; only for searches that sample the prior.
    - `keep_going`: whether to go on if the first simulations all raise. Otherwise the run ends with
      an error after 16 simulations with the same error, or after the first large round.

    **Raises:** `ValueError` for numbers out of range; `TypeError` for an object that is not a rule.
    A verb refuses what it does not use.
    """

    after: int | None = None
    seconds: float | None = None
    when: StoppingRule | None = None
    keep_going: bool = False

    def __post_init__(self) -> None:
        if self.after is not None:
            check_count("after", self.after)
        if self.seconds is not None:
            check_positive("seconds", self.seconds)
        if self.when is not None and not hasattr(self.when, "done"):
            raise TypeError(f"when must be a rule such as Within(0.005); got {self.when!r}")
