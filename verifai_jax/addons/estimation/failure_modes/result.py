"""The result of `modes`: failing regions with their probabilities, in words and numbers."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
import pandas as pd
from jaxtyping import Array, Key

from verifai_jax.addons.estimation.intervals import format_probability
from verifai_jax.core.compute.keys import simulation_key
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook, picture_html
from verifai_jax.core.messages.text import format_percent
from verifai_jax.counterexamples import explain, shrink
from verifai_jax.counterexamples._explain import Explained
from verifai_jax.counterexamples.shrunk import Shrunk
from verifai_jax.evaluation.replay import Replay, replay
from verifai_jax.falsification.run import Run
from verifai_jax.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Mode(InNotebook):
    """One failing region.

    - `number`: its index in the order of probability; 0 is the most probable one.
    - `name`: conditions that distinguish it from the prior, as text.
    - `probability`: the probability of a failure in it, under the prior.
    - `low`, `high`: the interval, at the confidence of the result.
    - `share`: its share of the whole failure probability.
    - `features`: its likeliest failure under the prior (the design point).
    - `distance`: the distance of that point from the middle of the prior, in standard deviations of
      normal space (the reliability index).
    - `rho`: robustness at that point.
    - `cause`: the deciding formula and predicate at that point, as text; empty without a verdict.
    - `failures`: features of failures of this mode, distributed as under the prior, one a row.
    - `problem`: the problem.
    - `run`: simulations of the likeliest failure, all with its random key if the system draws
      random numbers.
    - `row`: row of `run` that fails at the likeliest failure or just beyond it; None if none does.
    - `chance`: for a system with memory or randomness of its own, the share of several simulations
      of the likeliest failure that failed; None for other systems.
    """

    number: int
    name: str
    probability: float
    low: float
    high: float
    share: float
    features: dict[str, Any]
    distance: float
    rho: float
    cause: str
    failures: pd.DataFrame = field(repr=False)
    row: int | None
    problem: Problem = field(repr=False)
    run: Run = field(repr=False)
    key: Key[Array, ""] = field(repr=False)
    precision: str = "float32"
    key_number: int = 0
    chance: float | None = None

    @property
    def random_key(self) -> Key[Array, ""]:
        """The random key under which the likeliest failure fails, for `problem.system`."""
        return simulation_key(self.key, self.key_number)

    @property
    def interval(self) -> tuple[float, float]:
        """`(low, high)`."""
        return self.low, self.high

    def replay(self, precision: str | None = None) -> Replay:
        """Simulate the likeliest failure again with its random key, and keep the trace."""
        columns: Mapping[str, Any] = self.features
        again = replay(
            self.problem, columns, self.key, self.key_number, precision or self.precision
        )
        return replace(again, row=None)

    def animate(self, path: str | Path | None = None, **options: Any) -> Any:
        """Draw the likeliest failure as an animated GIF.

        **Arguments:**
        - `path`: a file to write as well; none when left out.
        - `options`: `camera`, `size` and `fps`, as in `Replay.animate`.
        **Raises:** the errors of `Replay.animate`.
        """
        return self.replay().animate(path, **options)

    def explain(self, nominal: Mapping[str, Any] | None = None) -> Explained:
        """Explain the likeliest failure: its predicate, instant, and the features that matter.

        **Raises:** `ValueError` if it does not fail when it is simulated again.
        """
        return explain(self.run, self._row(), nominal=nominal)

    def shrink(
        self, nominal: Mapping[str, Any] | None = None, by: Literal["count", "distance"] = "count",
        budget: int = 2000,
    ) -> Shrunk:  # fmt: skip
        """Find the smallest departure from nominal that still fails in this mode.

        It stays on the same side of nominal as the likeliest failure.

        **Raises:** `ValueError` if the likeliest failure does not fail when it is simulated again,
        or if a feature has no nominal value.
        """
        return shrink(
            self.run, self._row(), nominal=nominal, by=by, budget=budget, others=False, stay=True
        )

    def _row(self) -> int:
        if self.row is None:
            how = "with another random key" if self.chance is None else "every time"
            raise ValueError(
                f"the likeliest failure of mode {self.number} of {self.problem.name!r} does not "
                f"fail when it is simulated again {how}"
            )
        return self.row

    def __str__(self) -> str:
        return (
            f"mode {self.number}: {self.name}: probability {self.probability:z.3g} "
            f"({self.low:z.3g} to {self.high:z.3g})"
        )


SECTION = "verifai_jax.addons.estimation.report.modes_section"


@dataclass(frozen=True, eq=False)
class Modes(Drawn, InNotebook):
    """All failing regions that were found, the most probable first.

    - `name`: the name of the problem.
    - `modes`: the regions.
    - `probability`, `low`, `high`: probability of any failure, as `estimate` gives it. Without an
      estimate None, with 0 and the guaranteed bound.
    - `confidence`: the confidence of all intervals.
    - `unexplained`: share of the failures that no path joins to a mode, as an interval `(low,
      high)`.
    - `rest`: total probability of further regions that are too improbable to be listed.
    - `simulations`, `budget`: simulations used and allowed.
    - `upper_bound`: upper bound guaranteed by samples of the prior alone.
    - `notes`: sentences on anything surprising.
    - `run`: simulations of the likeliest failures, in the form of a run of `falsify`.
    - `seconds`: wall-clock time.
    - `stopped`: the reason for an early end: `"max_seconds"` or `"interrupted"`; None without one.
    - `sources`: the files of the model, as a run records them.
    - `changed`: a sentence if the model has changed since the given run was made.
    """

    _picture = "verifai_jax.addons.estimation.pictures.modes", "plot_modes"
    """The probabilities with their intervals, and the failures of each mode."""
    name: str
    modes: tuple[Mode, ...]
    probability: float | None
    low: float
    high: float
    confidence: float
    unexplained: tuple[float, float]
    rest: float
    simulations: int
    budget: int
    upper_bound: float
    notes: tuple[str, ...]
    run: Run | None = field(repr=False)
    seconds: float = math.nan
    sources: Mapping[str, Any] = field(default_factory=dict)
    changed: str = ""
    stopped: str | None = None

    def section(self, about: Any) -> Any:
        """Return the section of a report on these modes."""
        return lazy_import(SECTION, "modes_section")(self, about)

    def claims(self) -> list[tuple[str, tuple[str, ...], tuple[str, ...]]]:
        """Return sentence, evidence and assumptions of the claims that these modes support."""
        return lazy_import(SECTION, "mode_claims")(self)

    def __len__(self) -> int:
        return len(self.modes)

    def __iter__(self) -> Iterator[Mode]:
        return iter(self.modes)

    @overload
    def __getitem__(self, number: int) -> Mode: ...
    @overload
    def __getitem__(self, number: slice) -> tuple[Mode, ...]: ...
    def __getitem__(self, number: int | slice) -> "Mode | tuple[Mode, ...]":
        return self.modes[number]

    @property
    def table(self) -> pd.DataFrame:
        """One row a mode: its numbers, its name, and the features of its likeliest failure."""
        return pd.DataFrame(
            [
                {
                    "mode": mode.number, "name": mode.name, "probability": mode.probability,
                    "low": mode.low, "high": mode.high, "share": mode.share,
                    "distance": mode.distance, "cause": mode.cause,
                    **mode.features,
                }
                for mode in self.modes
            ]
        )  # fmt: skip

    def _notebook_parts(self) -> Iterator[str]:
        if self.modes:
            yield picture_html(self.plot())

    def __str__(self) -> str:
        sure = format_percent(self.confidence)
        if self.probability is None:
            lines = [
                f"{self.name}: no mode of failure found; a failure has probability "
                f"{self.upper_bound:z.2g} at most ({sure} bound)"
            ]
        else:
            lines = [
                f"{self.name}: fails with probability {format_probability(self.probability)} "
                f"({sure} interval {format_probability(self.low)} to "
                f"{format_probability(self.high)}), in {len(self.modes)} "
                f"mode{'s' if len(self.modes) != 1 else ''}"
            ]
        if self.changed:
            lines.insert(0, self.changed)
        for mode in self.modes:
            lines.append(
                f"  {mode.number}  {format_percent(mode.share)} of the failures: "
                f"{mode.probability:z.3g} ({mode.low:z.3g} to {mode.high:z.3g})  {mode.name}"
            )
            if mode.cause:
                lines.append(f"     {mode.cause}")
            lines.append(
                f"     likeliest at {_listed(mode.features)}, {mode.distance:z.3g} standard "
                "deviations out"
            )
        if self.modes:
            low, high = self.unexplained
            lines.append(
                f"  unexplained  {format_percent(low)} to {format_percent(high)} of the failures "
                f"are joined to none of these; {self.rest:z.2g} is the probability of regions too "
                "improbable to be listed"
            )
        lines.append(
            f"  simulations  {self.simulations:,} of {self.budget:,}, {self.seconds:z.1f} s"
        )
        lines += [f"  note         {note}" for note in self.notes]
        return "\n".join(lines)

    __repr__ = __str__


def _listed(features: Mapping[str, Any], maximum: int = 6) -> str:
    """Write features in one line, the first few of many."""
    parts = [
        f"{name} = {value:z.4g}" if isinstance(value, float | np.floating) else f"{name} = {value}"
        for name, value in list(features.items())[:maximum]
    ]
    return ", ".join(parts) + (", ..." if len(features) > maximum else "")
