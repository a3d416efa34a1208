"""The result of an estimate: the failure probability with an interval and a bound.

result = vj.estimate(problem)
result.probability, result.interval, result.upper_bound
result.simulations_until(1e-6)
print(result)
result.plot("estimate.png")
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from verifai_jax.addons.estimation.intervals import format_probability, simulations_until
from verifai_jax.core.display.figure import Drawn, Reported
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.core.messages.text import format_percent

if TYPE_CHECKING:
    pass
METHODS = {
    "monte_carlo": "Monte Carlo",
    "importance": "importance sampling",
    "splitting": "multilevel splitting",
    "surrogate": "importance sampling by a surrogate",
}
WEIGHTED = ("importance", "splitting", "surrogate")
"""Methods that reach failures by a search, so that they may miss some."""


@dataclass(frozen=True, eq=False)
class Estimate(Drawn, Reported, InNotebook):
    """A failure probability, as `estimate` returns it.

    - `name`: name of the problem.
    - `probability`: the probability of a failure, under the prior of the feature space; None if
      none is claimed.
    - `low`, `high`: the interval at `confidence`; without an estimate 0 and `upper_bound`.
    - `confidence`: the confidence of the interval and of the bound.
    - `method`: a name of `METHODS`; None without an estimate.
    - `simulations`: number of all simulations; one with its gradient counts as 2.
    - `budget`: simulations that were allowed.
    - `failures`, `no_verdict`: number of failed simulations, and of simulations without a verdict.
    - `upper_bound`: upper bound guaranteed at `confidence` by independent samples of the prior
      alone, whatever a search may have missed.
    - `prior_simulations`, `prior_failures`, `prior_no_verdict`: the samples of the prior on which
      the bound rests; one without a verdict counts as a failure there.
    - `effective`: effective number of independent failures in the weighted samples; NaN for methods
      where that has no meaning.
    - `relative_error`: one standard error divided by the estimate.
    - `diagnostics`: further numbers of the method, by name.
    - `notes`: sentences on anything surprising.
    - `certain`, `rest`: the share of the prior that fails for certain, and the share that is
      neither proved safe nor certain to fail, from which samples are drawn; 0 and 1 without a
      proof.
    - `p0`: the wanted upper limit of the probability, if one was given.
    - `seed`, `version`, `precision`, `backend`: needed to repeat the estimate.
    - `seconds`: wall-clock time.
    - `stopped`: the reason for an early end: `"max_seconds"` or `"interrupted"`; None without one.
    - `sources`: the files of the model, as a run records them; empty if not recorded.
    - `drawn`: data of the pictures.
    """

    _report = "verifai_jax.addons.estimation.report.estimate_report", "estimate_page"
    _picture = "verifai_jax.addons.estimation.pictures.estimate", "plot_estimate"
    """The interval, the splitting levels and the weights, as far as there are any."""
    name: str
    probability: float | None
    low: float
    high: float
    confidence: float
    method: str | None
    simulations: int
    budget: int
    failures: int
    no_verdict: int
    upper_bound: float
    prior_simulations: int
    prior_failures: int
    prior_no_verdict: int
    effective: float = math.nan
    relative_error: float = math.nan
    diagnostics: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    certain: float = 0.0
    rest: float = 1.0
    p0: float | None = None
    seed: int = 0
    version: str = ""
    precision: str = "float32"
    backend: str | None = None
    seconds: float = 0.0
    stopped: str | None = None
    sources: Mapping[str, Any] = field(default_factory=dict)
    drawn: dict[str, Any] = field(default_factory=dict, repr=False)

    @property
    def interval(self) -> tuple[float, float]:
        """`(low, high)`."""
        return self.low, self.high

    @property
    def no_verdict_probability(self) -> float:
        """Share of the prior without a verdict, estimated from its samples."""
        return self.rest * self.prior_no_verdict / max(self.prior_simulations, 1)

    def simulations_until(self, p0: float, confidence: float | None = None) -> int:
        """Return the number of further failure-free samples that show a probability below `p0`.

        **Arguments:**
        - `p0`: failure probability to be shown, between 0 and 1.
        - `confidence`: the confidence of the bound; by default that of the estimate.
        **Returns:** the number of samples beyond those of `upper_bound`; 0 if these suffice.
        **Raises:** `ValueError` unless `0 < p0 < 1`.
        """
        check_fraction("p0", p0)
        if p0 >= self.certain + self.rest:
            return 0
        return simulations_until(
            max((p0 - self.certain) / self.rest, 1e-18),
            self.prior_failures + self.prior_no_verdict,
            self.prior_simulations,
            self.confidence if confidence is None else confidence,
        )

    def __str__(self) -> str:
        sure = format_percent(self.confidence)
        if not self.rest:
            exact = format_probability(self.certain)
            return f"{self.name}: fails with probability {exact}, as all of the prior is decided"
        if self.probability is None or self.method is None:
            lines = [
                f"{self.name}: no estimate of the failure probability; at most "
                f"{self.upper_bound:z.2g} ({sure} bound)"
            ]
        else:
            ends = (format_probability(end) for end in (self.low, self.high))
            lines = [
                f"{self.name}: fails with probability {format_probability(self.probability)} "
                f"({sure} interval {' to '.join(ends)}), by {METHODS[self.method]}"
            ]
        without = f", {self.no_verdict:,} without a verdict" if self.no_verdict else ""
        lines.append(
            f"  simulations  {self.simulations:,} of {self.budget:,}, {self.failures:,} failing"
            f"{without}, {self.seconds:z.1f} s"
        )
        if self.probability is not None and math.isfinite(self.relative_error):
            worth = ""
            if math.isfinite(self.effective):
                worth = f", worth {self.effective:z,.0f} independent failures"
            lines.append(
                f"  precision    relative error {format_percent(self.relative_error)}{worth}"
            )
        if self.rest < 1:
            lines.append(
                f"  proved       all of the prior but {format_percent(self.rest)}, of which the "
                f"samples are, and {format_percent(self.certain)} that fails for certain"
            )
        lines.append(
            f"  guaranteed   at most {self.upper_bound:z.2g} at {sure}, by {self.prior_failures:,} "
            f"failures in {self.prior_simulations:,} independent samples of {self._drawn_from} "
            "alone"
        )
        if self.no_verdict:
            lines.append(
                f"  no verdict   {format_percent(self.no_verdict_probability)} of the prior, by "
                "its samples; neither safe nor failing: the upper ends count them as failing"
            )
        if self.p0 is not None:
            lines.append(f"  p < {self.p0:zg}    {self._conclusion(self.p0)}")
        first = self.diagnostics.get("independent_searches") == 0
        lines[1:1] = [f"  caution      {note}" for note in self.notes[:first]]
        lines += [f"  note         {note}" for note in self.notes[first:]]
        return "\n".join(lines)

    __repr__ = __str__

    @property
    def _drawn_from(self) -> str:
        return "the prior" if self.rest == 1 else "this rest"

    def _conclusion(self, p0: float) -> str:
        """Write whether a probability below `p0` is shown, refuted or open."""
        if self.upper_bound <= p0:
            return f"shown, by samples of {self._drawn_from} alone"
        more = self.simulations_until(p0)
        if self.low > p0:
            return "refuted: the whole interval is above"
        prior = f"samples of {self._drawn_from} alone would need {more:,} more without a failure"
        if self.probability is not None and self.high < p0:
            return f"shown, unless the method has missed a part of the failures; {prior}"
        return f"open; {prior}"
