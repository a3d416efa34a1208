"""User-given features: their conversion from all forms, and rows that carry them exactly.

    features = given_features(space, {"x": 5.0}, "float32")     # checked, stacked [1, ...]
    rows = given_rows(space, features)                  # [n, dim + width], points and values
    space.unflatten_given(rows[0, :1], rows[0, 1:])     # {"x": 5.0}, not what the point stands for

A float32 point of the unit cube cannot represent every value, so a row contains both the point and
the given values. Searches use the point; simulations use the values.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.messages.errors import check_names, unknown_name
from verifai_jax.features.arrays import Array, VariableArray
from verifai_jax.features.box import Box
from verifai_jax.features.compound import Struct
from verifai_jax.features.continuous import Continuous
from verifai_jax.features.domain import Domain, as_numbers, as_scalar, dotted
from verifai_jax.features.signal import Signal
from verifai_jax.features.space import FeatureSpace

if TYPE_CHECKING:
    import pandas as pd
Rows: TypeAlias = "pd.DataFrame | pd.Series | Iterable[Any] | Mapping[str, Any]"
"""Features of simulations: the feature columns of a table, a row of one, or dictionaries."""
TABLE_COLUMNS = ("row", "rho", "violated", "status", "verdict", "message")
"""Columns of a table other than its features, which a dictionary made of a row may hold."""


def given_features(space: FeatureSpace, rows: Rows, precision: str = "float32") -> dict[str, Any]:
    """Check features in any form, and convert them to the form that a system receives.

    Everything is checked as given, in double precision, before it is converted.

    **Arguments:**
    - `rows`: a DataFrame with the columns of a table, a row of one, or dictionaries (one or
      several) of features by name or by the columns of a table.
    - `precision`: the precision of their real numbers, `"float32"` or `"float64"`.
    **Returns:** the features, stacked along a leading axis `[n, ...]`.
    **Raises:** `ValueError` that names the first row and feature that is missing, unknown, outside
    its domain or refused by the constraint; `TypeError` for rows of another type.
    """
    if hasattr(rows, "columns") and hasattr(rows, "to_dict"):
        frame: Any = rows
        columns = _by_name(space, list(frame), lambda name: frame[name])
        if len(frame):
            return _of_columns(space, columns, precision)
        check_names("column", space.columns, columns)
        rows = []
    listed = _listed(rows)
    each = []
    for i, row in enumerate(listed):
        try:
            each.append(_of_row(space, row, precision))
        except ValueError as error:
            if len(listed) == 1:
                raise
            raise ValueError(f"row {i}: {error}") from error
    if not each:
        return jax.tree.map(
            lambda form: np.zeros((0, *form.shape), form.dtype), dict(space.feature_form)
        )
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *each)


def given_rows(space: FeatureSpace, features: Mapping[str, Any]) -> Float[np.ndarray, "n row"]:
    """Return rows that an engine simulates with exactly these features.

    **Arguments:**
    - `features`: `[n, ...]`, as returned by `given_features`.
    **Returns:** the points of the unit cube nearest to the features, each followed by the real
    numbers among its features; see `FeatureSpace.unflatten_given`.
    """
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(features)]
    if not (count := len(leaves[0])):
        return np.zeros((0, space.dim))
    single = jax.tree.map(_single, features)
    points = np.asarray(space.points_at(single), np.float64).reshape(count, -1)
    points = np.clip(np.nan_to_num(points, nan=0.5), 0.0, 1.0)
    values = [leaf.reshape(count, -1) for leaf in leaves if leaf.dtype.kind == "f"]
    return np.concatenate([points, *values], axis=1, dtype=np.float64)


def check_columns(
    space: FeatureSpace, columns: Mapping[str, Any], *, held: bool = True
) -> dict[str, Any]:
    """Check rows of a table `[n]`, and return their features in double precision.

    **Arguments:**
    - `columns`: columns by name; those that belong to no feature are ignored.
    - `held`: whether to check features that the space fixes, too.
    **Raises:** the errors of `given_features`.
    """
    for name in space.columns:
        if name not in columns:
            raise unknown_name("column", name, columns)
    own = {name: _column(columns[name], name) for name in space.columns}
    features = _converted(space, own, "float64")
    for name, domain in space.domains.items():
        if held or domain.size:
            _check_batch(domain, features[name], own, name)
    return features


def _column(entries: Any, name: str) -> np.ndarray:
    """Return a column of a table `[n]` with one value in each entry."""
    column = np.asarray(entries)
    if column.dtype == object and column.ndim == 1:
        column = np.fromiter(map(as_scalar, column), object, len(column))
    several = [each for each in column if _is_several(each)] if column.dtype == object else []
    if column.ndim != 1 or several:
        shown = several[0] if several else column[0].tolist()
        raise ValueError(f"{name} must be one value in each row; got {shown!r}")
    return column


def _is_several(entry: object) -> bool:
    return isinstance(entry, Iterable) and not isinstance(entry, str | bytes)


def _converted(
    space: FeatureSpace, columns: Mapping[str, np.ndarray], precision: str
) -> dict[str, Any]:
    """Return the features of columns, or say which row has none."""
    try:
        return space.features_of(columns, precision)
    except ValueError:
        count = len(next(iter(columns.values())))
        for row in range(count if count > 1 else 0):
            one = {name: entries[row : row + 1] for name, entries in columns.items()}
            try:
                space.features_of(one, precision)
            except ValueError as error:
                raise ValueError(f"{_at(row, count)}{error}") from error
        raise


def _of_columns(space: FeatureSpace, columns: Mapping[str, Any], precision: str) -> dict[str, Any]:
    features = check_columns(space, columns)
    _check_absent(space, columns)
    if precision != "float64":
        own = {name: _column(columns[name], name) for name in space.columns}
        features = _converted(space, own, precision)
    count = len(jax.tree.leaves(features)[0])
    if space.where is not None and count:
        with in_precision(precision):
            accepted = np.asarray(jax.jit(jax.vmap(space.accepts))(features))
        if not accepted.all():
            row = int(np.argmin(accepted))
            raise ValueError(f"{_at(row, count)}it {space.breaks_constraint}")
    return features


def _of_row(space: FeatureSpace, row: object, precision: str) -> dict[str, Any]:
    """Return the features `[1, ...]` of one row."""
    by_columns = _is_series(row)
    if hasattr(row, "_asdict"):
        row = row._asdict()  # pyright: ignore[reportAttributeAccessIssue]
    elif by_columns:
        series: Any = row
        row = _by_name(space, list(series.keys()), lambda name: series[name])
    if not isinstance(row, Mapping):
        raise ValueError(f"features must be a dictionary, or a row of a table; got {row!r}")
    flat = set(space.columns) - set(space.domains)
    if by_columns or flat & set(row):
        if not by_columns:
            check_names("column", _features_of(row, space.columns), space.columns)
        return _of_columns(space, {name: [row[name]] for name in row}, precision)
    written = {name: row[name] for name in _features_of(row, space.domains)}
    space.check(written)
    with in_precision(precision):
        features = space.root.coerce(space.completed(written))
        return jax.tree.map(lambda leaf: _as(np.asarray(leaf), precision)[None], features)


def _by_name(
    space: FeatureSpace, names: Sequence[Any], entries_of: Callable[[Any], Any]
) -> dict[str, Any]:
    """Return entries by their names as texts, or refuse a feature that is there twice."""
    texts = [str(name) for name in names]
    for name in space.columns:
        if texts.count(name) > 1:
            raise ValueError(
                f"there are {texts.count(name)} columns {name!r}, and nothing says which is meant; "
                "leave one"
            )
    return {text: entries_of(name) for text, name in zip(texts, names, strict=True)}


def _features_of(row: Mapping[str, Any], known: Iterable[str]) -> list[str]:
    """Return the names of a dictionary without those of a table's other columns."""
    known = set(known)
    return [
        name
        for name in row
        if name in known or not (name in TABLE_COLUMNS or str(name).startswith("rho."))
    ]


