"""Optuna's samplers choose the hyper-parameters: `sweep(study, search="optuna:tpe")`.

Needs the extra `optuna`. Seeded, so that a resumed sweep asks for the same configurations.
"""

import importlib.util
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from verifai_jax.core.errors import MissingExtra, require, unknown_name
from verifai_jax.features import (
    Box,
    Categorical,
    Constant,
    DiscreteBox,
    FeatureSpace,
    LogUniform,
)
from verifai_jax.features.domain import Domain
from verifai_jax.features.fixed import Fixed
from verifai_jax.sweeps.proposers import Values
from verifai_jax.sweeps.trainer import labelled, labels

_SAMPLERS = {
    "tpe": "TPESampler",
    "random": "RandomSampler",
    "cmaes": "CmaEsSampler",
    "gp": "GPSampler",
    "nsgaii": "NSGAIISampler",
    "qmc": "QMCSampler",
}
_MOST_REFUSED = 1000
"""Trials in a row that the constraint refuses, after which there are no more."""


@dataclass(frozen=True)
class OptunaSampler:
    """A sampler of Optuna, by name, with its options: `OptunaSampler("tpe", {"multivariate": 1})`.

    - `name`: `tpe`, `random`, `cmaes`, `gp`, `nsgaii` or `qmc`.
    - `options`: keywords of the sampler's class; the seed is the sweep's.

    **Raises:** `UnknownNameError` for another name; `ValueError` for a seed among the options.
    """

    name: str = "tpe"
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.name not in _SAMPLERS:
            raise unknown_name("sampler of Optuna", self.name, _SAMPLERS)
        if "seed" in self.options:
            raise ValueError("the seed of Optuna's sampler is the sweep's: sweep(..., seed=...)")

    def asker(self, space: FeatureSpace, seed: int, batch: int) -> "OptunaAsker":
        """What asks this sampler.

        **Raises:** `MissingExtra` without Optuna, or what the sampler needs; `TypeError` for
        options that the sampler does not have.
        """
        optuna = require("optuna", "optuna")
        if self.name == "cmaes" and importlib.util.find_spec("cmaes") is None:
            raise MissingExtra("Optuna's sampler cmaes needs a package: pip install cmaes")
        with warnings.catch_warnings():
            # Optuna calls some of its samplers experimental; who names one has chosen it.
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            made = getattr(optuna.samplers, _SAMPLERS[self.name])(seed=seed, **self.options)
        return OptunaAsker(self, made, space, batch)


class OptunaAsker:
    """A study of Optuna's that is asked for configurations and told how bad they are."""

    learns = True

    def __init__(self, described: OptunaSampler, made: Any, space: FeatureSpace, batch: int):
        self.sampler, self.space, self.batch = described, space, batch
        optuna = require("optuna", "optuna")
        self._failed = optuna.trial.TrialState.FAIL
        self._distributions = distributions(space)
        before = optuna.logging.get_verbosity()
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        try:
            self._study = optuna.create_study(sampler=made)
        finally:
            optuna.logging.set_verbosity(before)
        self._trials: list[Any] = []

    def ask(self, most: int) -> list[Values]:
        self._trials, found, refused = [], [], 0
        while len(found) < min(most, self.batch) and refused < _MOST_REFUSED:
            trial = self._study.ask(self._distributions)
            values, accepted = _values(self.space, trial.params)
            if accepted:
                self._trials.append(trial)
                found.append(values)
                refused = 0
            else:
                self._study.tell(trial, state=self._failed)
                refused += 1
        return found

    def tell(self, badness: Sequence[float | None]) -> None:
        for trial, bad in zip(self._trials, badness, strict=False):
            if bad is None:
                self._study.tell(trial, state=self._failed)
            else:
                self._study.tell(trial, float(bad))

    def described(self) -> Any:
        options = {name: repr(value) for name, value in self.sampler.options.items()}
        return {"optuna": self.sampler.name, "options": options}


def distributions(space: FeatureSpace) -> dict[str, Any]:
    """The domains of a space as Optuna's distributions; one that it lacks by its probability."""
    made = require("optuna", "optuna").distributions
    found: dict[str, Any] = {}
    for name, domain in space.domains.items():
        match domain:
            case Constant() | Fixed():
                continue
            case LogUniform():
                found[name] = made.FloatDistribution(domain.low, domain.high, log=True)
            case DiscreteBox():
                found[name] = made.IntDistribution(domain.low, domain.high)
            case Categorical():
                found[name] = made.CategoricalDistribution([_plain(c) for c in domain.choices])
            case Box() if np.ndim(domain.low) == 0:
                found[name] = made.FloatDistribution(domain.low, domain.high)
            case _:
                found[name] = made.FloatDistribution(0.0, 1.0)
    return found


def _values(space: FeatureSpace, chosen: Mapping[str, Any]) -> tuple[Values, bool]:
    """Values as a training sees them, and whether the constraint accepts them."""
    features = {
        name: domain.value if isinstance(domain, Constant | Fixed) else _value(domain, chosen[name])
        for name, domain in space.domains.items()
    }
    coerced = space.root.coerce(features)
    accepted = bool(space.accepts(coerced))
    return labels(space, jax.tree.map(lambda leaf: np.asarray(leaf)[None], coerced))[0], accepted


def _value(domain: Domain, chosen: Any) -> Any:
    match domain:
        case LogUniform() | DiscreteBox() | Box():
            return chosen
        case Categorical():
            return next(c for c in domain.choices if _plain(c) == chosen)
    point = np.array([[chosen]], np.float32)
    return labelled(FeatureSpace({"value": domain}), point)[0]["value"]


def _plain(choice: Any) -> Any:
    return choice if isinstance(choice, bool | int | float | str | None) else str(choice)
