"""Domains of single features: maps from unit coordinates to values and back.

    Box(-0.05, 0.05), Box([0, 0], [10, 5])              # box.py: a real number, a vector of two
    DiscreteBox(1, 4), DiscreteBox([0, 0], [3, 5])      # box.py: an integer, a vector of two
    Categorical("ppo", "sac"), Constant(9.8)            # choice.py
    Array(Struct({"x": Box(0, 50), "v": Box(0, 20)}), length=3)             # compound.py, arrays.py

The unit cube is the probability space: uniform coordinates give the prior on the values.
"""

import abc
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Decimal
from fractions import Fraction
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, TypeAlias, TypeVar
from typing import runtime_checkable as checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import dtypes
from jaxtyping import Array, Bool, Float, Int, PyTree

from verifai_jax.core.display.notebook import ForUsers
from verifai_jax.core.messages.text import one_line
from verifai_jax.features.facts import Facts, drawn_facts

MAX_LEVELS = 2**20
"""Cells of a coordinate at most: narrower ones are not distinct in a float32 coordinate."""
MIN_REAL = float(np.finfo(np.float32).tiny)
"""Smallest normal float32 number: XLA treats smaller ones as zero."""
MAX_REAL = float(np.finfo(np.float32).max)
"""Largest float32 number."""
Numbers: TypeAlias = float | Sequence | np.generic | np.ndarray | jax.Array
"""A number or an array of them, as a person, a table or a system writes it."""
Value = TypeVar("Value")


@checkable
class Row(Protocol):
    """A row of a table: a mapping, or a row of pandas."""

    def keys(self) -> Iterable[str]:
        """Return the names of the columns."""
        ...

    def __getitem__(self, key: str, /) -> Any:
        """Return the entry of a column."""
        ...


class Tuning(NamedTuple):
    """One number or choice, in the terms of tools that tune hyper-parameters.

    - `scale`: `"linear"`, `"log"` or `"integer"` for values uniform between the ends on that scale,
      `"choice"`, or `"other"` for anything that such tools lack.
    - `low`, `high`: the ends as they were written, not rounded to float32.
    - `choices`: the possible choices.
    """

    scale: Literal["linear", "log", "integer", "choice", "other"]
    low: Any = None
    high: Any = None
    choices: tuple[object, ...] = ()


