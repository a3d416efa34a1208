"""Searches over the unit cube, by class or by name.

CrossEntropy(elite=0.2)
named("cross_entropy", elite=0.2)
split({"wind": "cross_entropy"}, rest="halton")
"""

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, cast

from verifai_jax.core.display.extensions import entries, extension, extensions
from verifai_jax.core.display.lazy import attach, lazy_import
from verifai_jax.core.messages.errors import check_names, unknown_name

if TYPE_CHECKING:
    from verifai_jax.core.values.cube import Cube as Cube
    from verifai_jax.search._split import Split as Split
    from verifai_jax.search.base import Observations as Observations
    from verifai_jax.search.base import Plan as Plan
    from verifai_jax.search.base import Search as Search
    from verifai_jax.search.base import Wants as Wants
    from verifai_jax.search.cross_entropy import CrossEntropy as CrossEntropy
    from verifai_jax.search.descent import Descent as Descent
    from verifai_jax.search.distances import distinct as distinct
    from verifai_jax.search.gradient import Gradient as Gradient
    from verifai_jax.search.halton import Halton as Halton
    from verifai_jax.search.mutation import Mutation as Mutation
    from verifai_jax.search.point_list import PointList as PointList
    from verifai_jax.search.portfolio import Portfolio as Portfolio
    from verifai_jax.search.uniform import Uniform as Uniform
    from verifai_jax.search.wrapper import Wrapper as Wrapper
_SEARCHES = {
    "uniform": "Uniform",
    "halton": "Halton",
    "cross_entropy": "CrossEntropy",
    "mutation": "Mutation",
    "gradient": "Gradient",
    "descent": "Descent",
    "portfolio": "Portfolio",
}
GROUP = "verifai_jax.searches"
"""Entry points of searches of other packages, by name."""
# Imported when first used: a run needs few of these searches.
__getattr__, __dir__, __all__ = attach(
    __name__, "from_json", "named", "names", "split", "to_json", group=GROUP, classes=True
)


def names() -> tuple[str, ...]:
    """Return the names of all searches that `named` can build."""
    return (*_SEARCHES, *extensions(GROUP))


def named(name: str, **options: Any) -> "Search":
    """Build a search by its name.

    **Arguments:**
    - `name`: such as `"cross_entropy"`; `names()` lists all.
    - `options`: hyper-parameters of the search, by name.
    **Raises:** `ValueError` for an unknown name or option, or a value out of range.
    """
    if name in _SEARCHES:
        kind = lazy_import(__name__, _SEARCHES[name])
    elif name in extensions(GROUP):
        kind = extension(GROUP, name)
    else:
        raise unknown_name("search", name, names())
    check_names(f"option of search {name}", options, [field.name for field in fields(kind)])
    return kind(**options)


def split(parts: "Mapping[str, str | Search]", rest: "str | Search" = "uniform") -> "Split":
    """Build a search with a separate search for each part of the space; see `Split`.

    **Arguments:**
    - `parts`: feature name -> search, or the name of a search.
    - `rest`: the search of all other features.
    **Raises:** the errors of `named` and `Split`.
    """
    from verifai_jax.search._split import Split

    return Split({name: _as_search(part) for name, part in parts.items()}, _as_search(rest))


def _as_search(search: "str | Search") -> "Search":
    return named(search) if isinstance(search, str) else search


def to_json(search: "Search") -> dict[str, Any] | None:
    """Describe a search as plain data; None for one that has no name here."""
    from verifai_jax.search.base import Search

    kind, ours = type(search), type(search).__module__.startswith(f"{__name__}.")
    # By the name of its class, since comparing with the classes would import all of them.
    known = {of: name for name, of in _SEARCHES.items()} if ours else entries(GROUP, classes=True)
    name = known.get(kind.__name__)
    if not ours and (name is None or extension(GROUP, name) is not kind):
        return None
    if ours and kind.__name__ == "Split":
        splits = cast("Split", search)
        parts = [[name, to_json(part)] for name, part in splits.parts]
        rest = to_json(splits.rest)
        whole = rest is not None and all(part is not None for _, part in parts)
        return {"split": parts, "rest": rest} if whole else None
    options = {f.name: getattr(search, f.name) for f in fields(cast(Any, search))}
    inner = {at: to_json(each) for at, each in options.items() if isinstance(each, Search)}
    if name is None or None in inner.values():
        return None
    return {"name": name, "options": options | inner}


def from_json(data: Mapping[str, Any]) -> "Search":
    """Build the search that `to_json` described.

    **Raises:** the errors of `named`; `ValueError` for data that describes no search.
    """
    if "split" in data:
        from verifai_jax.search._split import Split

        return Split(
            {name: from_json(part) for name, part in data["split"]}, from_json(data["rest"])
        )
    if not isinstance(data.get("options"), Mapping):
        raise ValueError(f"this does not describe a search: {data!r}")
    # A search around another one has that as an option.
    made: dict[type, Callable[[Any], Any]] = {list: tuple, dict: from_json}
    options = {at: made.get(type(it), lambda it: it)(it) for at, it in data["options"].items()}
    return named(data["name"], **options)
