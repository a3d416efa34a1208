"""Searches of the unit cube: `named("cross_entropy", elite=0.2)` or `CrossEntropy(elite=0.2)`."""

import dataclasses
from typing import Any

from verifai_jax.errors import check_names, unknown_name
from verifai_jax.search.base import Cube as Cube
from verifai_jax.search.base import Evaluated as Evaluated
from verifai_jax.search.base import Search as Search
from verifai_jax.search.cross_entropy import CrossEntropy as CrossEntropy
from verifai_jax.search.gradient import Gradient as Gradient
from verifai_jax.search.halton import Halton as Halton
from verifai_jax.search.uniform import Uniform as Uniform

_SEARCHES: dict[str, Any] = {
    "uniform": Uniform,
    "halton": Halton,
    "cross_entropy": CrossEntropy,
    "gradient": Gradient,
}


def names() -> tuple[str, ...]:
    """Names of the searches."""
    return tuple(_SEARCHES)


def named(name: str, **options: Any) -> Search:
    """The search of this name with these options.

    **Raises:** `UnknownNameError` for a name or an option that does not exist; `ValueError` for an
    option out of range.
    """
    if name not in _SEARCHES:
        raise unknown_name("search", name, _SEARCHES)
    kind = _SEARCHES[name]
    check_names(f"option of {name}", options, [field.name for field in dataclasses.fields(kind)])
    return kind(**options)
