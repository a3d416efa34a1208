"""The failure rate in reality, from a few trials and many simulations.

    found = real_trials(problem, "trials.csv")
    print(found); found.rate, found.rules(), found.next_trials(5)

Each trial is simulated with the same features, which predicts whether it fails. The rate of
predicted failures comes from simulations of the prior, and the accuracy of predictions from the
trials. `statistics.stratified_rate` combines both into an interval that is valid for any quality of
the simulation.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Real

from verifai_jax.addons.estimation.stratified_rate import stratified_rate
from verifai_jax.addons.estimation.trials.reading import TrialTable, copies, read_trials
from verifai_jax.addons.estimation.trials.result import RealTrials
from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.messages.text import counted
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.falsification import falsify, simulate
from verifai_jax.falsification.run import Run
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd
UNLIKELY = 1e-3
"""Probability below which trials are not taken for samples of the prior."""
MIN_TRIALS = 10
"""Trials from which on that is asked."""


@suggests_options
def real_trials(
    problem: Problem,
    trials: TrialTable,
    *,
    simulations: int = 10_000,
    confidence: float = 0.95,
    seed: int = 0,
    allocated: bool = False,
    at_any_time: bool = False,
    time: str = "time",
    dt: float | None = None,
    precision: str = "float32",
    run_on: RunOn | None = None,
    progress: bool | None = None,
) -> RealTrials:
    """Estimate the failure rate of the real system from trials, with the help of the simulation.

    The interval holds however good or bad the simulation is. If its predictions are good, half as
    many trials or fewer give an interval as short as that of Clopper and Pearson.

    **Arguments:**
    - `problem`: the simulation. The prior of its features must be the distribution of the trials.
    - `trials`: the path of a CSV or Parquet file, or a data frame: a column for each feature as in
      the table of a run, and `failed` (yes or no; empty where a trial may have failed), or
      `recording` with a file of signals for each trial, which the formulas judge.
    - `simulations`: number of simulations of the prior, for the rate of predicted failures.
    - `confidence`: the probability that the interval holds.
    - `seed`: the seed of the simulations.
    - `allocated`: True if the numbers of trials with and without a predicted failure were chosen
      beforehand, as `next_trials` does; otherwise the trials are samples of the prior.
    - `at_any_time`: True if verdicts influenced which trials were made, or when to stop.
    - `time`, `dt`: time column and period of recordings, as in `mtl.read`.
    - `precision`, `run_on`, `progress`: as in `falsify`.
    **Returns:** the result, with the table of trials and predictions.
    **Raises:** `FileNotFoundError`; `ValueError` for tables without a verdict or a feature,
    features outside their domains, and options out of range; the errors of `falsify`.
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"real_trials needs a Problem; got {type(problem).__name__}")
    check_fraction("confidence", confidence)
    check_count("simulations", simulations)
    read, unread = read_trials(problem, trials, time=time, dt=dt)
    features: Any = read[list(problem.space.columns)]
    how: Any = {"precision": precision, "run_on": run_on, "progress": progress}
    same = simulate(problem, features, seed=seed, **how)
    prior = falsify(problem, "uniform", simulations, seed=seed + 1, confirm=False, **how)
    table: Any = read.assign(**_predictions(same))
    background: Any = prior.table.all[list(problem.space.columns)].assign(**_predictions(prior))
    predicted = table["predicted"].to_numpy(bool)
    failed, open_ones = (
        np.array([verdict is wanted for verdict in table["failed"]]) for wanted in (True, None)
    )
    sides = [~predicted, predicted]
    rate = stratified_rate(
        *((int(np.sum(failed & side)), int(np.sum(side))) for side in sides),
        share=(int(np.sum(background["predicted"].to_numpy(bool))), len(background)),
        undecided=tuple(int(np.sum(open_ones & side)) for side in sides),  # pyright: ignore
        confidence=confidence, allocated=allocated, at_any_time=at_any_time,
    )  # fmt: skip
    notes = [f"{counted(n, 'recording')} without a verdict: {why}" for why, n in unread.items()]
    notes += copies(features)
    if not (allocated or at_any_time):
        notes += _unlike_prior(problem, features)
    if without := int(table["robustness"].isna().sum()):
        which = f"the simulation of {counted(without, 'trial')}"
        notes.append(f"{which} has no verdict, and predicts no failure")
    return RealTrials(problem, table, background, rate, seed, tuple(notes))


def _predictions(run: Run) -> dict[str, Real[np.ndarray, " n"]]:
    rows = run.table.all
    return {"predicted": rows["violated"].to_numpy(bool), "robustness": rows["rho"].to_numpy()}


def _unlike_prior(problem: Problem, features: "pd.DataFrame") -> list[str]:
    """Say which features of the trials are no samples of the prior, by Kolmogorov's test."""
    from scipy.stats import kstest

    if len(features) < MIN_TRIALS:
        return []
    points = problem.space.points(features)
    notes = []
    for index, levels in enumerate(problem.space.levels):
        if levels or kstest(points[:, index], "uniform").pvalue > UNLIKELY / points.shape[1]:
            continue
        notes.append(
            f"{problem.space.coordinates[index]} of the trials is distributed otherwise than in "
            "the problem; the rate is of trials whose features are drawn as the problem says"
        )
    return notes
