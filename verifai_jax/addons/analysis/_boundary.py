"""The probability of a failure at any point of the space, learned from the rows of a table.

    found = boundary(run)
    found.probability({"speed": 17.0, "grip": 5.5})     # 0.93
    found.sampled({"speed": 17.0, "grip": 5.5})         # True: rows lie that close
    found.next_points(8)                                # where a simulation would say most

Four models are trained: polynomials of the robustness and of the odds, boosted trees, a Gaussian
process. A logistic regression on their predictions for held-out rows gives the probability
(Wolpert, Stacked generalization, Neural Networks 5, 1992). The Brier score on held-out rows
measures its quality (Brier, Monthly Weather Review 78, 1950).
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from verifai_jax.addons.analysis.data.samples import Samples, Source
from verifai_jax.core.display.notebook import InNotebook, frame_html
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.text import format_features, format_percent

MIN_ROWS = 10
"""Failures, and safe rows, from which on a boundary between them is learned."""
MAX_ROWS = 6000
"""Rows learned from at most, drawn at random of each verdict."""
MAX_PROCESS = 2000
"""Rows of the Gaussian process at most: its time grows with their cube, ..."""
MAX_LENGTHS = 400
"""... and rows that its length scales are learned from, fifty times over."""
FOLDS = 5
PRIOR = 4096
"""Points of the prior at which the probability is averaged, and new points are sought."""
FAR = 2.0
"""Greatest robustness that learners see, in medians of its size."""
NEAR = 0.99
"""Share of the rows that have another row within the reach of one."""
Points = pd.DataFrame | Mapping[str, Any]
Matrix = Float[np.ndarray, "n d"]
Margin = Float[np.ndarray, " n"]
Failing = Bool[np.ndarray, " n"]
Answer = Callable[[Matrix], Margin]


@dataclass(frozen=True, eq=False)
class Boundary(InNotebook):
    """The probability of a failure over the space, as learned by `boundary`.

    - `brier`: mean squared difference of predicted probability and verdict, on held-out rows.
    - `base`: the same for a constant prediction, the share of failures.
    - `calibration`: for each tenth of the predicted probability, the failed rows and all rows.
    - `reach`: maximum distance at which a row is informative about a point (`Samples.points`).
    - `share`: mean probability over the prior; neither a bound nor an estimate with an interval.
    - `unsampled`: share of the prior beyond the reach of all rows. Both are NaN without a space.
    - `samples`: the rows.
    """

    brier: float
    base: float
    calibration: pd.DataFrame = field(repr=False)
    reach: float
    share: float
    unsampled: float
    samples: Samples
    _answer: Answer = field(repr=False)
    _prior: pd.DataFrame | None = field(repr=False)

    def probability(self, points: Points) -> float | Float[np.ndarray, " n"]:
        """Return the probability of a failure at points.

        **Arguments:**
        - `points`: a dictionary of the features of one point, or a DataFrame of several.
        **Returns:** a number, or an array; NaN where no row is near (see `sampled`).
        **Raises:** `KeyError` for a feature that is missing.
        """
        frame = _frame(points, self.samples)
        said = np.where(self._near(frame), self._answer(_inputs(self.samples, frame)), np.nan)
        return said if isinstance(points, pd.DataFrame) else float(said[0])

    def sampled(self, points: Points) -> bool | Bool[np.ndarray, " n"]:
        """Return whether a row lies within reach of each point; without one nothing is known."""
        near = self._near(_frame(points, self.samples))
        return near if isinstance(points, pd.DataFrame) else bool(near[0])

    def next_points(self, count: int = 10) -> pd.DataFrame:
        """Return the points of the prior whose simulation would be most informative.

        Points without a near row come first, then those with an uncertain verdict; they are far
        from each other.

        **Arguments:**
        - `count`: number of points.
        **Returns:** their features, with `probability` and `sampled`.
        **Raises:** `ValueError` for rows whose space is not known.
        """
        check_count("count", count)
        if self._prior is None:
            raise ValueError("the space of the rows is unknown: use boundary(run), which knows it")
        frame = self._prior
        inputs = _inputs(self.samples, frame)
        near, said = self._near(frame), self._answer(inputs)
        worth = np.where(near, 4 * said * (1 - said), 1.0)
        chosen: list[int] = []
        apart = np.full(len(frame), np.inf)
        for _ in range(min(count, len(frame))):
            best = int(np.argmax(worth * np.minimum(apart, 1.0)))
            chosen.append(best)
            apart = np.minimum(apart, np.linalg.norm(inputs - inputs[best], axis=1) / self.reach)
        found = frame.iloc[chosen].reset_index(drop=True)
        return found.assign(probability=np.where(near, said, np.nan)[chosen], sampled=near[chosen])

    def _near(self, frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
        distance, _ = _tree(self.samples).query(_inputs(self.samples, frame))
        return np.asarray(distance) <= self.reach

    def __str__(self) -> str:
        lines = [
            f"the failing boundary of {self.samples.name}, from {len(self.samples):,} rows: Brier "
            f"score {self.brier:z.3g} on held-out rows, {self.base:z.3g} for a constant prediction"
        ]
        if self._prior is not None:
            lines.append(
                f"  mean over the prior {format_percent(self.share)}, which is not a bound; "
                f"{format_percent(self.unsampled)} of the prior was never sampled"
            )
        for low, high, rows, failed in self.calibration.to_numpy(float):
            count = f"{int(failed):,} of {int(rows):,}"
            lines.append(f"  predicted {low:z.1f} to {high:z.1f}: {count} failed")
        if self._prior is not None:
            best = self.next_points(1).iloc[0].to_dict()
            shown = {name: best[name] for name in self.samples.names}
            lines.append(f"  a simulation would say most at {format_features(shown)}")
        return "\n".join(lines)

    def _notebook_parts(self) -> Any:
        yield frame_html(self.calibration)


def boundary(source: Source, *, seed: int = 0) -> Boundary:
    """Learn the probability of a failure at any point from the rows of a table.

    It is calibrated on held-out rows, and is NaN where no row is near.

    **Arguments:**
    - `source`: a run, its table, a DataFrame, or `Samples`; rows with a verdict are used.
    - `seed`: the seed of the folds, and of the points of the prior.
    **Returns:** the `Boundary`.
    **Raises:** `ValueError` for fewer than ten failures, or ten safe rows.
    """
    samples = Samples.of(source, "all")
    failing = samples.failing
    if min(failing.sum(), (~failing).sum()) < MIN_ROWS:
        raise ValueError(
            f"a boundary needs {MIN_ROWS} failures and {MIN_ROWS} safe rows; {samples.name} has "
            f"{failing.sum():,} and {(~failing).sum():,}: simulate more, or search where it fails"
        )
    rng = np.random.default_rng(seed)
    x, rho = _inputs(samples, samples.frame), samples.rho
    rows = rng.permutation(len(x))[:MAX_ROWS]
    learned, verdicts = x[rows], failing[rows]
    # Far from zero a robustness says little more than its side.
    finite = np.abs(rho[np.isfinite(rho)])
    scale = float(np.median(finite)) if len(finite) and np.median(finite) > 0 else 1.0
    margin = np.where(
        np.isnan(rho), np.where(failing, -1.0, 1.0), FAR * np.tanh(rho / scale / FAR)
    )[rows]
    folds = rng.integers(0, FOLDS, len(rows))
    learners = (_by_polynomial, _by_odds, _by_trees, _Process())
    unseen = np.zeros((len(rows), len(learners)))
    for column, learn in enumerate(learners):
        for fold in range(FOLDS):
            out = folds == fold
            answer = learn(learned[~out], margin[~out], verdicts[~out], seed)
            unseen[out, column] = answer(learned[out])
    curve = _logistic(unseen, verdicts)
    whole = [learn(learned, margin, verdicts, seed) for learn in learners]
    said = curve(unseen)
    rate = float(verdicts.mean())
    distance, _ = _tree(samples).query(x, k=2)
    found = Boundary(
        float(np.mean((said - verdicts) ** 2)), rate * (1 - rate), _tenths(said, verdicts),
        max(float(np.quantile(distance[:, 1], NEAR)), 1e-12), float("nan"), float("nan"), samples,
        lambda inputs: curve(np.stack([each(inputs) for each in whole], axis=1)), None,
    )  # fmt: skip
    if samples.space is None:
        return found
    key = jax.random.key(seed, impl="threefry2x32")
    prior = pd.DataFrame(samples.space.rows(samples.space.sample(key, PRIOR)))
    return replace(
        found, share=float(np.mean(found._answer(_inputs(samples, prior)))),
        unsampled=float(np.mean(~found._near(prior))), _prior=prior,
    )  # fmt: skip


def _frame(points: Points, samples: Samples) -> pd.DataFrame:
    frame = points if isinstance(points, pd.DataFrame) else pd.DataFrame([dict(points)])
    found: Any = frame[list(samples.names)]
    return found


def _inputs(samples: Samples, frame: pd.DataFrame) -> Matrix:
    """Return rows as `Samples.points` does."""
    coordinates, codes = samples.embed("range", frame)
    parts = [coordinates]
    for column, code in zip(samples.unordered, codes.T, strict=True):
        parts.append((np.eye(len(column.choices) + 1) / np.sqrt(2))[code])
    return np.concatenate(parts, axis=1)


def _tree(samples: Samples) -> Any:
    from scipy.spatial import KDTree

    return KDTree(_inputs(samples, samples.frame))


def _tenths(said: Margin, failing: Failing) -> pd.DataFrame:
    cells = np.minimum((said * 10).astype(int), 9)
    rows = [
        (k / 10, (k + 1) / 10, int((cells == k).sum()), int(failing[cells == k].sum()))
        for k in range(10)
        if (cells == k).any()
    ]
    return pd.DataFrame(rows, columns=["low", "high", "rows", "failed"])


def _logistic(scores: Matrix, failing: Failing) -> Answer:
    """Fit the logistic curve that turns scores into probabilities."""
    from sklearn.linear_model import LogisticRegression

    scale = np.maximum(scores.std(axis=0), 1e-12)
    curve = LogisticRegression(C=1e3, max_iter=5000).fit(scores / scale, failing)
    return lambda each: curve.predict_proba(each / scale)[:, 1]


def _by_polynomial(x: Matrix, margin: Margin, failing: Failing, seed: int) -> Answer:
    """Learn the robustness by a polynomial of degree three, of degree two in many dimensions."""
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    degree = 3 if x.shape[1] <= 8 else 2
    model = make_pipeline(
        StandardScaler(), PolynomialFeatures(degree), StandardScaler(),
        RidgeCV(np.logspace(-4, 3, 8)),
    ).fit(x, margin)  # fmt: skip
    return lambda each: -model.predict(each)


def _by_odds(x: Matrix, margin: Margin, failing: Failing, seed: int) -> Answer:
    """Learn the odds of a failure by a polynomial of degree two."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    if failing.all() or not failing.any():
        return lambda each: np.zeros(len(each))
    model = make_pipeline(
        StandardScaler(), PolynomialFeatures(2), StandardScaler(),
        LogisticRegression(C=1.0, max_iter=2000),
    ).fit(x, failing)  # fmt: skip
    return model.decision_function


