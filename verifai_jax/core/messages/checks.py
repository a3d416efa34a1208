"""Checks of numbers that a user gives; each error names the argument, its range and its value.

>>> check_fraction("confidence", 95)
Traceback (most recent call last):
ValueError: confidence must lie between 0 and 1; got 95
"""

import math
import operator
from dataclasses import fields
from typing import Any, SupportsIndex, TypeGuard, TypeVar, cast

import numpy as np

from verifai_jax.core.messages.text import is_control

T = TypeVar("T")


def is_number(value: object) -> TypeGuard[float]:
    """Return whether this is a real number of Python or NumPy, but not a truth value."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def check_name(
    what: str, name: object, *, lines: bool = False, error: type[ValueError] = ValueError
) -> str:
    """Check a name for use in tables and files.

    **Arguments:**
    - `what`: a description of the named object, for the message: `the name of a signal`.
    - `lines`: whether it may have line breaks and other control characters.
    - `error`: type of the error to raise.
    **Raises:** `error` for anything but a non-empty text that UTF-8 can encode.
    """
    if not isinstance(name, str) or not name:
        raise error(f"{what} must be a text that is not empty; got {name!r}")
    try:
        name.encode()
    except UnicodeEncodeError as cause:
        raise error(
            f"{what} must be a text that UTF-8 can hold; {name!r} has the lone surrogate "
            f"{cause.object[cause.start]!r}"
        ) from None
    if not lines and any(is_control(character) for character in name):
        raise error(
            f"{what} must be one line without control characters, as people read it in summaries; "
            f"got {name!r}"
        )
    return name


def check_fraction(
    name: str, value: object, *, zero: bool = False, one: bool = False,
    error: type[ValueError] = ValueError,
) -> float:  # fmt: skip
    """Check a probability or another share.

    **Arguments:**
    - `name`: name of the argument in the error message.
    - `zero`: whether 0 itself is allowed.
    - `one`: whether 1 itself is allowed.
    - `error`: type of the error to raise.
    **Raises:** `error` unless `0 < value < 1`, or the value is an allowed end.
    """
    if is_number(value) and (0 < value < 1 or (zero and value == 0) or (one and value == 1)):
        return value
    allowed = "must lie between 0 and 1"
    if zero or one:
        allowed = f"must be in {'[' if zero else '('}0, 1{']' if one else ')'}"
    raise error(f"{name} {allowed}; got {value!r}")


def check_positive(
    name: str, value: object, *, finite: bool = False, error: type[ValueError] = ValueError
) -> float:
    """Check a number above zero.

    **Arguments:**
    - `name`: name of the argument in the error message.
    - `finite`: whether infinity is refused too.
    - `error`: type of the error to raise.
    **Raises:** `error` unless `value > 0`.
    """
    if not (is_number(value) and value > 0 and not (finite and math.isinf(value))):
        raise error(f"{name} must be positive{' and finite' if finite else ''}; got {value!r}")
    return value


def check_count(
    name: str, value: object, minimum: int = 1, *, error: type[ValueError] = ValueError
) -> int:
    """Check a whole number.

    **Arguments:**
    - `name`: name of the argument in the error message.
    - `value`: value to check; NumPy integers are allowed, truth values and floats are not.
    - `minimum`: smallest value allowed.
    - `error`: type of the error to raise.
    **Returns:** the value as a Python integer.
    **Raises:** `error` for anything but an integer of at least `minimum`.
    """
    count = None
    if isinstance(value, SupportsIndex) and not isinstance(value, bool | np.bool_):
        try:
            count = operator.index(value)
        except TypeError:  # An array of floats, or of several numbers.
            count = None
    if count is None or count < minimum:
        raise error(f"{name} must be an integer of at least {minimum}; got {value!r}")
    return count


def check_options(budget: object, batch: object, seed: object) -> None:
    """Refuse numbers out of range."""
    check_count("budget", budget)
    check_count("batch", batch)
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or not 0 <= seed < 2**63:
        raise ValueError(f"seed must be an integer from 0 to 2**63 - 1; got {seed!r}")


def options_of(verb: str, kind: type[T], given: T | None, *used: str) -> T:
    """Return the options that a value holds, or their defaults if it is None.

    **Arguments:**
    - `verb`: name of the public function, for the error message.
    - `kind`: the frozen dataclass of the value, such as `Stop`.
    - `used`: fields that the function uses; all when left out.
    **Raises:** `TypeError` for another object; `ValueError` if another field is set.
    """
    if given is None:
        return kind()
    if not isinstance(given, kind):
        raise TypeError(f"{verb} needs a vj.{kind.__name__}; got {given!r}")
    for field in fields(cast(Any, kind)):
        if used and field.name not in used and getattr(given, field.name) != field.default:
            allowed = ", ".join(f"{name}=" for name in used)
            raise ValueError(
                f"{verb} does not use {field.name}= of vj.{kind.__name__}; it uses {allowed}"
            )
    return given
