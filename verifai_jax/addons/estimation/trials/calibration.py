"""Calibration of unmeasured features by real trials.

    found = calibrate(problem, "trials.csv", ["friction"])
    print(found); found.samples; found.problem      # falsify(found.problem) is nearer to reality

The posterior is sampled by rejection from the prior in two stages: the second draws only from the
region that the first left. The likelihood of values is that of the trials they explain, integrated
over the unknown share of unexplained trials, or over the unknown spread of the robustness.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float

from verifai_jax.addons.estimation.fitting import effective_size
from verifai_jax.addons.estimation.trials.reading import FAILED, TrialTable, table_of, verdicts_of
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import check_names, suggests_options
from verifai_jax.core.messages.text import format_percent
from verifai_jax.falsification import simulate
from verifai_jax.features import Empirical, FeatureSpace
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd
POSTERIOR = 1000
"""Samples of the posterior that are returned."""
TAIL = 1e-3
"""Posterior probability outside the second stage's range, at each end of each feature."""
TRUSTED = 9.0
"""Trials that the prior takes for explained, for one that nothing explains."""
AT_END, PILED = 0.05, 2.0
"""Share of the prior at each end of a domain, and times as many draws as that there are noted."""
DRAWN = 50
"""Draws of the prior for each one that is simulated in the second stage, at most."""


@dataclass(frozen=True, eq=False)
class Calibration(InNotebook):
    """The posterior of unmeasured features, as `calibrate` returns it.

    - `samples`: draws of the posterior, a column for each feature.
    - `problem`: the problem in which each of these features has the distribution of its draws,
      independently of the others.
    - `trials`: the number of trials with a verdict.
    - `unexplained`: number of trials that contradict even the best values.
    - `effective`: effective number of independent draws.
    - `notes`: features whose draws lie at an end of their domain.
    """

    samples: "pd.DataFrame"
    problem: Problem = field(repr=False)
    trials: int
    unexplained: int
    effective: float
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [f"{self.problem.name}: calibrated by {self.trials:,} trials"]
        for name in self.samples.columns:
            low, middle, high = self.samples[name].quantile([0.025, 0.5, 0.975])
            lines.append(f"  {name:12} {middle:z.4g} (95 % between {low:z.4g} and {high:z.4g})")
        lines.append(f"  unexplained  {self.unexplained:,} trials, by the best values too")
        lines += [f"  note         {note}" for note in self.notes]
        if self.effective < 50:
            lines.append(f"  note         worth {self.effective:z.0f} draws only: simulate more")
        return "\n".join(lines)

    __repr__ = __str__