class Domain(ForUsers, abc.ABC):
    """Values of one feature, addressed by `size` coordinates in `[0, 1]`.

    Laws: `from_unit(to_unit(value))` is `value` (up to rounding in a `Box`);
    `to_unit(from_unit(u))` is `u` in a continuous coordinate and the middle of its cell in a
    discrete one. Both are pure JAX, so they can be jitted, differentiated and vmapped.
    """

    _internal = frozenset((
        "arguments", "check_reachable", "closed", "coerce", "coordinates", "ends", "facts",
        "from_columns", "graph", "held_at", "items", "labels", "lengths", "levels", "monotone",
        "coverage_id_count", "coverage_ids", "from_plain", "named", "nominal", "numeric", "ordered",
        "parts", "plain", "refine", "refined", "rounded", "sequences", "settled", "signals",
        "spans", "tail", "tailed", "to_columns", "tuning", "uniform", "used", "weights", "without",
        "words", "words_for",
    ))  # fmt: skip
    arguments: ClassVar[tuple[str, ...] | None] = None
    """Attributes from which it can be rebuilt; None for a domain defined by a user."""

    def __repr__(self) -> str:
        if self.arguments is None:
            return super().__repr__()
        given = ", ".join(short(getattr(self, name)) for name in self.arguments)
        return f"{type(self).__name__}({given})"

    @property
    @abc.abstractmethod
    def levels(self) -> tuple[int, ...]:
        """Number of cells of each unit coordinate; 0 if it is continuous."""

    @abc.abstractmethod
    def from_unit(self, u: Float[Array, " size"]) -> PyTree:
        """Return the value at coordinates `u` in `[0, 1]`, both ends included.

        Real numbers have the dtype of `u`.
        """

    @abc.abstractmethod
    def to_unit(self, value: PyTree) -> Float[Array, " size"]:
        """Return the coordinates of a value, as `from_unit` gives it; cell centres if discrete."""

    @abc.abstractmethod
    def coerce(self, value: PyTree) -> PyTree:
        """Convert a value as a user writes it (number, list, choice) to the form of `from_unit`.

        Leading axes are kept. Nothing is checked; see `check`.
        """

    @abc.abstractmethod
    def check(self, value: object, name: str) -> None:
        """Check that a concrete value lies in the domain.

        **Arguments:**
        - `value`: a value as returned by `from_unit`, or as a user writes it.
        - `name`: the name of the feature, for the message.
        **Raises:** `ValueError` for a value outside the domain, or of another type.
        """

    @abc.abstractmethod
    def columns(self, name: str) -> tuple[str, ...]:
        """Return the names of the table columns that hold the feature called `name`."""

    @abc.abstractmethod
    def to_columns(self, values: PyTree, name: str) -> dict[str, np.ndarray]:
        """Return a batch of values (leaves `[n, ...]`) as table columns `[n]`."""

    @abc.abstractmethod
    def from_columns(self, row: Row, name: str) -> PyTree:
        """Return the exact value stored in a table row.

        **Raises:** `ValueError` for an entry that is not a value of this domain's type.
        """

    @property
    def size(self) -> int:
        """Number of unit coordinates."""
        return len(self.levels)

    @property
    def weights(self) -> tuple[tuple[float, ...] | None, ...]:
        """Probabilities (widths) of the cells of each unit coordinate; None if they are equal."""
        return (None,) * self.size

    @property
    def ordered(self) -> tuple[bool, ...]:
        """For each unit coordinate, True if its values have an order; choices have none."""
        return (True,) * self.size

    @property
    def lengths(self) -> tuple[int, ...]:
        """Indices of the unit coordinates that are array lengths; others depend on them."""
        return ()

    @property
    def signals(self) -> tuple[tuple[int, ...], ...]:
        """The unit coordinates of each function of time, in the order of its control points."""
        return ()

    @property
    def sequences(self) -> tuple[tuple[int, int, int, int], ...]:
        """Arrays whose items can be inserted and removed; see `Cube`."""
        return ()

    @property
    def nominal(self) -> PyTree:
        """A value that is nominal for any system, such as no events; None if there is none."""
        return None

    @property
    def items(self) -> int:
        """Maximum number of items that `without` can remove."""
        return 0

    def without(
        self, u: Float[Array, " size"], drop: Bool[Array, " items"]
    ) -> Float[Array, " size"]:
        """Return the coordinates of the value without some items; later items move up.

        Items that depend on removed ones are removed too.
        """
        return u

    def settled(self, u: Float[Array, " size"]) -> Float[Array, " size"]:
        """Return `u` with unused coordinates set to a fixed value; the value stays the same."""
        return u

    def used(self, u: Float[Array, " size"]) -> Bool[Array, " size"]:
        """Return which coordinates are used: all but those of absent items."""
        return jnp.ones(self.size, bool)

    @property
    def coverage_id_count(self) -> int:
        """Number of items that values can cover, such as transitions of an automaton."""
        return 0

    def coverage_ids(self, value: PyTree) -> Int[Array, " ids"]:
        """Return the ids of the items that a value covers, below `coverage_id_count`, or -1."""
        return jnp.zeros(0, jnp.int32)

    # Other rooms ask for these. Each has a default, which a domain overrides where it differs.

    def words(self) -> str:
        """Describe the possible values and their probabilities in English."""
        return one_line(repr(self))

    def words_for(self, value: PyTree) -> str:
        """Describe a value in words, if its coordinates alone do not tell; empty otherwise."""
        return ""

    def plain(self, nested: "Callable[[Domain], dict[str, Any]]") -> dict[str, Any] | None:
        """Return what `from_plain` needs, for JSON; None if it is `arguments`.

        `nested` converts a domain within this one.
        """
        return None

    @classmethod
    def from_plain(
        cls, data: Mapping[str, Any], nested: "Callable[[Mapping[str, Any]], Domain]"
    ) -> "Domain":
        """Build the domain from what `plain` returned; `nested` builds one within this one."""
        return cls(**{name: data[name] for name in cls.arguments or ()})

    def parts(self, name: str) -> "tuple[tuple[str, Domain], ...]":
        """Return the domains of a value's parts, with the names of their columns.

        **Arguments:**
        - `name`: the name of the feature.
        """
        return ()

    @property
    def named(self) -> "tuple[tuple[str, Domain], ...]":
        """The fields of a structure with their domains; none for any other domain."""
        return ()

    def facts(self, name: str) -> Facts:
        """Return the facts about a feature's table columns known before any row; see `facts`."""
        found: Facts = {}
        parts = self.parts(name)
        for part_name, part in parts:
            found |= part.facts(part_name)
        return found if parts else drawn_facts(self, name)

    @property
    def held_at(self) -> PyTree:
        """The value at which the feature is fixed; None for one that varies."""
        return None

    @property
    def numeric(self) -> bool:
        """True if a system receives the value itself, not the index of a choice."""
        return True

    @property
    def uniform(self) -> bool:
        """True if all values are known to be equally likely over their range."""
        return False

    @property
    def tailed(self) -> tuple[bool, ...]:
        """For each unit coordinate, True if its distribution has a tail towards an end."""
        inner = tuple(tailed for _, part in self.parts("") for tailed in part.tailed)
        return (False,) * (self.size - len(inner)) + inner

    @property
    def monotone(self) -> bool:
        """True if each number of a value increases with one coordinate only, or is constant."""
        return False

    @property
    def tuning(self) -> "Tuning | None":
        """The domain in the terms of hyper-parameter tuners; None if they lack it."""
        return None

    @property
    def graph(self) -> Any:
        """The graph of an automaton; None for any other domain."""
        return None

    def spans(self, duration: float) -> list[tuple[float, float]] | None:
        """Return the start and end of each control point's time of effect in seconds, or None.

        **Arguments:**
        - `duration`: the duration of the simulation in seconds.
        """
        return None

    def check_reachable(self, value: PyTree, name: str) -> None:
        """Check that a coordinate of the unit cube maps close to a value.

        **Raises:** `ValueError` for a value so far out in a tail that none does.
        """

    def coordinates(self, name: str) -> tuple[str, ...]:
        """Return the names of the unit coordinates of the feature called `name`."""
        return self.columns(name)

    def labels(self, name: str, duration: float | None = None) -> tuple[str, ...]:
        """Return readable names of the unit coordinates; control points are named by their time.

        **Arguments:**
        - `name`: the name of the feature.
        - `duration`: the duration of a simulation in seconds, for signals without their own.
        """
        return self.coordinates(name)

    def refined(self, factor: int) -> "Domain":
        """Return the same domain with finer signals, if it has signals; see `Signal.refined`."""
        return self

    def refine(self, value: PyTree, factor: int) -> PyTree:
        """Convert a value of this domain to one of `refined(factor)`."""
        return value


