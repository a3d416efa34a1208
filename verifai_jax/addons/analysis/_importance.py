"""Importance of features for failing and for the robustness, from the table alone.

found = importance(run)
found.table                 drop of the score when a feature is shuffled
found.is_reliable("failing")    whether its model can predict at all
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.analysis.data.samples import Samples, Source
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count

MAX_TRAINED = 4000
MAX_TESTED = 2000
MAX_PREDICTED = 200_000
"""Predictions at most, over all features and repetitions."""
MIN_OF_A_KIND = 5
"""Rows of each verdict, for training and for measuring, below which nothing is learned."""
MAX_ONE_HOT = 30
MAX_ENTRIES = 4_000_000
TREES = 60
MIN_SCORE = {"failing": 0.65, "rho": 0.2}
"""Scores on held-out rows; with lower ones, importances are unreliable."""
NAMES = {"failing": "failing", "rho": "robustness"}
"""Targets of the models, as a person calls them."""
SCORES = {"failing": "AUC", "rho": "R^2"}
MIN_LOSS = 0.01
MAX_NAMED = 6


@dataclass(frozen=True, eq=False)
class Importance(Drawn, InNotebook):
    """The loss in accuracy of a model of the table when one feature is shuffled.

    **Fields:** `table`: one row for each feature, the most important first; `failing` is the loss
    in the area under the ROC curve (0.5 is chance) of a model that predicts failures, `rho` the
    loss in R^2 of a model of the robustness, each with `_low` and `_high`, two standard deviations
    of the repetitions away; NaN without a model. `scores`: the accuracy of the models on held-out
    rows; `missing`: why a model is missing; `name` of the run.
    """

    _picture = "verifai_jax.addons.analysis.pictures.overview", "plot_importance"
    """The losses as bars."""
    table: pd.DataFrame
    scores: dict[str, float]
    missing: dict[str, str]
    name: str

    def is_reliable(self, target: str) -> bool:
        """Return whether the model of `"failing"` or `"rho"` predicts held-out rows."""
        return self.scores.get(target, -np.inf) >= MIN_SCORE[target]

    @property
    def ranked(self) -> list[str]:
        """Features by decreasing importance, according to the model that is reliable."""
        return [str(name) for name in self.table.index]

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        lines = []
        for target, what in NAMES.items():
            if target in self.missing:
                lines.append(f"{what}: {self.missing[target]}")
                continue
            losses = self.table[target].to_numpy(float)
            order = [i for i in np.argsort(-losses, kind="stable") if losses[i] >= MIN_LOSS]
            listed = ", ".join(
                f"{self.table.index[i]} ({losses[i]:z.2f})" for i in order[:MAX_NAMED]
            )
            if self.is_reliable(target):
                lines.append(f"{what} depends on {listed}; {self.score_words(target)}")
            else:
                lines.append(
                    f"{what}: importances are meaningless, because a model from these rows does "
                    f"not predict others ({self.score_words(target)})"
                )
        return "\n".join(lines)

    def score_words(self, target: str) -> str:
        """Describe the score of the model of `"failing"` or `"rho"`."""
        return f"{SCORES[target]} {self.scores[target]:z.2f} on rows kept aside"


@shows_progress("finding importances in")
def importance(
    source: Source, *, repeats: int = 5, seed: int = 0, progress: bool | None = None
) -> Importance:
    """Measure how important each feature is to a model trained on the table; nothing is simulated.

    **Arguments:**
    - `source`: a run, its table, a DataFrame, or `Samples`; of the first three all rows with a
      verdict are used.
    - `repeats`: how often each feature is shuffled.
    - `seed`: the seed of all random draws.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Returns:** an `Importance`.

    Half of the rows (at most 4000) train an ensemble of trees; the loss is measured on the others.
    If two features are correlated in the table, as after a search that learns, they share their
    importance or hide each other's.

    Sources: trees of Geurts, Ernst and Wehenkel, Extremely randomized trees, Machine Learning 63
    (2006); permutation importance of Breiman, Random forests, Machine Learning 45 (2001).

    **Raises:** `ValueError` without rows, or if neither failing nor the robustness can be learned.
    """
    repeats = check_count("repeats", repeats, 2)
    samples = Samples.of(source, "all")
    matrix, groups = _encoded(samples)
    names = [column.name for column in (*samples.ordered, *samples.unordered)]
    columns: dict[str, Any] = {}
    scores: dict[str, float] = {}
    missing: dict[str, str] = {}
    for target, values in (("failing", samples.failing), ("rho", samples.rho)):
        usable = np.isfinite(values.astype(np.float64))
        reason = _unlearnable(target, values[usable])
        if reason:
            missing[target] = reason
            continue
        generator = np.random.default_rng(seed)
        rows = np.flatnonzero(usable)
        train, test = _split(values[rows], generator, len(groups) * repeats)
        score, losses = _losses(
            matrix[rows], values[rows], groups, train, test, generator, repeats, seed
        )
        scores[target] = score
        mean, spread = losses.mean(axis=1), 2 * losses.std(axis=1, ddof=1)
        columns |= {target: mean, f"{target}_low": mean - spread, f"{target}_high": mean + spread}
    if not scores:
        reasons = "; ".join(f"{NAMES[target]}: {reason}" for target, reason in missing.items())
        raise ValueError(f"no importance can be learned from {samples.name!r}: {reasons}")
    table = pd.DataFrame(columns, index=pd.Index(names, name="feature"))
    by = max(scores, key=lambda target: (scores[target] >= MIN_SCORE[target], target == "failing"))
    table = table.sort_values(by, ascending=False, kind="stable")
    return Importance(table, scores, missing, samples.name)


def _unlearnable(target: str, values: np.ndarray) -> str:
    """Explain why nothing can be learned; empty if something can."""
    if target == "failing":
        smallest = int(min(values.sum(), (~values).sum()))
        if smallest < 2 * MIN_OF_A_KIND:
            kind = "failing" if values.sum() <= (~values).sum() else "safe"
            rows = "row" if smallest < 2 else "rows"
            return f"{smallest or 'no'} {kind} {rows}, too few to learn from"
    elif len(values) < 4 * MIN_OF_A_KIND:
        rows = "row" if len(values) == 1 else "rows"
        return f"{len(values)} {rows} with a robustness, too few to learn from"
    elif np.ptp(values) == 0:
        return f"it is {values[0]:z.4g} in every row"
    return ""


def _split(
    values: np.ndarray, generator: np.random.Generator, predictions: int
) -> tuple[Int[np.ndarray, " train"], Int[np.ndarray, " test"]]:
    """Return rows to train on and rows to measure on; rare verdicts are kept before others."""
    maximum = int(np.clip(MAX_PREDICTED // max(predictions, 1), 200, MAX_TESTED))
    if values.dtype != bool:
        order = generator.permutation(len(values))
        half = len(values) // 2
        return order[:half][:MAX_TRAINED], order[half:][:maximum]
    train, test = [], []
    for part in (values, ~values):
        order = generator.permutation(np.flatnonzero(part))
        half = len(order) // 2
        # Neither score depends on how many rows of each verdict there are.
        train.append(order[:half][: MAX_TRAINED // 2])
        test.append(order[half:][: maximum // 2])
    return np.concatenate(train), np.concatenate(test)


def _losses(
    matrix: Float[np.ndarray, "n e"], values: np.ndarray, groups: Sequence[Sequence[int]],
    train: Int[np.ndarray, " train"], test: Int[np.ndarray, " test"],
    generator: np.random.Generator, repeats: int, seed: int,
) -> tuple[float, Float[np.ndarray, "features repeats"]]:  # fmt: skip
    """Return the score of a model on the test rows, and its losses by shuffling each feature."""
    from sklearn.ensemble import ExtraTreesClassifier, ExtraTreesRegressor
    from sklearn.metrics import r2_score, roc_auc_score

    # Enough features a split that those without influence do not drown the others.
    options: Any = {"n_estimators": TREES, "min_samples_leaf": 2, "random_state": seed}
    options |= {"max_features": min(1.0, 40 / matrix.shape[1])}
    binary = values.dtype == bool
    if binary:
        model: Any = ExtraTreesClassifier(class_weight="balanced", **options)
    else:
        model = ExtraTreesRegressor(**options)
    model.fit(matrix[train], values[train])

    def scores(rows: Float[np.ndarray, "copies test e"]) -> Float[np.ndarray, " copies"]:
        flat = rows.reshape(-1, rows.shape[-1])
        guess = model.predict_proba(flat)[:, 1] if binary else model.predict(flat)
        measure: Any = roc_auc_score if binary else r2_score
        return np.array([measure(values[test], part) for part in guess.reshape(len(rows), -1)])

    plain = matrix[test]
    reached = float(scores(plain[None])[0])
    # Several features a call: sklearn takes longer to call a tree than to ask it.
    together = max(1, int(MAX_ENTRIES // (repeats * plain.size)))
    losses = []
    for begin in range(0, len(groups), together):
        some = groups[begin : begin + together]
        shuffled = np.repeat(plain[None], repeats * len(some), axis=0)
        for i, part in enumerate(shuffled):
            group = some[i // repeats]
            part[:, group] = plain[generator.permutation(len(test))][:, group]
        losses.append(reached - scores(shuffled).reshape(len(some), repeats))
    return reached, np.concatenate(losses)


def _encoded(samples: Samples) -> tuple[Float[np.ndarray, "n e"], list[list[int]]]:
    """Return columns for the trees, and those that belong to each feature, ordered ones first."""
    columns: list[Any] = []
    groups: list[list[int]] = []
    for values in samples.matrix().T.reshape(len(samples.ordered), -1):
        groups.append([len(columns)])
        columns.append(values)
    absent: Bool[np.ndarray, "n k"] = np.isnan(samples.values())
    for j in np.flatnonzero(absent.any(axis=0)):
        groups[j].append(len(columns))
        columns.append(absent[:, j].astype(float))
    for codes, column in zip(samples.codes().T, samples.unordered, strict=True):
        choices = len(column.choices)
        parts = [codes] if choices > MAX_ONE_HOT else [codes == i for i in range(choices)]
        groups.append(list(range(len(columns), len(columns) + len(parts))))
        columns += [part.astype(float) for part in parts]
    return np.stack(columns, axis=1).astype(np.float32), groups
