"""The result of a compositional falsification, and its summary.

result.region, result.candidates        tables
result.frames                           images rendered at each stage
result.replay(), result.rules()         a confirmed failure; where an error can matter
result.plot("region.png")
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from verifai_jax.addons.perception.compositional.region import (
    FAILS_ANYWAY,
    NO_VERDICT,
    SAFE,
    UNCERTAIN,
)
from verifai_jax.core.display.figure import Figure
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.text import format_features, format_percent
from verifai_jax.evaluation.replay import Replay
from verifai_jax.falsification import Run
from verifai_jax.problem import Problem
from verifai_jax.statistics.binomial import clopper_pearson

FOUND, BUDGET, NOTHING, INTERRUPTED = "found", "budget", "nothing uncertain", "interrupted"
"""What ends it."""


@dataclass(frozen=True, eq=False)
class Compositional(InNotebook):
    """The result of `vj.perception.abstract`.

    - `name`: the name of the problem.
    - `error`: the condition under which the perception errs.
    - `region`: a row for each sample of the prior: its features; `kind` (`"uncertain"`, `"safe"`
      even with the worst perception, `"fails anyway"`, `"no verdict"`); `best` and `worst`, the
      robustness with either perception; `severity`, the smallest error with which it fails, and
      `erring`, the number of instants at which the perception then errs, NaN unless uncertain.
    - `images`: the run that looked for images; None if nothing is uncertain.
    - `simulations`: a run with the simulations of candidates.
    - `candidates`: a row for each image on which the network errs: features; `image`, the size of
      its error (minus the robustness of `error`); `simulated`, the status of its simulation with
      the network, empty if there was none; `rho` and `fails` of that; `rendered`, the total number
      of images rendered until then.
    - `images_per_simulation`: number of images rendered in one simulation.
    - `budget`, `search`, `seed`: the arguments of the call.
    - `ended`: `"found"`, `"budget"`, `"nothing uncertain"`, `"interrupted"`, or another reason why
      the search for images ended.
    - `version`: the version of verifai_jax.
    """

    name: str
    error: str
    region: pd.DataFrame
    images: Run | None
    simulations: tuple[Run, ...]
    candidates: pd.DataFrame
    images_per_simulation: int
    budget: int
    search: str
    seed: int
    ended: str
    version: str
    problem: Problem = field(repr=False)

    @property
    def frames(self) -> dict[str, int]:
        """Number of rendered images: for the search, for simulations, and in all."""
        images = 0 if self.images is None else len(self.images.table)
        simulated = self.images_per_simulation * len(self.simulations)
        return {"images": images, "simulations": simulated, "total": images + simulated}

    @property
    def confirmed(self) -> pd.DataFrame:
        """The candidates that fail in the loop with the network."""
        return self.candidates.loc[self.candidates["fails"].fillna(False).astype(bool)]

    def replay(self, number: int = 0) -> Replay:
        """Simulate a confirmed failure again, and keep its trace.

        **Arguments:**
        - `number`: index of the failure, in the order in which they were found.
        **Raises:** `IndexError` if there are fewer.
        """
        failing = [run for run in self.simulations if len(run.table.counterexamples)]
        if not 0 <= number < len(failing):
            raise IndexError(
                f"{self.name} has {len(failing)} confirmed failures; there is no number {number}"
            )
        return failing[number].replay(0)

    def rules(self, **options: Any) -> Any:
        """Describe the region of uncertainty by rules.

        Samples that fail anyway or have no verdict are left out.

        **Arguments:**
        - `options`: the options of `vj.analysis.rules`.
        """
        known = self.region["kind"].isin([UNCERTAIN, SAFE])
        columns = list(self.problem.space.columns)
        table = self.region.loc[known, columns].assign(rho=self.region.loc[known, "worst"])
        return lazy_import("verifai_jax.addons.analysis", "rules")(table, **options)

    def plot(
        self, path: str | Path | None = None, features: tuple[str, str] | None = None
    ) -> Figure:
        """Draw the region of uncertainty over two features, coloured by the smallest failing error.

        **Arguments:**
        - `path`: file to which the picture is written, if given.
        - `features`: the columns; by default the two on which the region depends most.
        **Returns:** the figure.
        **Raises:** `UnknownNameError` for a column that the table does not have.
        """
        draw = lazy_import("verifai_jax.addons.perception.compositional.picture", "plot_region")
        return draw(self, path, features)

    def summary(self) -> str:
        """Write what was found; every number comes from the tables."""
        lines = [f"{self.name}: {self._finding()}", *self._region_lines()]
        if self.images is not None:
            lines += self._image_lines(self.images)
        if len(self.confirmed):
            first = self.confirmed.iloc[0]
            features = format_features({name: first[name] for name in self.problem.space.columns})
            lines.append(f"  first failure after {int(first['rendered']):,} images, at {features}")
        return "\n".join(lines)

    def _finding(self) -> str:
        count, total = len(self.confirmed), self.frames["total"]
        if count:
            named = "1 failure" if count == 1 else f"{count:,} failures"
            return f"{named} of the loop, after {total:,} rendered images"
        if self.ended == NOTHING:
            return "nothing is uncertain, so no image was rendered"
        return f"no failure of the loop found with {total:,} rendered images ({self.ended})"

    def _region_lines(self) -> list[str]:
        counts = {kind: list(self.region["kind"]).count(kind) for kind in KINDS}
        rate = clopper_pearson(counts[UNCERTAIN], len(self.region))
        interval = f"95 % interval {format_percent(rate.low)} to {format_percent(rate.high)}"
        lines = [
            f"  region       {counts[UNCERTAIN]:,} of {len(self.region):,} samples are uncertain "
            f"({interval}): they fail with the worst perception, not with the best"
        ]
        others = {kind: count for kind, count in counts.items() if count and kind != UNCERTAIN}
        lines += [f"               {count:,} {KINDS[kind]}" for kind, count in others.items()]
        uncertain = self.region.loc[self.region["kind"] == UNCERTAIN]
        if len(uncertain):
            severity = uncertain["severity"].quantile([0.0, 0.5]).to_numpy()
            lines.append(
                f"               least error that fails: {severity[0]:z.3g} of the worst at the "
                f"least, {severity[1]:z.3g} in the median"
            )
        if silent := list(uncertain["erring"]).count(0):
            lines.append(
                f"               in {silent:,} the abstraction fails though it never errs by "
                f"{self.error!r}"
            )
        return lines

    def _image_lines(self, images: Run) -> list[str]:
        frames, simulated = self.frames, self.candidates["simulated"]
        lines = [
            f"  images       {frames['images']:,} rendered where the perception decides; the "
            f"network errs on {len(self.candidates):,}"
        ]
        if without := len(images.table.failed):
            lines.append(f"               {without:,} without a verdict")
        tried = len(self.simulations)
        line = f"  simulations  {tried:,} with the network, {frames['simulations']:,} images; "
        lines.append(f"{line}{len(self.confirmed):,} fail" if tried else "  simulations  none")
        if broken := sum(status not in ("", "ok") for status in simulated):
            lines.append(f"               {broken:,} without a verdict")
        return lines

    def __str__(self) -> str:
        return self.summary()

    def __repr__(self) -> str:
        return self.summary()


KINDS = {
    UNCERTAIN: "uncertain",
    SAFE: "keep with the worst perception too",
    FAILS_ANYWAY: "fail with the best perception: not its fault",
    NO_VERDICT: "have no verdict",
}
"""How the summary calls the kinds of samples."""
