"""The table of a run as data for a page or a notebook: thinned rows, and traces.

data = view_data(run, traces)                       # plain data for `view.js`
trace_data(run.replay(17))                          # one trace of it
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Int

from verifai_jax.core.messages.text import one_line
from verifai_jax.evaluation.replay import Replay
from verifai_jax.falsification.counts import standing, violating_rows
from verifai_jax.falsification.run import Run
from verifai_jax.mtl.bounds import signal_bounds
from verifai_jax.mtl.expression import constant_value
from verifai_jax.pictures.replay import decisive_instant
from verifai_jax.pictures.scatter import distinguishing_features
from verifai_jax.pictures.style import FAILING, NOT_CLAIMED, SAFE, WITHOUT_VERDICT

GROUPS = (
    ("safe", SAFE, 4000),
    ("without a verdict", WITHOUT_VERDICT, 500),
    ("not claimed", NOT_CLAIMED, 500),
    ("claimed", FAILING, 2000),
)
"""Verdicts from the least grave on: name, colour, and rows shown at most."""
MAX_ROWS = 4000
"""Rows shown at most."""
MAX_CELLS = 160_000
"""Values shown at most; of a wide table there are fewer rows and columns."""
MAX_COLUMNS = 40
"""Features shown at most, those that distinguish failing from safe rows first."""
MAX_PARALLEL = 12
"""Axes of the parallel coordinates at most."""
MAX_CHOICES = 60
"""Different texts of a feature up to which it is shown."""
MAX_SAMPLES = 160
"""Samples of a trace at most."""
MAX_SIGNALS = 4
"""Signals of a trace at most."""
MAX_COMPONENTS = 6
"""Components of a signal that is a vector, at most."""


def view_data(
    run: Run, traces: Mapping[int, Mapping[str, Any]], command: str | None = None
) -> dict[str, Any]:
    """Describe the table of a run with rows for `view.js`, those with `traces` among them.

    The number of a row is appended to `command`, which simulates it again.
    """
    table = run.table.all
    columns = {str(name): table[name].to_numpy() for name in table.columns}
    group = np.zeros(len(table), int)
    group[columns["status"] != "ok"] = 1
    group[violating_rows(columns)] = 2
    group[standing(columns).claimed] = 3
    features = [*distinguishing_features(run)[:MAX_COLUMNS]]
    features += [name for name in run.table.features if name not in features]
    features = features[:MAX_COLUMNS]
    maximum = max(200, min(MAX_ROWS, MAX_CELLS // (len(features) + 1)))
    numbers = table.index.to_numpy()
    indices = _thinned(group, maximum, np.flatnonzero(np.isin(numbers, list(traces))))
    shown = table.iloc[indices]
    described = [_column("robustness", shown["rho"])]
    described += [_column(name, shown[name]) for name in features]
    described = [column for column in described if column is not None]
    names = [column["name"] for column in described]
    wanted = [names.index(name) for name in features if name in names]
    axes = [*wanted, 0, 0][:2]
    groups = [
        {"name": name, "color": color, "count": f"{np.sum(group == i):,}"}
        for i, (name, color, _) in enumerate(GROUPS)
    ]
    return {
        "columns": described,
        "rows": numbers[indices].tolist(),
        "group": group[indices].tolist(),
        "groups": groups,
        "axes": axes,
        "parallel": [*wanted[: MAX_PARALLEL - 1], 0],
        "traces": {str(number): dict(trace) for number, trace in traces.items()},
        "replay": "This command simulates it again:" if command else "",
        "command": command,
        "shown": len(indices),
        "simulations": run.simulations,
    }


def _thinned(
    group: Int[np.ndarray, " n"], maximum: int, kept: Int[np.ndarray, " k"]
) -> Int[np.ndarray, " shown"]:
    """Return indices of rows, evenly spread over each verdict, the graver ones first."""
    chosen, left = [kept], maximum - len(kept)
    for verdict in reversed(range(len(GROUPS))):
        indices = np.flatnonzero(group == verdict)
        count = min(len(indices), left, GROUPS[verdict][2] * maximum // MAX_ROWS)
        if count:
            spread = np.linspace(0, len(indices) - 1, count).astype(int)
            chosen.append(indices[np.unique(spread)])
            left -= count
    return np.unique(np.concatenate(chosen))


def _column(name: str, values: "pd.Series") -> dict[str, Any] | None:
    """Describe a column: numbers with six digits, texts as indices in their list."""
    array = values.to_numpy()
    if np.issubdtype(array.dtype, np.number):
        return {"name": name, "values": numbers_of(array)}
    texts = [None if pd.isna(value) else one_line(str(value), 80) for value in array]
    levels = sorted({text for text in texts if text is not None})
    if not levels or len(levels) > MAX_CHOICES:
        return None
    codes = {text: i for i, text in enumerate(levels)}
    return {
        "name": name,
        "levels": levels,
        "values": [None if text is None else codes[text] for text in texts],
    }


def numbers_of(values: Any) -> list[float | int | None]:
    """Return numbers with six digits; None if not finite."""
    return [_number(value) for value in np.asarray(values).tolist()]


def _number(value: float) -> float | int | None:
    if not math.isfinite(value):
        return None
    rounded = float(f"{value:z.6g}")
    return int(rounded) if rounded.is_integer() and abs(rounded) < 1e6 else rounded


def trace_data(replay: Replay, label: str = "") -> dict[str, Any]:
    """Describe the trace of a replay: the signals of its formulas, their bounds, the instant."""
    trace, problem = replay.trace, replay.problem
    clock = np.asarray(trace.clock())
    samples = np.unique(np.linspace(0, len(clock) - 1, MAX_SAMPLES).astype(int))
    monitored = [name for name in problem.monitored if name in trace.signals]
    others = [name for name in trace.signals if name not in monitored]
    signals = []
    for name in [*monitored, *others][:MAX_SIGNALS]:
        values = np.asarray(trace.signals[name], float).reshape(len(clock), -1)
        bounds = [
            limit
            for formula in problem.formulas.values()
            for _, limits in signal_bounds(formula, name)
            for limit in map(constant_value, limits)
            if limit is not None
        ]
        shown = [numbers_of(each) for each in values[samples].T[:MAX_COMPONENTS]]
        bounds = numbers_of(list(dict.fromkeys(bounds)))
        signals.append({"name": one_line(name), "values": shown, "bounds": bounds})
    decisive = decisive_instant(problem.formulas[replay.worst], trace, problem.end)
    verdict = "violates" if replay.violated else "keeps"
    words = f"Row {replay.row} {verdict} the property, robustness {replay.rho[replay.worst]:z.4g}."
    if replay.status != 0:
        words, decisive = f"Row {replay.row} has no verdict: {replay.status.name.lower()}.", None
    return {
        "label": label or f"row {replay.row}",
        "text": words,
        "time": numbers_of(clock[samples]),
        "signals": signals,
        "instant": None if decisive is None else _number(float(clock[decisive[1]])),
    }


def rows_to_trace(run: Run, maximum: int, first: Sequence[int] = ()) -> dict[int, str]:
    """Choose the most important rows, after the `first`, each with a word of explanation.

    These are the worst claimed rows, those nearest to the bound on both sides, and unclaimed ones.
    """
    chosen = {int(number): f"row {number}: shown above" for number in first[:maximum]}
    table = run.table
    share = max(maximum // 4, 1)
    for words, rows in (
        ("failing, among the worst", table.counterexamples.sort_values("rho")),
        ("failing, near the bound", table.counterexamples.sort_values("rho", ascending=False)),
        ("not claimed", table.unconfirmed.sort_values("rho")),
        ("safe, near the bound", table.safe.sort_values("rho")),
        ("safe, far from the bound", table.safe.sort_values("rho", ascending=False)),
    ):
        new = [int(number) for number in rows.index if int(number) not in chosen][:share]
        for number in new[: max(maximum - len(chosen), 0)]:
            chosen[number] = f"row {number}: {words}"
    return chosen
