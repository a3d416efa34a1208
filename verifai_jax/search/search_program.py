"""Compiled functions of a search, in the background, side by side."""

from collections.abc import Callable
from functools import lru_cache
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
    """Compiled functions of a search; `init` is None if they start from another search's state."""

    init: Callable[..., PyTree] | None
    ask: Callable[..., tuple[Array, PyTree]]
    tell: Callable[..., PyTree]
    temperature: Callable[..., Any]
    plan: Callable[..., Plan]


@lru_cache(maxsize=64)
@tracing("the search")
def compiled_search(
    search: Search, cube: Cube, batch: int, coverage_ids: int, begins: bool = True
) -> SearchProgram:
    """Compile `init / ask / tell` of a search on a cube, concurrently in the background.

    - `begins`: whether `init` is needed.
    """
    key = jax.eval_shape(lambda: jax.random.key(0, impl="threefry2x32"))
    begun = jax.jit(lambda key: search.init(key, cube, batch)).trace(key)
    state: Any = begun.out_info
    states = jax.tree.structure(state)
    # What a search of this package does follows from its options; a user's may do anything.
    kept = None if is_user_defined(search) else identity(search, cube, batch, coverage_ids)

    def compiled(verb: str, function: Callable[..., Any], *arguments: PyTree, form: Any) -> Any:
        name = remembered_as(f"search-{verb}", kept, verb)
        lowered = lower_or_recall(name, function, arguments, form)
        return compile_soon("the search", lowered, optimization_of(search, batch))

    # What takes longest to compile begins first.
    asked = jax.tree.structure((0, jax.tree.unflatten(states, [0] * states.num_leaves)))
    ask = compiled("ask", lambda state: search.ask(state, cube, batch), state, form=asked)
    init: Any = None
    if begins:
        init = compile_soon("the search", begun.lower(), optimization_of(search, batch))
    plan: Any = None
    if search.wants.clauses:
        form = jax.tree.structure(Plan(0, 0, 0))  # pyright: ignore[reportArgumentType]
        plan = compiled("plan", lambda state: search.plan(state, cube, batch), state, form=form)
    tell: Any = None
    if search.learns:
        tell = compiled(
            "tell", lambda state, rows: search.tell(state, cube, rows), state,
            search.wants.form(cube, batch, coverage_ids), form=states,
        )  # fmt: skip
    temperature: Any = lambda state: 1.0  # noqa: E731
    if search.wants.gradient:
        form = jax.tree.structure(0)
        temperature = compiled("temperature", search.temperature, state, form=form)
    return SearchProgram(init, ask, tell, temperature, plan)
