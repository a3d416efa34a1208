"""The feature space: all varied features, in the order written, over one unit cube.

space = FeatureSpace({"x0": Box(-0.05, 0.05), "alg": Categorical("ppo", "sac")})
features = space.unflatten(u)                        # u[dim] -> {"x0": ..., "alg": ...}
table = space.rows(jax.vmap(space.unflatten)(us))    # us[n, dim] -> columns [n]
space.from_row(table.loc[7])                         # the features simulated in row 7
space.distance({"x0": 0, "alg": "ppo"}, {"x0": 0.01, "alg": "sac"})
FeatureSpace({...}, where=lambda f: f["x"] < f["y"])                 # a constraint
space.only("x0", nominal={"alg": "ppo"})                             # a view
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.core.display.notebook import ForUsers, rows_html
from verifai_jax.core.messages.errors import check_names, unknown_name
from verifai_jax.features.acceptance import acceptance_rate
from verifai_jax.features.compound import Struct
from verifai_jax.features.custom import Distribution
from verifai_jax.features.domain import Domain, Numbers, Row
from verifai_jax.features.fixed import Fixed
from verifai_jax.features.plain import from_plain, to_plain
from verifai_jax.features.point_maps import PointMaps, features_of_rows, nudged

if TYPE_CHECKING:
    import pandas as pd


class FeatureSpace(PointMaps, ForUsers):
    """Named domains over `dim` unit coordinates; the prior is uniform in these coordinates.

    A simulation has three forms: a *point* of the unit cube, its *features* by name as a system
    receives them, and a *row* of a table. These methods convert between them:

    - point `[dim]` to features: `unflatten`; points `[n, dim]`: `features_at`, compiled.
    - features to point `[dim]`: `flatten`, and compiled `point_of`; features `[n, ...]` to points
      `[n, dim]`: `points_at`, compiled.
    - features `[n, ...]` to columns `[n]` of a table: `rows`.
    - row to features: `from_row`; columns `[n]` to features `[n, ...]`: `features_of`.
    - a table to points `[n, dim]`: `points`.
    - features as a user writes them: `coerce`, which checks them, and `convert`, which JAX may
      trace.

    **Arguments:**
    - `domains`: name -> `Domain`, in the order in which coordinates and columns come.
    - `where`: a constraint between features, a JAX function from features to one truth value. The
      prior is then that of the domains given that it holds, and only points that satisfy it are
      simulated.
    **Raises:** `ValueError` for no features, invalid names, or names that give the same column
    twice; `TypeError` for a value that is not a domain, or a `where` that is not a function.
    """

    _internal = frozenset((
        "accepts_points", "breaks_constraint", "check_where", "coerce", "completed",
        "constraint", "convert", "cube", "distance", "feature_form", "features_at", "fixed",
        "items", "labels", "lengths", "levels", "coverage_ids_at", "nudged", "ordered",
        "point_form",
        "point_of", "points", "points_at", "refined", "root", "settle", "signals",
        "unflatten_given", "used", "weights", "width", "without_items",
    ))  # fmt: skip

    def __init__(
        self, domains: Mapping[str, Domain], where: Callable[[Any], Bool[Array, ""]] | None = None
    ) -> None:
        super().__init__(Struct(domains), where)
        if where is not None and not callable(where):
            raise TypeError(f"where must be a function of the features; got {where!r}")
        known: set[str] = set()
        for column in self.columns:
            if column in known:
                raise ValueError(f"two features give the table column {column!r}; rename one")
            known.add(column)

    def points(self, rows: "pd.DataFrame") -> Float[np.ndarray, "n dim"]:
        """Convert a table to the points `[n, dim]` of the unit cube that gave its rows.

        **Raises:** `KeyError` for a missing column; `ValueError` for an entry of the wrong type.
        """
        columns = {str(name): rows[name].to_numpy() for name in rows}
        return np.asarray(self.points_at(self.features_of(columns, jnp.result_type(float).name)))

    def features_of(
        self, rows: Mapping[str, Numbers], precision: str = "float32"
    ) -> dict[str, Any]:
        """Convert columns `[n]` of a table to features `[n, ...]`: `from_row` of each row, stacked.

        **Arguments:**
        - `rows`: columns `[n]` by name; those that belong to no feature are ignored.
        - `precision`: the precision of their real numbers, `"float32"` or `"float64"`.
        **Raises:** the errors of `from_row`.
        """
        return features_of_rows(self.domains, rows, precision)

    def nudged(self, features: Mapping[str, Any]) -> dict[str, Any]:
        """Return features `[n, ...]` with real numbers moved by one rounding of float32."""
        return nudged(self.domains, features)

    def coerce(self, features: Mapping[str, Any]) -> dict[str, Any]:
        """Check features as a user writes them, and convert them to those that a system receives.

        **Arguments:**
        - `features`: numbers, lists, choices, dictionaries by name; constant and fixed features and
          events may be left out.
        **Returns:** the features in the form of `unflatten`.
        **Raises:** the errors of `check`.
        """
        self.check(features)
        return self.root.coerce(self.completed(features))

    def convert(self, features: Mapping[str, Any]) -> dict[str, Any]:
        """Convert features as a user writes them to those that a system receives; pure JAX.

        Names and shapes are checked; values are not, so that JAX may trace them.

        **Arguments:**
        - `features`: as in `coerce`.
        **Returns:** the features in the form of `unflatten`.
        **Raises:** `ValueError` with the first feature that is unknown, missing or of another
        shape.
        """
        complete = self.completed(features)
        check_names("feature", complete, self.domains)
        missing = [name for name in self.domains if name not in complete]
        if missing:
            raise ValueError(f"feature {missing[0]!r} is missing; got {', '.join(features)}")
        converted = self.root.coerce(complete)
        leaves = jax.tree_util.tree_flatten_with_path(self.feature_form)[0]
        for (path, form), leaf in zip(leaves, jax.tree.leaves(converted), strict=True):
            if form.shape != jnp.shape(leaf):
                name = jax.tree_util.keystr(path, simple=True, separator=".")
                raise ValueError(
                    f"feature {name!r} must have shape {list(form.shape)}; "
                    f"got {list(jnp.shape(leaf))}"
                )
        return converted

    def check(self, features: Mapping[str, Any]) -> None:
        """Check concrete features; constant and fixed features and events may be left out.

        **Raises:** `ValueError` that names the first feature that is missing, unknown or outside
        its domain, and for features that break the constraint.
        """
        complete = self.completed(features)
        self.root.check(complete, "")
        if self.where is not None and not bool(self.accepts(self.root.coerce(complete))):
            raise ValueError(f"{dict(features)!r} {self.breaks_constraint}")

    @property
    def breaks_constraint(self) -> str:
        """The end of a message on features that the constraint refuses."""
        assert self.where is not None
        return f"breaks the constraint of this space, {_source(self.where)}"

    def check_where(self, seed: int | Key[Array, ""] = 0) -> float:
        """Measure the share of the prior that the constraint accepts; 1 if there is none.

        A constraint that Python evaluates, through a callback, is called for a second instead of
        thousands of times.

        **Arguments:**
        - `seed`: the seed of the samples.
        **Raises:** `ValueError` for a constraint that raises, does not return one truth value, or
        accepts none of 65 536 samples (or of those that Python can check in a minute).
        """
        where = self.where
        if where is None:
            return 1.0
        return acceptance_rate(
            lambda u: where(self.unflatten(u)), self.accepts_points, [*self.domains], self.dim, seed
        )

    def sample(self, key: Key[Array, ""], count: int) -> dict[str, Any]:
        """Draw features from the prior, for use outside a run.

        **Arguments:**
        - `key`: a random key of JAX.
        - `count`: number of samples.
        **Returns:** the features by name, stacked along a leading axis `[count, ...]`.
        **Raises:** the errors of `check_where`; `ValueError` unless the count is a positive
        integer.
        """
        self.check_where()
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise ValueError(f"the number of samples must be a positive integer; got {count!r}")
        samples, total = [], 0
        while total < count:
            key, now = jax.random.split(key)
            points = jax.random.uniform(now, (max(count, 64), self.dim))
            accepted = np.flatnonzero(self.accepts_points(points))[: count - total]
            samples.append(jax.tree.map(lambda leaf, i=accepted: leaf[i], self.features_at(points)))
            total += len(accepted)
        return jax.tree.map(lambda *parts: jnp.concatenate(parts), *samples)

    def distance(
        self, one: Mapping[str, Any] | Row, other: Mapping[str, Any] | Row
    ) -> Float[Array, ""]:
        """Return the distance of two points of the space: Euclidean over unit coordinates.

        Distances are by probability in continuous coordinates, by difference of ranks (from 0 to 1)
        in integers and lengths, and 0 or 1 between choices; an absent item counts as one in the
        middle of its domain. This is a metric, in pure JAX for values returned by `unflatten`.

        **Arguments:**
        - `one`, `other`: features as returned by `unflatten`, or as a user writes them (numbers,
          lists, choices, dictionaries by name; constant and fixed features and events may be left
          out), or rows of a table.
        **Raises:** `ValueError` that names the first feature that is missing, unknown or outside
        its domain, for values as a user writes them.
        """
        levels, ordered = np.array(self.levels, int), np.array(self.ordered, bool)
        scale = np.where(levels > 1, levels / np.maximum(levels - 1, 1), 1.0)
        gap = jnp.abs(self._point(one) - self._point(other))
        gap = jnp.where((levels > 0) & ~ordered, (gap > 0).astype(gap.dtype), gap * scale)
        # The square root has no derivative at zero, where two points are the same.
        square = jnp.sum(gap * gap)
        return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)

    def fixed(self, **values: Any) -> "FeatureSpace":
        """Return the space with these features fixed at a value; they keep their table columns.

        **Arguments:**
        - `values`: values by name, as a user writes them.
        **Raises:** `ValueError` for an unknown feature, or a value outside its domain.
        """
        check_names("feature", values, self.domains)
        domains = {
            name: Fixed(_varied(domain), values[name], name) if name in values else domain
            for name, domain in self.root.fields
        }
        return FeatureSpace(domains, self.where)

    def only(self, *features: str, nominal: Mapping[str, Any] | None = None) -> "FeatureSpace":
        """Return the space in which only these features vary, the others fixed at `nominal`.

        **Arguments:**
        - `features`: names of the features that vary.
        - `nominal`: values of the others, by name, as a user writes them.
        **Raises:** `ValueError` for an unknown or no feature, or a fixed one without nominal value.
        """
        if not features:
            raise ValueError("name at least one feature that varies")
        check_names("feature", features, self.domains)
        check_names("feature", nominal or {}, self.domains)
        others = [
            name
            for name, domain in self.root.fields
            if name not in features and domain.held_at is None
        ]
        nominal = self.completed(nominal or {})
        missing = [name for name in others if name not in nominal]
        if missing:
            raise ValueError(
                f"features that do not vary need a nominal value; {', '.join(missing)} "
                f"{'has' if len(missing) == 1 else 'have'} none"
            )
        return self.fixed(**{name: nominal[name] for name in others})

    def refined(self, factor: int) -> "tuple[FeatureSpace, Callable[[dict], dict]]":
        """Return the space with finer signals, and a map from features to the new features.

        The finer features are the same functions of time; see `Signal.refined`.

        **Arguments:**
        - `factor`: number of control points of the finer signals for each of the coarse ones.
        **Raises:** `ValueError` for a factor that is not a positive integer.
        """
        positive = isinstance(factor, int | np.integer) and not isinstance(factor, bool)
        if not positive or factor < 1:
            raise ValueError(f"factor must be a positive integer; got {factor!r}")
        finer = FeatureSpace(dict(self.root.refined(factor).fields), self.where)
        return finer, lambda features: self.root.refine(features, factor)

    def to_json(self) -> dict[str, Any]:
        """Describe the space as plain data; a constraint is only described by its name.

        **Raises:** `ValueError` for a user's own domains.
        """
        where = None if self.where is None else _source(self.where)
        return {"features": to_plain(self.root)["fields"], "where": where}

    @classmethod
    def from_json(
        cls, data: Mapping[str, Any], where: Callable[[Any], Bool[Array, ""]] | None = None,
        distributions: Mapping[str, Distribution] | None = None,
    ) -> "FeatureSpace":  # fmt: skip
        """Build the space that `to_json` described; code is passed as arguments, never read.

        **Arguments:**
        - `data`: data returned by `to_json`.
        - `where`: the constraint, if the space has one.
        - `distributions`: distributions with their own functions, by name.
        **Raises:** `ValueError` for data that describes no space, or missing code.
        """
        if not isinstance(data, Mapping) or "features" not in data:
            raise ValueError(f"this does not describe a feature space: {data!r}")
        if data.get("where") is not None and where is None:
            raise ValueError(
                f"the constraint {data['where']} of this space is code, which JSON cannot contain; "
                "give it: from_json(data, where=...)"
            )
        root = from_plain({"kind": "Struct", "fields": data["features"]}, distributions)
        assert isinstance(root, Struct)
        return cls(dict(root.fields), where)

    def rows(self, features: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Convert features `[n, ...]` to columns `[n]` of a table, by name."""
        return self.root.to_columns(features, "")

    def from_row(self, row: Row) -> dict[str, Any]:
        """Convert a row of a table (a pandas row, or a mapping) to its features, exactly.

        Other columns are ignored; a value outside its domain is accepted.

        **Raises:** `ValueError` for a missing column, or an entry of the wrong type.
        """
        known = [str(column) for column in row.keys()]  # noqa: SIM118 - pandas iterates values
        present = set(known)
        for column in self.columns:
            if column not in present:
                raise unknown_name("column", column, known)
        return self.root.from_columns(row, "")

    def describe(self) -> str:
        """Describe the space, one line for each feature: name, domain and unit coordinates."""
        rows = self._summary()
        widths = [max(len(row[i]) for row in rows) for i in range(3)]
        return "\n".join(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        )

    def _point(self, features: Mapping[str, Any] | Row) -> Float[Array, " dim"]:
        """Return the point of these features, checked unless a system sees them so."""
        if isinstance(features, Row) and not isinstance(features, Mapping):
            features = self.from_row(features)  # Of pandas, which is not a mapping.
        leaves = jax.tree.leaves(features, is_leaf=lambda leaf: isinstance(leaf, list | tuple))
        if not all(isinstance(leaf, jax.Array) for leaf in leaves):
            self.root.check(self.completed(features), "")
        return self.flatten(features)

    def __getitem__(self, name: str) -> Domain:
        return self.root[name]

    def __eq__(self, other: object) -> bool:
        same = isinstance(other, FeatureSpace) and self.root == other.root
        return same and self.where == other.where  # pyright: ignore[reportAttributeAccessIssue]

    def __hash__(self) -> int:
        return hash((self.root, self.where))

    def __repr__(self) -> str:
        fields = [f"{name!r}: {domain!r}" for name, domain in self.root.fields]
        where = "" if self.where is None else f", where={_source(self.where)}"
        line = f"FeatureSpace({{{', '.join(fields)}}}{where})"
        if len(line) <= 88:
            return line
        return "FeatureSpace({\n" + "".join(f"    {field},\n" for field in fields) + f"}}{where})"

    def _repr_html_(self) -> str:
        header, *rows = self._summary()
        return rows_html(header, rows)

    def _summary(self) -> list[tuple[str, str, str]]:
        rows = [("feature", "domain", "coordinates")]
        for name, domain in self.root.fields:
            discrete = sum(level > 0 for level in domain.levels)
            counts = [(domain.size - discrete, "continuous"), (discrete, "discrete")]
            shown = ", ".join(f"{count} {kind}" for count, kind in counts if count)
            rows.append((name, repr(domain), shown or "none"))
        if self.where is not None:
            rows.append(("where", _source(self.where), ""))
        return rows


def _varied(domain: Domain) -> Domain:
    return domain.domain if isinstance(domain, Fixed) else domain


def _source(where: Callable[[Any], Bool[Array, ""]]) -> str:
    """Return the name of a constraint."""
    name = getattr(where, "__name__", type(where).__name__)
    if name == "<lambda>":
        code = where.__code__
        return f"lambda in line {code.co_firstlineno} of {Path(code.co_filename).name}"
    return name
