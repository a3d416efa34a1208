"""The domains of hyper-parameters as Optuna's distributions. Needs the extra `optuna`."""

from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.core.messages.errors import require
from verifai_jax.features.domain import Domain

if TYPE_CHECKING:
    import optuna
    from optuna.distributions import BaseDistribution


def optuna_distribution(domain: Domain | None) -> "BaseDistribution | None":
    """Return Optuna's distribution for a domain; None if there is none.

    **Raises:** `MissingExtra` without Optuna.
    """
    distributions = require("optuna", "optuna").distributions
    tuning = None if domain is None or domain.size != 1 else domain.tuning
    if tuning is None or tuning.scale == "other":
        return None
    if tuning.scale == "choice":
        return distributions.CategoricalDistribution([plain_choice(c) for c in tuning.choices])
    low, high = np.ravel(tuning.low)[0], np.ravel(tuning.high)[0]
    if tuning.scale == "integer":
        return distributions.IntDistribution(int(low), int(high))
    return distributions.FloatDistribution(float(low), float(high), log=tuning.scale == "log")


def quiet_study(**options: Any) -> "optuna.Study":
    """Create a study of Optuna without a line in its log."""
    optuna = require("optuna", "optuna")
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        return optuna.create_study(**options)
    finally:
        optuna.logging.set_verbosity(before)


def plain_choice(choice: object) -> bool | int | float | str | None:
    """Return a choice as Optuna stores it: numbers, texts and None unchanged, others as text."""
    return choice if isinstance(choice, bool | int | float | str | None) else str(choice)
