"""The importance of hyper-parameters for safety and for return, from the table of a sweep alone.

    importance = sweep.importance()
    importance.table                    # loss of R^2 when one is shuffled, shares of the variance
    importance.unsafe, importance.safe  # principal components of unsafe and safe configurations

A forest learns the failure rate and the return from coordinates in the unit cube of the study's
space: a log-uniform one counts by its logarithm. Its R^2 is measured on configurations that it was
not trained on. Rank correlations show weak trends where configurations are too few for it.

Sources: Geurts, Ernst and Wehenkel, Extremely randomized trees (2006); permutation importance of
Breiman, Random forests (2001); shares of the variance as in `fanova.py`; principal components as in
the case study of hyper-parameters of Dreossi et al., CAV 2019.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.addons.estimation.simultaneous_interval import verdict_kind
from verifai_jax.addons.training.sweeps.fanova import leaf_boxes, variance_shares
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.text import format_percent
from verifai_jax.features import FeatureSpace

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure
    from sklearn.ensemble import ExtraTreesRegressor

    from verifai_jax.addons.analysis._pca import Components
TARGETS = {"failure_rate": "failing", "nominal_return": "return"}
"""Columns that are explained, with their names in the summary."""
MIN_ROWS_TO_LEARN = 10
"""Configurations below which nothing is learned."""
MIN_ROWS = 5
"""Configurations of a verdict below which they have no principal components."""
FOLDS = 5
"""Folds of the cross-validation."""
TREES = 40
"""Trees of the forest."""
MIN_SCORE = 0.2
"""R^2 on held-out configurations below which importances mean nothing."""
MIN_LOSS = 0.02
"""Loss of R^2 below which the summary does not name a hyper-parameter."""
MAX_NAMED = 5
"""Hyper-parameters that the summary names, at most."""
MAX_CELLS = 8
"""Maximum number of different values in a column of unknown domain that count as choices."""


@dataclass(frozen=True, eq=False)
class HyperparameterImportance(InNotebook):
    """The importance of each hyper-parameter for safety and for the return.

    **Fields:**
    - `table`: one row for each hyper-parameter, the most important first. For each of
      `failure_rate` and `nominal_return` it has the loss in R^2 on held-out configurations when the
      column is shuffled, with `_low` and `_high` two standard deviations of the repetitions away;
      `_first` and `_total`, the shares of the model's variance that it explains alone and including
      interactions; `_trend`, its rank correlation (NaN for choices). NaN without a model.
    - `scores`: R^2 of the models, by target.
    - `chance`: by target, the 95 % quantile of the largest trend of unrelated hyper-parameters.
    - `missing`: reasons for a missing model, by target.
    - `unsafe`, `safe`: principal components of unsafe and safe configurations; None for fewer than
      five.
    - `configurations`: their number.
    - `name`: the name of the study.
    """

    table: "pd.DataFrame"
    scores: Mapping[str, float]
    chance: Mapping[str, float]
    missing: Mapping[str, str]
    unsafe: "Components | None"
    safe: "Components | None"
    configurations: int
    name: str

    def is_reliable(self, target: str) -> bool:
        """Return whether the model of one of the targets predicts held-out configurations."""
        return self.scores.get(target, -np.inf) >= MIN_SCORE

    @property
    def ranking(self) -> list[str]:
        """Hyper-parameters by decreasing importance, for safety if that is known."""
        return [str(name) for name in self.table.index]

    def plot(self, path: str | Path | None = None) -> "Figure":
        """Draw the shares of the variance, or the trends if no model is reliable.

        **Arguments:**
        - `path`: file to which the picture is written, if given.
        **Returns:** the Matplotlib figure.
        **Raises:** `ValueError` if there are too few configurations.
        """
        if not self.scores:
            raise ValueError(f"there is nothing to draw: {'; '.join(self._lines())}")
        return lazy_import("verifai_jax.addons.training.pictures.sweep", "plot_importance")(
            self, path
        )

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> list[str]:
        lines = []
        for target, what in TARGETS.items():
            if target in self.missing:
                lines.append(f"{what}: {self.missing[target]}")
                continue
            score = f"R^2 {self.scores[target]:z.2f} on held-out configurations"
            if not self.is_reliable(target):
                lines.append(
                    f"{what}: a model of these {self.configurations} configurations does not "
                    f"predict others ({score}); {self._trends(target)}"
                )
                continue
            losses = self.table[target].to_numpy(float)
            order = [j for j in np.argsort(-losses, kind="stable") if losses[j] >= MIN_LOSS]
            shares = self.table[f"{target}_total"].to_numpy(float)
            listed = ", ".join(
                f"{self.table.index[j]} ({format_percent(float(shares[j]))} of the variance)"
                for j in order[:MAX_NAMED]
            )
            lines.append(f"{what} depends on {listed or 'no single one'}; {score}")
        lines += self._directions()
        return lines

    def _trends(self, target: str) -> str:
        """Write the hyper-parameters that correlate with the target beyond chance."""
        trends = self.table[f"{target}_trend"].dropna()
        trends = trends.loc[trends.abs() > self.chance[target]]
        if not len(trends):
            return "no single one correlates with it beyond chance"
        order = trends.abs().sort_values(ascending=False).index[:MAX_NAMED]
        listed = ", ".join(f"{name} ({trends[name]:+z.2f})" for name in order)
        return f"its rank correlations beyond chance: {listed}"

    def _directions(self) -> list[str]:
        """Write the directions along which unsafe and safe configurations vary most."""
        lines = []
        for what, components in (("unsafe", self.unsafe), ("safe", self.safe)):
            if components is not None and len(components.directions):
                direction, names = components.directions[0], components.names
                order = np.argsort(-np.abs(direction), kind="stable")[:3]
                parts = " ".join(
                    f"{direction[j]:+z.2f} {names[j]}" for j in order if abs(direction[j]) >= 0.05
                )
                lines.append(
                    f"{what} configurations vary most along {parts} "
                    f"({format_percent(components.shares[0])} of their variance)"
                )
        return lines


@dataclass(frozen=True)
class _Input:
    """One hyper-parameter as the models see it: coordinates in [0, 1], the borders of its cells if
    it is discrete, and whether it is a number and not a choice.
    """

    name: str
    values: Float[np.ndarray, " rows"]
    edges: Float[np.ndarray, " edges"] | None
    ordered: bool


def hyperparameter_importance(
    table: "pd.DataFrame", hyperparameters: Sequence[str], space: FeatureSpace | None, *,
    name: str = "sweep", repeats: int = 5, seed: int = 0,
) -> HyperparameterImportance:  # fmt: skip
    """Measure the importance of hyper-parameters from the rows of a sweep's table.

    **Arguments:**
    - `table`: the table, whose hyper-parameters are in these columns; `steps` counts if it varies.
    - `space`: the space of the study; if None, columns are scaled by their minimum and maximum.
    - `repeats`, `seed`: as in `Sweep.importance`.
    """
    import pandas as pd

    names = list(dict.fromkeys([*hyperparameters, "steps"]))
    inputs = _inputs(table, names, space)
    groups = table["configuration"].to_numpy()
    columns: dict[str, np.ndarray] = {}
    scores: dict[str, float] = {}
    chance: dict[str, float] = {}
    missing: dict[str, str] = {}
    for target in TARGETS:
        values = table[target].to_numpy(np.float64)
        usable = np.isfinite(values)
        if reason := _unlearnable(values[usable], groups[usable], len(inputs)):
            missing[target] = reason
            continue
        matrix = np.stack([one.values for one in inputs], axis=1)[usable]
        score, losses = _permutation_losses(matrix, values[usable], groups[usable], repeats, seed)
        mean, spread = losses.mean(axis=0), 2 * losses.std(axis=0, ddof=1)
        forest = _forest(matrix.shape[1], seed).fit(matrix, values[usable])
        shares = variance_shares(leaf_boxes(forest, [one.edges for one in inputs]))
        scores[target] = score
        trend, chance[target] = trends(matrix, values[usable], groups[usable], seed)
        ordered = np.array([one.ordered for one in inputs])
        columns[f"{target}_trend"] = np.where(ordered, trend, np.nan)
        columns |= {target: mean, f"{target}_low": mean - spread, f"{target}_high": mean + spread}
        columns |= {f"{target}_first": shares.first, f"{target}_total": shares.total}
    importances = pd.DataFrame(columns, index=pd.Index([one.name for one in inputs], name="name"))
    if scores:
        by = max(scores, key=lambda target: (scores[target] >= MIN_SCORE, target == "failure_rate"))
        importances = importances.sort_values(by, ascending=False, kind="stable")
    unsafe, safe = (_components(table, inputs, kind) for kind in ("counterexamples", "safe"))
    return HyperparameterImportance(
        importances, scores, chance, missing, unsafe, safe, len(np.unique(groups)), name
    )


def _unlearnable(values: np.ndarray, groups: np.ndarray, inputs: int) -> str:
    """Return the reason why no model can be learned; empty if one can."""
    count = len(np.unique(groups))
    if not inputs:
        return "no hyper-parameter varies"
    if count < MIN_ROWS_TO_LEARN:
        some = f"{count} configuration{'s' * (count != 1)}" if count else "no configuration"
        return f"{some} with a verdict, too few to learn from (at least {MIN_ROWS_TO_LEARN})"
    if np.ptp(values) == 0:
        return f"it is {values[0]:z.4g} for every policy"
    return ""


def _forest(inputs: int, seed: int) -> "ExtraTreesRegressor":
    from sklearn.ensemble import ExtraTreesRegressor

    return ExtraTreesRegressor(
        n_estimators=TREES, min_samples_leaf=2, max_leaf_nodes=48,
        max_features=min(1.0, max(0.6, 3 / inputs)), random_state=seed,
    )  # fmt: skip


def _permutation_losses(
    matrix: Float[np.ndarray, "n d"], values: Float[np.ndarray, " n"],
    groups: Int[np.ndarray, " n"], repeats: int, seed: int,
) -> tuple[float, Float[np.ndarray, "repeats d"]]:  # fmt: skip
    """Return R^2 on held-out configurations, and its loss when each column is shuffled."""
    generator = np.random.default_rng(seed)
    rows, dimensions = matrix.shape
    distinct, member = np.unique(groups, return_inverse=True)
    scores, losses = [], []
    for repeat in range(repeats):
        # Seeds and checkpoints of a configuration are alike: they stay on one side.
        fold = generator.permutation(np.arange(len(distinct)) % FOLDS)[member]
        guess = np.zeros((dimensions + 1, rows))
        orders = [generator.permutation(rows) for _ in range(dimensions)]
        for k in range(FOLDS):
            aside = fold == k
            model = _forest(dimensions, seed + repeat).fit(matrix[~aside], values[~aside])
            queries = np.repeat(matrix[aside][None], dimensions + 1, axis=0)
            for j, order in enumerate(orders):
                queries[j + 1, :, j] = matrix[order, j][aside]
            answers = model.predict(queries.reshape(-1, dimensions))
            guess[:, aside] = answers.reshape(dimensions + 1, -1)
        errors = np.square(guess - values).sum(axis=1)
        r_squared = 1 - errors / np.square(values - values.mean()).sum()
        scores.append(r_squared[0])
        losses.append(r_squared[0] - r_squared[1:])
    return float(np.mean(scores)), np.array(losses)


def _inputs(
    table: "pd.DataFrame", names: Sequence[str], space: FeatureSpace | None
) -> list[_Input]:
    """Return the columns that vary, as coordinates in the unit cube."""
    import pandas as pd

    inputs = []
    domains = {} if space is None else space.domains
    for name in names:
        entries: Any = table[name]
        if entries.nunique(dropna=True) < 2:
            continue
        number = pd.api.types.is_numeric_dtype(entries) and not pd.api.types.is_bool_dtype(entries)
        # Checkpoints need not lie in the domain of the lengths of trainings.
        domain = None if name == "steps" else domains.get(name)
        if domain is not None and domain.size == 1:
            present = entries.dropna().unique().tolist()
            index = {
                entry: float(domain.to_unit(domain.from_columns({name: entry}, name))[0])
                for entry in present
            }
            values = entries.map(index).to_numpy(np.float64)
            levels, weights = domain.levels[0], domain.weights[0]
            edges = np.linspace(0, 1, levels + 1) if levels else None
            if weights is not None:
                edges = np.concatenate([[0.0], np.cumsum(weights)])
        elif number and entries.nunique() > MAX_CELLS:
            real = entries.to_numpy(np.float64)
            values, edges = (real - np.nanmin(real)) / np.ptp(real[~np.isnan(real)]), None
        else:
            # Lengths of trainings, and columns of an unknown domain, by their order.
            codes, kinds = pd.factorize(entries, sort=True)
            values = np.where(codes < 0, np.nan, (codes + 0.5) / len(kinds))
            edges = np.linspace(0, 1, len(kinds) + 1)
        # For an algorithm that lacks it the value is irrelevant: the middle.
        values = np.where(np.isnan(values), 0.5, values)
        inputs.append(_Input(name, values, edges, bool(number)))
    return inputs


def _components(
    table: "pd.DataFrame", inputs: Sequence[_Input], which: Literal["counterexamples", "safe"]
) -> "Components | None":
    """Compute principal components of the ordered hyper-parameters of unsafe or safe rows."""
    import pandas as pd

    from verifai_jax.addons.analysis._pca import pca

    ordered = [one for one in inputs if one.ordered and one.name != "steps"]
    verdicts = table["verdict"].astype(str)
    known = verdicts.map(verdict_kind).isin(["safe", "unsafe"])
    frame = pd.DataFrame({one.name: one.values for one in ordered}, index=table.index)
    frame["violated"] = (verdicts == "unsafe").to_numpy()
    # One row a configuration, at its last checkpoint; the worst of its seeds decides.
    last = table["steps"] == table.groupby("configuration")["steps"].transform("max")
    frame = frame.loc[known & last].assign(configuration=table["configuration"])
    frame = frame.sort_values("violated", kind="stable")
    frame = frame.drop_duplicates("configuration", keep="last").drop(columns="configuration")
    selected = frame["violated"] == (which == "counterexamples")
    if int(selected.sum()) < MIN_ROWS or not ordered:
        return None
    return pca(frame, which=which, columns=[one.name for one in ordered], scale="raw")


SHUFFLES = 1000
"""Shuffled outcomes that decide what chance can do."""


def trends(
    inputs: Float[np.ndarray, "n d"], outcome: Float[np.ndarray, " n"],
    groups: Int[np.ndarray, " n"], seed: int = 0,
) -> tuple[Float[np.ndarray, " d"], float]:  # fmt: skip
    """Correlate inputs with an outcome over groups of rows, using the mean of each group.

    **Returns:** Spearman's correlation of each input, NaN for a constant one; the 95 % quantile of
    the largest correlation over shuffled outcomes, whatever the number of inputs.
    """
    distinct, member = np.unique(groups, return_inverse=True)
    counts = np.bincount(member)
    means = np.stack(
        [np.bincount(member, column) / counts for column in (outcome, *inputs.T)], axis=1
    )
    ranks = _rank(means)
    result, columns = ranks[:, 0], ranks[:, 1:]
    rng = np.random.default_rng(seed)
    shuffled = np.stack([result, *(rng.permutation(result) for _ in range(SHUFFLES))])
    with np.errstate(invalid="ignore"):
        correlations = shuffled @ columns / len(distinct)
    constant = (columns == 0).all(axis=0)
    greatest = np.abs(correlations[1:, ~constant]).max(axis=1, initial=0.0)
    correlation = np.where(constant, np.nan, correlations[0])
    return correlation, float(np.quantile(greatest, 0.95))


def _rank(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Return ranks of columns with mean 0 and deviation 1 (or all 0); equal values share one."""
    from scipy.stats import rankdata

    ranks = np.asarray(rankdata(values, axis=0))
    ranks -= ranks.mean(axis=0)
    deviation = ranks.std(axis=0)
    return ranks / np.where(deviation > 0, deviation, 1.0)
