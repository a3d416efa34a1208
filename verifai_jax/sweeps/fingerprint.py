"""A sweep as plain data, by which a store knows whether it is its own."""

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from verifai_jax._version import __version__
from verifai_jax.features import FeatureSpace
from verifai_jax.sweeps.study import Study

_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")


def describe(study: Study, options: Mapping[str, Any]) -> dict[str, Any]:
    """All that decides the table of a sweep, as far as data can say it: code is known by name."""
    problem = study.untrained_problem()
    return {
        "study": study.name,
        "space": {name: _told(domain) for name, domain in study.space.domains.items()},
        "constrained": study.space.where is not None,
        "task": _described(study.trainer.task),
        "nominal": _described(study.trainer.measured_on),
        "algorithms": {
            name: _described(algorithm) for name, algorithm in study.trainer.by_name.items()
        },
        "steps": study.trainer.steps,
        "snapshots": list(study.snapshots),
        "seeds": list(study.training_seeds),
        "p": study.p,
        "curve": None if study.curve_formula is None else str(study.curve_formula),
        "problem": {
            "name": problem.name,
            "features": _features(problem.space),
            "formulas": {name: str(formula) for name, formula in problem.formulas.items()},
        },
        "options": dict(options),
        "version": __version__,
    }


def _features(space: FeatureSpace) -> dict[str, str]:
    return {name: _told(domain) for name, domain in space.domains.items()}


def _described(value: Any) -> Any:
    """A dataclass by its fields, anything else by what it calls itself."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _told(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"kind": type(value).__qualname__, **fields}
    return {"kind": type(value).__qualname__, "is": _told(value)}


def _told(value: Any) -> str:
    if isinstance(value, np.ndarray | jax.Array):
        return repr(np.asarray(value).tolist())
    # Where an object lies in memory says nothing of what it is.
    return _ADDRESS.sub("", repr(value))
