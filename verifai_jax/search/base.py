"""The contract of every search: `init / ask / tell` over the unit cube.

    state = search.init(key, cube, batch)
    u, state = search.ask(state, cube, batch)                            # [batch, d] in [0, 1]
    state = search.tell(state, cube, Observations(u, rho, valid, gradient))

A search is a frozen dataclass of hyper-parameters; its functions are pure and its state is a
pytree, so that it can be jitted, scanned, saved and resumed. It knows nothing of features.
"""

import abc
import math
from typing import ClassVar, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from verifai_jax.core.cube import Cube
from verifai_jax.core.notebook import ForUsers

KIND = 1 << 16
"""Marks below it are of the first kind, the next so many of the second, and so on."""


class Observations(NamedTuple):
    """A batch of points and the results of their simulations.

    - `u`: the points, in the unit cube.
    - `rho`: robustness; negative is a failure.
    - `valid`: False for padding and for simulations without a verdict: such a row must not
      influence the search, whatever its other entries are (NaN included).
    - `gradient`: of the smooth robustness with respect to `u`; only for a search that
      `wants_gradient`.
    - `clauses`: values of the clauses to violate together, without unit, all negative in a failure;
      very low where there are fewer than `CLAUSES`. Only for a search that `wants_clauses`.
    - `clause_gradients`: their gradients with respect to `u`; zero in rounds whose plan does not
      differentiate.
    - `outcomes`: what happened (`core.outcomes`), NaN where it is not known. Only for a search that
      `wants_outcomes`.
    - `marks`: numbers of what each simulation covered, -1 for nothing; `marks // KIND` is the kind
      of thing. Only for a search that `wants_marks`.
    """

    u: Float[Array, "n d"]
    rho: Float[Array, " n"]
    valid: Bool[Array, " n"]
    gradient: Float[Array, "n d"] | None = None
    clauses: Float[Array, "n clauses"] | None = None
    clause_gradients: Float[Array, "n clauses d"] | None = None
    marks: Int[Array, "n marks"] | None = None
    outcomes: Float[Array, "n outcome"] | None = None

    @property
    def usable(self) -> Bool[Array, " n"]:
        """Rows to learn from: the valid ones with a finite robustness."""
        return self.valid & jnp.isfinite(self.rho)

    @property
    def score(self) -> Float[Array, " n"]:
        """Robustness with all failures equally good, 0; infinite in rows that are not usable."""
        return jnp.where(self.usable, jnp.maximum(self.rho, 0.0), jnp.inf)


class Plan(NamedTuple):
    """The simulations that a search with `wants_clauses` wants of its last proposals.

    - `rows`: number of proposals to simulate, from the first on; the others are told as not valid.
    - `differentiate`: whether to compute the gradients of the clauses too, which costs as much as
      another simulation or two.
    - `temperature`: of the smooth robustness to differentiate, row by row, without unit.
    """

    rows: Int[Array, ""]
    differentiate: Bool[Array, ""]
    temperature: Float[Array, " batch"]


State = TypeVar("State")
"""The state of a search: a pytree of arrays."""


