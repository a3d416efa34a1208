"""The operational design domain as a file: `vj.read_odd`.

    domain = vj.read_odd("domain.yaml")
    problem = vj.Problem("brake", domain.space(), system, formula)
    print(domain.coverage(run))                         # and .next_points(10)

The file is YAML of ASAM OpenODD 1.0, or a file that names such files and maps features of a problem
to their attributes, with units, reasons and sources:

    openodd: [odd.yaml]
    features:
      speed: {attribute: dynamic.ego_speed, unit: m/s, reason: limit of the road, source: StVO 3}
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from verifai_jax.addons.analysis.data.samples import Source
from verifai_jax.addons.assurance import odd_conditions
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_files import write_yaml
from verifai_jax.core.user_code.sources import Source as HashedFile
from verifai_jax.features import Box, Categorical, DiscreteBox, Domain, FeatureSpace


@dataclass(frozen=True, eq=False)
class OperationalDomain:
    """An operational design domain, as `read_odd` reads it.

    - `name`: the name of the domain.
    - `attributes`: its attributes, in the order of the taxonomy.
    - `modules`: its modules by name; those in `roots` have to hold.
    - `document`: the tree of the file, from which `write` writes.
    - `files`: the files that it was read from, with their hashes.
    """

    name: str
    attributes: tuple[odd_conditions.Attribute, ...]
    modules: Mapping[str, odd_conditions.Module] = field(repr=False)
    roots: tuple[str, ...]
    document: Mapping[str, Any] = field(repr=False)
    files: tuple[HashedFile, ...] = field(default=(), repr=False, compare=False)

    @property
    def features(self) -> dict[str, odd_conditions.Attribute]:
        """The attributes that features vary, by feature."""
        return {each.feature: each for each in self.attributes if each.feature}

    @property
    def units(self) -> dict[str, str]:
        """The units of features, as `run.report(units=...)` takes them."""
        return {name: each.unit for name, each in self.features.items() if each.unit}

    @property
    def reasons(self) -> dict[str, str]:
        """The reasons of features with their sources, as `run.report(reasons=...)` takes them."""
        said = {name: (each.reason, each.source) for name, each in self.features.items()}
        return {name: ", ".join(filter(None, each)) for name, each in said.items() if any(each)}

    def hull(self, attribute: odd_conditions.Attribute) -> odd_conditions.Hull:
        """Return the interval, or the indices of literals, of an attribute inside the domain."""
        hulls = (odd_conditions.hull_of(attribute, name, self.modules) for name in self.roots)
        return reduce(odd_conditions.both, hulls, attribute.everything)

    def holds(self, rows: pd.DataFrame | Mapping[str, Any]) -> Bool[np.ndarray, " n"]:
        """Return which rows of features lie inside; conditions on missing columns are ignored."""
        frame = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame([dict(rows)])
        found = self._inside(self.values(frame))
        return np.broadcast_to(np.asarray(found, bool), len(frame))

    def values(self, frame: pd.DataFrame) -> dict[str, Float[np.ndarray, " n"]]:
        """Return the attributes' values in rows of features; literals by index, -1 if unknown."""
        found = {}
        for name, each in self.features.items():
            if name not in frame:
                continue
            column = frame[name]
            if each.literals:
                codes = {literal: index for index, literal in enumerate(each.literals)}
                texts = [odd_conditions.written(value) for value in column]
                found[each.name] = np.array([codes.get(text, -1) for text in texts], float)
            else:
                found[each.name] = column.to_numpy(float)
        return found

    def _inside(self, values: odd_conditions.Values) -> Any:
        found: Any = True
        for name in self.roots:
            found = found & odd_conditions.module_holds(name, values, self.modules, unknown=True)
        return found

    @property
    def is_box(self) -> bool:
        """True if no condition couples attributes, so that the domain is a product."""
        each = [condition for name in self.roots for condition in self.modules[name].conditions()]
        groups = [condition for condition in each if isinstance(condition, odd_conditions.Group)]
        tests = [condition for condition in each if isinstance(condition, odd_conditions.Test)]
        plain = all(self.modules[name].exclude is None for name in self.roots)
        simple = all(group.every for group in groups) and len(groups) + len(tests) == len(each)
        return plain and simple and not any(test.strict for test in tests)

    def space(self) -> FeatureSpace:
        """Return the features, uniform over the domain.

        **Raises:** `ValueError` for an attribute that the domain leaves unbounded or empty.
        """
        domains: dict[str, Domain] = {}
        for name, each in self.features.items():
            values = choices_of(each, self.hull(each))
            if isinstance(values, list):
                domains[name] = Categorical(*values)
            else:
                low, high = values
                whole = each.kind == "integer"
                domains[name] = DiscreteBox(int(low), int(high)) if whole else Box(low, high)
        return FeatureSpace(domains, None if self.is_box else self._accepts)

    def _accepts(self, features: Mapping[str, Any]) -> Any:
        values = {}
        for name, each in self.features.items():
            value, hull = features[name], self.hull(each)
            if isinstance(hull, frozenset) and each.kind != "boolean":
                value = jnp.asarray(sorted(hull))[value]  # An index among the allowed ones.
            values[each.name] = value
        return self._inside(values)

    def coverage(self, source: Source, *, cells: int = 10, seed: int = 0) -> Any:
        """Measure how much of the domain rows cover; see `odd_coverage.odd_coverage`."""
        measure = lazy_import("verifai_jax.addons.assurance.odd_coverage", "odd_coverage")
        return measure(self, source, cells=cells, seed=seed)

    def write(self, path: str | Path) -> Path:
        """Write the domain as OpenODD's YAML, which `read_odd` reads again."""
        with replacing(path) as partial:
            partial.write_text(write_yaml(dict(self.document)), encoding="utf-8")
        return Path(path)

    def __str__(self) -> str:
        lines = [f"{self.name}: {len(self.attributes)} attributes, inside where "
                 f"{' and '.join(self.roots) or 'anything'} holds"]  # fmt: skip
        for each in self.attributes:
            feature = f"feature {each.feature}" if each.feature else "no feature"
            lines.append(f"  {each.name}: {words(each, self.hull(each))}, {feature}")
        return "\n".join(lines)


def choices_of(
    attribute: odd_conditions.Attribute, hull: odd_conditions.Hull
) -> tuple[float, float] | list[str] | list[bool]:
    """Return the ends of an attribute's interval, which must have some, or its literals."""
    if isinstance(hull, frozenset):
        found = [attribute.literals[code] for code in sorted(hull)]
        if not found:
            raise ValueError(f"no value of {attribute.name} is inside the domain")
        return [each == "true" for each in found] if attribute.kind == "boolean" else found
    low, high = hull
    if attribute.kind == "integer":
        low, high = np.ceil(low), np.floor(high)
    if not np.isfinite([low, high]).all() or low > high or attribute.kind == "string":
        raise ValueError(
            f"{attribute.name} has no range in the domain ({words(attribute, hull)}): a module "
            'bounds it, INCLUDE_AND: {NAME: "[low .. high] unit"}'
        )
    return (int(low), int(high)) if attribute.kind == "integer" else (low, high)


def words(attribute: odd_conditions.Attribute, hull: odd_conditions.Hull) -> str:
    """Write the values of an attribute."""
    if isinstance(hull, frozenset):
        return ", ".join(attribute.literals[code] for code in sorted(hull)) or "nothing"
    return " ".join(filter(None, (f"{hull[0]:zg} to {hull[1]:zg}", attribute.unit)))
