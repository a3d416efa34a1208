"""Several features of one kind, in a fixed or a varying number (`Array`)."""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from verifai_jax.core.values.waveform import Waveform
from verifai_jax.features.domain import Domain, Row, as_numbers, cell, centre, dotted, indexed
from verifai_jax.features.facts import Facts, integer_facts


@dataclass(frozen=True, repr=False)
class Array(Domain):
    """`length` independent values of one domain: `Array(Box(0, 1), length=3)`.

    A value is stacked along a leading axis: an array `[length]` for a `Box`, a dictionary of such
    arrays for a `Struct`. With `length=(1, 3)` the number varies too; see `VariableArray`.

    **Arguments:**
    - `domain`: the domain of each value.
    - `length`: their number, or a pair with the smallest and the greatest number.
    **Raises:** `ValueError` for a length that is not a positive integer, or a pair that is not `0
    <= shortest <= longest` with `longest >= 1`; `TypeError` for a `domain` that is not a domain.
    """

    arguments = ("domain", "length")
    domain: Domain
    length: int

    @overload
    def __new__(cls, domain: Domain, length: int) -> "Array": ...
    @overload
    def __new__(cls, domain: Domain, length: tuple[int, int] | list[int]) -> "VariableArray": ...
    def __new__(cls, domain: Domain, length: object) -> "Array | VariableArray":
        if isinstance(length, tuple | list):
            return VariableArray(domain, *_ends(domain, length))
        return super().__new__(cls)

    def __getnewargs__(self) -> tuple[Domain, int]:
        return self.domain, self.length

    def __post_init__(self) -> None:
        _check_domain(self.domain)
        length = self.length
        if isinstance(length, bool) or not isinstance(length, int | np.integer) or length < 1:
            raise ValueError(f"the length of an Array must be a positive integer; got {length!r}")
        object.__setattr__(self, "length", int(length))

    @cached_property
    def levels(self) -> tuple[int, ...]:
        return self.domain.levels * self.length

    @property
    def weights(self) -> tuple[tuple[float, ...] | None, ...]:
        return self.domain.weights * self.length

    @property
    def ordered(self) -> tuple[bool, ...]:
        return self.domain.ordered * self.length

    @property
    def lengths(self) -> tuple[int, ...]:
        return _repeated(self.domain, self.length)

    @property
    def signals(self) -> tuple[tuple[int, ...], ...]:
        return _repeated_signals(self.domain, self.length)

    def coordinates(self, name: str) -> tuple[str, ...]:
        return tuple(
            label for item in indexed(name, self.length) for label in self.domain.coordinates(item)
        )

    def from_unit(self, u: Float[jax.Array, " size"]) -> PyTree:
        return jax.vmap(self.domain.from_unit)(u.reshape(self.length, self.domain.size))

    @property
    def monotone(self) -> bool:
        return self.domain.monotone

    def to_unit(self, value: PyTree) -> Float[jax.Array, " size"]:
        return jnp.ravel(jax.vmap(self.domain.to_unit, axis_size=self.length)(value))

    def coerce(self, value: PyTree) -> PyTree:
        if _is_stacked(value):
            return self.domain.coerce(value)
        # As a person wrote it, which one item may do in another form than the next.
        items = [_element(value, i, self.length, "the array") for i in range(self.length)]
        return _stacked([self.domain.coerce(item) for item in items])

    def check(self, value: object, name: str) -> None:
        for i in range(self.length):
            self.domain.check(_element(value, i, self.length, name), f"{name}[{i}]")

    def columns(self, name: str) -> tuple[str, ...]:
        return tuple(
            column for item in indexed(name, self.length) for column in self.domain.columns(item)
        )

    def to_columns(self, values: PyTree, name: str) -> dict[str, np.ndarray]:
        columns: dict[str, np.ndarray] = {}
        for i, item in enumerate(indexed(name, self.length)):
            element = jax.tree.map(operator.itemgetter((slice(None), i)), values)
            columns |= self.domain.to_columns(element, item)
        return columns

    def from_columns(self, row: Row, name: str) -> PyTree:
        return _stacked(
            [self.domain.from_columns(row, item) for item in indexed(name, self.length)]
        )

    def refined(self, factor: int) -> "Array":
        return Array(self.domain.refined(factor), self.length)

    def refine(self, value: PyTree, factor: int) -> PyTree:
        return jax.vmap(lambda item: self.domain.refine(item, factor), axis_size=self.length)(value)

    def words(self) -> str:
        return f"{self.length} items, each {self.domain.words()}"

    @property
    def uniform(self) -> bool:
        return self.domain.uniform

    def parts(self, name: str) -> tuple[tuple[str, Domain], ...]:
        return tuple((item, self.domain) for item in indexed(name, self.length))

    def __repr__(self) -> str:
        return f"Array({self.domain!r}, length={self.length})"


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Items:
    """The value of an array of variable length: entries, of which the first `length` are valid.

    - `values`: stacked along a leading axis as in an `Array` of the greatest length, so that every
      simulation has the same shapes. Entries after the length hold the middle of the item's domain.
    - `length`: the number of valid items.

    `features["cars"]["x"]` is the `x` of all entries; multiply it by `mask`, or use `jnp.where`.
    """

    values: PyTree
    length: Int[jax.Array, "*n"] | PyTree  # Any leaf while JAX maps over it.

    @property
    def mask(self) -> Bool[jax.Array, "*n entries"]:
        """True for the entries that hold an item."""
        count = jax.tree.leaves(self.values)[0].shape[jnp.ndim(self.length)]
        return jnp.arange(count) < jnp.asarray(self.length)[..., None]

    def __getitem__(self, name: str | int) -> PyTree:
        return self.values[name]

    def cleared(self, absent: PyTree) -> "Items":
        """Return the same items, with `absent` as the entries after the length."""
        mask, axes = self.mask, jnp.ndim(self.length) + 1

        def clear(leaf: jax.Array, rest: jax.Array) -> jax.Array:
            counts = jnp.expand_dims(mask, tuple(range(axes, jnp.ndim(leaf))))
            return jnp.where(counts, leaf, jnp.asarray(rest, leaf.dtype))

        return Items(jax.tree.map(clear, self.values, absent), self.length)


