"""Compiled functions of a search, in the background, side by side."""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, PyTree

from verifai_jax.core.compute.compilation import XlaOptimization, compile_soon, tracing
from verifai_jax.core.compute.fingerprint import identity
from verifai_jax.core.compute.remembered import lower_or_recall, remembered_as
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Plan, Search
from verifai_jax.search.contract import is_user_defined

SMALL = 256
"""Points of a round up to which a search that plans its rounds is compiled with the least effort:
its programs are large, and then run nearly as fast."""


def optimization_of(search: Search, batch: int) -> XlaOptimization:
    """Return how strongly the compiler optimises the programs of a search."""
    return "least" if search.wants.clauses and batch <= SMALL else "little"


class SearchProgram(NamedTuple):
    """Compiled functions of a search; `tell` or `plan` is None for one that does not need it."""

    ask: Callable[..., tuple[Array, PyTree]]
    tell: Callable[..., PyTree]
    temperature: Callable[..., Any]
    plan: Callable[..., Plan]


@lru_cache(maxsize=64)
@tracing("the search")
def compiled_search(search: Search, cube: Cube, batch: int, coverage_ids: int) -> SearchProgram:
    """Compile what is done in each round of a search on a cube, concurrently in the background."""
    wants, (_, state) = search.wants, _forms(search, cube, batch)
    named = partial(_compiled, search, cube, batch, coverage_ids)
    # What takes longest to compile begins first.
    ask = named("ask", lambda state: search.ask(state, cube, batch), (0, state), state)
    plan: Any = None
    if wants.clauses:
        like = Plan(0, 0, 0)  # pyright: ignore[reportArgumentType]
        plan = named("plan", lambda state: search.plan(state, cube, batch), like, state)
    tell: Any = None
    if search.learns:
        rows = wants.form(cube, batch, coverage_ids)
        tell = named("tell", lambda state, rows: search.tell(state, cube, rows), state, state, rows)
    temperature: Any = lambda state: 1.0  # noqa: E731
    if wants.gradient:
        temperature = named("temperature", search.temperature, 0, state)
    return SearchProgram(ask, tell, temperature, plan)


@lru_cache(maxsize=64)
@tracing("the search")
def compiled_start(search: Search, cube: Cube, batch: int) -> Callable[..., PyTree]:
    """Compile `init` of a search on a cube, in the background."""
    key, state = _forms(search, cube, batch)
    start = partial(search.init, cube=cube, batch=batch)
    return _compiled(search, cube, batch, 0, "init", start, state, key)


@lru_cache(maxsize=64)
def _forms(search: Search, cube: Cube, batch: int) -> tuple[Any, PyTree]:
    """Return the forms of a key, and of a state of the search."""
    key = jax.eval_shape(lambda: jax.random.key(0, impl="threefry2x32"))
    return key, jax.eval_shape(lambda key: search.init(key, cube, batch), key)


def _compiled(
    search: Search, cube: Cube, batch: int, coverage_ids: int, verb: str,
    function: Callable[..., Any], like: PyTree, *arguments: PyTree,
) -> Any:  # fmt: skip
    """Compile one function in the background; `like` is a pytree of the form of its result."""
    # What a search of this package does follows from its options; a user's may do anything.
    kept = None if is_user_defined(search) else identity(search, cube, batch, coverage_ids)
    name = remembered_as(f"search-{verb}", kept, verb)
    lowered = lower_or_recall(name, function, arguments, jax.tree.structure(like))
    return compile_soon("the search", lowered, optimization_of(search, batch))
