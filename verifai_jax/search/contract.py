"""Checks of a user's search: its return values, before anything compiles, and its points.

    check_contract(search, cube)                        # shapes and types, abstractly
    check_points(search, cube, points)                  # values, round by round

`verifai_jax.testing.check_search` tests all laws; here only those are checked on which a run would
fail.
"""

from dataclasses import fields, is_dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from verifai_jax.core.user_code.user_errors import explain_user_error
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Search

BATCH = 16
"""Points of a round with which the forms are checked. Nothing is computed; any number serves."""
COVERAGE_IDS = 4
"""Marks of a point with which the forms are checked; any number serves."""


class SearchError(ValueError):
    """An error for a search that breaks the contract of searches."""


def is_user_defined(search: Search) -> bool:
    """Return whether a search, or a part of it, is defined outside this package."""
    if type(search).__module__.partition(".")[0] != "verifai_jax":
        return True
    parts = [getattr(search, f.name) for f in fields(search)] if is_dataclass(search) else []
    parts = [each for part in parts for each in (part if isinstance(part, tuple) else (part,))]
    return any(is_user_defined(part) for part in parts if isinstance(part, Search))


def check_contract(search: Search, cube: Cube) -> None:
    """Refuse a user's search whose functions return values of wrong shapes.

    Nothing compiles and nothing is simulated.

    **Raises:** `SearchError` with the function's name, and the line of the user's file where it
    raised.
    """
    if not is_user_defined(search):
        return
    key = jax.eval_shape(lambda: jax.random.key(0, impl="threefry2x32"))
    state = _form(search, "init", lambda key: search.init(key, cube, BATCH), key)
    proposed = _form(search, "ask", lambda state: search.ask(state, cube, BATCH), state)
    if not (isinstance(proposed, tuple) and len(proposed) == 2):
        raise SearchError(
            f"ask of search {search!r} must return (points, state); got {type(proposed).__name__}"
        )
    points, following = proposed
    shape, dtype = getattr(points, "shape", None), np.dtype(getattr(points, "dtype", object))
    if shape != (BATCH, cube.dim) or not jnp.issubdtype(dtype, jnp.floating):
        got = type(points).__name__ if shape is None else f"{dtype}{list(shape)}"
        raise SearchError(
            f"ask of search {search!r} must return points float32[{BATCH}, {cube.dim}], a row for "
            f"each of the {BATCH} simulations that were asked for and a column for each coordinate "
            f"({', '.join(cube.names[:6])}{', ...' * (cube.dim > 6)}); got {got}"
        )
    _check_state(search, "ask", state, following)
    if search.learns:
        rows = search.wants.form(cube, BATCH, COVERAGE_IDS)
        updated = _form(search, "tell", lambda s, rows: search.tell(s, cube, rows), state, rows)
        _check_state(search, "tell", state, updated)


def check_points(search: Search, cube: Cube, points: Float[Any, "n d"]) -> None:
    """Refuse points outside the unit cube.

    **Raises:** `SearchError` that names the coordinate and the value.
    """
    values = np.asarray(points)
    inside = (values >= 0) & (values <= 1)
    if inside.all():
        return
    row, column = (int(i) for i in np.argwhere(~inside)[0])
    raise SearchError(
        f"ask of search {search!r} must return points of the unit cube, all entries in [0, 1]; in "
        f"row {row} {cube.names[column]} is {values[row, column]:zg}. Clip them, as in "
        "jnp.clip(points, 0, 1), or draw others where they are not finite"
    )


def _form(search: Search, name: str, function: Any, *arguments: PyTree) -> Any:
    try:
        return jax.eval_shape(function, *arguments)
    except Exception as error:
        why = explain_user_error(error, system=False)
        raise SearchError(f"{name} of search {search!r} cannot be run: {why}") from error


def _check_state(search: Search, name: str, before: PyTree, after: PyTree) -> None:
    must = f"{name} of search {search!r} must return the state in the form that init gave it"
    if jax.tree.structure(before) != jax.tree.structure(after):
        raise SearchError(f"{must}, {_outline(before)}; got {_outline(after)}")
    pairs = zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True)
    for (path, one), two in pairs:
        if (one.shape, one.dtype) != (two.shape, two.dtype):
            raise SearchError(
                f"{must}; its part {jax.tree_util.keystr(path) or 'state'} was {_leaf(one)} and "
                f"became {_leaf(two)}"
            )


def _leaf(leaf: Array | jax.ShapeDtypeStruct) -> str:
    return f"{leaf.dtype}{list(leaf.shape)}"


def _outline(state: PyTree) -> str:
    return ", ".join(_leaf(leaf) for leaf in jax.tree.leaves(state)) or "nothing"
