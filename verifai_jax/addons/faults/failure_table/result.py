"""The result of `fmea`: a row for each fault, and for each pair that fails only together."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from verifai_jax.core.display.figure import Drawn, Reported
from verifai_jax.core.display.notebook import Tabular
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import format_percent, format_seconds
from verifai_jax.falsification.run import Run

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Effect:
    """The effect of a fault, or of a pair of faults.

    - `faults`: names of the faults.
    - `fails`: whether any simulation with these faults alone breaks the property.
    - `failures`, `simulations`: counts of the samples of the prior that `probability` rests on.
    - `undecided`: number of these samples without a verdict.
    - `severity`: the lowest severity that fails, by the name of the number; empty without failures.
    - `edge`: whether a search over all numbers of the faults found nothing that fails at a severity
      lower by a thousandth of its range; otherwise less may fail, too.
    - `row`: the row of the counterexample in the run of the table; None if there is none.
    - `verdict`: the verdict of `vj.confirm` on that counterexample.
    - `broken`: the name of the broken formula.
    - `delay`: seconds from the onset to the violation.
    - `shown_by`: the first signal that differs from the same simulation without the fault;
      `shown_after`: seconds from the onset to this difference.
    - `occurrence`: probability that the fault, or the pair, happens in a mission.
    - `probability`, `low`, `high`: probability that a mission fails because of it, and its
      interval.
    - `command`: the command that simulates the counterexample again.
    """

    faults: tuple[str, ...]
    fails: bool
    failures: int
    simulations: int
    undecided: int = 0
    severity: Mapping[str, float] = field(default_factory=dict)
    edge: bool = False
    row: int | None = None
    verdict: str = ""
    broken: str = ""
    delay: float = math.nan
    shown_by: str = ""
    shown_after: float = math.nan
    occurrence: float = 1.0
    probability: float = math.nan
    low: float = 0.0
    high: float = 1.0
    command: str = ""

    @property
    def name(self) -> str:
        """The names of the faults, joined into one text."""
        return " + ".join(self.faults)

    @property
    def severity_text(self) -> str:
        """The lowest severities that fail, as text; with `at most` where less may fail, too."""
        text = ", ".join(f"{name} {value:z.4g}" for name, value in self.severity.items())
        return text if self.edge or not text else f"at most {text}"

    @property
    def confirmed(self) -> bool:
        """True if the counterexample failed in every closer replay."""
        return self.verdict == "confirmed"

    def __str__(self) -> str:
        chance = f"{self.probability:z.2g} ({self.low:z.2g} to {self.high:z.2g})"
        if not self.fails:
            return f"{chance}, no failure in {self.simulations:,} samples"
        if self.row is None:
            return f"{chance}, fails under few random keys"
        after, shown = (format_seconds(each, 3) for each in (self.delay, self.shown_after))
        shows = f";\n    {self.shown_by} shows it after {shown}" if self.shown_by else ""
        return (
            f"{chance}, {self.verdict}\n    from {self.severity_text}; breaks {self.broken} "
            f"{after} after the onset{shows}"
        )


COLUMNS = {
    "fails": "fails", "severity": "severity_text", "property": "broken",
    "onset_to_violation": "delay", "shown_by": "shown_by", "shown_after": "shown_after",
    "occurrence": "occurrence", "probability": "probability", "low": "low", "high": "high",
    "verdict": "verdict", "replay": "command",
}  # fmt: skip
"""Columns of the table, each with the attribute of an effect that it shows."""


@dataclass(frozen=True, eq=False)
class FailureTable(Drawn, Reported, Tabular):
    """Faults and their effects, the most probable failure first; made by `fmea`.

    - `name`: the name of the problem.
    - `effects`: the rows.
    - `run`: the counterexamples as a run, for `replay`, `explain` and `confirm`; None if no fault
      fails.
    - `rate`: the rate of each fault per hour; `mission_time`: in hours; both None if probabilities
      are conditional on the fault.
    - `confidence`: the confidence of each interval.
    - `healthy`: whether the property holds for the nominal features without a fault.
    - `seconds`: wall-clock time.
    """

    _report = "verifai_jax.addons.faults.failure_table.report", "failure_table_page"
    _picture = "verifai_jax.addons.faults.failure_table.picture", "plot_failure_table"
    """The probability of each row with its interval."""
    name: str
    effects: tuple[Effect, ...]
    run: Run | None = field(repr=False)
    rate: Mapping[str, float] | None
    mission_time: float | None
    confidence: float
    healthy: bool
    seconds: float

    def __iter__(self) -> Iterator[Effect]:
        return iter(self.effects)

    def __len__(self) -> int:
        return len(self.effects)

    def __getitem__(self, name: str) -> Effect:
        """Return the row of a fault, or of a pair: `table["gyro_bias + motor_stuck"]`.

        **Raises:** `UnknownNameError` for a name without a row.
        """
        rows = {each.name: each for each in self.effects}
        check_names("row of the failure table", [name], rows)
        return rows[name]

    @property
    def table(self) -> "pd.DataFrame":
        """A row for each effect, by name."""
        import pandas as pd

        columns = {name: [getattr(each, of) for each in self] for name, of in COLUMNS.items()}
        return pd.DataFrame(columns, pd.Index([each.name for each in self], name="fault"))

    def replay(self, name: str) -> Any:
        """Simulate the counterexample of a row again, and keep the trace.

        **Raises:** `UnknownNameError`; `ValueError` for a row without a counterexample.
        """
        effect = self[name]
        if effect.row is None or self.run is None:
            raise ValueError(f"{name} has no counterexample: nothing failed with it")
        return self.run.replay(effect.row)

    def __str__(self) -> str:
        failing = [each for each in self.effects if each.fails]
        what = "in a mission" if self.rate is not None else "given that it happens"
        sure = sum(each.confirmed for each in failing)
        only = f", {sure} of them in closer replays too" if sure < len(failing) else ""
        lines = [
            f"{self.name}: {len(failing)} of {len(self.effects)} faults and pairs break the "
            f"property{only}; probabilities {what}, {format_percent(self.confidence)} intervals; "
            f"{self.seconds:z.0f} s"
        ]
        width = max((len(each.name) for each in self.effects), default=0)
        lines += [f"  {each.name:<{width}}  {each}" for each in self.effects]
        if not self.healthy:
            lines.append("  note: the nominal features break the property without any fault")
        return "\n".join(lines)

    __repr__ = __str__
