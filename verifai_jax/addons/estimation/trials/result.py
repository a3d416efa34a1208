"""The result of real trials: the rate, where the simulation is right, and the next trials."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int

from verifai_jax.addons.analysis import rules as find_rules
from verifai_jax.addons.analysis.data.samples import Samples
from verifai_jax.addons.estimation.stratified_rate import StratifiedRate
from verifai_jax.core.display.notebook import InNotebook, frame_html
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.text import counted, format_percent
from verifai_jax.problem.problem import Problem
from verifai_jax.statistics.binomial import Rate, clopper_pearson

if TYPE_CHECKING:
    from collections.abc import Iterable

    import pandas as pd

    from verifai_jax.addons.analysis._rules import Rules


@dataclass(frozen=True, eq=False)
class RealTrials(InNotebook):
    """Real trials together with their simulations, as `real_trials` returns it.

    - `problem`: the simulation.
    - `table`: a row for each trial: its features, whether it `failed` (True, False, or None if
      undecided), whether the simulation `predicted` a failure, and the simulated `robustness`.
    - `background`: features, `predicted` and `robustness` of the simulated samples of the prior.
    - `rate`: the failure rate of the real system with its interval, from trials and simulations.
    - `seed`: the seed of the simulations.
    - `notes`: sentences on anything surprising.
    """

    problem: Problem
    table: "pd.DataFrame"
    background: "pd.DataFrame" = field(repr=False)
    rate: StratifiedRate
    seed: int = 0
    notes: tuple[str, ...] = ()

    @property
    def simulated(self) -> Rate:
        """The failure rate of the simulation alone."""
        predicted = self.background["predicted"].to_numpy(bool)
        return clopper_pearson(int(predicted.sum()), len(predicted), self.rate.confidence)

    def predictions(self, predicted: bool) -> Rate | None:
        """Return how often trials fail, among those predicted to fail or among the others.

        None if there is no such trial. The counts show how good the simulation's predictions are.
        """
        rows = self.table[self.table["predicted"] == predicted]["failed"]
        if not len(rows):
            return None
        failures, open_ones = (sum(v is wanted for v in rows) for wanted in (True, None))
        return clopper_pearson(failures, len(rows), self.rate.confidence, open_ones)

    @property
    def wrong(self) -> "pd.DataFrame":
        """The trials whose verdict differs from the prediction."""
        known = self._known
        return known[known["failed"].astype(bool) != known["predicted"]]

    @property
    def _known(self) -> Any:
        """The trials with a verdict."""
        return self.table[[verdict is not None for verdict in self.table["failed"]]]

    def rules(self, **options: Any) -> "Rules":
        """Describe the region where the simulation is wrong by boxes; see `analysis.rules`.

        **Arguments:**
        - `options`: the options of `analysis.rules`.
        **Raises:** `ValueError` if all predictions are right, or all wrong.
        """
        columns = list(self.problem.space.columns)
        known = self._known
        rows = known[columns].assign(violated=known.index.isin(self.wrong.index))
        return find_rules(Samples.of(rows, "all", columns, self.problem.space), **options)

    def next_trials(self, count: int = 1, *, seed: int = 0) -> "pd.DataFrame":
        """Choose the trials that would shorten the interval most, the safest first.

        Neyman's rule determines the number of trials with a predicted failure; the features of both
        groups are drawn at random, which the interval relies on. So make all of these trials, in
        any order, and give their verdicts to `real_trials(..., allocated=True)`, with
        `at_any_time=True` if you stop early.

        **Arguments:**
        - `count`: number of trials.
        - `seed`: the seed of the draw.
        **Returns:** the features, `predicted` and the simulated `robustness` of each.
        """
        check_count("count", count)
        rng = np.random.default_rng(seed)
        predicted = self.background["predicted"].to_numpy(bool)
        rows = []
        for side, wanted in enumerate(self._allocation(count)):
            rows.append(rng.choice(np.flatnonzero(predicted == side), wanted, replace=False))
        chosen = self.background.iloc[np.concatenate(rows)]
        chosen = chosen.sort_values("robustness", ascending=False, kind="stable")
        return chosen.reset_index(drop=True)

    def _allocation(self, count: int) -> Int[np.ndarray, " 2"]:
        """Return how many of the next trials are not predicted to fail, and how many are."""
        predicted = self.table["predicted"].to_numpy(bool)
        failed = np.array([verdict is not False for verdict in self.table["failed"]])
        trials = np.array([np.sum(~predicted), np.sum(predicted)])
        failures = np.array([np.sum(failed & ~predicted), np.sum(failed & predicted)])
        share = self.background["predicted"].to_numpy(bool).mean()
        there = np.round(np.array([1 - share, share]) * len(self.background)).astype(int)
        q = (failures + 0.5) / (trials + 1)  # As if half a trial more had failed, and half not.
        spread = np.array([1 - share, share]) ** 2 * q * (1 - q)
        wanted = np.zeros(2, int)
        for _ in range(min(count, len(self.background))):
            now = trials + wanted + 1
            gain = np.where(wanted < there, spread / (now * (now + 1)), -1.0)
            wanted[int(gain.argmax())] += 1
        return wanted

    def __str__(self) -> str:
        verdicts = self.table["failed"]
        failures, open_ones = (sum(v is wanted for v in verdicts) for wanted in (True, None))
        undecided = f", {open_ones:,} undecided" if open_ones else ""
        rate, simulated = self.rate, self.simulated
        lines = [
            f"{self.problem.name}: {counted(rate.trials, 'real trial')}, {failures:,} failed"
            f"{undecided}",
            f"  real rate    {format_percent(rate.estimate)} "
            f"({format_percent(rate.confidence)} interval {format_percent(rate.low)} to "
            f"{format_percent(rate.high)}{', whenever stopped' if rate.at_any_time else ''}), as "
            f"short as that of {rate.worth:z,.0f} trials without the simulation",
            f"  simulated    {simulated}: {self._judgement(simulated)}",
        ]
        for predicted, words in ((True, "predicted to fail"), (False, "predicted to hold")):
            found = self.predictions(predicted)
            if found is not None:
                lines.append(
                    f"  {words}: {found.failures:,} of {counted(found.simulations, 'trial')} fail, "
                    f"{format_percent(found.low)} to {format_percent(found.high)}"
                )
        wrong = self.wrong["robustness"]
        if len(wrong):
            lines.append(
                f"  wrong        {counted(len(wrong), 'prediction')}, at a simulated robustness of "
                f"{wrong.min():z.3g} to {wrong.max():z.3g}; rules() describes where"
            )
        return "\n".join([*lines, *(f"  note         {note}" for note in self.notes)])

    def _judgement(self, simulated: Rate) -> str:
        """Say how the rate of the simulation compares with that of the trials."""
        if simulated.high < self.rate.low:
            return "the simulation is too optimistic"
        if simulated.low > self.rate.high:
            return "the simulation is too pessimistic"
        return "the trials do not contradict it"

    __repr__ = __str__

    def _notebook_parts(self) -> "Iterable[str]":
        return (frame_html(self.wrong),) if len(self.wrong) else ()