@dataclass(frozen=True, repr=False)
class VariableArray(Domain):
    """From `shortest` to `longest` values of one domain: `Array(domain, length=(1, 3))`.

    A value is an `Items`; users may write a list of items. The first coordinate is the length, with
    equally likely values; there is none if `shortest == longest`. In a table the column
    `cars.length` holds the length; the entries of absent items are empty (NaN or None).
    """

    domain: Domain
    shortest: int
    longest: int

    @property
    def _varies(self) -> bool:
        return self.longest > self.shortest

    @cached_property
    def levels(self) -> tuple[int, ...]:
        length = (self.longest - self.shortest + 1,) if self._varies else ()
        return length + self.domain.levels * self.longest

    @property
    def weights(self) -> tuple[tuple[float, ...] | None, ...]:
        return (None,) * self._varies + self.domain.weights * self.longest

    @property
    def ordered(self) -> tuple[bool, ...]:
        return (True,) * self._varies + self.domain.ordered * self.longest

    @property
    def lengths(self) -> tuple[int, ...]:
        inner = _repeated(self.domain, self.longest)
        return (0,) * self._varies + tuple(self._varies + i for i in inner)

    @property
    def signals(self) -> tuple[tuple[int, ...], ...]:
        inner = _repeated_signals(self.domain, self.longest)
        return tuple(tuple(self._varies + i for i in signal) for signal in inner)

    def coordinates(self, name: str) -> tuple[str, ...]:
        items = indexed(name, self.longest)
        labels = tuple(label for item in items for label in self.domain.coordinates(item))
        return (f"{name}.length",) * self._varies + labels

    def from_unit(self, u: Float[jax.Array, " size"]) -> Items:
        length = self.shortest + (cell(u[0], self.levels[0]) if self._varies else jnp.int32(0))
        units = u[int(self._varies) :].reshape(self.longest, self.domain.size)
        present = jnp.arange(self.longest) < length
        units = jnp.where(present[:, None], units, 0.5)
        return Items(jax.vmap(self.domain.from_unit)(units), length)

    def to_unit(self, value: Items) -> Float[jax.Array, " size"]:
        units = jax.vmap(self.domain.to_unit, axis_size=self.longest)(value.values)
        present = jnp.arange(self.longest) < value.length
        units = jnp.ravel(jnp.where(present[:, None], units, self._absent_unit))
        if not self._varies:
            return units
        return jnp.concatenate([centre(value.length - self.shortest, self.levels[0]), units])

    def coerce(self, value: PyTree) -> "Items":
        if isinstance(value, Items):
            items = Items(self.domain.coerce(value.values), jnp.asarray(value.length, jnp.int32))
            # Whatever stands after the length must not make two of the same value.
            return items.cleared(self._absent)
        items = [self.domain.coerce(item) for item in _items(value, "the array")]
        length = jnp.asarray(len(items), jnp.int32)
        items += [self._absent] * (self.longest - len(items))
        return Items(_stacked(items), length)

    def check(self, value: object, name: str) -> None:
        if isinstance(value, Items):
            length = int(value.length)
            items = [
                jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], value.values)
                for i in range(min(length, self.longest))
            ]
        else:
            items = _items(value, name)
            length = len(items)
        if not self.shortest <= length <= self.longest:
            raise ValueError(
                f"{name} must have {self.shortest} to {self.longest} items; got {length}"
            )
        for i, item in enumerate(items):
            self.domain.check(item, f"{name}[{i}]")

    def columns(self, name: str) -> tuple[str, ...]:
        items = indexed(name, self.longest)
        columns = tuple(column for item in items for column in self.domain.columns(item))
        return (f"{name}.length",) * self._varies + columns

    def to_columns(self, values: Items, name: str) -> dict[str, np.ndarray]:
        length = np.asarray(values.length)
        columns: dict[str, np.ndarray] = {f"{name}.length": length} if self._varies else {}
        for i, item in enumerate(indexed(name, self.longest)):
            element = jax.tree.map(operator.itemgetter((slice(None), i)), values.values)
            for column, entries in self.domain.to_columns(element, item).items():
                columns[column] = entries if i < self.shortest else _emptied(entries, length <= i)
        return columns

    def from_columns(self, row: Row, name: str) -> Items:
        length = self.shortest
        if self._varies:
            number = as_numbers(row[f"{name}.length"], f"{name}.length").item()
            if number not in range(self.shortest, self.longest + 1):
                raise ValueError(
                    f"{name}.length must be an integer from {self.shortest} to {self.longest}; "
                    f"got {number!r}"
                )
            length = int(number)
        items = [
            self.domain.from_columns(row, item) if i < length else self._absent
            for i, item in enumerate(indexed(name, self.longest))
        ]
        return Items(_stacked(items), jnp.asarray(length, jnp.int32))

    @property
    def sequences(self) -> tuple[tuple[int, int, int, int], ...]:
        return ((0, 1, self.domain.size, self.longest),) if self._varies else ()

    @property
    def items(self) -> int:
        return self.longest * self._varies

    def without(
        self, u: Float[jax.Array, " size"], drop: Bool[jax.Array, " items"]
    ) -> Float[jax.Array, " size"]:
        if not self._varies:
            return u
        length = self.shortest + cell(u[0], self.levels[0])
        stays = (jnp.arange(self.longest) < length) & ~drop
        order = jnp.argsort(~stays, stable=True)
        units = u[1:].reshape(self.longest, self.domain.size)[order]
        fewer = jnp.maximum(jnp.sum(stays), self.shortest)
        unit = centre(fewer - self.shortest, self.levels[0]).astype(u.dtype)
        return self.settled(jnp.concatenate([unit, jnp.ravel(units)]))

    def settled(self, u: Float[jax.Array, " size"]) -> Float[jax.Array, " size"]:
        if not self._varies:
            return u
        length = self.shortest + cell(u[0], self.levels[0])
        units = u[1:].reshape(self.longest, self.domain.size)
        present = jnp.arange(self.longest)[:, None] < length
        own = jax.vmap(self.domain.settled, axis_size=self.longest)(units)
        absent = self._absent_unit.astype(u.dtype)
        return jnp.concatenate([u[:1], jnp.ravel(jnp.where(present, own, absent))])

    def used(self, u: Float[jax.Array, " size"]) -> Bool[jax.Array, " size"]:
        length = self.shortest + (cell(u[0], self.levels[0]) if self._varies else 0)
        units = u[int(self._varies) :].reshape(self.longest, self.domain.size)
        own = jax.vmap(self.domain.used, axis_size=self.longest)(units)
        mine = jnp.ravel(own & (jnp.arange(self.longest)[:, None] < length))
        return jnp.concatenate([jnp.ones(int(self._varies), bool), mine])

    def refined(self, factor: int) -> "VariableArray":
        return VariableArray(self.domain.refined(factor), self.shortest, self.longest)

    def refine(self, value: Items, factor: int) -> Items:
        finer = jax.vmap(lambda item: self.domain.refine(item, factor), axis_size=self.longest)
        return Items(finer(value.values), value.length)

    @property
    def _absent(self) -> PyTree:
        """The value of an entry after the length."""
        return self.domain.from_unit(jnp.full(self.domain.size, 0.5))

    @property
    def _absent_unit(self) -> Float[jax.Array, " size"]:
        return self.domain.to_unit(self._absent)

    def words(self) -> str:
        return f"{self.shortest} to {self.longest} items, each {self.domain.words()}"

    def parts(self, name: str) -> tuple[tuple[str, Domain], ...]:
        return tuple((item, self.domain) for item in indexed(name, self.longest))

    def facts(self, name: str) -> Facts:
        length = {**integer_facts(self.shortest, self.longest), "length": True}
        return {**({f"{name}.length": length} if self._varies else {}), **super().facts(name)}

    def __repr__(self) -> str:
        return f"Array({self.domain!r}, length=({self.shortest}, {self.longest}))"


