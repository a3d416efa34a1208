"""The contract of every search: `init / ask / tell` over the unit cube.

    state = search.init(key, cube, batch)
    u, state = search.ask(state, cube, batch)                            # [batch, d] in [0, 1]
    state = search.tell(state, cube, Observations(u, rho, valid, gradient))

A search is a frozen dataclass of hyper-parameters; its functions are pure and its state is a
pytree, so that it can be jitted, scanned, saved and resumed. It knows nothing of features.
"""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Generic, Literal, NamedTuple, Protocol, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from verifai_jax.core.display.notebook import ForUsers
from verifai_jax.core.messages.checks import check_count, check_fraction, check_positive
from verifai_jax.core.values.clauses import CLAUSES, OUTCOME
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.best_points import keep_best

KIND = 1 << 16
"""Coverage ids of one kind: a coverage id is `kind * KIND + number`. An int32 has room for 32 768
kinds with 65 536 numbers each."""


class Observations(NamedTuple):
    """A batch of points and the results of their simulations.

    - `u`: the points, in the unit cube.
    - `rho`: robustness; negative is a failure.
    - `valid`: False for padding and for simulations without a verdict: such a row must not
      influence the search, even if its other entries are NaN.
    - `gradient`: the gradient of the smooth robustness with respect to `u`.
    - `clauses`: dimensionless values of the clauses, which are all negative in a failure; very low
      values fill up to `CLAUSES`.
    - `clause_gradients`: their gradients by `u`; zero in rounds that do not differentiate.
    - `outcomes`: a description of what happened (`core.values.clauses`), NaN if unknown.
    - `coverage_ids`: ids of the items that each simulation covered, padded with -1; `coverage_ids
      // KIND` is the kind of item.

    Fields after `valid` are None unless the search's `Wants` name them.
    """

    u: Float[Array, "n d"]
    rho: Float[Array, " n"]
    valid: Bool[Array, " n"]
    gradient: Float[Array, "n d"] | None = None
    clauses: Float[Array, "n clauses"] | None = None
    clause_gradients: Float[Array, "n clauses d"] | None = None
    coverage_ids: Int[Array, "n ids"] | None = None
    outcomes: Float[Array, "n outcome"] | None = None

    @property
    def usable(self) -> Bool[Array, " n"]:
        """Rows to learn from: the valid ones with a finite robustness."""
        return self.valid & jnp.isfinite(self.rho)

    @property
    def score(self) -> Float[Array, " n"]:
        """Robustness with 0 for all failures; infinite in rows that are not usable."""
        return jnp.where(self.usable, jnp.maximum(self.rho, 0.0), jnp.inf)


def check_options(
    options: object, counts: Mapping[str, int] | None = None, shares: Sequence[str] = (),
    sizes: Sequence[str] = (),
) -> None:  # fmt: skip
    """Check the options of a search, which are its attributes of the same names.

    **Arguments:**
    - `options`: the search object.
    - `counts`: names of whole numbers, with the smallest value of each.
    - `shares`: names of options in `(0, 1]`.
    - `sizes`: names of options that must be positive and finite.
    **Raises:** `ValueError` that names the first option out of range.
    """
    for name, smallest in (counts or {}).items():
        check_count(name, getattr(options, name), smallest)
    for name in shares:
        check_fraction(name, getattr(options, name), one=True)
    for name in sizes:
        check_positive(name, getattr(options, name), finite=True)


class TraceProposer(Protocol):
    """A model of the traces of a run, which proposes some of its points.

    `learn` gets the rows of a round as `Verdicts`, with their traces; `improve` replaces some of a
    round's points; what `checkpoint` returns determines the next ones.
    """

    def learn(self, u: Float[Any, "n d"], verdicts: Any) -> None: ...
    def improve(self, points: Float[Any, "batch d"]) -> Float[Any, "batch d"]: ...
    def checkpoint(self) -> dict[str, np.ndarray]: ...
    def restore(self, checkpoint: Mapping[str, Any]) -> None: ...


class ModelsTraces(Protocol):
    """A search that has a model of the traces; `key` is that of its random numbers."""

    def trace_model(self, problem: Any, key: Key[Array, ""]) -> TraceProposer: ...