def _check_batch(
    domain: Domain, values: PyTree, columns: Mapping[str, np.ndarray], name: str
) -> None:
    """Check values `[n, ...]` of a feature: its columns, or what `features_of` gives of them."""
    if isinstance(domain, Box | Continuous):
        # As it is written: a value is rounded to an end that is near when it is converted.
        each = [as_numbers(columns[column], column) for column in domain.columns(name)]
        written = each[0] if np.ndim(values) == 1 else np.stack(each, axis=1)
        inside = domain.contains(written).reshape(len(written), -1).all(axis=1)
        if not inside.all():
            _check_one(domain, written, int(np.argmin(inside)), name)
    elif isinstance(domain, Signal):
        for i in range(domain.knots):
            _check_batch(domain.domain, values.knots[:, i], columns, f"{name}[{i}]")
    elif isinstance(domain, Struct):
        for field, inner in domain.fields:
            _check_batch(inner, values[field], columns, dotted(name, field))
    elif isinstance(domain, Array):
        for i in range(domain.length):
            item = jax.tree.map(lambda leaf, i=i: leaf[:, i], values)
            _check_batch(domain.domain, item, columns, f"{name}[{i}]")
    else:
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(values)]
        known: set[tuple[bytes, ...]] = set()
        for i in range(len(leaves[0]) if leaves else 0):
            content = tuple(leaf[i].tobytes() for leaf in leaves)
            if content not in known:
                known.add(content)
                _check_one(domain, values, i, name)


