"""What every search is: `init / ask / tell` over the unit cube.

    state = search.init(key, cube, batch)
    u, state = search.ask(state, cube, batch)                            # [batch, d] in [0, 1]
    state = search.tell(state, cube, Evaluated(u, rho, counted, gradient))

A search is a frozen dataclass of hyper-parameters; its functions are pure and its state is a
pytree, so that it can be jitted, scanned, saved and resumed. It knows nothing of features.
"""

import abc
import math
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.core.cube import Cube

CLAUSES = 4
"""Clauses that `Evaluated` tells apart."""


class Evaluated(NamedTuple):
    """A batch of points and what came of them.

    - `rho`: robustness; negative is a failure.
    - `counted`: False for padding and for simulations without a verdict: such a row must not
      influence the search, whatever its other entries are (NaN included).
    - `gradient`: of the smooth robustness with respect to `u`; only where a search wants it.
    - `clauses`: values of what has to be broken together, without unit, all negative in a failure;
      very low where there are fewer than `CLAUSES`. Only for a search that wants clauses.
    - `slopes`: their derivatives with respect to `u`; zero in rounds that asked for none.
    """

    u: Float[Array, "n d"]
    rho: Float[Array, " n"]
    counted: Bool[Array, " n"]
    gradient: Float[Array, "n d"] | None = None
    clauses: Float[Array, "n clauses"] | None = None
    slopes: Float[Array, "n clauses d"] | None = None

    @property
    def judged(self) -> Bool[Array, " n"]:
        """Rows from which something can be learned: counted ones with a finite robustness."""
        return self.counted & jnp.isfinite(self.rho)

    @property
    def score(self) -> Float[Array, " n"]:
        """Robustness with all failures equally good, 0; infinite where nothing can be learned."""
        return jnp.where(self.judged, jnp.maximum(self.rho, 0.0), jnp.inf)


class Plan(NamedTuple):
    """What a search that wants clauses has in mind for the points of its last `ask`.

    - `rows`: how many of them, from the first on, are to be simulated; the others are told as not
      counted.
    - `slopes`: whether with the slopes of the clauses, which cost another simulation or two.
    - `temperature`: of the smooth robustness whose slopes they are, row by row, without unit.
    """

    rows: Int[Array, ""]
    slopes: Bool[Array, ""]
    temperature: Float[Array, " batch"]


class Search(abc.ABC):
    """The contract; `verifai_jax.testing.check_search` tests it.

    `cube` and `batch` are static under `jit`. A state from `init` with one `batch` takes part in
    calls with that `batch` only. `ask` may be called several times before a `tell`: where a
    constraint refuses rows, they are replaced by the same rows of the next proposals.
    """

    wants_gradient: ClassVar[bool] = False
    """Whether `tell` needs `Evaluated.gradient`."""

    wants_clauses: ClassVar[bool] = False
    """Whether `tell` needs `Evaluated.clauses` and, in rounds that `plan` says, `slopes`."""

    samples_prior: ClassVar[bool] = False
    """Whether points are independent samples of the prior, so that failure rates mean something."""

    learns: ClassVar[bool] = True
    """Whether `tell` changes what is asked next; False for sequences fixed from the start."""

    most_at_once: ClassVar[int] = 1024
    """Points in a round beyond which more rounds are worth more than larger ones."""

    def check(self, cube: Cube) -> None:  # noqa: B027 - most searches work on every cube
        """Raise `ValueError` if this search cannot work on this cube."""

    def total(self, cube: Cube) -> int | None:
        """How many points there are in all; None where they never end."""
        return None

    @abc.abstractmethod
    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> Any:
        """The state before the first round; all randomness comes from `key`."""

    @abc.abstractmethod
    def ask(self, state: Any, cube: Cube, batch: int) -> tuple[Float[Array, "batch d"], Any]:
        """The next points to simulate."""

    @abc.abstractmethod
    def tell(self, state: Any, cube: Cube, evaluated: Evaluated) -> Any:
        """Learn from the points of the last `ask`, which are in `evaluated`, row by row."""

    def warm(self, state: Any, cube: Cube, evaluated: Evaluated) -> Any:
        """Learn from points of an earlier table, a batch of them, before the first `ask`."""
        return self.tell(state, cube, evaluated)

    def plan(self, state: Any, cube: Cube, batch: int) -> Plan:
        """Which rows of the last `ask`, and with what; only where `wants_clauses`."""
        raise NotImplementedError(f"{type(self).__name__} has no plans")

    def temperature(self, state: Any) -> Float[Array, ""]:
        """Of the smooth robustness to differentiate next; only where `wants_gradient`."""
        raise NotImplementedError(f"{type(self).__name__} uses no gradient")


def standard_normal(uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Standard normal numbers from uniform ones in `[0, 1)`, finite at 0."""
    return ndtri(jnp.maximum(uniform, np.float32(2**-25)))


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
