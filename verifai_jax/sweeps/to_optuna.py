"""A sweep as an Optuna study, for Optuna's plots and its dashboard. Needs the extra `optuna`."""

from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.core.errors import require
from verifai_jax.features import Box, Categorical, Constant, DiscreteBox, LogUniform
from verifai_jax.features.domain import Domain

if TYPE_CHECKING:
    from verifai_jax.sweeps.result import Sweep

METRICS = ("upper end of the failure probability", "nominal return")
DIRECTIONS = ("minimize", "maximize")
_ABOUT = (
    "verdict",
    "seeds",
    "seeds_safe",
    "steps",
    "failure_rate",
    "failure_rate_worst",
    "training_seconds",
    "status",
    "best_row",
    "best_steps",
    "best_verdict",
)
"""What each trial says of its configuration, as attributes."""


def to_optuna(sweep: "Sweep", storage: Any = None, name: str | None = None) -> Any:
    """An Optuna study with one trial a configuration; see `Sweep.to_optuna`.

    A configuration without a certificate is a failed trial, one that halving stopped before the
    end a pruned one. What a domain of ours cannot say in Optuna's, it says by the range of the
    values that were tried.
    """
    optuna = require("optuna", "optuna")
    loudness = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        made = optuna.create_study(
            study_name=sweep.name if name is None else name,
            storage=storage,
            directions=list(DIRECTIONS),
        )
    finally:
        optuna.logging.set_verbosity(loudness)
    made.set_user_attr("metrics", list(METRICS))
    groups: Any = sweep.configurations
    names = [n for n in sweep.hyperparameters if n in groups]
    domains = {} if sweep.space is None else sweep.space.domains
    known = {n: distribution(optuna, domains.get(n), groups[n]) for n in names}
    distributions = {n: found for n, found in known.items() if found is not None}
    for i, row in groups.iterrows():
        algorithm = row.get("algorithm")
        own = {n: d for n, d in distributions.items() if sweep.applies(n, algorithm)}
        made.add_trial(_trial(optuna, int(i), row, own))
    return made


def distribution(optuna: Any, domain: Domain | None, values: Any) -> Any:
    """Optuna's distribution for a domain of ours; None for what does not vary.

    - `values`: that were tried, of which the range is taken where Optuna has no such domain.
    """
    import pandas as pd

    match domain:
        case Constant():
            return None
        case LogUniform(low, high):
            return optuna.distributions.FloatDistribution(float(low), float(high), log=True)
        case DiscreteBox(int(low), int(high)):
            return optuna.distributions.IntDistribution(low, high)
        case Categorical():
            plain = [
                c if isinstance(c, bool | int | float | str) else str(c) for c in domain.choices
            ]
            return optuna.distributions.CategoricalDistribution(plain)
        case Box(low, high) if domain.size == 1:
            ends = float(np.ravel(low)[0]), float(np.ravel(high)[0])
            return optuna.distributions.FloatDistribution(*ends)
    present = values.dropna()
    if not len(present):
        return None
    if pd.api.types.is_bool_dtype(present) or not pd.api.types.is_numeric_dtype(present):
        return optuna.distributions.CategoricalDistribution(sorted(set(present.tolist())))
    low, high = present.min(), present.max()
    if pd.api.types.is_integer_dtype(present):
        return optuna.distributions.IntDistribution(int(low), int(high))
    return optuna.distributions.FloatDistribution(float(low), float(high))


def _trial(optuna: Any, number: int, row: Any, distributions: dict[str, Any]) -> Any:
    values = [float(row["failure_high"]), float(row["nominal_return"])]
    state = optuna.trial.TrialState.COMPLETE
    if not np.isfinite(values).all():
        state = optuna.trial.TrialState.FAIL
    elif "stopped" in str(row["status"]):
        state = optuna.trial.TrialState.PRUNED
    complete = state == optuna.trial.TrialState.COMPLETE
    about = {name: _plain(row[name]) for name in _ABOUT if name in row}
    parameters = {n: _inside(_plain(row[n]), d) for n, d in distributions.items()}
    parameters = {n: v for n, v in parameters.items() if v == v}
    return optuna.trial.create_trial(
        state=state,
        values=values if complete else None,
        params=parameters,
        distributions={n: d for n, d in distributions.items() if n in parameters},
        user_attrs={"configuration": number, **about},
    )


def _inside(value: Any, distribution: Any) -> Any:
    """The value as the distribution has it: float32 may lie beyond the end of a range."""
    low, high = getattr(distribution, "low", None), getattr(distribution, "high", None)
    if low is None or high is None:
        choices = getattr(distribution, "choices", ())
        return next(
            (choice for choice in choices if choice == value or str(choice) == value), value
        )
    if value != value:
        return value
    kind = int if isinstance(low, int) else float
    return kind(min(max(value, low), high))


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