def _check_absent(space: FeatureSpace, columns: Mapping[str, Any]) -> None:
    """Refuse values of items beyond the length of their array: they would be left out unsaid."""
    for name, domain in space.domains.items():
        if not (isinstance(domain, VariableArray) and f"{name}.length" in space.columns):
            continue
        lengths = np.asarray(columns[f"{name}.length"], np.float64)
        for i in range(domain.shortest, domain.longest):
            for column in domain.domain.columns(f"{name}[{i}]"):
                entries = np.asarray(columns[column], object)
                present = np.array([entry is not None and entry == entry for entry in entries])
                if (beyond := present & (lengths <= i)).any():
                    row = int(np.argmax(beyond))
                    raise ValueError(
                        f"{_at(row, len(lengths))}{column} must be empty where {name}.length is "
                        f"{lengths[row]:zg}; got {entries[row]!r}"
                    )


def _check_one(domain: Domain, values: PyTree, row: int, name: str) -> None:
    count = len(jax.tree.leaves(values)[0])
    try:
        domain.check(jax.tree.map(lambda leaf: np.asarray(leaf)[row], values), name)
    except ValueError as error:
        raise ValueError(f"{_at(row, count)}{error}") from error


def _at(row: int, count: int) -> str:
    return f"row {row}: " if count > 1 else ""


def _is_series(row: object) -> bool:
    return hasattr(row, "to_dict") and hasattr(row, "index") and not hasattr(row, "columns")


def _listed(rows: Rows) -> list[Any]:
    if isinstance(rows, Mapping) or _is_series(rows) or hasattr(rows, "_asdict"):
        return [rows]
    if isinstance(rows, str | bytes) or not isinstance(rows, Iterable):
        raise TypeError(
            "features are a DataFrame, a row of one, or dictionaries of names to values (read a "
            f"file with pandas.read_csv first); got {rows!r}"
        )
    return list(rows)


def _single(leaf: Any) -> np.ndarray:
    return _as(np.asarray(leaf), "float32")


def _as(leaf: np.ndarray, precision: str) -> np.ndarray:
    return leaf.astype(precision) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf
