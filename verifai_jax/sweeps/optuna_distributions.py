"""The domains of hyper-parameters as Optuna's distributions. Needs the extra `optuna`."""

from typing import TYPE_CHECKING

import numpy as np

from verifai_jax.core.errors import require
from verifai_jax.features import Box, Categorical, DiscreteBox, LogUniform
from verifai_jax.features.domain import Domain

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution


def optuna_distribution(domain: Domain | None) -> "BaseDistribution | None":
    """Return Optuna's distribution for a domain; None where Optuna has no such distribution.

    **Raises:** `MissingExtra` without Optuna.
    """
    distributions = require("optuna", "optuna").distributions
    match domain:
        case LogUniform():
            return distributions.FloatDistribution(float(domain.low), float(domain.high), log=True)
        case DiscreteBox() if domain.size == 1:
            low, high = np.ravel(domain.low)[0], np.ravel(domain.high)[0]
            return distributions.IntDistribution(int(low), int(high))
        case Categorical():
            return distributions.CategoricalDistribution([plain_choice(c) for c in domain.choices])
        case Box() if domain.size == 1:
            low, high = map(np.ravel, domain.ends(np.float64))
            return distributions.FloatDistribution(float(low[0]), float(high[0]))
    return None


def plain_choice(choice: object) -> bool | int | float | str | None:
    """Return a choice as Optuna stores it: numbers, texts and None as they are, others as text."""
    return choice if isinstance(choice, bool | int | float | str | None) else str(choice)