@dataclass(frozen=True)
class Wants:
    """The data that a search needs from the loop, in addition to the robustness of its points.

    **Arguments:**
    - `gradient`: `Observations.gradient`, at the `temperature` of the search.
    - `clauses`: `Observations.clauses`. A search with this plans its rounds (`plan`).
    - `clause_gradients`: `Observations.clause_gradients`, in the rounds whose plan says so.
    - `coverage_ids`: `Observations.coverage_ids`.
    - `outcomes`: `Observations.outcomes`.
    - `no_verdict_rows`: whether simulations without a verdict are valid rows with robustness NaN,
      so that a model of the robustness learns to avoid them.
    - `traces`: what makes a model of the traces that proposes some of the points; None without one.
    - `likelihood`: whether the objective prefers likely failures, instead of the robustness.
    - `max_batch`: size of a round beyond which more rounds are better than larger ones. At the
      default size compiled simulators run at three quarters of their maximum speed or more
      (`benchmarks/RESULTS.md`, "The engine on real dynamics").
    """

    gradient: bool = False
    clauses: bool = False
    clause_gradients: bool = False
    coverage_ids: bool = False
    outcomes: bool = False
    no_verdict_rows: bool = False
    traces: ModelsTraces | None = None
    likelihood: bool = False
    max_batch: int = 1024

    @property
    def derivatives(self) -> bool:
        """True for a search that follows derivatives, of the robustness or of clauses."""
        return self.gradient or self.clause_gradients

    def __or__(self, other: "Wants") -> "Wants":
        """Return what two searches want together, in rounds that suit both."""
        either: dict[str, Any] = {
            f.name: getattr(self, f.name) or getattr(other, f.name) for f in fields(self)
        }
        either["max_batch"] = min(self.max_batch, other.max_batch)
        return Wants(**either)

    def only(self, observations: Observations) -> Observations:
        """Return observations with only the wanted parts."""
        wanted = {
            "gradient": self.gradient,
            "clauses": self.clauses,
            "clause_gradients": self.clauses,
            "coverage_ids": self.coverage_ids,
            "outcomes": self.outcomes,
        }
        return observations._replace(**{name: None for name, want in wanted.items() if not want})

    def form(self, cube: Cube, batch: int, coverage_ids: int) -> Observations:
        """Return the shapes and types of the observations of a round.

        **Arguments:**
        - `cube`: the cube that is searched.
        - `batch`: number of rows in a round.
        - `coverage_ids`: number of coverage ids of a row.
        """

        def array(*shape: int, dtype: DTypeLike = jnp.float32) -> Any:
            return jax.ShapeDtypeStruct(shape, dtype)

        everything = Observations(
            u=array(batch, cube.dim),
            rho=array(batch),
            valid=array(batch, dtype=jnp.bool_),
            gradient=array(batch, cube.dim),
            clauses=array(batch, CLAUSES),
            clause_gradients=array(batch, CLAUSES, cube.dim),
            coverage_ids=array(batch, coverage_ids, dtype=jnp.int32),
            outcomes=array(batch, OUTCOME),
        )
        return self.only(everything)


class Plan(NamedTuple):
    """The simulations of its last proposals that a search with clauses requests.

    - `rows`: number of proposals to simulate, counted from the first; the others are returned as
      rows that are not valid.
    - `differentiate`: whether to compute the gradients of the clauses as well, which costs as much
      as one or two more simulations.
    - `temperature`: the dimensionless temperature of the smooth robustness, for each row.
    """

    rows: Int[Array, ""]
    differentiate: Bool[Array, ""]
    temperature: Float[Array, " batch"]


Origin = Literal["prior", "given", "sequence", "coverage", "learned"]
"""Where points come from: independent samples of the prior; a list that somebody gave; a sequence
that is fixed from the start; a search guided by coverage; a search guided by robustness."""
State = TypeVar("State")
"""The state of a search: a pytree of arrays."""
Asked: TypeAlias = tuple[Float[Array, "batch d"], State]
"""Points to simulate, and the state of the search after it proposed them."""