def cell(u: Float[Array, "*shape"], count: int) -> Int[Array, "*shape"]:
    """Return the index of the cell that contains `u`, of `count` equally wide cells.

    1.0 belongs to the last one.
    """
    return jnp.clip((u * count).astype(jnp.int32), 0, count - 1)


def centre(index: Numbers, count: int) -> Float[Array, "1"]:
    """Return the middle of a cell."""
    return jnp.reshape((as_real(index) + 0.5) / count, (1,))


def as_real(value: Any) -> Float[Array, "*shape"]:
    """Convert to an array of real numbers; integers and lists get JAX's default precision."""
    return on_device(real_numbers(value))


def real_numbers(value: Any) -> Any:
    """Convert like `as_real`, but to a NumPy array if the value is not a JAX array."""
    value = without_objects(value)
    plain = float | int | np.ndarray | np.number
    several = isinstance(value, list | tuple) and all(isinstance(each, plain) for each in value)
    if several or isinstance(value, plain):
        # Of an array of JAX each first operation of a kind compiles a program.
        array = np.asarray(value)
        if array.dtype == object:  # Integers of more than 64 bits.
            array = array.astype(np.float64)
        if array.dtype.kind in "fiub":
            real = array.dtype.kind == "f" and not isinstance(value, float)
            kind = dtypes.canonicalize_dtype(array.dtype) if real else jnp.result_type(float)
            with np.errstate(over="ignore"):
                return array.astype(kind)
    array = jnp.asarray(value)
    real = jnp.issubdtype(array.dtype, jnp.floating) and not array.weak_type
    return array if real else array.astype(jnp.result_type(float))


