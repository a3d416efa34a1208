"""Results of a certification: the failure rate of each policy, with an interval and a verdict."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.addons.estimation.simultaneous_interval import UNSAFE, safe_at
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.text import format_percent
from verifai_jax.statistics.binomial import Rate

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Certificate(InNotebook):
    """The certificate of one policy.

    - `simulations`: number of independent samples of the prior; `failures` and `not_finite` are
      counts among them. Samples without a verdict (`not_finite`) count as failures in the `rate`.
    - `rate`: the failure rate with an interval. The intervals of all policies hold together,
      however the number of samples was decided; None before the first sample.
    - `verdict`: `"safe@p"` if the interval is below p, `"unsafe"` if above, or `"undecided"`.
    - `attacks`, `attack_failures`: simulations and failures of the attack, which are in no rate.
    - `worst_robustness`: the least robustness of all simulations except `fragile` rows, NaN without
      a verdict; `worst_features`: the table columns of that simulation.
    - `counterexamples`: columns of features and `rho`, worst first.
    - `fragile`: failures that did not fail again with the same features and random key. They count
      in the `rate`, but not in `worst_robustness` and `counterexamples`.
    """

    number: int
    failures: int
    simulations: int
    not_finite: int
    rate: Rate | None
    verdict: str
    attacks: int
    attack_failures: int
    worst_robustness: float
    worst_features: Mapping[str, Any] | None
    counterexamples: Mapping[str, np.ndarray] = field(repr=False)
    fragile: int = 0

    @property
    def cost(self) -> int:
        """Number of simulations of attack and certification."""
        return self.simulations + self.attacks

    def __str__(self) -> str:
        return f"policy {self.number}: {self.verdict}, {self._summary()}"

    def _summary(self) -> str:
        if self.rate is None:
            text = "no sample yet"
        else:
            failing = self.failures + self.not_finite
            low, high = format_percent(self.rate.low), format_percent(self.rate.high)
            text = f"{failing} of {self.simulations} fail, between {low} and {high}"
        if self.not_finite:
            text += f"; {self.not_finite} of them gave no verdict"
        if np.isfinite(self.worst_robustness):
            text += f"; worst robustness {self.worst_robustness:z.4g}"
        if self.fragile:
            again = f"{self.fragile} failure{'s' * (self.fragile > 1)} that did not fail again"
            text += f"{', leaving out' if np.isfinite(self.worst_robustness) else ';'} {again}"
        return text


@dataclass(frozen=True, eq=False)
class Certificates(InNotebook):
    """The certificates of all policies; `certificates[i]` is the `Certificate` of policy i.

    **Fields:** `p` and `confidence` of the verdicts: with this probability all intervals, and so
    all verdicts, are right; `safest`: number of the policy that fails least often, None before all
    have been sampled; `chance`: its posterior probability of being the safest up to `tie` (an
    estimate, no bound); `samples`: minimum for each policy; `budget`: for all policies; `stopped`:
    `"decided"`, `"budget"` (a verdict or the safest is open, and what is left of the budget is too
    small) or `"interrupted"`; `notes`; `seconds`; `seed`; `problem`: its name; `sources`: the files
    of the model, as a run records them.
    """

    rows: tuple[Certificate, ...] = field(repr=False)
    problem: str
    p: float
    confidence: float
    safest: int | None
    chance: float | None
    tie: float
    seed: int
    samples: int
    budget: int
    stopped: str
    seconds: float
    notes: tuple[str, ...] = ()
    sources: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __getitem__(self, number: int) -> Certificate:
        return self.rows[number]

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def safe(self) -> tuple[int, ...]:
        """Numbers of the policies that are safe at p."""
        return tuple(row.number for row in self.rows if row.verdict == safe_at(self.p))

    @property
    def unsafe(self) -> tuple[int, ...]:
        """Numbers of the policies that fail with a probability above p."""
        return tuple(row.number for row in self.rows if row.verdict == UNSAFE)

    @property
    def simulations(self) -> int:
        """Number of samples of all policies together, without the attacks."""
        return sum(row.simulations for row in self.rows)

    @property
    def attacks(self) -> int:
        """Number of simulations of the attack, all policies together."""
        return sum(row.attacks for row in self.rows)

    @property
    def uniform(self) -> int:
        """Number of samples if every policy had as many as the policy with the most samples."""
        return len(self.rows) * max((row.simulations for row in self.rows), default=0)

    @property
    def table(self) -> "pd.DataFrame":
        """A row for each policy, in the order they were given."""
        import pandas as pd

        def bound(row: Certificate, name: str) -> float:
            return float("nan") if row.rate is None else getattr(row.rate, name)

        return pd.DataFrame(
            {
                "policy": [row.number for row in self.rows],
                "verdict": [row.verdict for row in self.rows],
                "failures": [row.failures for row in self.rows],
                "simulations": [row.simulations for row in self.rows],
                "not_finite": [row.not_finite for row in self.rows],
                "failure_rate": [bound(row, "estimate") for row in self.rows],
                "failure_low": [bound(row, "low") for row in self.rows],
                "failure_high": [bound(row, "high") for row in self.rows],
                "worst_robustness": [row.worst_robustness for row in self.rows],
                "attacks": [row.attacks for row in self.rows],
                "attack_failures": [row.attack_failures for row in self.rows],
                "fragile": [row.fragile for row in self.rows],
                "cost": [row.cost for row in self.rows],
            }
        )

    def counterexamples(self, number: int) -> "pd.DataFrame":
        """Return failing features of a policy with their robustness `rho`, worst first."""
        import pandas as pd

        return pd.DataFrame(dict(self.rows[number].counterexamples))

    def __str__(self) -> str:
        open_ = len(self.rows) - len(self.safe) - len(self.unsafe)
        lines = [
            f"certificates of {len(self.rows)} policies for {self.problem}: {len(self.safe)} "
            f"{safe_at(self.p)}, {len(self.unsafe)} unsafe, {open_} undecided "
            f"(all are right with {self.confidence * 100:zg} %)"
        ]
        if self.safest is not None and self.chance is not None:
            lines.append(
                f"  safest: policy {self.safest}, {self._chance(self.chance)} that none is better "
                f"by more than {self.tie:z.2g}"
            )
        # The safe ones first, then the least failing.
        order = sorted(self.rows, key=lambda row: (_rank(row, self.p), row.number))
        shown = order if len(order) <= 16 else order[:12]
        lines += [f"  {row}" for row in shown]
        if len(shown) < len(order):
            lines.append(f"  ... and {len(order) - len(shown)} more: .table")
        equal = (
            f"; the same number for every policy would be {self.uniform:,}"
            if self.uniform > self.simulations
            else ""
        )
        lines.append(
            f"  {self.simulations:,} samples{equal}; {self.attacks:,} more in the attack; "
            f"{self.seconds:z.1f} s, stopped: {self.stopped}"
        )
        lines += [f"  note: {note}" for note in self.notes]
        return "\n".join(lines)

    @staticmethod
    def _chance(chance: float) -> str:
        return "almost certain" if chance > 0.9995 else f"chance {format_percent(chance)}"


def _rank(row: Certificate, p: float) -> float:
    if row.rate is None:
        return 3.0
    return row.rate.estimate + (0.0 if row.verdict == safe_at(p) else 1.0)
