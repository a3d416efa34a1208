"""Plain data of domains, for JSON: `to_plain(domain)` and back.

Data holds a `kind`, the name of a domain, and the `arguments` of that domain. Code, such as the
functions of a `Distribution`, is not data: give it again by name.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from jaxtyping import PyTree

from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.display.extensions import extension, extensions
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.features.arrays import Array, VariableArray
from verifai_jax.features.box import Box
from verifai_jax.features.choice import Categorical
from verifai_jax.features.compound import Struct
from verifai_jax.features.custom import Distribution
from verifai_jax.features.domain import Domain
from verifai_jax.features.fixed import Fixed
from verifai_jax.features.signal import Signal
from verifai_jax.features.tabulated import Empirical

GROUP = "verifai_jax.domains"
"""Entry points of the domains of add-ons and of other packages, each named as its class."""
SIGNAL_OPTIONS = ("times", "width")
"""Arguments of a Signal that are written where they are given."""


def to_plain(domain: Domain) -> dict[str, Any]:
    """Convert a domain to dictionaries, lists, texts and numbers.

    **Raises:** `ValueError` for a user's own domain, or choices that are not plain data.
    """
    match domain:
        case Struct():
            fields = [[name, to_plain(field)] for name, field in domain.fields]
            return {"kind": "Struct", "fields": fields}
        case VariableArray():
            length = [domain.shortest, domain.longest]
            return {"kind": "Array", "domain": to_plain(domain.domain), "length": length}
        case Categorical():
            for choice in domain.choices:
                if not isinstance(choice, bool | int | float | str | None):
                    raise ValueError(f"the choice {choice!r} is not plain data")
            weights = None if domain.probabilities is None else list(domain.probabilities)
            return {"kind": "Categorical", "choices": list(domain.choices), "weights": weights}
        case Fixed():
            row = [list(entry) for entry in domain.row]
            return {"kind": "Fixed", "domain": to_plain(domain.domain), "row": row}
        case Distribution():
            return {"kind": "Distribution", "name": domain.name}
    if (own := domain.plain(to_plain)) is not None:
        return {"kind": type(domain).__name__, **own}
    if domain.arguments is None:
        raise ValueError(f"{domain!r} is a domain of your own, which JSON cannot describe")
    data: dict[str, Any] = {"kind": type(domain).__name__}
    for name in domain.arguments:
        value = getattr(domain, name)
        data[name] = to_plain(value) if isinstance(value, Domain) else _lists(value)
    if isinstance(domain, Box) and domain.closed != "both":
        data["closed"] = domain.closed
    if isinstance(domain, Signal):
        options = {name: _lists(getattr(domain, name)) for name in SIGNAL_OPTIONS}
        data |= {name: value for name, value in options.items() if value is not None}
    return data


def from_plain(
    data: Mapping[str, Any], distributions: Mapping[str, Distribution] | None = None
) -> Domain:
    """Build the domain that `to_plain` described.

    **Arguments:**
    - `data`: data returned by `to_plain`.
    - `distributions`: the distributions that have functions, by name.
    **Raises:** `ValueError` for an unknown kind, a distribution that is not given, missing parts;
    the errors of the domain.
    """
    try:
        return _build(data, distributions or {})
    except (KeyError, TypeError) as error:
        raise ValueError(f"this does not describe a domain ({error}): {data!r}") from error


def _build(data: Mapping[str, Any], distributions: Mapping[str, Distribution]) -> Domain:
    kind = data["kind"]
    match kind:
        case "Struct":
            names = [name for name, _ in data["fields"]]
            for name in names:
                if names.count(name) > 1:
                    raise ValueError(f"the name {name!r} comes twice; got {names}")
            return Struct(
                {name: from_plain(field, distributions) for name, field in data["fields"]}
            )
        case "Array":
            length: Any = data["length"]
            length = tuple(length) if isinstance(length, list) else length
            return Array(from_plain(data["domain"], distributions), length)
        case "Categorical":
            return Categorical(*data["choices"], weights=data["weights"])
        case "Fixed":
            domain = from_plain(data["domain"], distributions)
            with in_precision("float64"):
                return Fixed(domain, domain.from_columns(dict(data["row"]), ""))
        case "Distribution":
            if data["name"] not in distributions:
                raise ValueError(
                    f"the functions of Distribution {data['name']!r} are code, which JSON cannot "
                    "contain; give it: from_json(data, distributions={...})"
                )
            return distributions[data["name"]]
    if kind in extensions(GROUP):
        return extension(GROUP, kind).from_plain(data, lambda one: from_plain(one, distributions))
    kinds = {each.__name__: each for each in _kinds(Domain)}
    if kind not in kinds:
        others = ("Struct", "Categorical", "Fixed", "Distribution", *extensions(GROUP))
        raise unknown_name("kind of domain", kind, (*kinds, *others))
    arguments: dict[str, Any] = {
        name: from_plain(data[name], distributions) if name == "domain" else data[name]
        for name in kinds[kind].arguments or ()
    }
    if kind == "Empirical":
        return Empirical.from_ranks(**arguments)
    if kind == "Box" and "closed" in data:
        arguments["closed"] = data["closed"]
    if kind == "Signal":
        arguments |= {name: data[name] for name in SIGNAL_OPTIONS if name in data}
    return kinds[kind](**arguments)


def _kinds(kind: type[Domain]) -> Iterator[type[Domain]]:
    """Yield the domains of this package that their arguments describe."""
    for below in kind.__subclasses__():
        if below.__module__.startswith("verifai_jax.") and "arguments" in vars(below):
            yield below
        yield from _kinds(below)


def _lists(value: PyTree) -> PyTree:
    return [_lists(entry) for entry in value] if isinstance(value, tuple) else value
