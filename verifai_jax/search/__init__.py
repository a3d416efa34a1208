"""Searches over the unit cube, by class or by name.

CrossEntropy(elite=0.2)
named("cross_entropy", elite=0.2)
"""

from dataclasses import fields
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
    """The names that `named` knows."""
    return tuple(_SEARCHES)


def named(name: str, **options: Any) -> Search:
    """The search of that name, with its hyper-parameters.

    **Raises:** `ValueError` for an unknown name or option, or a value out of range.
    """
    if name not in _SEARCHES:
        raise unknown_name("search", name, _SEARCHES)
    known = [field.name for field in fields(_SEARCHES[name])]
    check_names(f"option of search {name}", options, known)
    return _SEARCHES[name](**options)
