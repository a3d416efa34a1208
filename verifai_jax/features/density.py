"""The probability of features under the prior: densities of rows, and tails of single values.

log_density(space, run.table.all)                   # [n], of whole rows
tails(space, run.table.all)                         # {"wind": [n], ...}, column by column
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PyTree

from verifai_jax.features.arrays import Array, VariableArray
from verifai_jax.features.box import Box, DiscreteBox
from verifai_jax.features.choice import Categorical, Constant
from verifai_jax.features.compound import Struct
from verifai_jax.features.continuous import Continuous
from verifai_jax.features.domain import Domain, dotted
from verifai_jax.features.fixed import Fixed
from verifai_jax.features.given import check_columns
from verifai_jax.features.signal import Signal
from verifai_jax.features.space import FeatureSpace


class NoDensityError(ValueError):
    """Raised for a domain whose values have no probability density, such as an automaton."""


def log_density(space: FeatureSpace, rows: Mapping[str, Any]) -> Float[np.ndarray, " n"]:
    """Return the natural logarithm of the prior's density at rows of a table.

    It is the sum over the features, which are independent except for the constraint: a density of
    real numbers, a probability of choices, integers and lengths. Fixed features do not count. The
    sum is not divided by the share that the constraint accepts.

    **Arguments:**
    - `space`: the space of the features.
    - `rows`: columns `[n]` by name; columns that belong to no feature are ignored.
    **Raises:** `ValueError` for a row outside the space, and for a domain without a density, such
    as an automaton or a user's own.
    """
    features = check_columns(space, rows, held=False)
    whole = np.zeros(len(rows[space.columns[0]]) if space.columns else 0)
    for name, domain in space.domains.items():
        whole = whole + _log_density(domain, features[name], name)
    return whole


def tails(space: FeatureSpace, rows: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the probability of a value at least as far out, for each column of a distribution.

    It is twice the probability of the smaller side: 0.046 at two standard deviations of a `Normal`.
    Columns of boxes, integers and choices, which have no tails, are left out.

    **Arguments:**
    - `space`, `rows`: as in `log_density`.
    **Returns:** probabilities `[n]` by the names of columns; NaN for an absent item.
    **Raises:** `ValueError` for a row outside the space.
    """
    check_columns(space, rows, held=False)
    found: dict[str, np.ndarray] = {}
    for name, domain in space.domains.items():
        for column, continuous in _continuous(domain, name):
            values = np.asarray(rows[column], np.float64)
            known = np.isfinite(values)
            tail = continuous.tail(np.where(known, values, 1.0))
            found[column] = np.where(known, tail, np.nan)
    return found


def _log_density(domain: Domain, values: PyTree, name: str) -> Float[np.ndarray, "*n"]:
    """Return the logarithm of the density of values `[n, ...]`; one number where all are alike."""
    match domain:
        case Constant() | Fixed():
            return np.zeros(())
        case Box():
            width = np.asarray(domain.high, np.float64) - np.asarray(domain.low, np.float64)
            return np.asarray(-np.sum(np.log(width)))
        case Continuous():
            return domain.log_density(values)
        case DiscreteBox():
            return np.asarray(-np.sum(np.log(domain.levels)))
        case Categorical():
            if domain.probabilities is None:
                return np.asarray(-math.log(len(domain.choices)))
            shown = [str(choice) for choice in domain.to_columns(values, name)[name].tolist()]
            names = [str(choice) for choice in domain.choices]
            return np.log([domain.probabilities[names.index(choice)] for choice in shown])
        case Signal():
            each = (values.knots[:, i] for i in range(domain.knots))
            return _sum(_log_density(domain.domain, knot, name) for knot in each)
        case Struct():
            return _sum(
                _log_density(part, values[field], dotted(name, field))
                for field, part in domain.fields
            )
        case Array():
            return _sum(
                _log_density(domain.domain, _item(values, i), f"{name}[{i}]")
                for i in range(domain.length)
            )
        case VariableArray():
            items = (
                np.where(i < np.asarray(values.length), _log_density(domain.domain, item, name), 0)
                for i, item in ((i, _item(values.values, i)) for i in range(domain.longest))
            )
            return _sum(items) - math.log(domain.longest - domain.shortest + 1)
    raise NoDensityError(f"the prior of {name} has no density: {domain!r}")


def _continuous(domain: Domain, name: str) -> list[tuple[str, Continuous]]:
    """Return the columns that hold values of distributions."""
    if isinstance(domain, Continuous):
        return [(name, domain)]
    return [found for part, inner in domain.parts(name) for found in _continuous(inner, part)]


def _item(values: PyTree, i: int) -> PyTree:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:, i], values)


def _sum(parts: Iterable[Float[np.ndarray, "*n"]]) -> Float[np.ndarray, "*n"]:
    whole = np.zeros(())
    for part in parts:
        whole = whole + part
    return whole