def _is_stacked(value: PyTree) -> bool:
    """Return whether this is a value as `from_unit` gives it, and not one that a person wrote."""
    leaves = jax.tree.leaves(value, is_leaf=lambda leaf: isinstance(leaf, list | tuple))
    return all(isinstance(leaf, jax.Array) for leaf in leaves)


def _stacked(items: list[PyTree]) -> PyTree:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)


def _check_domain(domain: object) -> None:
    if not isinstance(domain, Domain):
        raise TypeError(f"an Array needs a domain, such as Box(0, 1); got {domain!r}")


def _ends(domain: object, length: tuple | list) -> tuple[int, int]:
    _check_domain(domain)
    whole = all(isinstance(n, int | np.integer) and not isinstance(n, bool) for n in length)
    if len(length) != 2 or not whole:
        raise ValueError(
            f"a variable length is a pair of integers, (shortest, longest); got {length!r}"
        )
    shortest, longest = int(length[0]), int(length[1])
    if not (0 <= shortest <= longest and longest >= 1):
        raise ValueError(
            f"a variable length needs 0 <= shortest <= longest and longest >= 1; got {length!r}"
        )
    return shortest, longest


def _repeated_signals(domain: Domain, times: int) -> tuple[tuple[int, ...], ...]:
    return tuple(
        tuple(item * domain.size + i for i in signal)
        for item in range(times)
        for signal in domain.signals
    )


