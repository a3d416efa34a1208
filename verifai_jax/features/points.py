"""Conversion of many rows of a table to features, and features one rounding away."""

from collections.abc import Mapping
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from verifai_jax.core.errors import unknown_name
from verifai_jax.core.precision import in_precision
from verifai_jax.features.arrays import Array, Items, VariableArray
from verifai_jax.features.box import Box
from verifai_jax.features.compound import Struct
from verifai_jax.features.continuous import Continuous
from verifai_jax.features.domain import Domain, Numbers, as_numbers, dotted, indexed
from verifai_jax.features.signal import Signal

ROUNDING = 2.0**-23
"""Relative distance between neighbouring float32 numbers."""


def features_of_rows(
    domains: Mapping[str, Domain], rows: Mapping[str, Numbers], precision: str
) -> dict[str, PyTree]:
    """Return the features `[n, ...]` that rows of a table hold, in this precision.

    **Arguments:**
    - `domains`: the domains of the features, by name.
    - `rows`: columns `[n]` by name; others than those of features are ignored.
    - `precision`: `"float32"` or `"float64"`, of real numbers.
    **Raises:** as `space.from_row`.
    """
    names = [column for name, domain in domains.items() for column in domain.columns(name)]
    for name in names:
        if name not in rows:
            raise unknown_name("column", name, rows)
    columns = {name: np.asarray(rows[name]) for name in names}
    if not names and len(rows):
        # Where nothing varies, any other column says how many rows there are.
        columns = {"": np.asarray(rows[next(iter(rows))])}
    with in_precision(precision):
        batch = {name: _batch(domain, columns, name, precision) for name, domain in domains.items()}
        return jax.tree.map(lambda leaf: _cast(leaf, precision), batch)


def _cast(leaf: np.ndarray, precision: str) -> np.ndarray:
    inexact = jnp.issubdtype(leaf.dtype, jnp.inexact) and leaf.dtype != precision
    return leaf.astype(precision) if inexact else leaf


def _batch(domain: Domain, columns: Mapping[str, np.ndarray], name: str, precision: str) -> PyTree:
    names = domain.columns(name)
    if isinstance(domain, Struct):
        return {
            part: _batch(inner, columns, dotted(name, part), precision)
            for part, inner in domain.fields
        }
    if isinstance(domain, Box | Continuous):
        # In NumPy: a first use of JAX takes longer than the simulation.
        values = [as_numbers(columns[column], column) for column in names]
        scalar = np.ndim(getattr(domain, "low", 0.0)) == 0
        stacked = values[0] if scalar else np.stack(values, axis=1)
        return domain.rounded(stacked.astype(precision))
    if isinstance(domain, Signal):
        each = indexed(name, domain.knots)
        knots = [_batch(domain.domain, columns, knot, precision) for knot in each]
        return domain.waveform(np.stack(knots, axis=1))  # pyright: ignore[reportArgumentType]
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

    They stay in their domains; choices, constants and fixed features do not move.
    """
    return {name: _nudged(domain, features[name]) for name, domain in domains.items()}


def _nudged(domain: Domain, value: PyTree) -> PyTree:
    if isinstance(domain, Struct):
        return {name: _nudged(part, value[name]) for name, part in domain.fields}
    if isinstance(domain, Signal):
        return replace(value, knots=_nudged(domain.domain, value.knots))
    if isinstance(domain, Array):
        return _nudged(domain.domain, value)
    if isinstance(domain, VariableArray):
        present = np.asarray(value.mask)

        def where_present(new: np.ndarray, old: np.ndarray) -> np.ndarray:
            axes = (1,) * (np.ndim(new) - present.ndim)
            return np.where(present.reshape(present.shape + axes), new, old)

        moved = _nudged(domain.domain, value.values)
        return Items(jax.tree.map(where_present, moved, value.values), value.length)
    if isinstance(domain, Box | Continuous):
        first, last = domain.ends(value.dtype)
        farther, nearer = ((value * (1 + sign * ROUNDING)).astype(value.dtype) for sign in (1, -1))
        # In a box of few numbers neither may be inside.
        stays = np.where((nearer >= first) & (nearer <= last), nearer, value)
        return np.where((farther >= first) & (farther <= last), farther, stays)
    return value
