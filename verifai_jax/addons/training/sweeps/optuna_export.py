"""A sweep as an Optuna study, for Optuna's plots and its dashboard. Needs the extra `optuna`."""

from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.addons.training.sweeps.optuna_distributions import optuna_distribution, quiet_study
from verifai_jax.addons.training.sweeps.record import STOPPED, algorithm_uses
from verifai_jax.core.messages.errors import require
from verifai_jax.features import FeatureSpace
from verifai_jax.features.domain import Domain, as_scalar

if TYPE_CHECKING:
    import optuna
    import pandas as pd
    from optuna.distributions import BaseDistribution
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial
METRICS = ("upper end of the failure probability", "nominal return")
"""Names of a trial's values."""
DIRECTIONS = ("minimize", "maximize")
"""Optuna's directions of a trial's values."""
_ATTRIBUTES = (
    "verdict", "seeds", "seeds_safe", "steps", "failure_rate", "failure_rate_worst",
    "training_seconds", "status", "best_row", "best_steps", "best_verdict",
)  # fmt: skip
"""Columns that become user attributes of a trial."""


def export_to_optuna(
    configurations: "pd.DataFrame", hyperparameters: Sequence[str], space: FeatureSpace | None,
    used: Mapping[str, Sequence[str]], *, name: str, storage: "str | BaseStorage | None" = None,
) -> "optuna.Study":  # fmt: skip
    """Make an Optuna study with one trial for each configuration; see `Sweep.to_optuna`.

    A configuration without a certificate becomes a failed trial, one stopped by halving a pruned
    one. A domain that Optuna lacks becomes the range of the tried values.
    """
    optuna = require("optuna", "optuna")
    study = quiet_study(study_name=name, storage=storage, directions=list(DIRECTIONS))
    study.set_user_attr("metrics", list(METRICS))
    domains = {} if space is None else space.domains
    distributions: dict[str, BaseDistribution] = {}
    for column in hyperparameters:
        if column in configurations:
            values: Any = configurations[column]
            distribution = _distribution(optuna, domains.get(column), values)
            if distribution is not None:
                distributions[column] = distribution
    rows: Any = configurations.to_dict("records")
    for number, row in zip(configurations.index.tolist(), rows, strict=True):
        algorithm = row.get("algorithm")
        own = {n: d for n, d in distributions.items() if algorithm_uses(used, algorithm, n)}
        study.add_trial(_trial(optuna, number, row, own))
    return study


def _distribution(
    optuna: ModuleType, domain: Domain | None, values: "pd.Series"
) -> "BaseDistribution | None":
    """Return the distribution of a hyper-parameter; None for one that does not vary."""
    import pandas as pd

    if domain is not None and not domain.columns(""):
        return None
    if (distribution := optuna_distribution(domain)) is not None:
        return distribution
    present = values.dropna()
    if not len(present):
        return None
    if pd.api.types.is_bool_dtype(present) or not pd.api.types.is_numeric_dtype(present):
        return optuna.distributions.CategoricalDistribution(sorted(set(present.tolist())))
    low, high = present.min(), present.max()
    if pd.api.types.is_integer_dtype(present):
        return optuna.distributions.IntDistribution(int(low), int(high))
    return optuna.distributions.FloatDistribution(float(low), float(high))


def _trial(
    optuna: ModuleType, number: int, row: Mapping[str, Any],
    distributions: "Mapping[str, BaseDistribution]",
) -> "FrozenTrial":  # fmt: skip
    values, state = [float(row["failure_high"]), float(row["nominal_return"])], state_of(row)
    attributes = {name: as_scalar(row[name]) for name in _ATTRIBUTES if name in row}
    parameters = {n: _clamp(as_scalar(row[n]), d) for n, d in distributions.items()}
    parameters = {n: v for n, v in parameters.items() if v == v}
    return optuna.trial.create_trial(
        state=optuna.trial.TrialState[state], params=parameters,
        values=values if state == "COMPLETE" else None,
        distributions={n: d for n, d in distributions.items() if n in parameters},
        user_attrs={"configuration": number, **attributes},
    )  # fmt: skip


def state_of(row: Mapping[str, Any]) -> str:
    """Return the name of Optuna's state for a configuration."""
    if not np.isfinite([row["failure_high"], row["nominal_return"]]).all():
        return "FAIL"
    return "PRUNED" if STOPPED in str(row["status"]).split(", ") else "COMPLETE"


def _clamp(value: object, distribution: "BaseDistribution") -> object:
    """Return the value within its distribution: float32 may lie beyond the end of a range."""
    low, high = getattr(distribution, "low", None), getattr(distribution, "high", None)
    if low is None or high is None:
        choices = getattr(distribution, "choices", ())
        equal = (choice for choice in choices if choice == value or str(choice) == value)
        return next(equal, value)
    if value != value:
        return value
    assert isinstance(value, int | float)
    return (int if isinstance(low, int) else float)(min(max(value, low), high))