def _by_trees(x: Matrix, margin: Margin, failing: Failing, seed: int) -> Answer:
    """Learn the robustness by boosted trees."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    model = HistGradientBoostingRegressor(max_iter=200, random_state=seed).fit(x, margin)
    return lambda each: -model.predict(each)


class _Process:
    """A Gaussian process of the robustness; its length scales are learned once, for all folds."""

    kernel: Any = None

    def __call__(self, x: Matrix, margin: Margin, failing: Failing, seed: int) -> Answer:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import Matern, WhiteKernel

        process: Any = GaussianProcessRegressor
        order = np.random.default_rng(seed).permutation(len(x))
        width = np.maximum(x.std(axis=0), 1e-12)
        if self.kernel is None:
            lengths: Any = np.full(x.shape[1], 3.0)
            kernel = Matern(lengths, (0.1, 1e3), nu=2.5) + WhiteKernel(1e-2, (1e-6, 1.0))
            model = process(kernel, normalize_y=True, random_state=seed)
            rows = order[:MAX_LENGTHS]
            with warnings.catch_warnings():
                # A length at its bound is a feature of no influence.
                warnings.simplefilter("ignore", ConvergenceWarning)
                self.kernel = model.fit(x[rows] / width, margin[rows]).kernel_
        rows = order[:MAX_PROCESS]
        model = process(self.kernel, optimizer=None, normalize_y=True)
        model.fit(x[rows] / width, margin[rows])

        def score(each: Matrix) -> Float[np.ndarray, " n"]:
            mean, deviation = model.predict(each / width, return_std=True)
            return -mean / np.maximum(deviation, 1e-6)

        return score
