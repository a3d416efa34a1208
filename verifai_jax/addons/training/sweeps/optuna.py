"""Optuna's samplers as proposers of configurations: `sweep(study, search="optuna:tpe")`.

Needs the extra `optuna`. Samplers are seeded, so a resumed sweep proposes the same configurations.
"""

import importlib.util
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from verifai_jax.addons.training.sweeps.hyperparameters import (
    Hyperparameters,
    values_at,
    values_of_features,
)
from verifai_jax.addons.training.sweeps.optuna_distributions import (
    optuna_distribution,
    plain_choice,
    quiet_study,
)
from verifai_jax.core.messages.errors import MissingExtra, require, unknown_name
from verifai_jax.features import FeatureSpace
from verifai_jax.features.domain import Domain

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.samplers import BaseSampler
    from optuna.trial import Trial
_SAMPLERS = {
    "tpe": "TPESampler", "random": "RandomSampler", "cmaes": "CmaEsSampler", "gp": "GPSampler",
    "nsgaii": "NSGAIISampler", "qmc": "QMCSampler",
}  # fmt: skip
"""Classes of Optuna's samplers, by the names that are used here."""
_MAX_REFUSED = 1000
"""Trials in a row that the constraint may refuse before proposals end."""


@dataclass(frozen=True)
class OptunaSampler:
    """An Optuna sampler with its options, such as `OptunaSampler("tpe", {"multivariate": 1})`.

    **Arguments:**
    - `name`: `tpe`, `random`, `cmaes`, `gp`, `nsgaii` or `qmc`.
    - `options`: keyword arguments of the sampler's class; the sweep sets the seed.
    **Raises:** `UnknownNameError` for another name; `ValueError` for a seed among the options.
    """

    name: str = "tpe"
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.name not in _SAMPLERS:
            raise unknown_name("sampler of Optuna", self.name, _SAMPLERS)
        if "seed" in self.options:
            raise ValueError("the seed of Optuna's sampler is the sweep's: sweep(..., seed=...)")

    def proposer(self, space: FeatureSpace, seed: int, batch: int) -> "OptunaProposer":
        """Make the proposer of this sampler, for rounds of `batch` configurations.

        **Raises:** `MissingExtra` without Optuna or a package that the sampler needs; `TypeError`
        for options that the sampler does not have.
        """
        optuna = require("optuna", "optuna")
        if self.name == "cmaes" and importlib.util.find_spec("cmaes") is None:
            raise MissingExtra("Optuna's sampler cmaes needs a package: pip install cmaes")
        with warnings.catch_warnings():
            # Optuna warns that some samplers are experimental; this one was chosen by name.
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            sampler = getattr(optuna.samplers, _SAMPLERS[self.name])(seed=seed, **self.options)
        return OptunaProposer(self, sampler, space, batch)


class OptunaProposer:
    """A proposer that asks an Optuna study, with this sampler, for trials; see `Proposer`."""

    learns = True

    def __init__(
        self, description: OptunaSampler, sampler: "BaseSampler", space: FeatureSpace, batch: int
    ) -> None:
        self.description, self.space, self.batch = description, space, batch
        optuna = require("optuna", "optuna")
        self._failed = optuna.trial.TrialState.FAIL
        self._distributions = _distributions(space)
        self._study = quiet_study(sampler=sampler)
        self._trials: list[Trial] = []

    def propose(self, maximum: int) -> list[Hyperparameters]:
        self._trials, proposals, refused = [], [], 0
        while len(proposals) < min(maximum, self.batch) and refused < _MAX_REFUSED:
            trial = self._study.ask(self._distributions)
            values, accepted = _values(self.space, trial.params)
            if accepted:
                self._trials.append(trial)
                proposals.append(values)
                refused = 0
            else:
                self._study.tell(trial, state=self._failed)
                refused += 1
        return proposals

    def observe(self, objectives: Sequence[float | None]) -> None:
        for trial, value in zip(self._trials, objectives, strict=False):
            if value is None:
                self._study.tell(trial, state=self._failed)
            else:
                self._study.tell(trial, float(value))

    def to_json(self) -> object:
        options = {name: repr(value) for name, value in self.description.options.items()}
        return {"optuna": self.description.name, "options": options}


def _distributions(space: FeatureSpace) -> "dict[str, BaseDistribution]":
    """Return Optuna's distributions of a space; probabilities where Optuna lacks a domain."""
    unit = require("optuna", "optuna").distributions.FloatDistribution(0.0, 1.0)
    return {
        name: optuna_distribution(domain) or unit
        for name, domain in space.domains.items()
        if domain.held_at is None
    }


def _values(space: FeatureSpace, parameters: Mapping[str, object]) -> tuple[Hyperparameters, bool]:
    """Return values as a training sees them, and whether the constraint accepts them."""
    features = {
        name: _value(domain, parameters[name]) if domain.held_at is None else domain.held_at
        for name, domain in space.domains.items()
    }
    coerced = space.root.coerce(features)
    accepted = bool(space.accepts(coerced))
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], coerced)
    return values_of_features(space, batch)[0], accepted


def _value(domain: Domain, parameter: object) -> object:
    tuning = domain.tuning
    if tuning is not None and tuning.scale == "choice":
        return next(c for c in tuning.choices if plain_choice(c) == parameter)
    if tuning is not None and tuning.scale != "other":
        return parameter
    point = np.array([[parameter]], np.float32)
    return values_at(FeatureSpace({"value": domain}), point)[0]["value"]
