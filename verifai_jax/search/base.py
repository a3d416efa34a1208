"""What every search is: `init / ask / tell` over the unit cube.

    state = search.init(key, cube, batch)
    u, state = search.ask(state, cube, batch)                            # [batch, d] in [0, 1]
    state = search.tell(state, cube, Evaluated(u, rho, counted, gradient))

A search is a frozen dataclass of hyper-parameters; its functions are pure and its state is a
pytree, so that it can be jitted, scanned, saved and resumed. It knows nothing of features.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key


@dataclass(frozen=True)
class Cube:
    """The unit cube `[0, 1]^d` with the prior uniform on it.

    **Arguments:** `levels`: for each coordinate 0 if it is continuous, or the number `n >= 1` of
    its equally wide cells, inside which points mean the same.

    **Raises:** `ValueError` for a negative level.
    """

    levels: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", tuple(int(level) for level in self.levels))
        if any(level < 0 for level in self.levels):
            raise ValueError(f"levels must not be negative; got {self.levels}")

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return len(self.levels)

    @cached_property
    def continuous(self) -> Int[np.ndarray, " c"]:
        """Indices of the continuous coordinates."""
        return np.flatnonzero(np.array(self.levels, np.int64) == 0)

    @cached_property
    def discrete(self) -> Int[np.ndarray, " k"]:
        """Indices of the discrete coordinates."""
        return np.flatnonzero(np.array(self.levels, np.int64) > 0)


class Evaluated(NamedTuple):
    """A batch of points and what came of them.

    - `rho`: robustness; negative is a failure.
    - `counted`: False for padding and for simulations without a verdict: such a row must not
      influence the search, whatever its other entries are (NaN included).
    - `gradient`: of the smooth robustness with respect to `u`; only where a search wants it.
    """

    u: Float[Array, "n d"]
    rho: Float[Array, " n"]
    counted: Bool[Array, " n"]
    gradient: Float[Array, "n d"] | None = None


class Search(Protocol):
    """The contract; `verifai_jax.testing.check_search` tests it.

    `cube` and `batch` are static under `jit`. A state from `init` with one `batch` takes part in
    calls with that `batch` only.
    """

    wants_gradient: ClassVar[bool]
    """Whether `tell` needs `Evaluated.gradient`."""

    samples_prior: ClassVar[bool]
    """Whether points are independent samples of the prior, so that failure rates mean something."""

    def check(self, cube: Cube) -> None:
        """Raise `ValueError` if this search cannot work on this cube."""
        ...

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> Any:
        """The state before the first round; all randomness comes from `key`."""
        ...

    def ask(self, state: Any, cube: Cube, batch: int) -> tuple[Float[Array, "batch d"], Any]:
        """The next points to simulate."""
        ...

    def tell(self, state: Any, cube: Cube, evaluated: Evaluated) -> Any:
        """Learn from the points of the last `ask`."""
        ...

    def temperature(self, state: Any) -> Float[Array, ""]:
        """Of the smooth robustness to differentiate next; only where `wants_gradient`."""
        ...


def check_positive(name: str, value: Any) -> None:
    """Raise `ValueError` unless `value` is a positive finite number."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and 0 < value < math.inf):
        raise ValueError(f"{name} must be positive and finite; got {value!r}")


def check_fraction(name: str, value: Any, *, or_zero: bool = False) -> None:
    """Raise `ValueError` unless `value` is a number in `(0, 1]`, or in `[0, 1]`."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and (0 < value <= 1 or (or_zero and value == 0))):
        raise ValueError(f"{name} must be in {'[' if or_zero else '('}0, 1]; got {value!r}")


def check_count(name: str, value: Any, least: int = 1) -> None:
    """Raise `ValueError` unless `value` is an integer of at least `least`."""
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}; got {value!r}")
