"""The maps between the points of the unit cube and the features of a space, in JAX.

Users create a `FeatureSpace`; searches, engines and tables use the maps here. Other functions
convert rows of a table to features, and move features by one rounding.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.values.cube import Cube
from verifai_jax.features.arrays import Array as ArrayDomain
from verifai_jax.features.arrays import Items, VariableArray
from verifai_jax.features.box import Box
from verifai_jax.features.compound import Struct
from verifai_jax.features.continuous import Continuous
from verifai_jax.features.domain import Domain, Numbers, as_numbers, as_real, dotted, indexed
from verifai_jax.features.signal import Signal


class PointMaps:
    """Maps from points `[dim]` of the unit cube to features by name, and back; compiled once.

    **Arguments:**
    - `root`: the domains by name, as one domain.
    - `where`: the constraint between features; None without one.
    """

    def __init__(self, root: Struct, where: Callable[[Any], Bool[Array, ""]] | None) -> None:
        self.root = root
        self.where = where

    def __getstate__(self) -> dict[str, Any]:
        # What follows from the domains is computed where it is wanted, and so are programs.
        kind = type(self)
        return {
            name: value
            for name, value in vars(self).items()
            if not isinstance(getattr(kind, name, None), cached_property)
        }

    @property
    def domains(self) -> dict[str, Domain]:
        """Domains by name, in the order written."""
        return dict(self.root.fields)

    @cached_property
    def levels(self) -> tuple[int, ...]:
        """Number of cells of each coordinate; 0 if it is continuous."""
        return self.root.levels

    @cached_property
    def weights(self) -> tuple[tuple[float, ...] | None, ...]:
        """Probabilities of the cells of each coordinate; None for equal ones."""
        return self.root.weights

    @cached_property
    def ordered(self) -> tuple[bool, ...]:
        """For each coordinate, True if its values have an order."""
        return self.root.ordered

    @cached_property
    def lengths(self) -> tuple[int, ...]:
        """Indices of the coordinates that are lengths of arrays; others depend on them."""
        return self.root.lengths

    @cached_property
    def signals(self) -> tuple[tuple[int, ...], ...]:
        """The coordinates of each function of time, in the order of its control points."""
        return self.root.signals

    @cached_property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates, such as `x0`, `cars.length`, `cars[0].x`."""
        return self.root.coordinates("")

    def labels(self, duration: float | None = None) -> dict[str, str]:
        """Return readable names of the coordinates: `{"wind[3]": "wind at 1.5 s", ...}`.

        **Arguments:**
        - `duration`: the duration of a simulation in seconds, for signals without their own; when
          left out, control points keep their numbers.
        """
        return dict(zip(self.coordinates, self.root.labels("", duration), strict=True))

    @property
    def dim(self) -> int:
        """Number of unit coordinates."""
        return len(self.levels)

    @property
    def point_form(self) -> jax.ShapeDtypeStruct:
        """Shape and type of a point of the unit cube, for abstract evaluation."""
        return jax.ShapeDtypeStruct((self.dim,), jnp.result_type(float))

    @property
    def feature_form(self) -> dict[str, Any]:
        """Shapes and types of the features of a point, for abstract evaluation."""
        return self.feature_form_in(str(self.point_form.dtype))

    def feature_form_in(self, precision: str) -> dict[str, Any]:
        """Return the form of the features in `"float32"` or `"float64"`, whatever JAX's setting."""
        if precision not in self._forms:
            with in_precision(precision):
                self._forms[precision] = jax.eval_shape(self.unflatten, self.point_form)
        return jax.tree.map(lambda form: form, self._forms[precision])

    @cached_property
    def _forms(self) -> dict[str, dict[str, Any]]:
        """Forms of the features by precision, each traced once."""
        return {}

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Names of the feature columns of a table, such as `x0`, `cars[0].x`, `point[1]`."""
        return self.root.columns("")

    def unflatten(self, u: Numbers) -> dict[str, Any]:
        """Convert a point `[dim]` of the unit cube to features; real ones have the dtype of `u`.

        Pure JAX; `jax.vmap` it for batches.

        **Arguments:**
        - `u`: the point, `[dim]` with entries in `[0, 1]`.
        **Returns:** the features by name, as a system receives them.
        **Raises:** `ValueError` for a point of another shape.
        """
        u = as_real(u)
        if u.shape != (self.dim,):
            raise ValueError(
                f"u must have shape [{self.dim}], one coordinate for each of "
                f"{', '.join(self.columns[:8])}{', ...' * (self.dim > 8)}; got {list(u.shape)}"
            )
        return self.root.from_unit(u)

    def flatten(self, features: Mapping[str, Any]) -> Float[Array, " dim"]:
        """Convert features to the point `[dim]` of the unit cube; discrete ones to cell middles.

        Pure JAX for values of `unflatten`; also takes plain Python values, unchecked.

        **Arguments:**
        - `features`: features by name; constant and fixed features and events may be left out.
        **Returns:** the point, `[dim]`.
        """
        return self.root.to_unit(self.root.coerce(self.completed(features)))

    @cached_property
    def features_at(self) -> Callable[[Numbers], dict[str, Any]]:
        """Convert points `[n, dim]` to features `[n, ...]`: `unflatten`, compiled for each `n`."""
        return jax.jit(jax.vmap(self.unflatten))

    @cached_property
    def point_of(self) -> Callable[[Mapping[str, Any]], Float[Array, " dim"]]:
        """Convert features of one simulation to a point `[dim]`: `flatten`, compiled."""
        return jax.jit(self.flatten)

    @cached_property
    def points_at(self) -> Callable[[Mapping[str, Any]], Float[Array, "n dim"]]:
        """Convert features `[n, ...]` to points `[n, dim]`: `flatten`, compiled for each `n`."""
        return jax.jit(jax.vmap(self.flatten))

    @cached_property
    def width(self) -> int:
        """Number of real numbers in the features of one simulation."""
        leaves = jax.tree.leaves(self.feature_form)
        return sum(math.prod(leaf.shape) for leaf in leaves if _is_real(leaf))

    def unflatten_given(
        self, u: Float[Array, " dim"], values: Float[Array, " width"]
    ) -> dict[str, Any]:
        """Return features with given real numbers, and the rest from `unflatten`. Pure JAX.

        **Arguments:**
        - `u`: the point of the unit cube nearest to the features.
        - `values`: their real numbers in order; NaN stands for the number of the point.
        """
        leaves, form = jax.tree.flatten(self.unflatten(u))
        start = 0
        for i, leaf in enumerate(leaves):
            if _is_real(leaf):
                given = values[start : start + leaf.size].reshape(leaf.shape).astype(leaf.dtype)
                leaves[i] = jnp.where(jnp.isnan(given), leaf, given)
                start += leaf.size
        return jax.tree.unflatten(form, leaves)

    @cached_property
    def cube(self) -> Cube:
        """The unit cube of this space, as searches see it."""
        return Cube(
            levels=self.levels, weights=self.weights, ordered=self.ordered, names=self.coordinates,
            lengths=self.lengths, signals=self.signals, sequences=self.root.sequences,
        )  # fmt: skip

    def accepts(self, features: Mapping[str, Any]) -> Bool[Array, ""]:
        """Return whether the constraint holds; True without one. Pure JAX."""
        return jnp.asarray(True if self.where is None else self.where(features))

    @cached_property
    def accepts_points(self) -> Callable[[Numbers], Bool[Array | np.ndarray, " n"]]:
        """The constraint as a compiled function of points `[n, dim]` of the unit cube."""
        if self.where is None:
            return lambda u: np.ones(np.shape(u)[0], bool)
        return jax.jit(jax.vmap(lambda u: self.accepts(self.unflatten(u))))

    @property
    def items(self) -> int:
        """Maximum number of items, such as events, that `without_items` can remove."""
        return self.root.items

    @cached_property
    def without_items(self) -> Callable[[Numbers, Numbers], Float[Array, "n dim"]]:
        """Remove the items selected by `[n, items]` from points `[n, dim]`; compiled."""
        return jax.jit(jax.vmap(self.root.without))

    @cached_property
    def settle(self) -> Callable[[Numbers], Float[Array, "n dim"]]:
        """Set unused coordinates of points `[n, dim]` to a fixed value; compiled."""
        return jax.jit(jax.vmap(self.root.settled))

    @cached_property
    def used(self) -> Callable[[Numbers], Bool[Array, "n dim"]]:
        """Return which coordinates of points `[n, dim]` are used; compiled."""
        return jax.jit(jax.vmap(self.root.used))

    @cached_property
    def coverage_ids_at(self) -> Callable[[Numbers], Int[Array, "n ids"]]:
        """Return the items that points `[n, dim]` cover, such as transitions; compiled."""
        return jax.jit(jax.vmap(lambda u: self.root.coverage_ids(self.unflatten(u))))

    @property
    def constraint(self) -> Callable[[Numbers], Bool[Array | np.ndarray, " n"]] | None:
        """The compiled constraint `[n, dim] -> [n]`; None for a space without one."""
        return None if self.where is None else self.accepts_points

    def completed(self, features: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return features with the constant and fixed ones and events added that were left out."""
        if not isinstance(features, Mapping):
            return features
        held = ((name, domain.held_at) for name, domain in self.root.fields)
        known = {name: value for name, value in held if value is not None}
        known |= {n: d.nominal for n, d in self.root.fields if d.nominal is not None}
        return {**known, **features}


def _is_real(leaf: jax.Array | jax.ShapeDtypeStruct) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jnp.floating))


ROUNDING = 2.0**-23
"""Relative distance between neighbouring float32 numbers."""


def features_of_rows(
    domains: Mapping[str, Domain], rows: Mapping[str, Numbers], precision: str
) -> dict[str, PyTree]:
    """Return the features `[n, ...]` in rows of a table, in this precision.

    **Arguments:**
    - `domains`: the domains of the features, by name.
    - `rows`: columns `[n]` by name; those that belong to no feature are ignored.
    - `precision`: the precision of real numbers, `"float32"` or `"float64"`.
    **Raises:** the errors of `space.from_row`.
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
    """Return the features `[n, ...]` with real numbers moved by one rounding of float32.

    They stay in their domains; choices, constants and fixed features do not move.
    """
    return {name: _nudged(domain, features[name]) for name, domain in domains.items()}


def _nudged(domain: Domain, value: PyTree) -> PyTree:
    if isinstance(domain, Struct):
        return {name: _nudged(part, value[name]) for name, part in domain.fields}
    if isinstance(domain, Signal):
        return replace(value, knots=_nudged(domain.domain, value.knots))
    if isinstance(domain, ArrayDomain):
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