@suggests_options
def calibrate(
    problem: Problem, trials: TrialTable, features: Sequence[str], *, simulations: int = 20_000,
    seed: int = 0,
) -> Calibration:  # fmt: skip
    """Find values of features that make the simulation agree with trials.

    **Arguments:**
    - `problem`: the simulation.
    - `trials`: a table with the other features, and `failed` as in `real_trials`; a column
      `robustness` of measured values is used instead if there is one.
    - `features`: names of the features that had the same unknown values in all trials.
    - `simulations`: number of all simulations; each draw takes as many as there are trials.
    - `seed`: the seed of the draws.
    **Returns:** the posterior, and the problem with it.
    **Raises:** `ValueError` for no or an unknown feature, a feature that is not a single number, a
    table without a verdict, and fewer simulations than 20 draws take; the errors of `simulate`.
    """
    table: Any = table_of(trials)[0]
    check_names("feature", dict.fromkeys(features), problem.space.domains)
    wrong = [name for name in features if name not in problem.space.columns]
    if wrong or not features:
        raise ValueError(f"calibrate needs features of one number each; got {list(features)}")
    measured = "robustness" in table.columns
    if not measured:
        table = table.assign(failed=verdicts_of(table)).dropna(subset=[FAILED])
    seen = table["robustness" if measured else FAILED].to_numpy(float)
    draws = check_count("simulations", simulations) // (2 * max(len(table), 1))
    if draws < 10:
        raise ValueError(
            f"calibrate takes two stages of 10 draws at least, {20 * len(table):,} simulations for "
            f"{len(table):,} trials; got simulations={simulations:,}"
        )
    names, known = list(features), table.drop(columns=[*features], errors="ignore")
    prior = _prior(problem, names, draws, seed)
    evidence, _ = _evidence(problem, names, prior, known, seen, measured, seed)
    posterior = np.exp(evidence - evidence.max())
    inside = np.ones(DRAWN * draws, bool)
    more = _prior(problem, names, DRAWN * draws, seed + 1)
    for column, values in zip(more.T, prior.T, strict=True):
        order = np.argsort(values)
        mass = np.cumsum(posterior[order]) / posterior.sum()
        first, last = np.searchsorted(mass, [TAIL, 1 - TAIL])
        # One draw further out: the end lies between the two.
        ends = values[order][[max(first - 1, 0), min(last + 1, draws - 1)]]
        inside &= (column >= ends[0]) & (column <= ends[1])
    chosen = more[inside][:draws]
    if len(chosen) < 10:
        chosen = prior
    evidence, unexplained = _evidence(problem, names, chosen, known, seen, measured, seed)
    weight = np.exp(evidence - evidence.max())
    rng = np.random.default_rng(seed)
    rows = rng.choice(len(chosen), POSTERIOR, p=weight / weight.sum())
    import pandas as pd

    samples = pd.DataFrame(chosen[rows], columns=names)
    varied = [name for name in names if float(np.ptp(samples[name].to_numpy(float))) > 0]
    domains = {name: Empirical(samples[name]) for name in varied}
    space = FeatureSpace({**problem.space.domains, **domains}, problem.space.where)
    return Calibration(
        samples, replace(problem, space=space, nominal=None), len(table),
        int(unexplained[evidence.argmax()]), effective_size(weight), _at_ends(samples, more),
    )  # fmt: skip


def _at_ends(samples: "pd.DataFrame", prior: Float[np.ndarray, "n k"]) -> tuple[str, ...]:
    """Say which features have draws at an end of the prior's, where the truth may lie beyond it."""
    notes = []
    for name, column in zip(samples.columns, prior.T, strict=True):
        values = samples[name].to_numpy(float)
        for sign, word in ((1, "lowest"), (-1, "highest")):
            at = np.quantile(sign * column, AT_END)
            share, usual = np.mean(sign * values <= at), np.mean(sign * column <= at)
            if share > PILED * usual:
                notes.append(
                    f"{name}: {format_percent(share)} of the draws lie among the {word} "
                    f"{format_percent(usual)} of the prior: the interval ends at the edge of its "
                    "domain, and the true value may lie beyond it"
                )
    return tuple(notes)


def _prior(problem: Problem, names: list[str], count: int, seed: int) -> Float[np.ndarray, "n k"]:
    columns = problem.space.rows(problem.space.sample(jax.random.key(seed), count))
    return np.column_stack([np.asarray(columns[name], float) for name in names])


def _evidence(
    problem: Problem, names: list[str], values: Float[np.ndarray, "n k"], known: "pd.DataFrame",
    seen: Float[np.ndarray, " trials"], measured: bool, seed: int,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:  # fmt: skip
    """Return the log likelihood of each row of values, and the trials that contradict it."""
    from scipy.special import betaln

    n = len(seen)
    rows = known.iloc[np.tile(np.arange(n), len(values))]
    rows = rows.assign(**dict(zip(names, np.repeat(values, n, axis=0).T, strict=True)))
    rows = rows[list(problem.space.columns)]
    table = simulate(problem, rows, seed=seed, progress=False).table.all
    wrong = table["violated"].to_numpy(bool).reshape(-1, n) != (seen < 0 if measured else seen > 0)
    if not measured:
        counts = wrong.sum(axis=1)
        return betaln(counts + 1, n - counts + TRUSTED), counts
    gaps = table["rho"].to_numpy(float).reshape(-1, n) - seen
    square = np.nan_to_num(np.mean(gaps**2, axis=1), nan=np.inf)
    return -n / 2 * np.log(square + 1e-12 * np.var(seen) + 1e-300), wrong.sum(axis=1)