def without_objects(value: Value) -> Value | np.ndarray:
    """Convert numbers that JAX does not support, such as `Decimal`, to NumPy; others stay."""
    other = Decimal | Fraction | np.longdouble
    several = isinstance(value, list | tuple) and any(isinstance(each, other) for each in value)
    objects = isinstance(value, np.ndarray) and value.dtype in (object, np.longdouble)
    if several or objects or isinstance(value, other):
        return np.asarray(value, np.float64)
    return value


def on_device(numbers: Array | np.ndarray) -> Array:
    """Return numbers as a JAX array; a NumPy array passed here must not change afterwards."""
    # Not `jnp.asarray`, which compiles a program for each shape.
    return numbers if isinstance(numbers, jax.Array) else jax.device_put(numbers)


def as_number(value: object, what: str) -> float:
    """Convert to one number; `what` names it in the error."""
    if np.ma.is_masked(value):
        raise ValueError(f"{what} must be a number; got one that is masked")
    if not isinstance(value, bool | np.bool_ | str | bytes):
        try:
            return float(value)  # pyright: ignore[reportArgumentType]
        except (TypeError, ValueError, OverflowError):
            pass
    raise ValueError(f"{what} must be a number; got {value!r}")


def as_numbers(value: object, name: str) -> Float[np.ndarray, "*shape"]:
    """Convert a concrete number or an array of them to float64; `name` names it in the error."""
    if np.ma.is_masked(value):
        raise ValueError(f"{name} must be a number; got one that is masked")
    try:
        numbers = np.asarray(value)
        if numbers.dtype == object:
            if any(isinstance(each, _NO_NUMBERS) for each in numbers.ravel()):
                raise TypeError
            numbers = numbers.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.asarray("")
    if numbers.dtype.kind not in "iufb":
        shown = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
        raise ValueError(f"{name} must be a number; got {shown!r}")
    return numbers.astype(np.float64)


_NO_NUMBERS = (str, bytes, complex, np.complexfloating, np.datetime64, np.timedelta64)
"""Types that NumPy converts to real numbers, although they are not numbers here."""


def as_scalar(value: Value) -> Value:
    """Convert NumPy and JAX scalars to plain Python; other values stay as they are."""
    if isinstance(value, np.generic | jax.Array | np.ndarray) and np.ndim(value) == 0:
        return value.item()
    return value


def as_tuple(value: PyTree) -> PyTree:
    """Convert nested lists to nested tuples."""
    return tuple(map(as_tuple, value)) if isinstance(value, list) else value


def indexed(name: str, count: int) -> tuple[str, ...]:
    """Return the names `name[0]`, `name[1]`, ..."""
    return tuple(f"{name}[{i}]" for i in range(count))


def dotted(name: str, field: str) -> str:
    """Return the full name of a field of the feature called `name`."""
    return f"{name}.{field}" if name else field


def nearest(number: float, low: float, high: float) -> str:
    """Return the end of a message with the value nearest to a number; empty if there is none."""
    text = f"; the nearest value is {short(np.clip(number, low, high).item())}"
    return text if math.isfinite(number) else ""


def format_choices(choices: Sequence[object]) -> str:
    """Format choices for a message."""
    return ", ".join(map(repr, choices))


def short(value: object) -> str:
    """Format a number, or a tuple of numbers, as a user would write it."""
    if isinstance(value, tuple):
        return "[" + ", ".join(map(short, value)) + "]"
    if isinstance(value, float) and value == int(value if math.isfinite(value) else 0):
        return repr(int(value)) if abs(value) < 1e15 else repr(value)
    return repr(value)