def _repeated(domain: Domain, count: int) -> tuple[int, ...]:
    return tuple(i * domain.size + index for i in range(count) for index in domain.lengths)


def _emptied(entries: np.ndarray, absent: np.ndarray) -> np.ndarray:
    """Return entries with empty ones where absent, in one dtype whether or not there are such."""
    if entries.dtype.kind in "iub":
        entries = entries.astype(np.float64)
    emptied = entries.copy()
    emptied[absent] = np.nan if entries.dtype.kind == "f" else None
    return emptied


def _items(value: PyTree, name: str) -> list[PyTree]:
    """Return the items that a person wrote: one by one, or stacked as in an `Array`."""
    if isinstance(value, Mapping):
        leaves = list(value.values())
        count = len(leaves[0]) if leaves and isinstance(leaves[0], Sequence | np.ndarray) else -1
        return [_element(value, i, count, name) for i in range(count)]
    if isinstance(value, str) or np.ndim(np.asarray(value, dtype=object)) == 0:
        raise ValueError(f"{name} must be a list of items; got {value!r}")
    return list(value)


def _element(value: PyTree, i: int, length: int, name: str) -> PyTree:
    """Return element `i` of a stacked value."""
    if isinstance(value, Mapping):
        return {
            field: _element(leaf, i, length, dotted(name, field)) for field, leaf in value.items()
        }
    if isinstance(value, Items | Waveform):
        return jax.tree.map(operator.itemgetter(i), value)
    if np.ndim(np.asarray(value, dtype=object)) == 0 or len(value) != length:
        raise ValueError(f"{name} must have {length} entries; got {value!r}")
    return value[i]
