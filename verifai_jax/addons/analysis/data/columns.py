"""Columns of the error table: numbers with an order, or choices without one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Int

from verifai_jax.core.messages.errors import check_names
from verifai_jax.falsification.table import RESERVED
from verifai_jax.features import FeatureSpace
from verifai_jax.features.domain import as_scalar


@dataclass(frozen=True)
class Column:
    """One column that is analysed.

    **Fields:** `name`; `ordered`: True for numbers; otherwise `choices` are the values, in the
    order of the space or sorted; `low` and `high`: bounds in the feature space, infinite if there
    are none or no space is known; `near` and `far`: the finite range that is scaled to `[0, 1]`:
    the bounds, or else the minimum and maximum of the whole table; `integer`: whether all numbers
    are whole; `known`: whether this comes from the feature space; `prior`: probabilities of the
    `choices` if the space has them; `uniform`: whether an ordered column has a uniform prior;
    `length`: whether it is the number of items of an array.
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
        """Return the indices of entries in `choices`; -1 for an absent one.

        **Raises:** `ValueError` for an entry that is not one of the choices.
        """
        kinds, values = pd.factorize(entries)
        indices = _indices(self.choices)
        found = [indices.get(value, indices.get(str(value), -2)) for value in values.tolist()]
        codes = np.array([*found, -1], np.int64)[kinds]
        if (codes == -2).any():
            stray = as_scalar(entries.iloc[int(np.argmax(codes == -2))])
            raise ValueError(
                f"column {self.name!r} holds {stray!r}, which is not one of its choices "
                f"{', '.join(map(repr, self.choices))}"
            )
        return codes


def feature_columns(table: pd.DataFrame, space: FeatureSpace | None) -> tuple[str, ...]:
    """Return the feature columns: those of the space, or all except verdicts and robustness.

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
    """Describe columns from the space, or else from their entries.

    **Raises:** `UnknownNameError` for a column that the table does not have; `ValueError` for an
    ordered one with infinite entries.
    """
    check_names("column", names, table.columns)
    of_space = space.root.facts("") if space is not None else {}
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


def _indices(choices: Sequence[Any]) -> dict[Any, int]:
    # A float32 entry of 0.1 still means the choice 0.1.
    indices = {float(np.float32(c)): i for i, c in enumerate(choices) if isinstance(c, float)}
    return indices | {choice: i for i, choice in enumerate(choices)}


def _sorting(choice: Any) -> tuple[str, Any]:
    numeric = isinstance(choice, int | float)
    return ("" if numeric else type(choice).__name__, choice if numeric else str(choice))
