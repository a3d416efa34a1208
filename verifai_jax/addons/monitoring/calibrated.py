"""Monitors that learn from runs, with a bound on the probability of a false alarm.

    ahead = predictive_monitor("always gap > 2", traces, horizon=1.0)    # of simulations
    step = ahead.start()
    step({"gap": 4.0, "speed": 9.0})      # Forecast(robustness, low, p_value, alarm)

    known = domain_monitor(traces)        # is this input unlike all that was tested?
    known.start()({"gap": 4.0, "speed": 9.0})

Half of the runs train the model, the other half calibrate it. The guarantees hold for a further run
of the same distribution (independent samples of one feature space, not the rows of a search that
learns), for all its samples at once. Their probability is over the calibration runs and the further
run.

Source: L. Lindemann et al., "Conformal prediction for STL runtime verification", ICCPS 2023.
"""

import abc
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.monitoring.conformal import conformal_p_value, conformal_threshold
from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.formula import Formula, Interval
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.statistics.binomial import Rate, clopper_pearson

Said = TypeVar("Said")
Rows = Float[np.ndarray, "time columns"]
TAUGHT = 20_000
"""Samples that a model learns from at most: quadratic models gain nothing from more."""


class Model(Protocol):
    """A regressor that learns and predicts, with the interface of scikit-learn."""

    def fit(self, x: np.ndarray, y: np.ndarray) -> object:
        """Learn from rows `[n, d]` and values `[n]`."""
        ...

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return the values of rows."""
        ...


class Forecast(NamedTuple):
    """A prediction at one sample.

    - `robustness`: the least robustness expected within the horizon.
    - `low`: a lower bound on it; with probability `1 - alpha` it holds at every sample of the run.
    - `p_value`: share of the runs without violation in which some prediction was as low or lower.
    - `alarm`: whether the p-value is at most `alpha`. In a further run without violation an alarm
      is raised with probability at most `alpha`.
    """

    robustness: float
    low: float
    p_value: float
    alarm: bool


class Distance(NamedTuple):
    """A sample compared with the tested ones.

    - `distance`: distance from the nearest tested sample, in standard deviations of the signals.
    - `p_value`: share of the tested runs with a sample as far from the other runs.
    - `alarm`: whether the p-value is at most `alpha`. In a further run like the tested ones an
      alarm is raised with probability at most `alpha`.
    """

    distance: float
    p_value: float
    alarm: bool


class _Follows(abc.ABC, Generic[Said]):
    """A monitor that judges rows of numbers, and so runs and their samples."""

    _columns: "_Columns"

    @abc.abstractmethod
    def _said(self, rows: Rows) -> list[Said]: ...
    def start(self) -> Callable[[Mapping[str, Any]], Said]:
        """Return what takes one sample of a run after another, and says something of each."""
        return self._columns.follow(lambda row: self._said(row)[0])


@dataclass(frozen=True)
class PredictiveMonitor(_Follows[Forecast]):
    """A monitor that predicts violations; made by `predictive_monitor`.

    - `horizon`: prediction horizon in seconds.
    - `slack`: the amount by which predictions are too high in at most a share `alpha` of runs.
    - `caught`: of the calibration runs that violated the formula, the rate of those with an earlier
      alarm; None if no run did.
    """

    formula: Formula
    horizon: float
    alpha: float
    slack: float
    caught: Rate | None
    _columns: "_Columns"
    _model: Model
    _lowest: np.ndarray

    def forecasts(self, trace: Trace) -> list[Forecast]:
        """Return a forecast at every sample of a run."""
        return self._said(self._columns.rows(trace))

    def _said(self, rows: Rows) -> list[Forecast]:
        predicted = self._model.predict(rows)
        p_values = conformal_p_value(-self._lowest, -predicted)
        return [
            Forecast(float(y), float(y) - self.slack, float(p), bool(p <= self.alpha))
            for y, p in zip(predicted, p_values, strict=True)
        ]


def predictive_monitor(
    formula: Formula | str,
    traces: Sequence[Trace],
    horizon: float,
    *,
    signals: Sequence[str] | None = None,
    alpha: float = 0.05,
    lags: Sequence[int] = (0, 1, 4),
    model: Model | None = None,
    seed: int = 0,
) -> PredictiveMonitor:
    """Learn to predict a violation of a requirement within the next seconds.

    **Arguments:**
    - `formula`: a requirement; for `always f` the robustness of `f` at each instant is predicted.
    - `traces`: runs of one system with the same sampling period.
    - `horizon`: prediction horizon in seconds, a multiple of the sampling period.
    - `signals`: names of the signals used for prediction; all if None.
    - `alpha`: probability of a false alarm in a run, and of a lower bound that is too high.
    - `lags`: how many samples ago the signals are used as well.
    - `model`: a regressor with the interface of scikit-learn; a quadratic function if None.
    - `seed`: the seed of the division into training and calibration runs.
    **Raises:** `ValueError` for too few runs without violation; `IntervalError` for a horizon that
    is not a multiple of the sampling period.
    """
    formula = parse(formula) if isinstance(formula, str) else formula
    within = formula.operand if isinstance(formula, ast.Always) else formula
    columns, rows, (teach, calibrate) = _learning(traces, signals, lags, seed)
    ahead = ast.Always(within, Interval(0.0, horizon))
    values = [HostValues.of(trace) for trace in traces]
    margins, worst = ([np.broadcast_to(v(f), v.length) for v in values] for f in (within, ahead))
    x, y = (np.concatenate([each[k] for k in teach]) for each in (rows, worst))
    if not np.isfinite(y).all():
        raise ValueError(f"the robustness of {within} is infinite or NaN, and cannot be predicted")
    kept = np.random.default_rng(seed).permutation(len(x))[:TAUGHT]
    taught: Model = model or _quadratic()
    taught.fit(x[kept], y[kept])
    predicted = {int(k): taught.predict(rows[k]) for k in calibrate}
    slack = conformal_threshold([np.max(p - worst[k]) for k, p in predicted.items()], alpha)
    safe = [k for k in predicted if np.min(margins[k]) >= 0]
    lowest = np.sort([np.min(predicted[k]) for k in safe])
    conformal_threshold(lowest, alpha)  # Refuses too few runs without violation.
    caught: list[bool] = []
    for k in predicted.keys() - safe:
        before = predicted[k][: np.argmax(margins[k] < 0) + 1]
        caught.append(bool(np.any(conformal_p_value(-lowest, -before) <= alpha)))
    rate = clopper_pearson(sum(caught), len(caught)) if caught else None
    return PredictiveMonitor(formula, horizon, alpha, slack, rate, columns, taught, lowest)


def _quadratic() -> Any:
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    return make_pipeline(StandardScaler(), PolynomialFeatures(2), Ridge(1e-3))


@dataclass(frozen=True)
class DomainMonitor(_Follows[Distance]):
    """A monitor that recognises inputs unlike all tested ones; made by `domain_monitor`.

    - `reach`: distance beyond which it raises an alarm.
    """

    alpha: float
    reach: float
    _columns: "_Columns"
    _tree: Any
    _mean: np.ndarray
    _scale: np.ndarray
    _farthest: np.ndarray

    def distances(self, trace: Trace) -> list[Distance]:
        """Return the distance from the tested samples at every sample of a run."""
        return self._said(self._columns.rows(trace))

    def _said(self, rows: Rows) -> list[Distance]:
        far = np.asarray(self._tree.query((rows - self._mean) / self._scale)[0])
        p_values = conformal_p_value(self._farthest, far)
        return [
            Distance(float(d), float(p), bool(p <= self.alpha))
            for d, p in zip(far, p_values, strict=True)
        ]


def domain_monitor(
    traces: Sequence[Trace], *, signals: Sequence[str] | None = None, alpha: float = 0.05,
    lags: Sequence[int] = (0,), seed: int = 0,
) -> DomainMonitor:  # fmt: skip
    """Learn which samples were tested, to recognise later ones that are unlike them.

    **Arguments:**
    - `traces`: the tested runs; for inputs without time, traces of one sample.
    - `signals`: names of the compared signals; all if None.
    - `alpha`: probability of an alarm in a run like the tested ones.
    - `lags`: how many samples ago the signals are compared as well.
    - `seed`: the seed of the division into reference and calibration runs.
    **Raises:** `ValueError` for too few runs, and for a NaN.
    """
    from scipy.spatial import KDTree

    columns, rows, (teach, calibrate) = _learning(traces, signals, lags, seed)
    known = np.concatenate([rows[k] for k in teach])
    mean, scale = known.mean(axis=0), known.std(axis=0)
    scale[scale == 0] = 1.0
    tree = KDTree((known - mean) / scale)
    farthest = np.sort([np.max(tree.query((rows[k] - mean) / scale)[0]) for k in calibrate])
    reach = conformal_threshold(farthest, alpha)
    return DomainMonitor(alpha, reach, columns, tree, mean, scale, farthest)


def _learning(
    traces: Sequence[Trace], signals: Sequence[str] | None, lags: Sequence[int], seed: int
) -> tuple["_Columns", list[Rows], list[np.ndarray]]:
    """Return the columns, their rows in each run, and the runs that teach and that calibrate."""
    if len(traces) < 2:
        raise ValueError(
            f"two runs or more are needed, to teach and to calibrate; got {len(traces)}"
        )
    columns = _Columns(tuple(signals or traces[0].signals), tuple(lags))
    rows = [columns.rows(trace) for trace in traces]
    order = np.random.default_rng(seed).permutation(len(rows))
    return columns, rows, np.split(order, [len(rows) // 2])


@dataclass(frozen=True)
class _Columns:
    """The numbers of a sample and of earlier ones; before the first sample it stands for them."""

    signals: tuple[str, ...]
    lags: tuple[int, ...]

    def rows(self, trace: Trace) -> Rows:
        values = HostValues.of(trace).signals
        for name in self.signals:
            if name not in values:
                raise missing_name("the trace", "signal", name, values)
        now = np.column_stack([values[name] for name in self.signals])
        if np.isnan(now).any():
            raise ValueError("a signal is NaN; leave out the runs with gaps")
        ago = [now[np.maximum(np.arange(len(now)) - lag, 0)] for lag in self.lags]
        return np.concatenate(ago, axis=1)

    def follow(self, result: Callable[[Rows], Any]) -> Callable[[Mapping[str, Any]], Any]:
        last: deque[np.ndarray] = deque(maxlen=max(self.lags) + 1)

        def step(sample: Mapping[str, Any]) -> Any:
            for name in self.signals:
                if name not in sample:
                    raise missing_name("the sample", "signal", name, sample)
            one = Trace({name: np.asarray(sample[name])[None] for name in self.signals}, dt=1.0)
            last.appendleft(_Columns(self.signals, (0,)).rows(one)[0])
            ago = [last[min(lag, len(last) - 1)] for lag in self.lags]
            return result(np.concatenate(ago)[None])

        return step
