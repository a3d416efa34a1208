"""A question to a source of suggested points: the problem and the rows so far, as plain data.

    question = describe_run(problem, frame, search)
    json.dumps(question)                                # numbers, texts, lists and dictionaries

It contains no time of day, so a function of the question alone gives a reproducible table.
"""

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Array, Key

from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.replay import Replay, replay
from verifai_jax.features import Domain
from verifai_jax.features.plain import to_plain
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Suggested

if TYPE_CHECKING:
    import pandas as pd
SAMPLES = 16
"""Samples of a signal that are shown, evenly spaced, the first and the last among them: a question
has to stay short for whoever reads it."""
SIGNALS = 8
"""Maximum number of signals shown, those of formulas first, for the same reason."""


def describe_run(
    problem: Problem,
    frame: "pd.DataFrame",
    search: Suggested,
    key: Key[Array, ""],
    precision: str,
    refused: tuple[str, ...],
) -> dict[str, Any]:
    """Return the question that is asked after these rows.

    **Arguments:**
    - `problem`: the problem that is falsified.
    - `frame`: the table so far.
    - `search`: the search that asks.
    - `key`: the key of simulations, for the traces of the worst rows.
    - `precision`: the precision of simulations.
    - `refused`: the reasons why earlier suggestions were refused.
    **Returns:** a dictionary of plain data:
    - `problem`, `description`, `context`: texts.
    - `formulas`: texts by name; the system should satisfy all of them, and breaking one is a
      failure.
    - `features`: a dictionary for each feature, with `name`, `kind`, `unit` if it has one, and the
      entries of its domain (`low`, `high`, `choices`, `knots`, ...); `columns` lists its columns in
      the rows.
    - `constraint`: the constraint of the features, its text or name; None without one.
    - `nominal`: the nominal features; None without any.
    - `wanted`: requested number of suggestions.
    - `simulations`, `counterexamples`, `least_robustness`: the run so far.
    - `rows`: the last rows of the table, without those that are among the worst: features,
      robustness (`rho`, and `rho.NAME` of each of several formulas), `status`.
    - `worst`: the rows with the least robustness, the worst first. They also have `explanation`, a
      text; `critical`, the deciding predicate with its time in seconds, robustness and share; and
      `trace`: signals by name, with `times` and `values`, `least` and `greatest`.
    - `refused`: the reasons why suggestions were refused, one text each.
    """
    proper = frame.loc[frame["status"] == "ok"]
    worst = proper.nsmallest(search.worst, "rho") if len(proper) else proper
    others = frame.drop(index=worst.index).tail(search.rows) if search.rows else frame.head(0)
    failing = frame["violated"] if "violated" in frame else np.zeros(0, bool)
    question = {
        "problem": problem.name,
        "description": problem.description,
        "context": search.context,
        "formulas": {name: str(formula) for name, formula in problem.formulas.items()},
        "features": [
            _feature(name, domain, search.units.get(name))
            for name, domain in problem.space.domains.items()
        ],
        "constraint": _constraint(problem),
        "nominal": None if problem.nominal is None else dict(problem.nominal),
        "wanted": search.points,
        "simulations": len(frame),
        "counterexamples": int(np.sum(failing)),
        "least_robustness": float(proper["rho"].min()) if len(proper) else None,
        "rows": [_row(problem, frame, number) for number in others.index],
        "worst": [
            _row(problem, frame, number)
            | _trace(lambda n=number: replay(problem, frame.loc[n], key, int(n), precision))
            for number in worst.index
        ],
        "refused": list(refused),
    }
    return plain(question)


def _feature(name: str, domain: Domain, unit: str | None) -> dict[str, Any]:
    try:
        data = dict(to_plain(domain))
    except ValueError:
        data = {"kind": type(domain).__name__}
    described: dict[str, Any] = {"name": name, **data, "text": repr(domain)}
    if unit is not None:
        described["unit"] = unit
    return described | {"columns": list(domain.columns(name))}


def _constraint(problem: Problem) -> str | None:
    if problem.space.where is None:
        return None
    try:
        return str(problem.space.to_json()["where"])
    except ValueError:
        return "there is one"


def _row(problem: Problem, frame: "pd.DataFrame", number: Any) -> dict[str, Any]:
    own = [name for name in frame.columns if name == "rho" or name.startswith("rho.")]
    names = [*problem.space.columns, *own, "violated", "status"]
    names += [name for name in ("suggested", "message") if name in frame]
    return {"row": int(number)} | {name: frame.at[number, name] for name in names}


def _trace(simulated: Callable[[], Replay]) -> dict[str, Any]:
    """Return the trace of a simulation as plain data; empty if it has none."""
    try:
        seen = simulated()
        if seen.status != Status.OK:
            return {}
        why = seen.explain()
    except Exception as error:  # A row is worth more than its picture.
        return {"explanation": f"its trace cannot be shown: {one_line(format_error(error), 120)}"}
    critical = [
        {
            "predicate": str(instant.predicate),
            "time": instant.time,
            "robustness": instant.robustness,
            "share": instant.share,
        }
        for instant in why.critical
    ]
    return {
        "explanation": f"{seen.worst}: {str(why).splitlines()[0]}",
        "critical": critical,
        "trace": _signals(seen),
    }


def _signals(seen: Replay) -> dict[str, Any]:
    names = [*seen.problem.monitored, *seen.trace.signals]
    clock = np.asarray(seen.trace.clock(), np.float64)
    shown: dict[str, Any] = {}
    for name in dict.fromkeys(names):
        values = np.asarray(seen.trace.signals[name], np.float64)
        if values.ndim != 1 or len(shown) == SIGNALS:
            continue
        indices = np.unique(np.linspace(0, len(values) - 1, SAMPLES).round().astype(int))
        shown[name] = {
            "times": clock[indices],
            "values": values[indices],
            "least": np.min(values),
            "greatest": np.max(values),
        }
    return shown


def plain(value: Any) -> Any:
    """Convert to JSON types; numbers have six digits, and are None if not finite."""
    if isinstance(value, Mapping):
        return {str(name): plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, np.ndarray | jax.Array | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:z.6g}") if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
