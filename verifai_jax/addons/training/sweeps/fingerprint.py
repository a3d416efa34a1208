"""The fingerprint of a sweep: plain data by which a cache recognises its own sweep.

fingerprint(study, options)                         # nested dictionaries of numbers and texts
digest({"learning_rate": 1e-3})                     # 20 hexadecimal digits
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from verifai_jax._version import __version__
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.core.compute.fingerprint import stable_text
from verifai_jax.features import FeatureSpace


def fingerprint(study: Study, options: Mapping[str, Any]) -> dict[str, Any]:
    """Describe everything that determines the table of a sweep, as far as plain data can.

    Code is described by its name only.
    """
    problem = study.untrained_problem()
    return {
        "study": study.name, "space": describe_space(study.space),
        "constrained": study.space.where is not None, "task": describe(study.trainer.task),
        "nominal": describe(study.trainer.evaluation_task),
        "algorithms": {
            name: describe(algorithm) for name, algorithm in study.trainer.by_name.items()
        },
        "steps": study.trainer.steps, "snapshots": list(study.checkpoints),
        "seeds": list(study.training_seeds), "p": study.p,
        "curve": None if study.curve_formula is None else str(study.curve_formula),
        "problem": {
            "name": problem.name, "features": describe_space(problem.space),
            "formulas": {name: str(formula) for name, formula in problem.formulas.items()},
        },
        "options": dict(options), "version": __version__,
    }  # fmt: skip


def digest(value: Mapping[str, Any]) -> str:
    """Return a short hash of plain data."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=repr).encode()).hexdigest()[:20]


def describe_space(space: FeatureSpace) -> dict[str, str]:
    """Describe a space by its domains."""
    return {name: stable_text(domain) for name, domain in space.domains.items()}


def describe(value: object) -> dict[str, str]:
    """Describe a dataclass by its fields, anything else by its `repr`."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: stable_text(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"kind": type(value).__qualname__, **fields}
    return {"kind": type(value).__qualname__, "is": stable_text(value)}
