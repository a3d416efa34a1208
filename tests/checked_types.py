"""The type checker of the tests: beartype, which takes NumPy's numbers for Python's.

check_first_calls()
install_import_hook("verifai_jax.addons.estimation", "checked_types.check")
with unchecked():
    estimate("no problem")          # the function's own message, not the checker's
"""

import contextlib
import functools
import inspect
from collections import Counter
from collections.abc import Callable, Iterator
from types import CodeType
from typing import Any
from weakref import WeakKeyDictionary

import jaxtyping
import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype

NUMBERS = FrozenDict({int: int | np.integer, float: float | int | np.floating | np.integer})
"""An integer will do where a number is wanted, and NumPy's scalars are numbers."""

check = beartype(conf=BeartypeConf(hint_overrides=NUMBERS))


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Let values of a wrong kind through, to read what a function itself says of them."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


CALLS = 50
"""Calls of a function that are checked in a process, of all calls the first: a wrong annotation
shows in one of these, and a million checks take longer than what they look at."""

INSTANCES = 3
"""Functions made within another one, by the same lines of it, whose calls are checked."""

COUNTED: WeakKeyDictionary[Callable[..., Any], int] = WeakKeyDictionary()
"""Calls so far. A variable of each function would be memory that it keeps from call to call, of
which the package warns."""


def check_first_calls() -> None:
    """Let jaxtyping's import hook make the checks of a function when it is called, and not always.

    Before a module is imported under the hook.
    """
    whole = jaxtyping.jaxtyped
    made: Counter[CodeType] = Counter()

    def jaxtyped(fn: Any = None, *, typechecker: Any) -> Any:
        if fn is None:
            return functools.partial(jaxtyped, typechecker=typechecker)
        if not inspect.isfunction(fn):
            return whole(typechecker=typechecker)(fn)
        made[fn.__code__] += 1
        if made[fn.__code__] > INSTANCES:
            return fn
        checked: list[Callable[..., Any]] = []

        @functools.wraps(fn)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            __tracebackhide__ = True
            if (calls := COUNTED.get(fn, 0)) >= CALLS:
                return fn(*args, **kwargs)
            COUNTED[fn] = calls + 1
            if not checked:
                checked.append(whole(typechecker=typechecker)(fn))
            return checked[0](*args, **kwargs)

        # What makes a model is told by the files of its functions: this one is no part of any.
        wrapped.__code__ = wrapped.__code__.replace(co_filename=fn.__code__.co_filename)
        return wrapped

    jaxtyping.jaxtyped = jaxtyped
