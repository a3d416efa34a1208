"""Comparison of two policies by the scores that other evaluators wrote.

print(compare_scores("old/eval_info.json", "new/eval_info.json"))
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.addons.estimation.clustered import (
    ClusteredMean,
    anytime_mean,
    clustered_mean,
    difference,
)
from verifai_jax.addons.estimation.comparison.result import judge_score
from verifai_jax.addons.estimation.comparison.score_tables import KEYS, read_scores
from verifai_jax.addons.estimation.paired_rates import paired_rates
from verifai_jax.core.display.notebook import Tabular
from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import counted, format_percent
from verifai_jax.statistics.binomial import clopper_pearson

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class ScoreComparison(Tabular):
    """Two policies by their scores, of which more is better; made by `compare`.

    - `baseline`, `candidate`: their names; `scores`: their means over tasks.
    - `low`, `high`: bounds of the difference, candidate minus baseline.
    - `clusters`: number of the independent parts on which these rest; `by`: the column that they
      are of.
    - `paired`: whether both have the same clusters, which are compared one by one.
    - `at_any_time`: whether the bounds hold however the end was decided.
    - `table`: a row for each task, with both means and their difference.
    """

    baseline: str
    candidate: str
    scores: tuple[float, float]
    low: float
    high: float
    confidence: float
    margin: float
    clusters: int
    by: str
    paired: bool
    at_any_time: bool
    table: "pd.DataFrame" = field(repr=False)

    @property
    def estimate(self) -> float:
        """The difference of the scores."""
        return self.scores[1] - self.scores[0]

    @property
    def verdict(self) -> str:
        """`"worse"` (by more than the margin), `"better"`, `"the same"` or `"undecided"`."""
        return judge_score(self.low, self.high, self.margin)

    @property
    def regression(self) -> bool:
        """True if the candidate is worse by more than the margin."""
        return self.verdict == "worse"

    def __str__(self) -> str:
        when = ", whenever stopped" if self.at_any_time else ""
        how = "in pairs" if self.paired else "of each, not paired"
        lines = [
            f"{self.candidate} is {self.verdict.upper()} against {self.baseline}: the score "
            f"changes by {self.estimate:z.3g} ({format_percent(self.confidence)} interval "
            f"{self.low:z.3g} to {self.high:z.3g}{when}), from {self.scores[0]:z.3g} to "
            f"{self.scores[1]:z.3g}",
            f"  {counted(self.clusters, f'cluster of {self.by}')} {how}",
        ]
        if len(self.table) > 1:
            lines += [f"  {line}" for line in self.table.to_string().splitlines()]
        return "\n".join(lines)


def compare_scores(
    given: tuple[Any, Any], names: tuple[str, str], margin: float, confidence: float,
    cluster: str | None, in_order: bool,
) -> ScoreComparison:  # fmt: skip
    """Compare two tables of scores; see `compare`."""
    check_fraction("confidence", confidence)
    if not margin >= 0:
        raise ValueError(f"margin must be a difference of scores, 0 or more; got {margin}")
    sides: list[Any] = [read_scores(each) for each in given]
    by = _cluster(sides, cluster)
    sides = [s.assign(task=s["task"].astype(str) if "task" in s.columns else "") for s in sides]
    if alone := {*sides[0]["task"]} ^ {*sides[1]["task"]}:
        some = ", ".join(sorted(alone)[:5])
        raise ValueError(f"both sides must have the same tasks; only one of them has {some}")
    one, other = (side.groupby("task")["score"].mean() for side in sides)
    table = one.to_frame("baseline").assign(candidate=other, difference=other - one)
    pairs = _pairs(sides)
    low, high, count = (_in_order(pairs, by, confidence) if in_order
                        else _fixed(sides, pairs, by, confidence))  # fmt: skip
    return ScoreComparison(
        *names, (float(one.mean()), float(other.mean())), low, high, confidence, margin, count, by,
        pairs is not None, in_order, table,
    )  # fmt: skip


def _cluster(sides: list[Any], cluster: str | None) -> str:
    """Return the column of clusters: the one given, or what is repeated, runs before seeds."""
    known = [key for key in KEYS if all(key in side.columns for side in sides)]
    if cluster is not None:
        check_names("column of both sides", [cluster], known)
        return cluster
    for key in ("run", "seed"):
        if key in known and all(side[key].nunique() > 1 for side in sides):
            return key
    for side in sides:
        side["episode of its own"] = np.arange(len(side))
    return "episode of its own"


def _pairs(sides: list[Any]) -> Any:
    """Return both scores of each episode if both sides have the same ones; None otherwise."""
    keys = [key for key in KEYS if key in sides[0].columns and key in sides[1].columns]
    one, other = (side.assign(repetition=side.groupby(keys).cumcount()) for side in sides)
    joined = one.merge(other, on=[*keys, "repetition"], suffixes=("", "_other"))
    joined["apart"] = joined["score_other"] - joined["score"]
    return joined if len(joined) == len(one) == len(other) else None


def _mean(table: Any, column: str, by: str) -> ClusteredMean:
    codes = [np.unique(table[c].astype(str), return_inverse=True)[1] for c in (by, "task")]
    return clustered_mean(table[column].to_numpy(float), *codes)


def _discordant(pairs: Any) -> tuple[int, int, int]:
    return int((pairs["apart"] == -1).sum()), int((pairs["apart"] == 1).sum()), len(pairs)


def _fixed(sides: list[Any], pairs: Any, by: str, confidence: float) -> tuple[float, float, int]:
    """Return the bounds for a number of scores fixed beforehand, and the number of clusters.

    Where all scores are 0 or 1 they are at least as wide as those of independent episodes: clusters
    that agree by chance, as where all succeed, have no spread.
    """
    apart = pairs is not None and _mean(pairs, "apart", by)
    between = apart or difference(*(_mean(side, "score", by) for side in sides))
    low, high = between.interval(confidence)
    if not all(side["score"].isin([0.0, 1.0]).all() for side in sides):
        return low, high, between.count
    if apart:
        exact = paired_rates(*_discordant(pairs), confidence, at_any_time=False)
        ends = exact.low, exact.high
    else:
        a, b = (clopper_pearson(int(s["score"].sum()), len(s), confidence) for s in sides)
        gap = b.estimate - a.estimate
        ends = (gap - float(np.hypot(b.estimate - b.low, a.high - a.estimate)),
                gap + float(np.hypot(b.high - b.estimate, a.estimate - a.low)))  # fmt: skip
    return max(min(low, ends[0]), -1.0), min(max(high, ends[1]), 1.0), between.count


def _in_order(pairs: Any, by: str, confidence: float) -> tuple[float, float, int]:
    """Return bounds that hold after any number of clusters, in their order, and that number."""
    if pairs is None:
        raise ValueError("in_order needs the same episodes of both sides, to compare them in pairs")
    scores = pairs[["score", "score_other"]].to_numpy(float)
    if scores.min() < 0 or scores.max() > 1:
        ends = f"they go from {scores.min():zg} to {scores.max():zg}"
        raise ValueError(f"in_order needs scores from 0 to 1; {ends}")
    means = pairs.groupby([by, "task"], sort=False)["apart"].mean().unstack()
    if means.isna().any(axis=None):
        raise ValueError(
            f"in_order needs all tasks in each {by}, otherwise the later ones are of other tasks; "
            "give the scores of one task, or another cluster="
        )
    if len(means) == len(pairs) and np.isin(scores, (0.0, 1.0)).all():
        rates = paired_rates(*_discordant(pairs), confidence)
        return rates.low, rates.high, len(means)
    means = means.loc[pairs[by].drop_duplicates()].mean(axis=1).to_numpy(float)
    low, high = anytime_mean((means + 1) / 2, confidence)
    return 2 * low - 1, 2 * high - 1, len(means)
