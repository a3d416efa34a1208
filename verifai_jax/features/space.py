"""The feature space: all that varies, in the order written, over one unit cube.

    space = FeatureSpace({"x0": Box(-0.05, 0.05), "alg": Categorical("ppo", "sac")})
    features = space.unflatten(u)                        # u[dim] -> {"x0": ..., "alg": ...}
    table = space.rows(jax.vmap(space.unflatten)(us))    # us[n, dim] -> columns [n]
    space.from_row(table.loc[7])                         # what was simulated in row 7

Constraints between features (`where`) will live here too.
"""

import html
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from verifai_jax.errors import unknown_name
from verifai_jax.features.choice import Constant
from verifai_jax.features.compound import Struct
from verifai_jax.features.domain import Domain, as_real


class FeatureSpace:
    """Named domains over `dim` unit coordinates; uniform coordinates are the prior on features.

    **Arguments:** `domains`: name -> `Domain`, in the order in which coordinates and columns come.

    **Raises:** `ValueError` for no features, bad names, or names that give one column twice;
    `TypeError` for a value that is no domain.
    """

    def __init__(self, domains: Mapping[str, Domain]) -> None:
        self.root = Struct(domains)
        seen: set[str] = set()
        for column in self.columns:
            if column in seen:
                raise ValueError(f"two features give the table column {column!r}; rename one")
            seen.add(column)

    @property
    def domains(self) -> dict[str, Domain]:
        """Name -> domain, in the order written."""
        return dict(self.root.fields)

    @cached_property
    def levels(self) -> tuple[int, ...]:
        """For each coordinate: 0 if continuous, or the number of its cells."""
        return self.root.levels

    @property
    def ordered(self) -> tuple[bool, ...]:
        """For each coordinate: whether neighbouring points or cells mean similar values."""
        return self.root.ordered

    @property
    def weights(self) -> tuple[tuple[float, ...] | None, ...]:
        """For each coordinate: the probabilities of its cells; None where they are equal."""
        return self.root.weights

    @cached_property
    def coordinates(self) -> tuple[str, ...]:
        """What each coordinate is called, such as `x0`, `cars.length`, `cars[0].x`."""
        return self.root.coordinates("")

    @property
    def lengths(self) -> tuple[int, ...]:
        """Indices of the coordinates that are lengths of arrays, on which others depend."""
        return self.root.lengths

    @property
    def dim(self) -> int:
        """Number of unit coordinates."""
        return len(self.levels)

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Names of the feature columns of a table, such as `x0`, `cars[0].x`, `point[1]`."""
        return self.root.columns("")

    def unflatten(self, u: Float[Array, " dim"]) -> dict[str, Any]:
        """The features at a point of the unit cube; real ones in the dtype of `u`.

        Pure JAX; `jax.vmap` it for batches.
        """
        u = as_real(u)
        if u.shape != (self.dim,):
            raise ValueError(
                f"u must have shape [{self.dim}], one coordinate for each of "
                f"{', '.join(self.columns[:8])}{', ...' * (self.dim > 8)}; got {list(u.shape)}"
            )
        return self.root.from_unit(u)

    def flatten(self, features: Mapping[str, Any]) -> Float[Array, " dim"]:
        """The point of the unit cube with these features; the middle of the cell where discrete.

        Pure JAX on what `unflatten` gives; takes plain Python values too. Nothing is checked.
        """
        return self.root.to_unit(self.root.coerce(self._completed(features)))

    def coerce(self, features: Mapping[str, Any]) -> dict[str, Any]:
        """Features that a person wrote (numbers, lists, choices), checked, as a system sees them.

        **Raises:** as `check`.
        """
        self.check(features)
        return self.root.coerce(self._completed(features))

    def check(self, features: Mapping[str, Any]) -> None:
        """Check concrete features, of which constant ones may be left out.

        **Raises:** `ValueError` that names the first feature which is missing, unknown or outside
        its domain.
        """
        self.root.check(self._completed(features), "")

    def rows(self, features: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Columns `[n]` of the table for a batch of features (leaves `[n, ...]`)."""
        return self.root.to_columns(features, "")

    def from_row(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """The features that a row of the table (pandas or a mapping) holds, exactly.

        Other columns are ignored; a value outside its domain is taken as it is.

        **Raises:** `ValueError` for a missing column, or an entry of the wrong kind.
        """
        known = [str(column) for column in row.keys()]  # noqa: SIM118 - pandas iterates values
        present = set(known)
        for column in self.columns:
            if column not in present:
                raise unknown_name("column", column, known)
        return self.root.from_columns(row, "")

    def describe(self) -> str:
        """One line a feature: its name, its domain and its unit coordinates."""
        rows = self._summary()
        widths = [max(len(row[i]) for row in rows) for i in range(3)]
        return "\n".join(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        )

    def _completed(self, features: Mapping[str, Any]) -> Mapping[str, Any]:
        if not isinstance(features, Mapping):
            return features
        constants = {n: d.value for n, d in self.root.fields if isinstance(d, Constant)}
        return {**constants, **features}

    def __getitem__(self, name: str) -> Domain:
        return self.root[name]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FeatureSpace) and self.root == other.root

    def __hash__(self) -> int:
        return hash(self.root)

    def __repr__(self) -> str:
        fields = [f"{name!r}: {domain!r}" for name, domain in self.root.fields]
        line = f"FeatureSpace({{{', '.join(fields)}}})"
        if len(line) <= 88:
            return line
        return "FeatureSpace({\n" + "".join(f"    {field},\n" for field in fields) + "})"

    def _repr_html_(self) -> str:
        header, *rows = self._summary()
        return (
            "<table><thead><tr>"
            + "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
            + "</tr></thead><tbody>"
            + "".join(
                "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>"
                for row in rows
            )
            + "</tbody></table>"
        )

    def _summary(self) -> list[tuple[str, str, str]]:
        rows = [("feature", "domain", "coordinates")]
        for name, domain in self.root.fields:
            discrete = sum(level > 0 for level in domain.levels)
            counts = [(domain.size - discrete, "continuous"), (discrete, "discrete")]
            shown = ", ".join(f"{count} {kind}" for count, kind in counts if count)
            rows.append((name, repr(domain), shown or "none"))
        return rows
