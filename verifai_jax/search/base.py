"""What every search is: `init / ask / tell` over the unit cube.

    state = search.init(key, cube, batch)
    u, state = search.ask(state, cube, batch)                            # [batch, d] in [0, 1]
    state = search.tell(state, cube, Evaluated(u, rho, counted, gradient))

A search is a frozen dataclass of hyper-parameters; its functions are pure and its state is a
pytree, so that it can be jitted, scanned, saved and resumed. It knows nothing of features.
"""

import abc
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Bool, Float, Int, Key


@dataclass(frozen=True)
class Cube:
    """The unit cube `[0, 1]^d` with the prior uniform on it.

    **Arguments:** for each coordinate

    - `levels`: 0 if it is continuous, or the number `n >= 1` of its cells, inside which points
      mean the same.
    - `weights`: the probabilities of its cells, which are their widths; None where they are equal.
    - `ordered`: whether its cells have an order; all of them when left out.
    - `names`: what it is called, such as `cars[0].x`; nothing when left out.

    and `lengths`: which coordinates are lengths of arrays, on which others depend; `signals`: the
    coordinates of each function of time, in the order of its control points.

    **Raises:** `ValueError` for a negative level, or entries that do not go with the levels.
    """

    levels: tuple[int, ...]
    weights: tuple[tuple[float, ...] | None, ...] = ()
    ordered: tuple[bool, ...] = ()
    names: tuple[str, ...] = ()
    lengths: tuple[int, ...] = ()
    signals: tuple[tuple[int, ...], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", tuple(int(level) for level in self.levels))
        if any(level < 0 for level in self.levels):
            raise ValueError(f"levels must not be negative; got {self.levels}")
        for name, default in (("weights", None), ("ordered", True), ("names", "")):
            given = tuple(getattr(self, name)) or (default,) * self.dim
            if len(given) != self.dim:
                raise ValueError(f"{name} must have {self.dim} entries, as levels; got {given}")
            object.__setattr__(self, name, given)
        for level, weights in zip(self.levels, self.weights, strict=True):
            if weights is not None and not (
                len(weights) == level
                and all(weight > 0 for weight in weights)
                and abs(math.fsum(weights) - 1) < 1e-6
            ):
                raise ValueError(
                    f"{level} cells need {level} positive weights that sum to one; got {weights}"
                )
        if not all(0 <= i < self.dim and self.levels[i] for i in self.lengths):
            raise ValueError(f"lengths must be discrete coordinates; got {self.lengths}")

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

    @cached_property
    def probabilities(self) -> tuple[Float[np.ndarray, " cells"], ...]:
        """The prior of the cells, for each discrete coordinate."""
        return tuple(
            np.full(self.levels[i], 1 / self.levels[i])
            if self.weights[i] is None
            else np.array(self.weights[i], np.float64)
            for i in self.discrete
        )

    def take(self, places: tuple[int, ...]) -> "Cube":
        """The cube of these coordinates alone."""
        return Cube(
            levels=tuple(self.levels[i] for i in places),
            weights=tuple(self.weights[i] for i in places),
            ordered=tuple(self.ordered[i] for i in places),
            names=tuple(self.names[i] for i in places),
            lengths=tuple(j for j, i in enumerate(places) if i in self.lengths),
            signals=tuple(
                tuple(places.index(i) for i in signal)
                for signal in self.signals
                if set(signal) <= set(places)
            ),
        )

    def cells(self, u: Float[Array, "*n d"]) -> Int[Array, "*n k"]:
        """Which cell holds each discrete coordinate of these points."""
        points = jnp.asarray(u)[..., self.discrete]
        counts = np.array([self.levels[i] for i in self.discrete], np.int32)
        found = jnp.clip((points * counts).astype(jnp.int32), 0, counts - 1)
        for j, edges in self._edges:
            place = jnp.searchsorted(edges[1:-1], points[..., j], side="right")
            found = found.at[..., j].set(place.astype(jnp.int32))
        return found

    def centres(self, cells: Int[Array, "*n k"]) -> Float[Array, "*n k"]:
        """The middles of these cells, as coordinates."""
        counts = np.array([self.levels[i] for i in self.discrete], np.float32)
        middles = ((jnp.asarray(cells) + 0.5) / counts).astype(jnp.float32)
        for j, edges in self._edges:
            centre = (edges[1:] + edges[:-1]) / 2
            middles = middles.at[..., j].set(jnp.asarray(centre)[cells[..., j]])
        return middles

    @cached_property
    def _edges(self) -> tuple[tuple[int, Float[np.ndarray, " edges"]], ...]:
        """Where the unequal cells begin and end, by place among the discrete coordinates."""
        return tuple(
            (j, np.concatenate([[0], np.cumsum(self.probabilities[j])]).astype(np.float32))
            for j, i in enumerate(self.discrete)
            if self.weights[i] is not None
        )


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
