"""Errors that say what was wrong and what to do about it.

>>> raise unknown_name("search", "halten", ["uniform", "halton"])
UnknownNameError: unknown search 'halten'; did you mean 'halton'? Known: uniform, halton.
"""

import difflib
import functools
import importlib
import inspect
from collections.abc import Callable, Iterable, Sequence
from numbers import Number
from typing import Any, ParamSpec, TypeVar, cast

P = ParamSpec("P")
R = TypeVar("R")


class UnknownNameError(ValueError):
    """A name that does not exist, with the nearest ones that do."""


def nearest_names(name: object, known: Iterable[str]) -> str:
    """Return the known names nearest to `name` as a question; empty if none is near."""
    near = difflib.get_close_matches(str(name), list(known), n=2, cutoff=0.5)
    return f"; did you mean {' or '.join(map(repr, near))}?" if near else ""


def unknown_name(kind: str, name: object, known: Iterable[str]) -> UnknownNameError:
    """Make the error for a `name` that is not among the `known` names of this `kind`."""
    known = [str(k) for k in known]
    hint = nearest_names(name, known) or "."
    listing = f" Known: {', '.join(known)}." if known else f" There is no {kind} at all."
    return UnknownNameError(f"unknown {kind} {name!r}{hint}{listing}")


def missing_name(owner: str, kind: str, name: object, known: Iterable[str]) -> UnknownNameError:
    """Make the error for a `name` that `owner` (`the trace`) should have but does not."""
    known = [str(k) for k in known]
    hint = nearest_names(name, known) or "."
    listing = f"It has: {', '.join(known)}." if known else f"It has no {kind} at all."
    return UnknownNameError(f"{owner} has no {kind} {name!r}{hint} {listing}")


def check_names(kind: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raise `UnknownNameError` for the first of `names` that is not `known`."""
    known = list(known)
    for name in names:
        if name not in known:
            raise unknown_name(kind, name, known)


def suggests_options(function: Callable[P, R]) -> Callable[P, R]:
    """Make a misspelt keyword of `function` raise `UnknownNameError` with the nearest keywords.

    Arguments in another order raise `TypeError` with the right order. NumPy numbers are converted
    to Python's, since arithmetic, JSON and JAX treat them differently.
    """
    known = inspect.signature(function).parameters

    @functools.wraps(function)
    def checked(*arguments: P.args, **options: P.kwargs) -> R:
        check_names(f"option of {function.__name__}", options, known)
        _check_order(function.__name__, list(known.values()), arguments)
        plain = {name: _plain_number(value) for name, value in options.items()}
        return cast(Callable[..., R], function)(*map(_plain_number, arguments), **plain)

    return checked


def _check_order(
    name: str, parameters: Sequence[inspect.Parameter], arguments: Sequence[object]
) -> None:
    """Refuse an object of our own in the place of another argument, while its own has none."""
    wanted = [str(getattr(p.annotation, "__name__", p.annotation)) for p in parameters]
    given = [
        {c.__name__ for c in type(value).__mro__ if str(c.__module__).startswith("verifai_jax.")}
        for value in arguments
    ]
    for kind, kinds in zip(wanted, given, strict=False):
        if kind not in kinds and any(
            kind in others and other != kind for other, others in zip(wanted, given, strict=False)
        ):
            order = ", ".join(p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD)
            got = ", ".join(type(value).__name__ for value in arguments)
            raise TypeError(f"{name} takes its arguments as {name}({order}); got ({got})")


def _plain_number(value: object) -> object:
    is_numpy = type(value).__module__ == "numpy" and isinstance(value, Number)
    return value.item() if is_numpy else value  # pyright: ignore[reportAttributeAccessIssue]


def end_if_interrupted(stopped: str | None) -> None:
    """Raise `KeyboardInterrupt` for a result that Ctrl-C cut short, since it is incomplete.

    **Arguments:**
    - `stopped`: the result's reason for ending.
    """
    if stopped == "interrupted":
        raise KeyboardInterrupt


class MissingExtra(ImportError):
    """An optional package that is not installed, with the command that installs it."""


def require(module: str, extra: str) -> Any:
    """Import an optional `module`, which the `extra` of verifai_jax installs.

    **Raises:** `MissingExtra`, one line with the pip command.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        # A package that is there but lacks one of its own is missing all the same.
        lacks = "is" if error.name == module else f"needs {error.name}, which is"
        raise MissingExtra(
            f"{module} {lacks} not installed: pip install 'verifai_jax[{extra}]'"
        ) from error
    except ImportError as error:
        raise MissingExtra(f"{module} is installed but cannot be imported: {error}") from error
