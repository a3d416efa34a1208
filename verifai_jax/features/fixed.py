"""Features held at one value (`Fixed`): those that a view of a space does not vary."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from verifai_jax.core.compute.precision import in_precision
from verifai_jax.features.domain import Domain, Row, as_scalar
from verifai_jax.features.english import number


@dataclass(frozen=True, init=False, repr=False)
class Fixed(Domain):
    """A domain fixed at one of its values: it keeps its table columns and has no coordinates.

    **Arguments:**
    - `domain`: the domain of the feature.
    - `value`: a value of the domain, as a user writes it.
    - `name`: the name of the feature, for messages.
    **Raises:** `ValueError` for a value outside the domain.
    """

    domain: Domain
    row: tuple[tuple[str, object], ...]  # The value as a row of a table, which can be compared.

    def __init__(self, domain: Domain, value: PyTree, name: str = "value") -> None:
        domain.check(value, name)
        object.__setattr__(self, "domain", domain)
        object.__setattr__(self, "row", _row(domain, value))

    @property
    def value(self) -> PyTree:
        """The value, as a system receives it."""
        return self.domain.from_columns(dict(self.row), "")

    @property
    def levels(self) -> tuple[int, ...]:
        return ()

    def coordinates(self, name: str) -> tuple[str, ...]:
        return ()

    def from_unit(self, u: Float[Array, "0"]) -> PyTree:
        def cast(leaf: Array) -> Array:
            real = jnp.issubdtype(leaf.dtype, jnp.floating)
            return leaf.astype(u.dtype) if real else leaf

        return self.domain.coerce(jax.tree.map(cast, self.value))

    @property
    def monotone(self) -> bool:
        return True

    def to_unit(self, value: PyTree) -> Float[Array, "0"]:
        return jnp.zeros(0, jnp.result_type(float))

    def coerce(self, value: PyTree) -> PyTree:
        return self.domain.coerce(value)

    def check(self, value: object, name: str) -> None:
        self.domain.check(value, name)
        # A row of a table has the number in the precision of its run.
        if _row(self.domain, value) != self.row and _row(self.domain, value, single=True) != _row(
            self.domain, self.value, single=True
        ):
            raise ValueError(f"{name} is fixed, {self._format()}; got {value!r}")

    def columns(self, name: str) -> tuple[str, ...]:
        return self.domain.columns(name)

    def to_columns(self, values: PyTree, name: str) -> dict[str, np.ndarray]:
        return self.domain.to_columns(values, name)

    def from_columns(self, row: Row, name: str) -> PyTree:
        return self.domain.from_columns(row, name)

    def refined(self, factor: int) -> "Fixed":
        return Fixed(self.domain.refined(factor), self.domain.refine(self.value, factor))

    def refine(self, value: PyTree, factor: int) -> PyTree:
        return self.domain.refine(value, factor)

    def _format(self) -> str:
        values = [value for _, value in self.row if value is not None]
        shown = [
            f"{value:z.4g}" if isinstance(value, float) else str(value) for value in values[:6]
        ]
        return f"{', '.join(shown)}{', ...' * (len(values) > 6)}"

    @property
    def held_at(self) -> PyTree:
        return self.value

    def words(self) -> str:
        values = ", ".join(number(value) for _, value in self.row)
        return f"fixed at {values}; otherwise {self.domain.words()}"

    def __repr__(self) -> str:
        return f"{self._format()}, fixed in {self.domain!r}"


def _row(domain: Domain, value: PyTree, single: bool = False) -> tuple[tuple[str, object], ...]:
    """Return a value as the table shows it, with None for absent items: NaN is not equal to NaN.

    In double precision as it was written, unless a `single` one is wanted.
    """
    with jax.ensure_compile_time_eval(), in_precision("float32" if single else "float64"):
        batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], domain.coerce(value))
        columns = domain.to_columns(batch, "")
    entries = ((column, as_scalar(column_entries[0])) for column, column_entries in columns.items())
    return tuple((column, None if entry != entry else entry) for column, entry in entries)
