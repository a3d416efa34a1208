"""How one feature varies: a domain maps unit coordinates to values and back.

    Box(-0.05, 0.05), Box([0, 0], [10, 5])              # box.py: a real number, a vector of two
    DiscreteBox(1, 4)                                   # box.py: an integer
    Categorical("ppo", "sac"), Constant(9.8)            # choice.py
    Array(Struct({"x": Box(0, 50), "v": Box(0, 20)}), length=3)             # compound.py
    Array(Box(0, 50), length=(1, 3))                                        # variable.py
    Normal(0, 1), TruncatedNormal(0, 1, -2, 2), LogUniform(0.05, 0.5)       # distributions.py
    Signal(Box(-1, 1), knots=16, hold="linear")                             # signal.py

The unit cube is the probability space: uniform coordinates give the prior on the values.
"""

import abc
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Cells narrower than this could not be told apart in a float32 coordinate.
MOST_LEVELS = 2**20
# Below, XLA takes numbers for zero.
LEAST_REAL = float(np.finfo(np.float32).tiny)
MOST_REAL = float(np.finfo(np.float32).max)


class Domain(abc.ABC):
    """Values of one feature, addressed by `size` coordinates in `[0, 1]`.

    Laws: `from_unit(to_unit(value))` is `value` (up to rounding in a `Box`);
    `to_unit(from_unit(u))` is `u` in a continuous coordinate and the middle of its cell in a
    discrete one. Both are pure JAX: they can be jitted, differentiated and vmapped.
    """

    @property
    @abc.abstractmethod
    def levels(self) -> tuple[int, ...]:
        """For each unit coordinate: 0 if continuous, or the number of its equally wide cells."""

    @abc.abstractmethod
    def from_unit(self, u: Float[Array, " size"]) -> Any:
        """The value at coordinates `u` in `[0, 1]`, both ends included; reals have `u`'s dtype."""

    @abc.abstractmethod
    def to_unit(self, value: Any) -> Float[Array, " size"]:
        """The coordinates of a value as `from_unit` gives it; cell centres where discrete."""

    @abc.abstractmethod
    def coerce(self, value: Any) -> Any:
        """What a person may write (a number, a list, a choice), as `from_unit` would give it.

        Leading axes are kept. Nothing is checked; see `check`.
        """

    @abc.abstractmethod
    def check(self, value: Any, name: str) -> None:
        """Raise `ValueError` unless this concrete value lies in the domain.

        - `name`: of the feature, for the message.
        """

    @abc.abstractmethod
    def columns(self, name: str) -> tuple[str, ...]:
        """Names of the table columns that hold the feature called `name`."""

    @abc.abstractmethod
    def to_columns(self, values: Any, name: str) -> dict[str, np.ndarray]:
        """A batch of values (leaves `[n, ...]`) as table columns `[n]`."""

    @abc.abstractmethod
    def from_columns(self, row: Mapping[str, Any], name: str) -> Any:
        """The value that a table row holds, exactly.

        **Raises:** `ValueError` for an entry that is no value of this kind.
        """

    @property
    def size(self) -> int:
        """Number of unit coordinates."""
        return len(self.levels)

    @property
    def weights(self) -> tuple[tuple[float, ...] | None, ...]:
        """For each unit coordinate the probabilities of its cells, their widths; None if equal."""
        return (None,) * self.size

    @property
    def ordered(self) -> tuple[bool, ...]:
        """For each unit coordinate whether its values have an order; choices have none."""
        return (True,) * self.size

    @property
    def lengths(self) -> tuple[int, ...]:
        """Which unit coordinates are lengths of arrays, on which others depend."""
        return ()

    @property
    def signals(self) -> tuple[tuple[int, ...], ...]:
        """The unit coordinates of each function of time, in the order of its control points."""
        return ()

    def coordinates(self, name: str) -> tuple[str, ...]:
        """What each unit coordinate of the feature called `name` is called."""
        return self.columns(name)

    def refined(self, factor: int) -> "Domain":
        """The same domain with finer signals, where it has any; see `Signal.refined`."""
        return self

    def refine(self, value: Any, factor: int) -> Any:
        """A value of this domain as one of `refined(factor)`."""
        return value


def cell(u: Float[Array, "*shape"], count: int) -> Any:
    """Which of `count` equally wide cells holds `u`, as `int32`; 1.0 is in the last one."""
    return jnp.clip((u * count).astype(jnp.int32), 0, count - 1)


def centre(index: Any, count: int) -> Float[Array, "1"]:
    """The middle of a cell."""
    return jnp.reshape((as_real(index) + 0.5) / count, (1,))


def as_real(value: Any) -> Float[Array, "*shape"]:
    """An array of floating-point numbers; integers and lists get JAX's default precision."""
    array = jnp.asarray(value)
    real = jnp.issubdtype(array.dtype, jnp.floating) and not array.weak_type
    return array if real else array.astype(jnp.result_type(float))


def as_number(value: Any, what: str) -> float:
    """One number; `what` names it in the error."""
    if not isinstance(value, bool | np.bool_ | str | bytes):
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            pass
    raise ValueError(f"{what} must be a number; got {value!r}")


def as_numbers(value: Any, name: str) -> np.ndarray:
    """A concrete number or an array of them, in float64; `name` names it in the error."""
    try:
        numbers = np.asarray(value)
        if numbers.dtype == object:
            numbers = numbers.astype(np.float64)
    except (TypeError, ValueError):
        numbers = np.asarray("")
    if numbers.dtype.kind not in "iufb":
        raise ValueError(f"{name} must be a number; got {value!r}")
    return numbers.astype(np.float64)


def as_scalar(value: Any) -> Any:
    """Plain Python instead of NumPy and JAX scalars."""
    if isinstance(value, np.generic | jax.Array | np.ndarray) and np.ndim(value) == 0:
        return value.item()
    return value


def as_tuple(value: Any) -> Any:
    """Nested tuples instead of nested lists."""
    return tuple(map(as_tuple, value)) if isinstance(value, list) else value


def indexed(name: str, count: int) -> tuple[str, ...]:
    """`name[0]`, `name[1]`, ..."""
    return tuple(f"{name}[{i}]" for i in range(count))


def dotted(name: str, field: str) -> str:
    """What a field of the feature called `name` is called."""
    return f"{name}.{field}" if name else field


def listed(choices: Sequence[Any]) -> str:
    """Choices for a message."""
    return ", ".join(map(repr, choices))


def short(value: Any) -> str:
    """A number, or a tuple of them, as a person would write it."""
    if isinstance(value, tuple):
        return "[" + ", ".join(map(short, value)) + "]"
    if isinstance(value, float) and value == int(value if math.isfinite(value) else 0):
        return repr(int(value)) if abs(value) < 1e15 else repr(value)
    return repr(value)
