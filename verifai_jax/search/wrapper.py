"""A search around another one; members that the wrapper does not override are forwarded.

    @dataclass(frozen=True)
    class Rounded(Wrapper):                             # points with two digits
        search: Search

        def ask(self, state, cube, batch):
            u, state = super().ask(state, cube, batch)
            return jnp.round(u, 2), state

Every member of `Search` is forwarded here, so no wrapper has to do it.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias, cast

from jaxtyping import Array, Float, Int, Key, PyTree

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Origin, Plan, Search, State, Wants

Learn: TypeAlias = Callable[[PyTree, Cube, Observations], PyTree]
"""A way to learn of the search inside: its `tell` or `warm_start`."""


class Wrapper(Search[State]):
    """A search around another one; a subclass is a frozen dataclass with a field `search`.

    A wrapper that moves the points of a search that samples the prior defines `samples_prior` as
    False. A subclass whose state holds more than that of the wrapped search defines `inner_state`
    and `with_inner_state`; one that changes what the wrapped search learns defines `learn`.

    **Raises:** `TypeError` for anything that is not a search.
    """

    _internal = frozenset(("inner_state", "learn", "with_inner_state"))
    search: Search

    def __post_init__(self) -> None:
        if not isinstance(self.search, Search):
            name = type(self).__name__
            raise TypeError(f"{name} needs a search like CrossEntropy(); got {self.search!r}")

    def inner_state(self, state: State) -> PyTree:
        """Return the state of the wrapped search."""
        return state

    def with_inner_state(self, state: State, inner: PyTree) -> State:
        """Return the state with a new state of the wrapped search."""
        return cast(State, inner)

    def learn(self, learn: Learn, state: State, cube: Cube, observations: Observations) -> State:
        """Learn from observations, in one of the three ways in which the wrapped search learns."""
        inner = learn(self.inner_state(state), cube, observations)
        return self.with_inner_state(state, inner)

    @property
    def wants(self) -> Wants:
        return self.search.wants

    @property
    def learns(self) -> bool:
        return self.search.learns

    @property
    def samples_prior(self) -> bool:
        return self.search.samples_prior

    @property
    def origin(self) -> Origin:
        # A wrapper that moves the points of the prior has none of these.
        inner = self.search.origin
        return super().origin if inner == "prior" else inner

    @property
    def sequence(self) -> tuple[str, str]:
        return self.search.sequence

    @property
    def fallback(self) -> Search | None:
        inner = self.search.fallback
        return None if inner is None else self._around(inner)

    def check(self, cube: Cube) -> None:
        self.search.check(cube)

    def total(self, cube: Cube) -> int | None:
        return self.search.total(cube)

    def counting(self, failures: int) -> Search[State]:
        return self._around(self.search.counting(failures))

    def staying(self) -> Search[State]:
        return self._around(self.search.staying())

    def stage(self, state: State | None, cube: Cube, batch: int) -> Search[State]:
        inner = self.search.stage(None if state is None else self.inner_state(state), cube, batch)
        return self._around(inner)

    def _around(self, inner: Search) -> Search:
        """Return the same wrapper around another search."""
        itself: Any = self  # A dataclass, as every subclass is.
        return self if inner == self.search else replace(itself, search=inner)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> State:
        return self.search.init(key, cube, batch)

    def ask(self, state: State, cube: Cube, batch: int) -> Asked[State]:
        u, inner = self.search.ask(self.inner_state(state), cube, batch)
        return u, self.with_inner_state(state, inner)

    def plan(self, state: State, cube: Cube, batch: int) -> Plan:
        return self.search.plan(self.inner_state(state), cube, batch)

    def temperature(self, state: State) -> Float[Array, ""]:
        return self.search.temperature(self.inner_state(state))

    def distinct(self, state: State) -> Int[Array, ""] | None:
        return self.search.distinct(self.inner_state(state))

    def tell(self, state: State, cube: Cube, observations: Observations) -> State:
        return self.learn(self.search.tell, state, cube, observations)

    def warm_start(self, state: State, cube: Cube, observations: Observations) -> State:
        return self.learn(self.search.warm_start, state, cube, observations)
