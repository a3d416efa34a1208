"""The error of a probability: its parts, their sum, and the admissible error of the prior.

budget = vj.error_budget(problem, vj.estimate(problem))
print(budget)
budget.low, budget.high; budget["step"].low; budget.prior.radius
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import Tabular
from verifai_jax.core.messages.text import format_percent

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ErrorPart:
    """A part of the error of a number.

    - `name`: `"sampling"`, `"step"`, `"precision"`, `"solver"` or a solver's name, `"seeds"`,
      `"randomness"`.
    - `low`, `high`: the range of the true number minus the simulated one due to this part; for
      `"sampling"`, the ends of its interval minus the number; NaN if it was not measured.
    - `text`: a sentence on how it was measured, or why not.
    - `counted`: whether this part is in the sum.
    """

    name: str
    low: float
    high: float
    text: str
    counted: bool = True

    @property
    def measured(self) -> bool:
        """True if it has a number."""
        return math.isfinite(self.low) and math.isfinite(self.high)


@dataclass(frozen=True)
class PriorError:
    """The error of the prior that would make a claim false.

    - `limit`: the claimed upper limit of the number.
    - `bound`: the upper end of the number, with all parts of the error.
    - `radius`: the smallest Kullback-Leibler divergence, in nats, at which another prior raises the
      number to `limit`; 0 if the claim is not shown under this prior.
    - `worst`: the greatest values of the number within a divergence of 0.01, 0.1 and 1 nat.
    """

    limit: float
    bound: float
    radius: float
    worst: tuple[tuple[float, float], ...]

    @property
    def shift(self) -> float:
        """The shift of the mean of one normal feature at `radius`, in standard deviations."""
        return math.sqrt(2 * self.radius)

    def __str__(self) -> str:
        worst = ", ".join(f"{value:z.3g} within {radius:zg}" for radius, value in self.worst)
        if not self.radius:
            return (
                f"That it is at most {self.limit:z.3g} is not shown under this prior, so that no "
                f"other prior is needed for the claim to fall. The worst within a divergence in "
                f"nats: {worst}."
            )
        return (
            f"The claim that it is at most {self.limit:z.3g} needs the prior to be right within "
            f"{self.radius:z.3g} nats of divergence, which the mean of one normal feature spends "
            f"by moving {self.shift:z.2g} standard deviations. The worst within a divergence in "
            f"nats: {worst}."
        )


@dataclass(frozen=True)
class ErrorBudget(Tabular):
    """The error of a number, split into parts, as `error_budget` returns it.

    - `name`: the name of the problem; `what`: a description of the number.
    - `value`: the number as simulated; NaN if there is no estimate.
    - `parts`: the parts of its error; each interval holds with its share of the allowed error.
    - `confidence`: the probability that all these intervals hold together.
    - `prior`: the admissible error of the prior.
    - `simulations`: number of simulations used.
    """

    name: str
    what: str
    value: float
    parts: tuple[ErrorPart, ...]
    confidence: float
    prior: PriorError
    simulations: int

    def on_page(self, page: Any) -> Any:
        """Return a report's page with a section on this error, and its claim."""
        section = lazy_import("verifai_jax.addons.estimation.report.error_section", "with_errors")
        return section(page, self)

    def __getitem__(self, name: str) -> ErrorPart:
        """Return the part of this name."""
        return {part.name: part for part in self.parts}[name]

    @property
    def low(self) -> float:
        """The lower end of the number with all parts of the error added."""
        floor = -1.0 if self.what == DIFFERENCE else 0.0
        return max(floor, self._base + sum(part.low for part in self._counted))

    @property
    def high(self) -> float:
        """The upper end of the number with all parts of the error added."""
        return min(1.0, self._base + sum(part.high for part in self._counted))

    @property
    def _base(self) -> float:
        return 0.0 if math.isnan(self.value) else self.value

    @property
    def _counted(self) -> list[ErrorPart]:
        return [part for part in self.parts if part.counted and part.measured]

    @property
    def table(self) -> "pd.DataFrame":
        """A row for each part."""
        import pandas as pd

        rows = [(p.name, p.low, p.high, p.counted and p.measured, p.text) for p in self.parts]
        return pd.DataFrame(rows, columns=["part", "low", "high", "counted", "how"])

    @property
    def total(self) -> str:
        """The sum in a sentence."""
        sure = format_percent(self.confidence)
        left_out = [part.name for part in self.parts if not part.measured]
        text = (
            f"With {', '.join(part.name for part in self._counted)} together, {self.what} of "
            f"{self.name} lies between {self.low:z.3g} and {self.high:z.3g}, at {sure}."
        )
        if left_out:
            text += f" Not measured, and not in it: {', '.join(left_out)}."
        return text

    def __str__(self) -> str:
        lines = [self.total]
        for part in self.parts:
            ends = f"{part.low:+z.2g} to {part.high:+z.2g}" if part.measured else "not measured"
            lines.append(f"  {part.name:<12} {ends}\n    {part.text}")
        return "\n".join([*lines, f"  prior\n    {self.prior}"])


PROBABILITY = "the failure probability"
DIFFERENCE = "the difference of the failure probabilities"
