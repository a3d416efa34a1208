"""Callbacks of long computations: called after each round or update, with plain numbers.

    def show(step, values):
        print(step, values["counterexamples"])

    falsify(problem, callbacks=[show, CSVLogger("progress.csv")])

A step is a count that grows (simulations, environment steps, policies), and values are numbers by
name, so that most loggers' own functions fit: `lambda step, values: wandb.log(values, step=step)`.
Callbacks cannot change a result; an error that one raises ends the computation.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import TypeAlias

from verifai_jax.core.user_code.forks import returning_once

Values: TypeAlias = Mapping[str, float]
"""Numbers by name."""
Callback: TypeAlias = Callable[[int, dict[str, float]], object]
"""A function of a step and of the values then."""


def check_callbacks(callbacks: Iterable[Callback]) -> tuple[Callback, ...]:
    """Return the callbacks as a tuple.

    **Raises:** `TypeError` for an object that cannot be called.
    """
    if callable(callbacks):
        raise TypeError(f"callbacks must be a list of functions; got {callbacks!r}, so write [it]")
    result = tuple(callbacks)
    for callback in result:
        if not callable(callback):
            raise TypeError(
                "callbacks must be functions of a step and a dictionary of numbers; got "
                f"{callback!r}"
            )
    return result


def notify(callbacks: Iterable[Callback], step: int, values: Values) -> None:
    """Call each callback with a step and its own copy of the numeric values."""
    # What is not a number, as the return of no episode, is left out: loggers store it as one.
    known = {name: value for name, value in values.items() if value == value}
    for callback in callbacks:
        with returning_once():
            callback(int(step), dict(known))
