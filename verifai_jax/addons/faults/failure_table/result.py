"""The result of `fmea`: a row for each fault, and for each pair that fails only together."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from verifai_jax.addons.faults.failure_table.sheet import (
    DECADES,
    Scale,
    Sheet,
    Words,
    make_sheet,
)
from verifai_jax.core.display.figure import Drawn, Reported
from verifai_jax.core.display.notebook import Tabular
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import format_percent, format_seconds
from verifai_jax.falsification.run import Run
from verifai_jax.statistics.binomial import Rate

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Detection:
    """The misses and the delay of a detector on board, for a fault or a pair.

    - `missed`: the share of simulations without an alarm from the onset until the property is
      broken, or until the end if it is not, with its interval.
    - `failing`: whether these simulations break the property; False if no sample breaks it.
    - `delay`: the median time in seconds from the onset to the alarm; NaN without an alarm.
    """

    missed: Rate
    failing: bool
    delay: float

    def __str__(self) -> str:
        share = f"the detector misses {self.missed}"
        after = "" if math.isnan(self.delay) else f", alarm after {format_seconds(self.delay, 3)}"
        return f"{share}{after}"


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
    - `detection`: what the detector finds of it; None without a detector.
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
    detection: Detection | None = None

    @property
    def missed(self) -> float:
        """The share of simulations that the detector misses; NaN without a detector."""
        return math.nan if self.detection is None else self.detection.missed.estimate

    @property
    def missed_high(self) -> float:
        """The upper end of the interval of this share; NaN without a detector."""
        return math.nan if self.detection is None else self.detection.missed.high

    @property
    def alarm_after(self) -> float:
        """The median time in seconds from the onset to the alarm; NaN without one."""
        return math.nan if self.detection is None else self.detection.delay

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
        found = "" if self.detection is None else f";\n    {self.detection}"
        if not self.fails:
            return f"{chance}, no failure in {self.simulations:,} samples{found}"
        if self.row is None:
            return f"{chance}, fails under few random keys{found}"
        after, shown = (format_seconds(each, 3) for each in (self.delay, self.shown_after))
        shows = f";\n    {self.shown_by} shows it after {shown}" if self.shown_by else ""
        return (
            f"{chance}, {self.verdict}\n    from {self.severity_text}; breaks {self.broken} "
            f"{after} after the onset{shows}{found}"
        )


COLUMNS = {
    "fails": "fails", "severity": "severity_text", "property": "broken",
    "onset_to_violation": "delay", "shown_by": "shown_by", "shown_after": "shown_after",
    "occurrence": "occurrence", "probability": "probability", "low": "low", "high": "high",
    "missed": "missed", "missed_high": "missed_high", "alarm_after": "alarm_after",
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
    - `false_alarms`: the share of simulations without a fault in which the detector gives an alarm;
      None without a detector.
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
    false_alarms: Rate | None = None

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

    def sheet(self, words: Words = None, scale: Scale = DECADES) -> Sheet:
        """Make the sheet of an FMEA: the words of its authors beside what was measured.

        **Arguments:**
        - `words`: by the name of a fault or a pair any of `component`, `cause`, `effect`,
          `mitigation`, `owner` (texts) and `severity` (1 to 10); or the path of a CSV file with
          these columns and `fault`. A pair has the components, causes and owners of its faults if
          it has none of its own.
        - `scale`: how probabilities and missed failures become ratings from 1 to 10.
        **Returns:** the sheet, for `to_xlsx`, `to_csv` and `table`.
        **Raises:** `ValueError` for a fault, a column or a severity that does not exist.
        """
        sure = format_percent(self.confidence)
        what = "in a mission" if self.rate is not None else "given that the fault happens"
        notes = {"probability": f"of a failure {what}, with {sure} intervals; occurrence and "
                                "detection rate the upper ends"}  # fmt: skip
        if self.false_alarms is not None:
            notes["false alarms"] = str(self.false_alarms)
        return make_sheet(self.name, self.table, notes, words, scale)

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
        if self.false_alarms is not None:
            lines.append(f"  false alarms of the detector: {self.false_alarms}")
        if not self.healthy:
            lines.append("  note: the nominal features break the property without any fault")
        return "\n".join(lines)

    __repr__ = __str__
