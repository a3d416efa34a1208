"""Columns of the error table: numbers with an order, or choices without one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Int

from verifai_jax.core.errors import check_names
from verifai_jax.falsification.table import RESERVED
from verifai_jax.features import (
    Array,
    Automaton,
    Box,
    Categorical,
    DiscreteBox,
    FeatureSpace,
    Signal,
    Struct,
    VariableArray,
)
from verifai_jax.features.domain import Domain, as_scalar, indexed


@dataclass(frozen=True)
class Column:
    """One column that is analysed.

    **Fields:** `name`; `ordered`: numbers with an order, else `choices`, in the order of the space
    or sorted; `low` and `high`: bounds in the feature space, infinite where there are none or no
    space is known; `near` and `far`: the finite range that is scaled to `[0, 1]`, which is the
    bounds, or else the least and the greatest entry of the whole table; `integer`: only whole
    numbers; `known`: whether the feature space says all this; `prior`: probabilities of the
    `choices` where the space knows them; `uniform`: whether an ordered one has a uniform prior;
    `length`: whether it says how many items an array has.
    """

    name: str
    ordered: bool
    low: float = -np.inf
    high: float = np.inf
    near: float = 0.0
    far: float = 0.0
    integer: bool = False
    choices: tuple[Any, ...] = ()
    known: bool = False
    prior: tuple[float, ...] | None = None
    uniform: bool = False
    length: bool = False

    def codes(self, entries: pd.Series | pd.DataFrame) -> Int[np.ndarray, " n"]:
        """Return the places of entries in `choices`; -1 for an absent one.

        **Raises:** `ValueError` for an entry that is none of the choices.
        """
        kinds, values = pd.factorize(entries)
        places = _places(self.choices)
        found = [places.get(value, places.get(str(value), -2)) for value in values.tolist()]
        codes = np.array([*found, -1], np.int64)[kinds]
        if (codes == -2).any():
            stray = as_scalar(entries.iloc[int(np.argmax(codes == -2))])
            raise ValueError(
                f"column {self.name!r} holds {stray!r}, which is none of its choices "
                f"{', '.join(map(repr, self.choices))}"
            )
        return codes


def feature_columns(table: pd.DataFrame, space: FeatureSpace | None) -> tuple[str, ...]:
    """Return the feature columns: those of the space, or all but verdicts and robustness.

    **Raises:** `UnknownNameError` for a feature of the space that the table does not have.
    """
    if space is not None:
        check_names("column", space.columns, table.columns)
        return space.columns
    names = [str(name) for name in table.columns]
    return tuple(name for name in names if name not in RESERVED and not name.startswith("rho."))


def describe_columns(
    table: pd.DataFrame, names: Sequence[str], space: FeatureSpace | None
) -> tuple[Column, ...]:
    """Describe columns: as the space says, otherwise as their entries are.

    **Raises:** `UnknownNameError` for a column that the table does not have; `ValueError` for an
    ordered one with infinite entries.
    """
    check_names("column", names, table.columns)
    of_space = _of_space(space) if space is not None else {}
    return tuple(_column(table[name], name, of_space.get(name, {})) for name in names)


def _column(entries: Any, name: str, known: Mapping[str, Any]) -> Column:
    numbers = pd.api.types.is_numeric_dtype(entries) and not pd.api.types.is_bool_dtype(entries)
    if not known.get("ordered", numbers):
        choices = known.get("choices")
        if choices is None:
            choices = tuple(sorted(entries.dropna().unique().tolist(), key=_sorting))
        # Where items can be absent, an entry is less likely than its choice.
        prior = None if entries.isna().any() else known.get("prior")
        return Column(name, ordered=False, choices=choices, known=bool(known), prior=prior)
    if not numbers:
        entries = pd.to_numeric(entries)
    present = entries.dropna().to_numpy(np.float64)
    if np.isinf(present).any():
        row = entries.index[np.isinf(entries.to_numpy(np.float64))][0]
        raise ValueError(f"column {name!r} is infinite in row {row}; leave the row or column out")
    near, far = known.get("range", (-np.inf, np.inf))
    if not np.isfinite([near, far]).all():
        near, far = (present.min(), present.max()) if len(present) else (0.0, 0.0)
    low, high = known.get("bounds", (-np.inf, np.inf))
    integer = known.get("integer", pd.api.types.is_integer_dtype(entries))
    return Column(
        name,
        ordered=True,
        low=float(low),
        high=float(high),
        near=float(near),
        far=float(far),
        integer=bool(integer),
        known=bool(known),
        uniform=known.get("uniform", False) and len(present) == len(entries),
        length=known.get("length", False),
    )


def _of_space(space: FeatureSpace) -> dict[str, dict[str, Any]]:
    return _of_domain(space.root, "")


def _of_domain(domain: Domain, name: str) -> dict[str, dict[str, Any]]:
    """Return what a domain says about its columns."""
    if isinstance(domain, Struct):
        found: dict[str, dict[str, Any]] = {}
        for field, part in domain.fields:
            found |= _of_domain(part, f"{name}.{field}" if name else field)
        return found
    if isinstance(domain, Array | VariableArray | Signal):
        count = {Array: "length", VariableArray: "most", Signal: "knots"}[type(domain)]
        found = {}
        if isinstance(domain, VariableArray) and domain.most > domain.least:
            found[f"{name}.length"] = {**_integers(domain.least, domain.most), "length": True}
        for item in indexed(name, getattr(domain, count)):
            found |= _of_domain(domain.domain, item)
        return found
    if isinstance(domain, Automaton):
        return _of_automaton(domain, name)
    if isinstance(domain, Categorical):
        count, weights = len(domain.choices), domain.weights[0]
        prior = tuple(float(weight) for weight in weights) if weights else (1 / count,) * count
        return {name: {"ordered": False, "choices": _shown(domain), "prior": prior}}
    if isinstance(domain, DiscreteBox):
        ends = zip(np.ravel(domain.low).tolist(), np.ravel(domain.high).tolist(), strict=True)
        return {
            column: _integers(low, high)
            for column, (low, high) in zip(domain.columns(name), ends, strict=True)
        }
    if isinstance(domain, Box):
        ends = zip(np.ravel(domain.low), np.ravel(domain.high), strict=True)
        return {
            column: {
                "ordered": True,
                "bounds": end,
                "range": end,
                "integer": False,
                "uniform": True,
            }
            for column, end in zip(domain.columns(name), ends, strict=True)
        }
    return _of_other_domain(domain, name)


def _of_automaton(domain: Automaton, name: str) -> dict[str, dict[str, Any]]:
    """Return what is known of the events' columns: kinds, and bounds over all kinds of events."""
    found = {f"{name}.length": {**_integers(0, domain.most), "length": True}}
    for item in indexed(name, domain.most):
        # An absent event is a choice of its own.
        found[f"{item}.kind"] = {"ordered": False, "choices": (*domain.names, "")}
        for each in domain.transitions:
            for part, own in (("wait", each.wait), *each.parameters):
                for column, known in _of_domain(own, f"{item}.{part}").items():
                    found[column] = _both(found.get(column), known)
    return found