class Search(ForUsers, abc.ABC, Generic[State]):
    """The contract of searches; `verifai_jax.testing.check_search` tests it.

    `cube` and `batch` are static under `jit`. A state from `init` may only be used in calls with
    the same `batch`. `ask` may be called several times before a `tell`: rows that a constraint
    refuses are replaced by the same rows of the next proposals.
    """

    _internal = frozenset((
        "counting", "distinct", "fallback", "learns", "needs_derivatives", "origin", "plan",
        "samples_prior", "sequence", "stage", "staying", "temperature", "total", "wants",
        "warm_start",
    ))  # fmt: skip

    @property
    def wants(self) -> Wants:
        """The needs of this search; a class states them in one line, `wants = Wants(...)`."""
        return Wants()

    @property
    def learns(self) -> bool:
        """True if `tell` changes the next proposals; False for sequences fixed from the start."""
        return True

    @property
    def samples_prior(self) -> bool:
        """True if points are independent samples of the prior, so that they give failure rates."""
        return False

    @property
    def origin(self) -> Origin:
        """The origin of the points, which determines the conclusions that their rows allow."""
        if self.samples_prior:
            return "prior"
        if not self.learns:
            return "sequence"
        return "coverage" if self.wants.coverage_ids else "learned"

    @property
    def sequence(self) -> tuple[str, str]:
        """The words that a note uses for the points of a finite search and their order."""
        return "search", "in its order"

    @property
    def fallback(self) -> "Search | None":
        """The search to use instead if the loop cannot provide what this one wants.

        None if there is no such search.
        """
        return None

    @property
    def needs_derivatives(self) -> bool:
        """True if the search follows derivatives and cannot work without them."""
        return self.wants.derivatives and self.fallback is None

    def check(self, cube: Cube) -> None:
        """Raise `ValueError` if this search cannot work on this cube."""

    def total(self, cube: Cube) -> int | None:
        """Return the total number of points; None for a search that never ends."""
        return None

    @abc.abstractmethod
    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> State:
        """Return the state before the first round; all randomness comes from `key`."""

    @abc.abstractmethod
    def ask(self, state: State, cube: Cube, batch: int) -> Asked[State]:
        """Propose the next points to simulate."""

    @abc.abstractmethod
    def tell(self, state: State, cube: Cube, observations: Observations) -> State:
        """Learn from the results of the points of the last `ask`, row by row."""

    def warm_start(self, state: State, cube: Cube, observations: Observations) -> State:
        """Learn from points of an earlier table, before the first `ask`."""
        return self.tell(state, cube, observations)

    def distinct(self, state: State) -> Int[Array, ""] | None:
        """Return the number of failures found so far that are far from each other.

        None for a search that does not count them.
        """
        return None

    def counting(self, failures: int) -> "Search[State]":
        """Return this search with room for so many failures that are far from each other."""
        return self

    def staying(self) -> "Search[State]":
        """Return this search without leaving regions of failures, for failures of unequal rank."""
        return self

    def stage(self, state: State | None, cube: Cube, batch: int) -> "Search[State]":
        """Return the search for the next round: this one, or only its members that take part.

        A stage uses the state of the whole search and behaves like it, but with smaller programs:
        members that may never take part are not compiled.

        **Arguments:**
        - `state`: the state before an `ask`; None for that of `init`.
        """
        return self

    def plan(self, state: State, cube: Cube, batch: int) -> Plan:
        """Return the simulations wanted of the last proposals, if the search wants clauses."""
        raise NotImplementedError(f"{type(self).__name__} has no plans")

    def temperature(self, state: State) -> Float[Array, ""]:
        """Return the temperature of the smooth robustness, if the search wants a gradient."""
        raise NotImplementedError(f"{type(self).__name__} uses no gradient")


class PointSequence(Search[State]):
    """A search whose points depend only on the key, not on results."""

    @property
    def learns(self) -> bool:
        return False

    def tell(self, state: State, cube: Cube, observations: Observations) -> State:
        return state


class SlopeSearch(Search[State]):
    """A search that follows gradients of clauses, and can also start from given points.

    Its state has the points `offered` as next starts, and `near`, the closeness of each to failing.
    """

    @property
    def wants(self) -> Wants:
        return Wants(clauses=True, clause_gradients=True)

    def check(self, cube: Cube) -> None:
        """Raise `ValueError` unless there is a continuous coordinate to move in."""
        if cube.dim and len(cube.continuous) == 0:
            raise ValueError(
                f"search {type(self).__name__.lower()} needs at least one continuous feature; all "
                f"{cube.dim} unit coordinates of this space are discrete. Use 'cross_entropy'"
            )

    def warm_start(self, state: State, cube: Cube, observations: Observations) -> State:
        """Start the first descents from the points nearest to failing, without failures."""
        its: Any = state
        # Of the batch and of earlier points, whose robustness is infinite where there is none.
        usable = observations.usable & (observations.rho >= 0)
        near = jnp.where(usable, observations.rho, jnp.inf)
        offered, near = keep_best(observations.u, near, its.offered, its.near)
        return its._replace(offered=offered, near=near)


Part = TypeVar("Part", bound=PyTree)
"""A state of a search, or a part of one."""


def choose(first: Bool[Array, ""], one: Part, two: Part) -> Part:
    """Return one of two states of the same form; equal parts are not selected but shared."""
    return jax.tree.map(lambda a, b: a if a is b else jnp.where(first, a, b), one, two)