class Search(ForUsers, abc.ABC, Generic[State]):
    """The contract; `verifai_jax.testing.check_search` tests it.

    `cube` and `batch` are static under `jit`. A state from `init` with one `batch` takes part in
    calls with that `batch` only. `ask` may be called several times before a `tell`: where a
    constraint refuses rows, they are replaced by the same rows of the next proposals.
    """

    _internal = frozenset((
        "differentiates", "learns", "most_at_once", "plan", "samples_prior", "stage",
        "start_from", "temperature", "total", "wants_clauses", "wants_gradient", "wants_marks",
        "wants_outcomes", "warm_start",
    ))  # fmt: skip

    wants_gradient: ClassVar[bool] = False
    """Whether `tell` needs `Observations.gradient`."""

    wants_clauses: ClassVar[bool] = False
    """Whether `tell` needs `Observations.clauses`, with `clause_gradients` in the rounds whose
    `plan` says so."""

    wants_marks: ClassVar[bool] = False
    """Whether `tell` needs `Observations.marks`."""

    wants_outcomes: ClassVar[bool] = False
    """Whether `tell` needs `Observations.outcomes`."""

    avoids_no_verdict: ClassVar[bool] = False
    """Whether a simulation without a verdict is told as one of the greatest robustness so far, so
    that a model of the robustness leaves alone where there are no verdicts."""

    samples_prior: ClassVar[bool] = False
    """Whether points are independent samples of the prior, so that failure rates mean something."""

    learns: ClassVar[bool] = True
    """Whether `tell` changes the next proposals; False for sequences fixed from the start."""

    most_at_once: ClassVar[int] = 1024
    """Points in a round beyond which more rounds are worth more than larger ones."""

    def check(self, cube: Cube) -> None:
        """Raise `ValueError` if this search cannot work on this cube."""

    def total(self, cube: Cube) -> int | None:
        """Return the number of points in all; None for a search that never ends."""
        return None

    @abc.abstractmethod
    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> State:
        """Return the state before the first round; all randomness comes from `key`."""

    @abc.abstractmethod
    def ask(self, state: State, cube: Cube, batch: int) -> tuple[Float[Array, "batch d"], State]:
        """Propose the next points to simulate."""

    @abc.abstractmethod
    def tell(self, state: State, cube: Cube, observations: Observations) -> State:
        """Learn from the points of the last `ask`, row by row."""

    def warm_start(self, state: State, cube: Cube, observations: Observations) -> State:
        """Learn from a batch of an earlier table's points, before the first `ask`."""
        return self.tell(state, cube, observations)

    def start_from(self, state: State, cube: Cube, observations: Observations) -> State:
        """Learn from points that somebody suggested between two rounds, and start from them."""
        return self.warm_start(state, cube, observations)

    @property
    def differentiates(self) -> bool:
        """True if a plan of this search may ask for derivatives of clauses."""
        return self.wants_clauses

    def stage(self, state: State | None, cube: Cube, batch: int) -> "Search[State]":
        """Return the search for the next round: this one, or only the parts of it that take part.

        A stage has the states of the whole, and does what the whole does, by smaller programs: of
        parts that may never take part nothing is compiled.

        **Arguments:**

        - `state`: before an `ask`; None for that of `init`.
        """
        return self

    def plan(self, state: State, cube: Cube, batch: int) -> Plan:
        """Return the simulations wanted of the last proposals; only where `wants_clauses`."""
        raise NotImplementedError(f"{type(self).__name__} has no plans")

    def temperature(self, state: State) -> Float[Array, ""]:
        """Return the temperature of the smooth robustness; only where `wants_gradient`."""
        raise NotImplementedError(f"{type(self).__name__} uses no gradient")


Part = TypeVar("Part", bound=PyTree)
"""A state of a search, or a part of one."""


def choose(first: Bool[Array, ""], one: Part, two: Part) -> Part:
    """Return one of two states of the same form; what is the same in both is left alone."""
    return jax.tree.map(lambda a, b: a if a is b else jnp.where(first, a, b), one, two)


def nearest_to_failing(
    observations: Observations, offered: Float[Array, "k d"], near: Float[Array, " k"]
) -> tuple[Float[Array, "k d"], Float[Array, " k"]]:
    """Return the points nearest to failing, failures left out, of a batch and of those offered.

    **Arguments:**

    - `observations`: the batch.
    - `offered`, `near`: earlier points and their robustness, infinite where there is none.
    """
    usable = observations.usable & (observations.rho >= 0)
    rho = jnp.concatenate([jnp.where(usable, observations.rho, jnp.inf), near])
    points = jnp.concatenate([jnp.where(usable[:, None], observations.u, 0.5), offered])
    _, nearest = jax.lax.top_k(-rho, len(near))
    return points[nearest], rho[nearest]


def draw_uniform(key: Key[Array, ""], shape: tuple[int, ...]) -> Float[Array, "*shape"]:
    """Draw uniform numbers in `[0, 1)`: those of `jax.random.uniform`, compiled much sooner.

    XLA spends seconds on the generator in more than one dimension, and again in each of its uses
    where it is not kept.
    """
    flat = jax.random.uniform(key, (math.prod(shape),), jnp.float32)
    return jax.lax.optimization_barrier(flat).reshape(shape)


def standard_normal(uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Map uniform numbers in `[0, 1)` to standard normal ones, finite at 0."""
    return ndtri(jnp.maximum(uniform, np.float32(2**-25)))
