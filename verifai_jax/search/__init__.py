"""Searches over the unit cube, by class or by name.

CrossEntropy(elite=0.2)
named("cross_entropy", elite=0.2)
split({"wind": "cross_entropy"}, rest="halton")
"""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from verifai_jax.core.cube import Cube
from verifai_jax.core.errors import check_names, unknown_name
from verifai_jax.search._split import Split
from verifai_jax.search.annealing import Annealing
from verifai_jax.search.bandit import Bandit
from verifai_jax.search.base import Observations, Plan, Search, Wants
from verifai_jax.search.bayes import Bayes
from verifai_jax.search.ce_compat import CECompat
from verifai_jax.search.cmaes import CMAES
from verifai_jax.search.coverage import Coverage
from verifai_jax.search.cross_entropy import CrossEntropy
from verifai_jax.search.descent import Descent
from verifai_jax.search.diverse import Diverse, distinct
from verifai_jax.search.epsilon_greedy import EpsilonGreedy
from verifai_jax.search.gradient import Gradient
from verifai_jax.search.grid import Grid
from verifai_jax.search.halton import Halton
from verifai_jax.search.mutation import Mutation
from verifai_jax.search.point_list import PointList
from verifai_jax.search.portfolio import Portfolio
from verifai_jax.search.sobol import Sobol
from verifai_jax.search.suggested import Absent, Suggested
from verifai_jax.search.trace_surrogate import TraceSurrogate
from verifai_jax.search.turbo import TuRBO
from verifai_jax.search.uniform import Uniform
from verifai_jax.search.wrapper import Wrapper

__all__ = [
    "CMAES", "Annealing", "Bandit", "Bayes", "CECompat", "Coverage", "CrossEntropy", "Cube",
    "Descent", "Diverse", "EpsilonGreedy", "Gradient", "Grid", "Halton", "Mutation",
    "Observations", "Plan", "PointList", "Portfolio", "Search", "Sobol", "Split", "Suggested",
    "TraceSurrogate", "TuRBO", "Uniform", "Wants", "Wrapper", "distinct", "from_json", "named",
    "names", "split",
    "to_json",
]  # fmt: skip


def __dir__() -> list[str]:
    return list(__all__)


_SEARCHES: dict[str, type[Search]] = {
    "uniform": Uniform,
    "halton": Halton,
    "sobol": Sobol,
    "grid": Grid,
    "annealing": Annealing,
    "cross_entropy": CrossEntropy,
    "ce_compat": CECompat,
    "bandit": Bandit,
    "epsilon_greedy": EpsilonGreedy,
    "bayes": Bayes,
    "turbo": TuRBO,
    "trace_surrogate": TraceSurrogate,
    "cmaes": CMAES,
    "mutation": Mutation,
    "coverage": Coverage,
    "gradient": Gradient,
    "descent": Descent,
    "portfolio": Portfolio,
}

_ASKING = tuple(f.name for f in fields(Suggested) if f.name not in ("suggest", "search"))
"""Options of `Suggested` that are plain data."""


def names() -> tuple[str, ...]:
    """Return the names that `named` knows."""
    return tuple(_SEARCHES)


def named(name: str, **options: Any) -> Search:
    """Build a search by its name.

    **Arguments:**

    - `name`: such as `"cross_entropy"`; `names()` lists all.
    - `options`: hyper-parameters of the search, by name.

    **Raises:** `ValueError` for an unknown name or option, or a value out of range.
    """
    if name not in _SEARCHES:
        raise unknown_name("search", name, _SEARCHES)
    known = [field.name for field in fields(_SEARCHES[name])]  # pyright: ignore[reportArgumentType]
    check_names(f"option of search {name}", options, known)
    return _SEARCHES[name](**options)


def split(parts: Mapping[str, str | Search], rest: str | Search = "uniform") -> Split:
    """Build a search that has one for each part of the space; see `Split`.

    **Arguments:**

    - `parts`: feature name -> search, or the name of one.
    - `rest`: the search of all other features.

    **Raises:** as `named` and `Split`.
    """
    return Split({name: _as_search(part) for name, part in parts.items()}, _as_search(rest))


def _as_search(search: str | Search) -> Search:
    return named(search) if isinstance(search, str) else search


def to_json(search: Search) -> dict[str, Any] | None:
    """Describe a search as plain data; None for one that has no name here."""
    if isinstance(search, Split):
        parts = [[name, to_json(part)] for name, part in search.parts]
        rest = to_json(search.rest)
        whole = rest is not None and all(part is not None for _, part in parts)
        return {"split": parts, "rest": rest} if whole else None
    if isinstance(search, Diverse):
        inner = to_json(search.search)
        if inner is None:
            return None
        own = {f.name: getattr(search, f.name) for f in fields(search) if f.name != "search"}
        return {"diverse": inner, "options": own}
    if isinstance(search, Suggested):
        inner = to_json(search.search)
        if inner is None:
            return None
        own = {name: getattr(search, name) for name in _ASKING}
        own["units"] = dict(search.units)
        return {"suggested": inner, "source": search.source, "options": own}
    for name, kind in _SEARCHES.items():
        if type(search) is kind:
            options = {field.name: getattr(search, field.name) for field in fields(search)}  # pyright: ignore[reportArgumentType]
            return {"name": name, "options": options}
    return None


def from_json(data: Mapping[str, Any]) -> Search:
    """Build the search that `to_json` described.

    **Raises:** `ValueError` as `named`, and for data that describes no search.
    """
    if "split" in data:
        return Split(
            {name: from_json(part) for name, part in data["split"]}, from_json(data["rest"])
        )
    if "diverse" in data:
        return Diverse(from_json(data["diverse"]), **data.get("options", {}))
    if "suggested" in data:
        source = Absent(str(data.get("source", "a function")))
        return Suggested(source, from_json(data["suggested"]), **data.get("options", {}))
    if not isinstance(data.get("options"), Mapping):
        raise ValueError(f"this describes no search: {data!r}")
    options = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in data["options"].items()
    }
    return named(data["name"], **options)
