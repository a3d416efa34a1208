"""Several domains under names (`Struct`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, groupby

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from verifai_jax.core.messages.checks import check_name
from verifai_jax.core.messages.errors import check_names
from verifai_jax.features.box import Box
from verifai_jax.features.domain import Domain, Row, dotted


@dataclass(frozen=True, init=False, repr=False)
class Struct(Domain):
    """Domains under names, in the order written: `Struct({"x": Box(0, 50), "v": Box(0, 20)})`.

    A value is a dictionary with these names.

    **Arguments:**
    - `fields`: name -> `Domain`, in the order in which coordinates and columns come.
    **Raises:** `ValueError` for no fields, or a name that is empty or not a text; `TypeError` for a
    field that is not a domain.
    """

    fields: tuple[tuple[str, Domain], ...]

    def __init__(self, fields: Mapping[str, Domain]) -> None:
        if not isinstance(fields, Mapping):
            raise TypeError(f"fields are given as a dictionary of domains; got {fields!r}")
        if not fields:
            raise ValueError("at least one field is needed; got none")
        for name, domain in fields.items():
            if not isinstance(name, str) or not name.strip():
                raise ValueError(f"the name of a field must be a text; got {name!r}")
            check_name("the name of a field", name)
            if isinstance(domain, Mapping):
                raise TypeError(f"{name} must be a domain; a dictionary of them goes into Struct")
            if not isinstance(domain, Domain):
                raise TypeError(f"{name} must be a domain, such as Box(0, 1); got {domain!r}")
        object.__setattr__(self, "fields", tuple(fields.items()))

    @cached_property
    def levels(self) -> tuple[int, ...]:
        return tuple(level for _, domain in self.fields for level in domain.levels)

    @property
    def weights(self) -> tuple[tuple[float, ...] | None, ...]:
        return tuple(weights for _, domain in self.fields for weights in domain.weights)

    @property
    def ordered(self) -> tuple[bool, ...]:
        return tuple(ordered for _, domain in self.fields for ordered in domain.ordered)

    @property
    def lengths(self) -> tuple[int, ...]:
        return tuple(start + i for start, domain in self._placed for i in domain.lengths)

    @cached_property
    def signals(self) -> tuple[tuple[int, ...], ...]:
        return tuple(
            tuple(start + i for i in signal)
            for start, domain in self._placed
            for signal in domain.signals
        )

    def coordinates(self, name: str) -> tuple[str, ...]:
        return self._texts(name, lambda domain, field: domain.coordinates(field))

    def labels(self, name: str, duration: float | None = None) -> tuple[str, ...]:
        return self._texts(name, lambda domain, field: domain.labels(field, duration))

    def __getitem__(self, name: str) -> Domain:
        check_names("feature", [name], self.names)
        return dict(self.fields)[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fields, in the order written."""
        return tuple(name for name, _ in self.fields)

    def from_unit(self, u: Float[jax.Array, " size"]) -> dict[str, PyTree]:
        value, start = {}, 0
        for names, domain in self._runs:
            part = domain.from_unit(u[start : start + domain.size])
            value.update([(names[0], part)] if len(names) == 1 else zip(names, part, strict=True))
            start += domain.size
        return value

    @property
    def monotone(self) -> bool:
        return all(domain.monotone for _, domain in self.fields)

    def to_unit(self, value: Mapping[str, PyTree]) -> Float[jax.Array, " size"]:
        parts = [
            domain.to_unit(
                value[names[0]] if len(names) == 1 else jnp.stack([value[name] for name in names])
            )
            for names, domain in self._runs
        ]
        return jnp.concatenate(parts)

    def coerce(self, value: Mapping[str, PyTree]) -> dict[str, PyTree]:
        return {name: domain.coerce(value[name]) for name, domain in self.fields}

    def check(self, value: object, name: str) -> None:
        if not isinstance(value, Mapping):
            raise ValueError(f"{name or 'features'} must be a dictionary; got {value!r}")
        check_names("feature", [dotted(name, field) for field in value], self._dotted_names(name))
        for field, domain in self.fields:
            if field not in value:
                raise ValueError(f"{dotted(name, field)} is missing; got {', '.join(value)}")
            domain.check(value[field], dotted(name, field))

    def columns(self, name: str) -> tuple[str, ...]:
        return self._texts(name, lambda domain, field: domain.columns(field))

    def to_columns(self, values: Mapping[str, PyTree], name: str) -> dict[str, np.ndarray]:
        columns: dict[str, np.ndarray] = {}
        for field, domain in self.fields:
            columns |= domain.to_columns(values[field], dotted(name, field))
        return columns

    def from_columns(self, row: Row, name: str) -> dict[str, PyTree]:
        return {
            field: domain.from_columns(row, dotted(name, field)) for field, domain in self.fields
        }

    @property
    def sequences(self) -> tuple[tuple[int, int, int, int], ...]:
        return tuple(
            (start + length, start + first, width, count)
            for start, domain in self._placed
            for length, first, width, count in domain.sequences
        )

    @property
    def items(self) -> int:
        return sum(domain.items for _, domain in self.fields)

    def without(
        self, u: Float[jax.Array, " size"], drop: Bool[jax.Array, " items"]
    ) -> Float[jax.Array, " size"]:
        parts, first = [u[:0]], 0
        for start, domain in self._placed:
            own, gone = u[start : start + domain.size], drop[first : first + domain.items]
            parts.append(domain.without(own, gone))
            first += domain.items
        return jnp.concatenate(parts)

    def settled(self, u: Float[jax.Array, " size"]) -> Float[jax.Array, " size"]:
        parts = [d.settled(u[start : start + d.size]) for start, d in self._placed]
        return jnp.concatenate([u[:0], *parts])

    def used(self, u: Float[jax.Array, " size"]) -> Bool[jax.Array, " size"]:
        parts = [d.used(u[start : start + d.size]) for start, d in self._placed]
        return jnp.concatenate([jnp.ones(0, bool), *parts])

    @property
    def coverage_id_count(self) -> int:
        return sum(domain.coverage_id_count for _, domain in self.fields)

    def coverage_ids(self, value: Mapping[str, PyTree]) -> Int[jax.Array, " ids"]:
        parts, start = [jnp.zeros(0, jnp.int32)], 0
        for name, domain in self.fields:
            own = domain.coverage_ids(value[name])
            parts.append(jnp.where(own >= 0, own + start, own))
            start += domain.coverage_id_count
        return jnp.concatenate(parts)

    def refined(self, factor: int) -> "Struct":
        return Struct({name: domain.refined(factor) for name, domain in self.fields})

    def refine(self, value: Mapping[str, PyTree], factor: int) -> dict[str, PyTree]:
        return {name: domain.refine(value[name], factor) for name, domain in self.fields}

    @cached_property
    def _runs(self) -> tuple[tuple[tuple[str, ...], Domain], ...]:
        """Fields, with neighbouring scalar boxes merged into a vector: 200 cost one operation."""
        runs: list[tuple[tuple[str, ...], Domain]] = []
        for closed, group in groupby(self.fields, lambda field: _scalar_box_closed(field[1])):
            names, domains = zip(*group, strict=True)
            if closed is not None and len(names) > 1:
                low, high = ([getattr(box, end) for box in domains] for end in ("low", "high"))
                runs.append((names, Box(low, high, closed)))
            else:
                runs += [((name,), domain) for name, domain in zip(names, domains, strict=True)]
        return tuple(runs)

    @cached_property
    def _placed(self) -> tuple[tuple[int, Domain], ...]:
        """The first coordinate of each field, and its domain."""
        domains = [domain for _, domain in self.fields]
        return tuple(zip(accumulate((d.size for d in domains), initial=0), domains, strict=False))

    def _texts(self, name: str, of: Callable[[Domain, str], tuple[str, ...]]) -> tuple[str, ...]:
        """Return texts of all fields, each by its domain and its full name."""
        return tuple(text for field, part in self.parts(name) for text in of(part, field))

    def _dotted_names(self, name: str) -> list[str]:
        return [dotted(name, field) for field, _ in self.fields]

    def words(self) -> str:
        return "; ".join(f"{name}: {field.words()}" for name, field in self.fields)

    @property
    def uniform(self) -> bool:
        return all(part.uniform for _, part in self.fields)

    @property
    def named(self) -> tuple[tuple[str, Domain], ...]:
        return self.fields

    def parts(self, name: str) -> tuple[tuple[str, Domain], ...]:
        return tuple((dotted(name, field), part) for field, part in self.fields)

    def __repr__(self) -> str:
        fields = ", ".join(f"{name!r}: {domain!r}" for name, domain in self.fields)
        return f"Struct({{{fields}}})"


def _scalar_box_closed(domain: Domain) -> str | None:
    """Return which ends of a box of numbers belong to it; None for any other domain."""
    return domain.closed if isinstance(domain, Box) and np.ndim(domain.low) == 0 else None
