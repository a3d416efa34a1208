"""Conversion of many rows of a table to features, and features one rounding away."""

from collections.abc import Mapping
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from verifai_jax.core.errors import unknown_name
from verifai_jax.core.precision import in_precision
from verifai_jax.core.waveform import Waveform
from verifai_jax.features.box import Box
from verifai_jax.features.compound import Struct
from verifai_jax.features.distributions import Continuous
from verifai_jax.features.domain import Domain, Numbers, as_numbers, dotted, indexed
from verifai_jax.features.signal import Signal

ROUNDING = 2.0**-23
"""Relative distance between neighbouring float32 numbers."""


def features_of_rows(
    domains: Mapping[str, Domain], rows: Mapping[str, Numbers], precision: str
) -> dict[str, PyTree]:
    """Return the features `[n, ...]` that rows of a table hold, in this precision.

    **Arguments:**

    - `domains`: of the features, by name.
    - `rows`: columns `[n]` by name; others than those of features are ignored.
    - `precision`: `"float32"` or `"float64"`, of real numbers.

    **Raises:** as `space.from_row`.
    """
    names = [column for name, domain in domains.items() for column in domain.columns(name)]
    for name in names:
        if name not in rows:
            raise unknown_name("column", name, rows)
    columns = {name: np.asarray(rows[name]) for name in names}
    with in_precision(precision):
        batch = {name: _batch(domain, columns, name) for name, domain in domains.items()}
        return jax.tree.map(lambda leaf: _cast(leaf, precision), batch)


def _cast(leaf: np.ndarray, precision: str) -> np.ndarray:
    return leaf.astype(precision) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf


def _batch(domain: Domain, columns: Mapping[str, np.ndarray], name: str) -> PyTree:
    names = domain.columns(name)
    if isinstance(domain, Struct):
        return {part: _batch(inner, columns, dotted(name, part)) for part, inner in domain.fields}
    if isinstance(domain, Box | Continuous):
        # In NumPy: a first use of JAX takes longer than the simulation.
        values = [as_numbers(columns[column], column) for column in names]
        return values[0] if np.ndim(getattr(domain, "low", 0.0)) == 0 else np.stack(values, axis=1)
    if isinstance(domain, Signal):
        knots = [_batch(domain.domain, columns, knot) for knot in indexed(name, domain.knots)]
        return Waveform(np.stack(knots, axis=1), domain.hold, domain.duration)  # pyright: ignore[reportArgumentType]
    # One row at a time, but equal ones once.
    rows = list(zip(*(columns[column].tolist() for column in names), strict=True))
    count = len(next(iter(columns.values())))
    known: dict[tuple, PyTree] = {}
    for row in rows or [()]:
        if row not in known:
            entries = dict(zip(names, row, strict=True))
            known[row] = jax.tree.map(np.asarray, domain.from_columns(entries, name))
    each = [known[row] for row in rows] if rows else [known[()]] * count
    return jax.tree.map(lambda *leaves: np.stack(leaves), *each)


def nudged(domains: Mapping[str, Domain], features: Mapping[str, PyTree]) -> dict[str, PyTree]:
    """Return the same features `[n, ...]`, their real numbers one rounding of float32 away.

    They stay in their domains; choices and constants stay as they are.
    """
    return {name: _nudged(domain, features[name]) for name, domain in domains.items()}


def _nudged(domain: Domain, value: PyTree) -> PyTree:
    if isinstance(domain, Struct):
        return {name: _nudged(part, value[name]) for name, part in domain.fields}
    if isinstance(domain, Signal):
        return replace(value, knots=_nudged(domain.domain, value.knots))
    if isinstance(domain, Box | Continuous):
        low, high = domain.support if isinstance(domain, Continuous) else (domain.low, domain.high)
        away = (value * (1 + ROUNDING)).astype(value.dtype)
        inside = (away >= np.asarray(low)) & (away <= np.asarray(high))
        return np.where(inside, away, (value * (1 - ROUNDING)).astype(value.dtype))
    return value