def _both(one: dict[str, Any] | None, other: dict[str, Any]) -> dict[str, Any]:
    """Return what is known of a column that has one of two domains, or is empty."""
    if not other["ordered"]:
        return {"ordered": False}
    if one is None or one == other:
        return other
    if not (one["ordered"] and other["ordered"]):
        return {"ordered": False}
    joined: dict[str, Any] = {"ordered": True, "integer": one["integer"] and other["integer"]}
    for ends in ("bounds", "range"):
        (a, b), (c, d) = one[ends], other[ends]
        joined[ends] = (min(a, c), max(b, d))
    return joined


def _of_other_domain(domain: Domain, name: str) -> dict[str, dict[str, Any]]:
    """Return bounds from the ends of the coordinates, or those that the domain names.

    The range of a distribution without ends, such as a normal one, leaves out their thousandths.
    """
    if domain.size == 0:
        return {}
    u = jnp.repeat(jnp.array([0.0, 1.0, 0.001, 0.999])[:, None], domain.size, axis=1)
    columns = domain.to_columns(jax.vmap(domain.from_unit)(u), name)
    found: dict[str, dict[str, Any]] = {}
    for column, entries in columns.items():
        ends = np.asarray(entries)
        if ends.dtype.kind not in "iuf":
            found[column] = {"ordered": False}
            continue
        low, high, near, far = ends.astype(np.float64)
        bounds, inner = sorted((low, high)), sorted((near, far))
        # A distribution names its support; drawn ends are finite even where that is not.
        endless = not np.isfinite(getattr(domain, "support", (np.inf, np.inf))).all()
        found[column] = {
            "ordered": True,
            "bounds": bounds,
            "range": inner if endless else bounds,
            "integer": ends.dtype.kind in "iu",
        }
    return found


def _integers(low: int, high: int) -> dict[str, Any]:
    ends = (low, high)
    return {"ordered": True, "bounds": ends, "range": ends, "integer": True, "uniform": True}


def _shown(domain: Categorical) -> tuple[Any, ...]:
    """Return the choices as the table shows them, in the order of the space."""
    return domain.choices if domain.numeric else tuple(map(str, domain.choices))


def _places(choices: Sequence[Any]) -> dict[Any, int]:
    # A float32 entry of 0.1 still means the choice 0.1.
    places = {float(np.float32(c)): i for i, c in enumerate(choices) if isinstance(c, float)}
    return places | {choice: i for i, choice in enumerate(choices)}


def _sorting(choice: Any) -> tuple[str, Any]:
    numeric = isinstance(choice, int | float)
    return ("" if numeric else type(choice).__name__, choice if numeric else str(choice))
